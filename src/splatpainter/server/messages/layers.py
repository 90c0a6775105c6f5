"""Layers, history and conflicts."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from splatpainter.server.messages.base import Answer, Command, Exported, Name
from splatpainter.server.messages.painting import LayerMade
from splatpainter.server.messages.state import Blend, Blob, Conflict, Unit


class LayerSet(Command):
    """Change what is given; the rest stays."""

    NAME = "layer.set"
    ANSWER = LayerMade
    layer: str
    name: Name | None = None
    visible: bool | None = None
    opacity: Unit | None = None
    blend: Blend | None = None
    parameters: dict[str, Any] | None = None
    """Of a look layer: the fields of Look."""
    gesture: Name | None = None
    """Steps of one gesture (a slider that is dragged) that follow each other are one step of the history."""


class LayerMove(Command):
    """Reorder: `to` is the new place, 0 the lowest."""

    NAME = "layer.move"
    layer: str
    to: int = Field(ge=0)


class LayerDuplicate(Command):
    NAME = "layer.duplicate"
    ANSWER = LayerMade
    layer: str


class LayerDelete(Command):
    NAME = "layer.delete"
    layer: str


class LayerMerge(Command):
    """Neighbouring layers become one, which shows the same."""

    NAME = "layer.merge"
    ANSWER = LayerMade
    layers: list[str] = Field(min_length=2)
    name: Name | None = None


class LayerExport(Command):
    """One layer with its pictures as a .splatlayer file, to download."""

    NAME = "layer.export"
    ANSWER = Exported
    layer: str


class LayerImport(Command):
    """The layer of a .splatlayer file that was sent, on top."""

    NAME = "layer.import"
    ANSWER = LayerMade
    blob: Blob


class Undo(Command):
    NAME = "undo"


class Redo(Command):
    NAME = "redo"


class Jump(Command):
    """To a place in the history; 0 is as the asset was opened."""

    NAME = "jump"
    cursor: int = Field(ge=0)


class ConflictsFound(Answer):
    conflicts: list[Conflict]


class Conflicts(Command):
    NAME = "conflicts"
    ANSWER = ConflictsFound


class ConflictSet(Command):
    """Who wins where two layers touched the same rows."""

    NAME = "conflict.set"
    lower: str
    upper: str
    policy: Literal["latest", "first", "blend"]
