"""What every command, answer and failure has in common."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from splatpainter.server.messages.state import Model, Unit

PIXELS = 4_000_000
"""Most pixels of a view that is painted or rendered."""
Name = Annotated[str, Field(min_length=1, max_length=200)]
FileName = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00-\x1f:]+$")]
"""A plain name inside the studio's folder, never a path."""


class Answer(Model):
    """What every command returns when it worked; most add fields."""

    re: int = 0
    ok: Literal[True] = True
    python: str = ""
    """The equivalent Python line; "" where there is none (looking at things)."""
    version: int = 0
    """Of the asset after the command."""
    seconds: float = 0.0
    """In the server, waiting for earlier work not included."""


class Command(Model):
    """Base of all commands. NAME is what `do` says, ANSWER the class of the answer."""

    NAME: ClassVar[str]
    ANSWER: ClassVar[type[Answer]] = Answer


class Exported(Answer):
    url: str
    """To download from, once or more, until the studio ends."""
    file: str
    bytes: int
    receipt_url: str | None = None
    """Where the receipt of an asset is."""


class Progress(Model):
    re: int
    progress: Unit
    stage: str


class Problem(Model):
    kind: Literal["input", "cancelled", "busy", "schema", "fault"]
    """input: the user can mend it; busy: too much is waiting; schema: reload the page; fault: ours."""
    message: str
    hint: str = ""


class Failure(Model):
    re: int
    ok: Literal[False] = False
    error: Problem
