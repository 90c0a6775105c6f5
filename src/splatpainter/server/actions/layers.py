"""Layers, history, conflicts."""

from __future__ import annotations

from typing import Any

from splatpainter.server.actions import Call, handles
from splatpainter.server.actions.common import called, layer_made, progress, python_line
from splatpainter.server.describe import conflict_infos
from splatpainter.server.messages import Answer
from splatpainter.server.messages import layers as say
from splatpainter.server.messages.base import Exported
from splatpainter.server.messages.painting import LayerMade
from splatpainter.sources.grade import NAME, Grade


@handles(say.LayerSet, writes=True)
def set_layer(call: Call, command: say.LayerSet) -> LayerMade:
    values: dict[str, Any] = {
        name: getattr(command, name)
        for name in ("name", "visible", "opacity", "blend", "parameters")
        if getattr(command, name) is not None
    }
    session = call.studio.session
    own = session.layer(command.layer)
    if "parameters" in values and own.parameters.get("look") == NAME:
        space = session.original.color_space
        values["parameters"] = Grade.from_dict({**values["parameters"], "space": space}).to_dict()
    with progress(call, "layers"):
        session.set(command.layer, gesture=command.gesture, **values)
    return layer_made(call, command.layer, python_line("session.set", command.layer, **values))


@handles(say.LayerMove, writes=True)
def move(call: Call, command: say.LayerMove) -> Answer:
    with progress(call, "layers"):
        call.studio.session.move(command.layer, command.to)
    return Answer(python=python_line("session.move", command.layer, command.to))


@handles(say.LayerDuplicate, writes=True)
def duplicate(call: Call, command: say.LayerDuplicate) -> LayerMade:
    with progress(call, "layers"):
        layer = call.studio.session.duplicate(command.layer)
    return layer_made(call, layer.id, python_line("session.duplicate", command.layer))


@handles(say.LayerDelete, writes=True)
def delete(call: Call, command: say.LayerDelete) -> Answer:
    with progress(call, "layers"):
        call.studio.session.delete(command.layer)
    return Answer(python=python_line("session.delete", command.layer))


@handles(say.LayerMerge, writes=True)
def merge(call: Call, command: say.LayerMerge) -> LayerMade:
    with progress(call, "layers"):
        layer = call.studio.session.merge(command.layers, command.name)
    return layer_made(call, layer.id, python_line("session.merge", command.layers, name=command.name))


@handles(say.LayerExport)
def export_layer(call: Call, command: say.LayerExport) -> Exported:
    studio = call.studio
    name = "".join(c if c.isalnum() or c in "-_ " else "_" for c in studio.session.layer(command.layer).name)
    path = studio.downloads.folder() / f"{name.strip()[:60] or 'layer'}.splatlayer"
    studio.session.export_layer(command.layer, path)
    line = python_line("session.export_layer", command.layer, path.name)
    return Exported(url=studio.downloads.add(path), file=path.name, bytes=path.stat().st_size, python=line)


@handles(say.LayerImport, writes=True)
def import_layer(call: Call, command: say.LayerImport) -> LayerMade:
    blob = call.studio.blobs.get(command.blob, "layer")
    with progress(call, "layers"), called(blob.path, blob.name or "layer"):
        layer = call.studio.session.import_layer(blob.path)
    return layer_made(call, layer.id, python_line("session.import_layer", blob.name or "layer.splatlayer"))


@handles(say.Undo, writes=True)
def undo(call: Call, command: say.Undo) -> Answer:
    with progress(call, "undo"):
        call.studio.session.undo()
    return Answer(python="session.undo()")


@handles(say.Redo, writes=True)
def redo(call: Call, command: say.Redo) -> Answer:
    with progress(call, "redo"):
        call.studio.session.redo()
    return Answer(python="session.redo()")


@handles(say.Jump, writes=True)
def jump(call: Call, command: say.Jump) -> Answer:
    with progress(call, "history"):
        call.studio.session.jump(command.cursor)
    return Answer(python=python_line("session.jump", command.cursor))


@handles(say.Conflicts)
def conflicts(call: Call, command: say.Conflicts) -> say.ConflictsFound:
    return say.ConflictsFound(conflicts=conflict_infos(call.studio.session), python="session.conflicts()")


@handles(say.ConflictSet, writes=True)
def settle(call: Call, command: say.ConflictSet) -> Answer:
    words = (command.lower, command.upper, command.policy)
    with progress(call, "layers"):
        call.studio.session.settle(*words)
    return Answer(python=python_line("session.settle", *words))
