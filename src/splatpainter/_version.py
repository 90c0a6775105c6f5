"""The version, for everybody in the package: its __init__ imports nobody that imports it."""

__version__ = "0.1.0"
