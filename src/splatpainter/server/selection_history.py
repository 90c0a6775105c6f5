"""What was selected at each step of the history, so that undo and redo go through selections too.

Selections are no steps of the project: they lie between them. Each step of the document has the selections that were
made while it was in effect, the first being what its own command left selected; undo goes back through these before it
takes back the step, and redo forward. Nothing of it is kept in the project.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Any

from splatpainter.system.quick_dataclass import dataclass

MAX_BYTES = 64 << 20
"""Most bytes of remembered selections: the oldest are forgotten first."""


@dataclass(frozen=True)
class SelectionState:
    """A selection to go back to."""

    selection: Any
    """A session.selection.Selection; None: nothing."""
    gaussians: int
    drawn: Any
    """The DrawnArea of CurrentSelection."""

    @property
    def bytes(self) -> int:
        arrays = [] if self.selection is None else [self.selection.weights, self.selection.points]
        arrays += [] if self.drawn is None else [self.drawn.mask]
        return sum(array.nbytes for array in arrays)


@dataclass
class _Track:
    """The selections of one step."""

    states: list[SelectionState]
    at: int = 0


@dataclass
class SelectionHistory:
    """Changed by one thread at a time."""

    _tracks: dict[int, _Track] = field(default_factory=dict)
    """Id of the step of the document -> its selections; the latest steps last."""

    def note(self, step: int, steps: Sequence[int], present: SelectionState, is_new: bool) -> None:
        """After a command: `step` is in effect, `steps` are there, `present` is selected. is_new: the command made the
        step."""
        # Steps that fell out of the document are never in effect again.
        for gone in self._tracks.keys() - set(steps):
            del self._tracks[gone]
        track = self._tracks.get(step)
        # A new step begins with what its command left; a selection made since then cuts off what was undone.
        if track is None or is_new:
            self._tracks[step] = _Track([present])
        elif track.states[track.at] is not present:
            track.states[track.at + 1 :] = [present]
            track.at += 1
        self._forget(step)

    def counts(self, step: int) -> tuple[int, int]:
        """How many selections can be undone and redone before a step of the document is."""
        track = self._tracks.get(step)
        return (0, 0) if track is None else (track.at, len(track.states) - 1 - track.at)

    def move(self, step: int, by: int) -> SelectionState | None:
        """One selection back (-1) or forward (1); None: there is none at this step."""
        back, forward = self.counts(step)
        if by < 0 < back or by > 0 < forward:
            track = self._tracks[step]
            track.at += by
            return track.states[track.at]
        return None

    def at(self, step: int) -> SelectionState | None:
        """What was selected when that step was in effect last; None: not known, as in a project that was reopened."""
        track = self._tracks.get(step)
        return None if track is None else track.states[track.at]

    def _forget(self, present: int) -> None:
        # Whole steps go first, the oldest before all; of the step in effect only what undo would reach last.
        total = sum(state.bytes for track in self._tracks.values() for state in track.states)
        for step, track in list(self._tracks.items()):
            while total > MAX_BYTES and (step != present and track.states or track.at > 0):
                total -= track.states.pop(0).bytes
                track.at = max(track.at - 1, 0)
            if not track.states:
                del self._tracks[step]
