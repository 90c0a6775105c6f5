"""session.history: the steps of a project, of which one is in effect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import overload

from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.project.project_file import Step


class SessionHistory(Sequence[Step]):
    """The steps, oldest first; the first one is the asset as it was opened. Session.undo and .redo go through them."""

    def __init__(self, core: SessionCore) -> None:
        self._core = core

    def __len__(self) -> int:
        return len(self._core.snapshot.history)

    def __iter__(self) -> Iterator[Step]:
        return iter(self._core.snapshot.history)

    @overload
    def __getitem__(self, index: int) -> Step: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Step, ...]: ...
    def __getitem__(self, index: int | slice) -> Step | tuple[Step, ...]:
        return self._core.snapshot.history[index]

    @property
    def cursor(self) -> int:
        """Index of the step in effect."""
        return self._core.snapshot.cursor

    @property
    def gesture(self) -> str:
        """The gesture of the step in effect (as of `layers.set`); "" of one that has none."""
        return self._core.project.gesture()

    def jump(self, cursor: int) -> None:
        """Jump to any step of the history. Raises ValueError for one that is not there."""
        with self._core.command():
            self._core.step(cursor - self.cursor, strict=True)
