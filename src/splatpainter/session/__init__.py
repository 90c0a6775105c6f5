"""Sessions: layers over an asset, undo and redo, and the project file. Begin with session.py, which
names the parts; they stand in commands/, on the rooms document, replay, project, selection and measures.

Names are imported on first use.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpainter.operations.session_files import SessionFiles, Weigh, read_session_files_with

if TYPE_CHECKING:
    from splatpainter.session.document.document import Layer as Layer
    from splatpainter.session.document.document import View as View
    from splatpainter.session.replay.delta import AssetDelta as AssetDelta
    from splatpainter.session.replay.snapshot import Snapshot as Snapshot
    from splatpainter.session.session import Session as Session

_MODULES = {
    "Session": "session",
    "Snapshot": "replay.snapshot",
    "Layer": "document.document",
    "View": "document.document",
    "AssetDelta": "replay.delta",
}
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
