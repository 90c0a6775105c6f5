"""Sessions: layers over an asset, undo and redo, and the project file. Begin with session.py.

Names are imported on first use.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpainter.operations.session_files import SessionFiles, Weigh, read_session_files_with

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


def _region(name: str, text: str) -> Weigh:
    from splatpainter.session.operation_files import project_term

    return project_term(name, text)


def _look(path: Path) -> Any:
    from splatpainter.session.operation_files import look_of_layer

    return look_of_layer(path)


read_session_files_with(SessionFiles(_region, _look))
