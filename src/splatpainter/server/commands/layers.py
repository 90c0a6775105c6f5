"""Layers, history, conflicts."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from splatpainter.server.commands.context import (
    CommandContext,
    command,
    layer_made,
    naming_errors,
    progress,
    python_line,
)
from splatpainter.server.describe import conflict_infos
from splatpainter.server.protocol import Answer, Blend, Blob, Command, ConflictInfo, Exported, LayerMade, Name, Unit
from splatpainter.sources.color_grading import GRADE, GradeSettings


class LayerNew(Command):
    """An empty paint layer, which strokes can go into; on top, or above another."""

    NAME = "layer.new"
    ANSWER = LayerMade
    name: Name | None = None
    above: str | None = None


@command(LayerNew, writes=True)
def new_layer(context: CommandContext, request: LayerNew) -> LayerMade:
    session = context.studio.session
    at = None
    if request.above is not None:
        session.layer(request.above)
        at = 1 + [layer.id for layer in session.layers].index(request.above)
    layer = session.new_layer(request.name, index=at)
    return layer_made(context, layer.id, python_line("session.new_layer", request.name, index=at))


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
    """Of an adjustment layer: the fields of GradeSliders."""
    gesture: Name | None = None
    """Steps of one gesture (a slider that is dragged) that follow each other are one step of the history."""


@command(LayerSet, writes=True)
def set_layer(context: CommandContext, request: LayerSet) -> LayerMade:
    values: dict[str, Any] = {
        name: getattr(request, name)
        for name in ("name", "visible", "opacity", "blend", "parameters")
        if getattr(request, name) is not None
    }
    session = context.studio.session
    layer = session.layer(request.layer)
    if "parameters" in values and layer.parameters.get("look") == GRADE:
        space = session.original.color_space
        values["parameters"] = GradeSettings.from_dict({**values["parameters"], "space": space}).to_dict()
    with progress(context, "layers"):
        session.set(request.layer, gesture=request.gesture, **values)
    return layer_made(context, request.layer, python_line("session.set", request.layer, **values))


class LayerMove(Command):
    """Reorder: `to` is the new position, 0 the lowest."""

    NAME = "layer.move"
    layer: str
    to: int = Field(ge=0)


@command(LayerMove, writes=True)
def move_layer(context: CommandContext, request: LayerMove) -> Answer:
    with progress(context, "layers"):
        context.studio.session.move(request.layer, request.to)
    return Answer(python=python_line("session.move", request.layer, request.to))


class LayerDuplicate(Command):
    NAME = "layer.duplicate"
    ANSWER = LayerMade
    layer: str


@command(LayerDuplicate, writes=True)
def duplicate_layer(context: CommandContext, request: LayerDuplicate) -> LayerMade:
    with progress(context, "layers"):
        layer = context.studio.session.duplicate(request.layer)
    return layer_made(context, layer.id, python_line("session.duplicate", request.layer))


class LayerDelete(Command):
    NAME = "layer.delete"
    layer: str


@command(LayerDelete, writes=True)
def delete_layer(context: CommandContext, request: LayerDelete) -> Answer:
    with progress(context, "layers"):
        context.studio.session.delete(request.layer)
    return Answer(python=python_line("session.delete", request.layer))


class LayerMerge(Command):
    """Neighbouring layers become one, which shows the same."""

    NAME = "layer.merge"
    ANSWER = LayerMade
    layers: list[str] = Field(min_length=2)
    name: Name | None = None


@command(LayerMerge, writes=True)
def merge_layers(context: CommandContext, request: LayerMerge) -> LayerMade:
    with progress(context, "layers"):
        layer = context.studio.session.merge(request.layers, request.name)
    return layer_made(context, layer.id, python_line("session.merge", request.layers, name=request.name))


class LayerExport(Command):
    """One layer with its pictures as a .splatlayer file, to download."""

    NAME = "layer.export"
    ANSWER = Exported
    layer: str


@command(LayerExport)
def export_layer(context: CommandContext, request: LayerExport) -> Exported:
    studio = context.studio
    name = "".join(c if c.isalnum() or c in "-_ " else "_" for c in studio.session.layer(request.layer).name)
    path = studio.downloads.folder() / f"{name.strip()[:60] or 'layer'}.splatlayer"
    studio.session.export_layer(request.layer, path)
    line = python_line("session.export_layer", request.layer, path.name)
    return Exported(url=studio.downloads.add(path), file=path.name, bytes=path.stat().st_size, python=line)


class LayerImport(Command):
    """The layer of a .splatlayer file that was sent, on top."""

    NAME = "layer.import"
    ANSWER = LayerMade
    blob: Blob


@command(LayerImport, writes=True)
def import_layer(context: CommandContext, request: LayerImport) -> LayerMade:
    blob = context.studio.blobs.get(request.blob, "layer")
    with progress(context, "layers"), naming_errors(blob.path, blob.name or "layer"):
        layer = context.studio.session.import_layer(blob.path)
    return layer_made(context, layer.id, python_line("session.import_layer", blob.name or "layer.splatlayer"))


class Undo(Command):
    NAME = "undo"


@command(Undo, writes=True)
def undo(context: CommandContext, request: Undo) -> Answer:
    with progress(context, "undo"):
        context.studio.session.undo()
    return Answer(python="session.undo()")


class Redo(Command):
    NAME = "redo"


@command(Redo, writes=True)
def redo(context: CommandContext, request: Redo) -> Answer:
    with progress(context, "redo"):
        context.studio.session.redo()
    return Answer(python="session.redo()")


class Jump(Command):
    """To a step of the history; 0 is as the asset was opened."""

    NAME = "jump"
    cursor: int = Field(ge=0)


@command(Jump, writes=True)
def jump_in_history(context: CommandContext, request: Jump) -> Answer:
    with progress(context, "history"):
        context.studio.session.jump(request.cursor)
    return Answer(python=python_line("session.jump", request.cursor))


class ConflictsListed(Answer):
    conflicts: list[ConflictInfo]


class ConflictsList(Command):
    NAME = "conflicts"
    ANSWER = ConflictsListed


@command(ConflictsList)
def list_conflicts(context: CommandContext, request: ConflictsList) -> ConflictsListed:
    return ConflictsListed(conflicts=conflict_infos(context.studio.session), python="session.conflicts()")


class ConflictSet(Command):
    """Which layer wins where two edited the same Gaussians."""

    NAME = "conflict.set"
    lower: str
    upper: str
    policy: Literal["latest", "first", "blend"]


@command(ConflictSet, writes=True)
def set_conflict(context: CommandContext, request: ConflictSet) -> Answer:
    args = (request.lower, request.upper, request.policy)
    with progress(context, "layers"):
        context.studio.session.resolve_conflict(*args)
    return Answer(python=python_line("session.resolve_conflict", *args))
