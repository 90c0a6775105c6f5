"""Bookmarks, projects, exports and receipts."""

from __future__ import annotations

from typing import Any, Literal

from splatpainter.server.messages.base import Answer, Command, Exported, FileName, Name
from splatpainter.server.messages.state import Blob, Bookmark, Camera, Model


class BookmarkMade(Answer):
    bookmark: Bookmark


class BookmarkAdd(Command):
    NAME = "bookmark.add"
    ANSWER = BookmarkMade
    name: Name
    camera: Camera


class BookmarkDelete(Command):
    NAME = "bookmark.delete"
    bookmark: str


class AssetOpen(Command):
    """A new session. Exactly one of: a blob that was sent, a file of the studio's folder, the demo asset."""

    NAME = "asset.open"
    blob: Blob | None = None
    file: FileName | None = None
    demo: bool = False


class AssetUp(Command):
    """Turn the asset on the screen; no row changes, and the project remembers it."""

    NAME = "asset.up"
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"]
    """World axis that is to point up."""


class ProjectOpen(Command):
    """Exactly one of: a file of the studio's folder, an id of `project.recent`, a blob that was sent."""

    NAME = "project.open"
    file: FileName | None = None
    recent: str | None = None
    blob: Blob | None = None


class ProjectSaveAs(Command):
    """Move the project to a file in the studio's folder; from then on it lives there."""

    NAME = "project.save_as"
    file: FileName
    overwrite: bool = False


class ProjectDownload(Command):
    """A copy of the project, whole, to download."""

    NAME = "project.download"
    ANSWER = Exported


class Recent(Model):
    id: str
    name: str
    changed: float
    """Seconds since 1970."""


class RecentProjects(Answer):
    recent: list[Recent]
    """Newest first."""
    files: list[str]
    """Assets and projects in the studio's folder."""


class ProjectRecent(Command):
    NAME = "project.recent"
    ANSWER = RecentProjects


class Export(Command):
    """The asset as it is, as a file of the format that the name's ending says (`formats` of the state)."""

    NAME = "export"
    ANSWER = Exported
    file: FileName


class ReceiptMade(Answer):
    receipt: dict[str, Any]
    """Of the whole session: original against now."""
    text: str
    """One line for people."""


class Receipt(Command):
    NAME = "receipt"
    ANSWER = ReceiptMade


class Verified(Answer):
    proved: bool
    rows: int
    same: int
    changed: int
    appended: int
    problems: list[str]
    exact: str
    """How the rows were compared."""


class Verify(Command):
    """Write the asset, read it again, and compare it row by row with the original."""

    NAME = "verify"
    ANSWER = Verified
