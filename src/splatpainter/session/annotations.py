"""What a project keeps beside its layers and their history: bookmarks, how the asset stands, selections by name."""

from __future__ import annotations

import base64
import contextlib
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.cameras import UPS, Camera
from splatpainter.jsonio import brief
from splatpainter.session.orientation import Orientation, azimuth_of, measure, parsed_direction
from splatpainter.session.project_file import Bookmark, Project
from splatpainter.session.project_summary import PICTURE_FACT
from splatpainter.session.selection import Selection

if TYPE_CHECKING:
    from splatpainter.splats import Splats

SELECTION_FACT = "selection "
"""Beginning of the names of facts that hold selections."""
MAX_SELECTIONS, MAX_SELECTION_NAME = 64, 80
"""Most selections of a project, and most characters of a name."""


def keep_selection(project: Path, name: str, png: bytes | str) -> None:
    """Put a selection into a project that nobody has open. png: its bytes, or the name of one that it keeps already.
    Raises ValueError for an unknown one."""
    with contextlib.closing(Project.open(project, readonly=False)) as opened:
        text = opened.fact(SELECTION_FACT + png) if isinstance(png, str) else base64.b64encode(png).decode()
        if text is None:
            raise ValueError(f"selection: the project holds none called {brief(png)}")
        opened.set_fact(SELECTION_FACT + name, text)


class Annotations:
    """Part of a Session. None of it is a step of the history, and none changes a Gaussian."""

    _project: Project
    _oriented: tuple[tuple[str | None, str | None], Orientation] | None = None

    @property
    def original(self) -> Splats:
        """The Gaussians as they were opened."""
        raise NotImplementedError

    @property
    def splats(self) -> Splats:
        """The Gaussians as they are now."""
        raise NotImplementedError

    # ---- how the asset stands

    @property
    def up(self) -> str:
        """Which way of the asset is up on the screen: a key of cameras.UPS; measured where nobody has said it."""
        return self._orientation().up

    @property
    def front(self) -> float:
        """From which side the asset is seen first: degrees around `up`, the `start` of cameras.orbit; measured where
        nobody has said it."""
        return self._orientation().front

    @property
    def oriented(self) -> bool:
        """Whether somebody has said which way is up, or where the front is."""
        return bool(self._project.fact("up") or self._project.fact("front"))

    def _orientation(self) -> Orientation:
        up, front = self._project.fact("up"), self._project.fact("front")
        key = (up, front)
        if self._oriented is None or self._oriented[0] != key:
            chosen = measure(self.original, up if up in UPS else None)
            if front:
                chosen = replace(chosen, front=azimuth_of(parsed_direction(front), chosen.up))
            self._oriented = (key, chosen)
        return self._oriented[1]

    def set_up(self, up: str) -> None:
        """Which way of the asset is up on the screen: a key of cameras.UPS. Kept in the project, not part of the
        history; no Gaussian changes. Raises ValueError for another one."""
        if up not in UPS:
            raise ValueError(f"up: expected one of {', '.join(UPS)}, got {str(up)[:20]!r}")
        self._project.set_fact("up", up)

    def set_front(self, camera: Camera) -> None:
        """The side that a view shows is the front, from which the asset is seen first. Kept as `set_up` keeps it."""
        self._project.set_fact("front", json.dumps(np.round(camera.forward, 6).tolist()))

    def set_picture(self, png: bytes) -> None:
        """A small PNG of the asset as it is now, for lists of projects (summary.py). Not part of the history."""
        self._project.set_fact(PICTURE_FACT, base64.b64encode(png).decode())

    @property
    def has_picture(self) -> bool:
        """Whether a bookmark's picture was set."""
        return self._project.fact(PICTURE_FACT) is not None

    # ---- bookmarks

    def bookmarks(self) -> list[Bookmark]:
        """Views to come back to. Not part of the history."""
        return self._project.bookmarks()

    def add_bookmark(self, name: str, camera: Camera) -> str:
        """Add a bookmark; returns its id."""
        return self._project.add_bookmark(name, camera)

    def delete_bookmark(self, bookmark: str) -> None:
        self._project.delete_bookmark(bookmark)

    # ---- selections

    def selections(self) -> list[str]:
        """Names of the selections that the project keeps. Not part of the history."""
        return [name.removeprefix(SELECTION_FACT) for name in self._project.facts_named(SELECTION_FACT)]

    def save_selection(self, name: str, weights: np.ndarray) -> None:
        """Keep a selection under a name (one of that name is replaced). weights: [N] 0..1 of `splats`."""
        names = self.selections()
        if not name or len(name) > MAX_SELECTION_NAME or (name not in names and len(names) >= MAX_SELECTIONS):
            raise ValueError(
                f"selection: expected a name of at most {MAX_SELECTION_NAME} characters, and at most {MAX_SELECTIONS}"
            )
        data = Selection.of(self._weights(weights), self.splats, self.original).to_png()
        self._project.set_fact(SELECTION_FACT + name, base64.b64encode(data).decode())

    def selection(self, name: str) -> np.ndarray:
        """[N] float32 weights of a selection that is kept, on the Gaussians as they are now. Raises ValueError."""
        text = self._project.fact(SELECTION_FACT + name)
        if text is None:
            raise ValueError(f"selection: expected one of {', '.join(self.selections()) or 'none'}, got {brief(name)}")
        where = f"selection {brief(name)}"
        try:
            data = base64.b64decode(text, validate=True)
        except ValueError:
            raise ValueError(f"{where}: is damaged") from None
        return Selection.from_png(data, len(self.original), where).on(self.splats, self.original)

    def delete_selection(self, name: str) -> None:
        self._project.delete_fact(SELECTION_FACT + name)

    def _weights(self, weights: np.ndarray) -> np.ndarray:
        weights = np.asarray(weights, np.float32)
        if weights.shape != (len(self.splats),) or not np.isfinite(weights).all():
            raise ValueError(f"selection: expected [{len(self.splats)}] finite weights, got {list(weights.shape)}")
        return weights
