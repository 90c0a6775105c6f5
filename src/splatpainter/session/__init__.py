"""Sessions: layers over an asset, undo and redo, and the project file. Begin with session.py.

Names are imported on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from splatpainter.session.delta import AssetDelta as AssetDelta
    from splatpainter.session.document import Layer as Layer
    from splatpainter.session.document import View as View
    from splatpainter.session.session import Session as Session
    from splatpainter.session.session import Snapshot as Snapshot

_MODULES = {"Session": "session", "Snapshot": "session", "Layer": "document", "View": "document", "AssetDelta": "delta"}
__all__ = ["AssetDelta", "Layer", "Session", "Snapshot", "View"]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f"splatpainter.session.{_MODULES[name]}"), name)
    raise AttributeError(f"module 'splatpainter.session' has no attribute {name!r}")
