"""The browser studio's server: one session, its HTTP and socket API, and the built front end in static/.

protocol.py and commands/ define every message; web/src/messages.ts is generated from them (schema.py).
"""
