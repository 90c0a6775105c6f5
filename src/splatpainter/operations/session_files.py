"""Files of sessions that an operation's options may name: projects, whose selections and layers are regions, and
adjustment layers, which are looks. Sessions stand above this room; their room brings what reads them when it is
imported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    import numpy as np

    from splatpainter.splats import Splats

Weigh: TypeAlias = "Callable[[Splats], np.ndarray]"
"""An asset -> [N] 0..1: how much of each Gaussian belongs to something."""


@dataclass(frozen=True)
class SessionFiles:
    """What reads them."""

    region: Callable[[str, str], Weigh]
    """("selection" or "layer", NAME@PROJECT.splatproj) -> what it weighs."""
    look: Callable[[Path], Any]
    """A .splatlayer -> a look (grade.Look)."""


_readers: list[SessionFiles] = []


def read_session_files_with(readers: SessionFiles) -> None:
    """Set what reads them."""
    _readers[:] = [readers]


def session_files(what: str) -> SessionFiles:
    """What reads them. what: the file or term that is to be read. Raises ValueError where no session is loaded."""
    if not _readers:
        raise ValueError(f"{what}: is of a session; import splatpainter.session before it is read")
    return _readers[0]
