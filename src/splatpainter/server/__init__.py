"""The browser studio's server: one session, its HTTP and socket API, and the built front end in static/.

messages/ is the one definition of what travels; web/src/messages.ts is generated from it (schema.py).
"""
