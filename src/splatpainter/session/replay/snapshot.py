"""A version of what a session shows."""

from __future__ import annotations

from dataclasses import field

from splatpainter.session.document.document import Document
from splatpainter.session.project.project_file import Step
from splatpainter.session.replay.layer_state import LayerState
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Snapshot:
    """One immutable version of the asset, for readers in other threads."""

    version: int
    """Goes up with every change of the Gaussians."""
    state: LayerState
    document: Document
    history: tuple[Step, ...]
    """Oldest first; the first one is the asset as it was opened."""
    cursor: int
    """Index in the history of the step in effect."""
    original: Splats = field(repr=False)
    """What it is made of: the asset as it was opened, or all visible assets as they stand."""

    @property
    def splats(self) -> Splats:
        return self.state.splats
