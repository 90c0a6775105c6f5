"""The picture sources of this package, one module each: DESCRIPTION, and open_source(options) for the dataclass of
options that it names. `sources/registry.py` imports them when they are asked for."""
