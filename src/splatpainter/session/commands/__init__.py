"""The parts of a session, each a topic of what can be done with it: session.layers, .strokes, .masks, .selections, ...

All of them stand on one SessionCore (session_core.py), which alone commits.
"""
