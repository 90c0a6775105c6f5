"""What does not come with the core: which distribution brings a module, and the one line said where it is missing."""

from __future__ import annotations

import importlib.util

EXTRAS = {
    "torch": "networks",
    "safetensors": "networks",
    "scipy": "train",
    "trimesh": "train",
    "mitsuba": "train",
    "fast_simplification": "mesh",
}
"""Module -> the extra of this distribution that brings it. Those that one function alone imports are named there."""


def require(module: str, purpose: str) -> None:
    """Raise ValueError, in one line, where a module of EXTRAS cannot be imported. Looks for it without importing it, so
    that this can be asked before anything is read. purpose: what needs it, as the beginning of that line."""
    if importlib.util.find_spec(module) is None:
        raise ValueError(missing(module, purpose))


def missing(module: str, purpose: str) -> str:
    """The one line."""
    return f"{purpose} needs {module}, which is not installed; pip install 'splatpainter[{EXTRAS[module]}]'"
