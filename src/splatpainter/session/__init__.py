"""Sessions: layers over an asset, undo and redo, and the project file. Begin with session.py.

Names are imported on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatpainter.session.changes import AssetDelta as AssetDelta
    from splatpainter.session.layers import Layer as Layer
    from splatpainter.session.layers import View as View
    from splatpainter.session.reader import Shown as Shown
    from splatpainter.session.session import Session as Session

_HOME = {"Session": "session", "Shown": "reader", "Layer": "layers", "View": "layers", "AssetDelta": "changes"}
__all__ = ["AssetDelta", "Layer", "Session", "Shown", "View"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"splatpainter.session.{_HOME[name]}"), name)
    raise AttributeError(f"module 'splatpainter.session' has no attribute {name!r}")
