"""What is selected now, of one session: the same for all its windows. Not part of the project until it gets a name.

A selection that was drawn on a view is also kept as it was drawn: on that view paint ends at the drawn edge, to the
pixel, and not where the Gaussians under it happen to end.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.rendering.pixel_shares import beside_mask
from splatpainter.server.selection_history import SelectionHistory, SelectionState
from splatpainter.session import Session
from splatpainter.session.selection.selection import Combine, Selection, combined, view_and_points, view_of
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

SHARPEN = (0.3, 0.7)
"""Shares of a pixel between which a rendered selection goes from 0 to 1: its Gaussians overlap."""


@dataclass(frozen=True)
class DrawnArea:
    """What is selected of a view, as it was drawn there."""

    camera: Camera
    mask: np.ndarray
    """[H, W] 0..1."""
    is_all: bool
    """Whether nothing that is selected was chosen in another way or on another view."""

    @property
    def view(self) -> bytes:
        return _key(self.camera)


class CurrentSelection:
    """Changed by one thread at a time; read by any."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.revision = 0
        """Goes up with every change."""
        self.gaussians = 0
        """How many are selected by half or more, when it was chosen."""
        self._history = SelectionHistory()
        self._state = SelectionState(None, 0, None)
        self._noted: int | None = None
        """The step of the history that was in effect after the latest command."""
        self._selection: Selection | None = None
        self._previous: Selection | None = None
        self._drawn: DrawnArea | None = None
        self._weights: tuple[int, int, np.ndarray] | None = None
        self._view: tuple[bytes, int, int, np.ndarray, np.ndarray] | None = None
        self._lock = threading.Lock()

    def __bool__(self) -> bool:
        return self._selection is not None

    def weights(self) -> np.ndarray | None:
        """[N] float32 of the Gaussians as they are now; None: nothing is selected, everything may change."""
        selection, snapshot = self._selection, self.session.snapshot
        if selection is None:
            return None
        cached = self._weights
        # Kept for one revision and one version: every tool asks for them, and placing them costs a pass over all.
        if cached is None or cached[:2] != (self.revision, snapshot.version):
            weights = selection.on(snapshot.splats, self.session.original)
            cached = self._weights = (self.revision, snapshot.version, weights)
        return cached[2]

    def choose(self, weights: np.ndarray | None) -> None:
        """Select these ([N] of the Gaussians as they are now); None, or none of them: nothing."""
        splats = self.session.splats
        selection = None
        if weights is not None and (weights > 0).any():
            # Weights of the original, points elsewhere: layers that come and go change which Gaussians there are.
            selection = Selection.of(weights, splats, self.session.original)
        self._set(selection, 0 if weights is None else int((weights >= 0.5).sum()), None)

    def choose_area(self, weights: np.ndarray, camera: Camera, mask: np.ndarray, how: Combine) -> None:
        """Apply what a mask on a view selects. weights: [N]; mask: [H, W] 0..1."""
        # The view is asked for before the choice changes it, and the drawn edge is kept only if anything was selected.
        before, of_before = self.view(camera), self._drawn
        drawn = combined(before, mask, how)
        is_all = how == "replace" or not self
        is_all |= of_before is not None and of_before.is_all and of_before.view == _key(camera)
        self.choose(combined(self.weights(), weights, how))
        if self:
            self._drawn = DrawnArea(camera, drawn, is_all)

    def beside(self) -> np.ndarray | None:
        """[N] bool: Gaussians that are drawn beside the outline, where one view's outline is all of the selection."""
        drawn = self._drawn
        if drawn is None or not drawn.is_all:
            return None
        return beside_mask(self.session.splats, drawn.camera, drawn.mask)

    def reselect(self) -> None:
        """Select what was selected before."""
        selection = self._previous
        if selection is not None:
            weights = selection.on(self.session.splats, self.session.original)
            self._set(selection, int((weights >= 0.5).sum()), None)

    def invert(self, weights: np.ndarray) -> None:
        """Select these, which are the rest; what was drawn is turned round too."""
        drawn = self._drawn
        self.choose(weights)
        if self and drawn is not None:
            self._drawn = replace(drawn, mask=1 - drawn.mask, is_all=False)

    def view(self, camera: Camera) -> np.ndarray | None:
        """[H, W] float32 0..1: what of a view is selected; None: nothing is, all of it may be painted."""
        seen = self.view_and_points(camera)
        return None if seen is None else seen[0]

    def view_and_points(self, camera: Camera) -> tuple[np.ndarray, np.ndarray] | None:
        """(`view`, [M, 2] pixels of what is selected and too faint to be seen there); None: nothing is selected."""
        weights, drawn, key = self.weights(), self._drawn, _key(camera)
        if weights is None:
            return None
        # On the view that it was drawn on, the drawn edge itself answers, and nothing has to be rendered.
        if drawn is not None and drawn.view == key:
            return drawn.mask, np.zeros((0, 2), np.float32)
        version = self.session.version
        # Pages ask for the same view at the same time; it is rendered once for all of them.
        with self._lock:
            cached = self._view
            if cached is None or cached[:3] != (key, self.revision, version):
                shares, points = view_and_points(self.session.splats, weights, camera)
                cached = self._view = (key, self.revision, version, _sharpened(shares), points)
            return cached[3:]

    def share(self) -> Callable[[Camera], np.ndarray] | None:
        """What is selected now, as a function that goes on giving it ([H, W] 0..1 of a camera's view) when something
        else is selected later; None: nothing is, all of it may change."""
        selection, session = self._selection, self.session
        if selection is None:
            return None

        # Nothing of this object is read later: the selection is bound now, the Gaussians when a view is asked for.
        def of_view(camera: Camera) -> np.ndarray:
            splats = session.splats
            return _sharpened(view_of(splats, selection.on(splats, session.original), camera))

        return of_view

    def note(self) -> None:
        """After a command: what is selected belongs to the step of the history that is in effect."""
        state = self._state
        # The same object as long as nothing changed, for the history tells selections apart by identity.
        if state.selection is not self._selection or state.drawn is not self._drawn:
            self._state = SelectionState(self._selection, self.gaussians, self._drawn)
        step, steps = self._step, [step.id for step in self.session.snapshot.history]
        is_new = step != self._noted  # ids of steps that were dropped are given again: only the way there tells
        self._history.note(step, steps, self._state, is_new)
        self._noted = step

    def undo(self) -> bool:
        """One selection back; False: a step of the document comes first."""
        return self._restore(self._history.move(self._step, -1))

    def redo(self) -> bool:
        """One selection forward; False: a step of the document comes first."""
        return self._restore(self._history.move(self._step, 1))

    def follow(self) -> None:
        """Undo, redo or a jump put another step into effect: select what was selected then."""
        self._noted = self._step
        self._restore(self._history.at(self._step))

    @property
    def steps(self) -> tuple[int, int]:
        """How many selections can be undone and redone before a step of the document is."""
        return self._history.counts(self._step)

    @property
    def _step(self) -> int:
        snapshot = self.session.snapshot
        return snapshot.history[snapshot.cursor].id

    def _restore(self, state: SelectionState | None) -> bool:
        if state is not None and state is not self._state:
            # `_set` counts up the revision, so pages ask for the new outline; the state is the stored one itself.
            self._set(state.selection, state.gaussians, state.drawn)
            self._state = state
        return state is not None

    def stored(self) -> tuple[str, bytes] | None:
        """(hash, PNG) for a layer that keeps to it; None: nothing is selected."""
        if self._selection is None:
            return None
        data = self._selection.to_png()
        return files.sha256(data), data

    def _set(self, selection: Selection | None, gaussians: int, drawn: DrawnArea | None) -> None:
        # An empty selection is no place to come back to.
        if self._selection is not None:
            self._previous = self._selection
        self._selection, self.gaussians, self._drawn = selection, gaussians, drawn
        self.revision += 1


def limited(splats: Splats, weights: np.ndarray | None, sh: np.ndarray) -> np.ndarray:
    """[N, K, 3] new colours as far as Gaussians are selected. weights: [N] or None: all."""
    if weights is None:
        return sh
    # Mixed only where partly selected: 0 and 1 must leave or take colours bit for bit, without rounding.
    part = weights[:, None, None]
    mixed = np.where(part == 1, sh, splats.sh + part * (sh - splats.sh))
    return np.where(part == 0, splats.sh, mixed).astype(np.float32)


def _sharpened(shares: np.ndarray) -> np.ndarray:
    low, high = SHARPEN
    return np.clip((shares - low) / (high - low), 0, 1).astype(np.float32)


def _key(camera: Camera) -> bytes:
    numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return np.array([*numbers, *camera.world_to_camera.ravel()], np.float64).tobytes()
