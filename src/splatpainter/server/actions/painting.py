"""Strokes and edits."""

from __future__ import annotations

import base64
import binascii
import secrets
import threading
from typing import Any

import numpy as np

from splatpainter.painter import Edit
from splatpainter.server import frames
from splatpainter.server.actions import Call, handles
from splatpainter.server.actions.common import Word, camera_of, edit_of, layer_made, mask_of, progress, python_line
from splatpainter.server.messages import Answer
from splatpainter.server.messages import painting as say
from splatpainter.server.paint import Stroke
from splatpainter.session.replay import WITHIN
from splatpainter.sources.color import from_display


@handles(say.PaintBegin)
def begin(call: Call, command: say.PaintBegin) -> say.StrokeStarted:
    studio = call.studio
    stroke = Stroke(camera_of(command.camera), command.kind == "erase")
    shown = studio.session.shown
    stroke.prepare(shown.splats, studio.original, shown.version)
    threading.Thread(target=studio.session.prepare, daemon=True).start()  # ready when the pen goes up
    call.put_back = True
    name = secrets.token_hex(6)
    call.desk.strokes = {name: stroke}
    return say.StrokeStarted(stroke=name)


@handles(say.PaintDab)
def dab(call: Call, command: say.PaintDab) -> say.Previewed:
    studio, stroke = call.studio, _stroke(call, command.stroke)
    try:
        rgba = base64.b64decode(command.rgba, validate=True)
    except binascii.Error:
        raise ValueError("dab: expected base64 of RGBA bytes") from None
    box = stroke.patch(command.x, command.y, command.width, command.height, rgba)
    shown = studio.session.shown
    found = stroke.preview(shown.splats, studio.original, shown.version, box)
    if len(found.rows):
        call.preview = frames.tints(found.splats.sh, found.rows, len(shown.splats), shown.version)
        call.preview_rows = found.rows
    return say.Previewed(rows=len(found.rows))


@handles(say.PaintEnd, writes=True)
def end(call: Call, command: say.PaintEnd) -> say.LayerMade:
    studio, stroke = call.studio, _stroke(call, command.stroke)
    if not stroke.mask.any():
        raise ValueError("stroke: nothing was painted")
    session = studio.session
    shown = session.shown
    picture = stroke.picture(shown.splats, studio.original, shown.version)
    image = from_display(picture.astype(np.float32), shown.splats.color_space)
    edit = Edit(image, stroke.camera, stroke.mask, command.name)
    kind = "erase" if stroke.erase else "paint"
    look: dict[str, Any] = {
        "name": command.name,
        "method": command.method,
        "opacity": command.opacity,
        "blend": command.blend,
    }
    with progress(call, "painting"):
        layer = session.add(kind, [edit], **look)
    call.desk.strokes.pop(command.stroke, None)
    call.put_back = True
    line = python_line("session.add", kind, [Word("sp.Edit(picture, camera, mask)")], **look)
    return layer_made(call, layer.id, line)


@handles(say.PaintCancel)
def cancel(call: Call, command: say.PaintCancel) -> Answer:
    call.desk.strokes.pop(command.stroke, None)
    call.put_back = True
    return Answer()


@handles(say.Edit, writes=True)
def edit(call: Call, command: say.Edit) -> say.LayerMade:
    session = call.studio.session
    if command.kind == "erase":
        edits = [_erasing(call, view) for view in command.views]
    else:
        edits = [edit_of(call, view, command.mode) for view in command.views]
    look: dict[str, Any] = {"name": command.name, "mode": command.mode, "method": command.method}
    look |= {"opacity": command.opacity, "blend": command.blend}
    if command.within and command.mode == "global":
        edits = [edit for edit in edits if edit.mask is not None]
        if not edits:
            raise ValueError("edit: expected a mask in one of the views; select an area on one of them")
        look["parameters"] = {WITHIN: True}
    with progress(call, "editing"):
        layer = session.add(command.kind, edits, **look)
    if command.stroke is not None:
        call.desk.strokes.pop(command.stroke, None)
    call.put_back = True
    shown = [Word(f"sp.Edit(picture{k or ''}, camera{k or ''}, mask{k or ''})") for k in range(len(edits))]
    return layer_made(call, layer.id, python_line("session.add", command.kind, shown, **look))


def _erasing(call: Call, view: say.EditView) -> Edit:
    """Of an eraser only the mask counts: the mask given, else the picture as one."""
    camera = camera_of(view.camera)
    mask = mask_of(call, view.mask or view.picture, camera)
    return Edit(np.zeros((camera.height, camera.width, 3), np.float32), camera, mask, "erase")


def _stroke(call: Call, name: str) -> Stroke:
    stroke = call.desk.strokes.get(name)
    if stroke is None:
        raise ValueError("stroke: there is no such stroke (any more); begin a new one")
    return stroke
