"""Global sliders: shown at once, kept as a layer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.painter import Edit
from splatpainter.receipts import changed_rows
from splatpainter.server import frames
from splatpainter.server.actions import Call, handles
from splatpainter.server.actions.common import Word, camera_of, layer_made, mask_of, progress, python_line
from splatpainter.server.messages import looks as say
from splatpainter.server.messages.painting import LayerMade, Previewed
from splatpainter.session import erase
from splatpainter.sources.grade import Grade, grade


@handles(say.LookPreview)
def preview(call: Call, command: say.LookPreview) -> Previewed:
    call.desk.strokes.clear()
    call.put_back = True
    if command.look is None:
        return Previewed(rows=0)
    shown = call.studio.session.shown
    splats = shown.splats
    sh = grade(splats.sh, _settings(call, command.look))
    if command.mask is not None:
        sh = np.where(_reached(call, command)[:, None, None], sh, splats.sh)
    rows = changed_rows(splats, replace(splats, sh=sh))
    if len(rows):
        every = len(rows) == len(splats)  # as a rule; 100,000 rows need not be copied for it
        some, old = (sh, splats.sh) if every else (sh[rows], splats.sh[rows])
        some = some[:, :1] if np.array_equal(some[:, 1:], old[:, 1:]) else some
        call.preview = frames.tints(some, rows, len(splats), shown.version)
        call.preview_rows = rows
    return Previewed(rows=len(rows))


@handles(say.LookCommit, writes=True)
def commit(call: Call, command: say.LookCommit) -> LayerMade:
    call.put_back = True
    settings = _settings(call, command.look)
    edits = []
    if command.mask is not None:
        camera = _camera(command)
        nothing = np.zeros((camera.height, camera.width, 3), np.float32)
        edits = [Edit(nothing, camera, mask_of(call, command.mask, camera), command.name)]
    with progress(call, "look"):
        layer = call.studio.session.add("look", edits, name=command.name, parameters=settings)
    shown = [Word("sp.Edit(picture, camera, mask)")] * len(edits)
    line = python_line("session.add", "look", shown, name=command.name, parameters=settings)
    return layer_made(call, layer.id, line)


def _settings(call: Call, look: say.Look) -> dict:
    space = call.studio.session.original.color_space
    return Grade.from_dict({**look.model_dump(), "space": space}).to_dict()


def _camera(command: say.LookPreview | say.LookCommit):
    if command.camera is None:
        raise ValueError("look: a mask needs the camera that it was drawn in")
    return camera_of(command.camera)


def _reached(call: Call, command: say.LookPreview) -> np.ndarray:
    assert command.mask is not None
    camera = _camera(command)
    return erase.reached(call.studio.session.splats, [(camera, mask_of(call, command.mask, camera))])
