"""Coming, going on after a lost connection, and what the server says unasked."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from splatpainter.server.messages.base import Answer, Command
from splatpainter.server.messages.state import Blob, Bookmark, HistoryChange, Model, Present, State


class Greeting(Answer):
    schema_hash: str
    client: str
    """This connection's name."""
    known: bool
    """Whether this page has been here before: then commands that it sends again are not carried out again."""
    state: State


class Hello(Command):
    """Start, or go on after a lost connection. The missing rows follow as a binary frame, before the answer: a delta if
    `session` and `since` are known to the server, else a snapshot; none if nothing changed."""

    NAME = "hello"
    ANSWER = Greeting
    schema_hash: str
    """SCHEMA_HASH of messages.ts; where it differs the error says to reload the page."""
    session: str | None = None
    since: int | None = None
    page: str | None = Field(default=None, pattern=r"^[0-9a-f]{32}$")
    """A random name that a page keeps over all its connections. Its command ids must then never repeat: one that came
    before is answered with what came of it, and not carried out again."""


class Sync(Command):
    """Ask for the rows again (a frame's version_from was not the version you have). since None: a snapshot."""

    NAME = "sync"
    since: int | None = None


class Cancel(Command):
    """Stop the command `of` (its id) of this connection; that command then fails with kind "cancelled"."""

    NAME = "cancel"
    of: int


class StateEvent(Model):
    """After every change of anything in the state, by whomever: what is so now, and what is new in the long lists."""

    event: Literal["state"] = "state"
    state: Present
    history: HistoryChange | None = None
    """Against the state that this connection was told before; None: as it was."""
    bookmarks: list[Bookmark] | None = None
    """All of them; None: as they were."""


class ToastEvent(Model):
    event: Literal["toast"] = "toast"
    level: Literal["info", "warning", "error"]
    message: str
    hint: str = ""


class PictureEvent(Model):
    """A picture was saved into the watched folder: check it and offer it as an edit."""

    event: Literal["picture"] = "picture"
    picture: Blob
    name: str
