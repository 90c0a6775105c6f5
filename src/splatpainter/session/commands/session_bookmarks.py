"""session.bookmarks: views of a project to come back to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import overload

from splatpainter.cameras import Camera
from splatpainter.session.commands.session_core import SessionCore
from splatpainter.session.project.project_file import Bookmark


class SessionBookmarks(Sequence[Bookmark]):
    """The views, in the order in which they were added. Not part of the history."""

    def __init__(self, core: SessionCore) -> None:
        self._core = core

    def __len__(self) -> int:
        return len(self._core.project.bookmarks())

    def __iter__(self) -> Iterator[Bookmark]:
        return iter(self._core.project.bookmarks())

    @overload
    def __getitem__(self, index: int) -> Bookmark: ...
    @overload
    def __getitem__(self, index: slice) -> list[Bookmark]: ...
    def __getitem__(self, index: int | slice) -> Bookmark | list[Bookmark]:
        return self._core.project.bookmarks()[index]

    def add(self, name: str, camera: Camera) -> str:
        """Add a bookmark; returns its id."""
        return self._core.project.add_bookmark(name, camera)

    def delete(self, bookmark: str) -> None:
        """Delete the bookmark of an id. Raises ValueError for an unknown one."""
        self._core.project.delete_bookmark(bookmark)
