"""session.selections: which Gaussians are chosen, by name in the project, and by the assets of a scene."""

from __future__ import annotations

import base64
import contextlib
from dataclasses import field
from pathlib import Path

import numpy as np

from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID
from splatpainter.session.project.project_file import Project
from splatpainter.session.selection.selection import Selection
from splatpainter.splats import Splats
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass

SELECTION_FACT = "selection "
"""Beginning of the names of facts that hold selections."""
MAX_SELECTIONS, MAX_SELECTION_NAME = 64, 80
"""Most selections of a project, and most characters of a name."""


@dataclass(frozen=True)
class SelectedPart:
    """What is selected of one asset."""

    asset: str
    """Its id."""
    weights: np.ndarray = field(repr=False)
    """[N] float32 of `splats`."""
    splats: Splats = field(repr=False)
    """The asset in its own space, with its layers; `original` without."""
    original: Splats = field(repr=False)


class SessionSelections:
    """Selections that the project keeps under names. Not part of the history."""

    def __init__(self, core: SessionCore) -> None:
        self._core = core

    def names(self) -> list[str]:
        """Names of the selections that the project keeps, ascending."""
        return [name.removeprefix(SELECTION_FACT) for name in self._core.project.facts_named(SELECTION_FACT)]

    def save(self, name: str, weights: np.ndarray) -> None:
        """Keep a selection under a name (one of that name is replaced). weights: [N] 0..1 of `Session.splats`."""
        names, core = self.names(), self._core
        if not name or len(name) > MAX_SELECTION_NAME or (name not in names and len(names) >= MAX_SELECTIONS):
            raise ValueError(
                f"selection: expected a name of at most {MAX_SELECTION_NAME} characters, and at most {MAX_SELECTIONS}"
            )
        # As a Selection, which still holds when layers come and go.
        data = Selection.of(core.checked_weights(weights), core.splats, core.original).to_png()
        core.project.set_fact(SELECTION_FACT + name, base64.b64encode(data).decode())

    def load(self, name: str) -> np.ndarray:
        """[N] float32 weights of a selection that is kept, on the Gaussians as they are now. Raises ValueError."""
        core = self._core
        text = core.project.fact(SELECTION_FACT + name)
        if text is None:
            raise ValueError(f"selection: expected one of {', '.join(self.names()) or 'none'}, got {brief(name)}")
        where = f"selection {brief(name)}"
        try:
            data = base64.b64decode(text, validate=True)
        except ValueError:
            raise ValueError(f"{where}: is damaged") from None
        return Selection.from_png(data, len(core.original), where).on(core.splats, core.original)

    def delete(self, name: str) -> None:
        """Forget a selection; one that is not kept is no error."""
        self._core.project.delete_fact(SELECTION_FACT + name)

    def by_asset(self, weights: np.ndarray) -> list[SelectedPart]:
        """Weights of the scene by asset, those of which anything is selected, the most first. Those of one asset: as
        they are."""
        core = self._core
        if not core.document.assets:
            snapshot = core.snapshot
            return [SelectedPart(MAIN_ASSET_ID, weights, snapshot.splats, snapshot.original)]
        # Weights of the scene are by its ids, those of a layer by its asset's.
        parts = [
            SelectedPart(part.asset.id, weights[part.scene_ids], part.state.splats, part.original)
            for part in core.scene().parts
        ]
        return sorted((part for part in parts if part.weights.any()), key=lambda part: -float(part.weights.sum()))


def keep_selection(project: Path, name: str, png: bytes | str) -> None:
    """Put a selection into a project that nobody has open. png: its bytes, or the name of one that it keeps already.
    Raises ValueError for an unknown one."""
    with contextlib.closing(Project.open(project, readonly=False)) as opened:
        text = opened.fact(SELECTION_FACT + png) if isinstance(png, str) else base64.b64encode(png).decode()
        if text is None:
            raise ValueError(f"selection: the project holds none called {brief(png)}")
        opened.set_fact(SELECTION_FACT + name, text)
