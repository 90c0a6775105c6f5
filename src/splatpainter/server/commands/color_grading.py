"""Global sliders: shown at once, kept as an adjustment layer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field

from splatpainter.cameras import Camera
from splatpainter.painter import Edit
from splatpainter.receipts import changed_rows
from splatpainter.server import frames
from splatpainter.server.commands.context import (
    CommandContext,
    RawExpr,
    command,
    layer_made,
    mask_from_upload,
    progress,
    python_line,
)
from splatpainter.server.current_selection import limited
from splatpainter.server.protocol import Blob, CameraInfo, Command, LayerMade, Message, Name, Previewed, Unit
from splatpainter.session.document import SELECTION
from splatpainter.session.layer_blending import reached_gaussians
from splatpainter.sources.color_grading import GradeSettings, grade_sh


class HueSliders(Message):
    """A change of one range of hues."""

    hue: float = Field(ge=0, lt=360)
    """Middle of the range, degrees (0 red, 120 green, 240 blue)."""
    width: float = Field(default=60, gt=0, le=360)
    """Degrees to either side over which the change fades out."""
    shift: float = Field(default=0, ge=-180, le=180)
    """Degrees."""
    saturation: float = Field(default=0, ge=-1, le=1)
    lightness: float = Field(default=0, ge=-1, le=1)


class GradeSliders(Message):
    """Global sliders; zeros change nothing."""

    exposure: float = Field(default=0, ge=-5, le=5)
    """Stops, in linear light."""
    temperature: float = Field(default=0, ge=-1, le=1)
    """-1 cold .. 1 warm."""
    tint: float = Field(default=0, ge=-1, le=1)
    """-1 green .. 1 magenta."""
    contrast: float = Field(default=0, ge=-1, le=1)
    saturation: float = Field(default=0, ge=-1, le=1)
    """-1: grey."""
    curve: list[tuple[Unit, Unit]] = Field(default=[], max_length=16)
    """Points (in, out) of a tone curve of display values, by ascending `in`; [] is the straight line."""
    hues: list[HueSliders] = Field(default=[], max_length=12)
    strength: Unit = 1.0


class GradePreview(Command):
    """Show the sliders on all Gaussians, or on those that a mask reaches, without a layer: the colours come as a frame
    with the PREVIEW flag. look None: end the preview."""

    NAME = "look.preview"
    ANSWER = Previewed
    look: GradeSliders | None
    mask: Blob | None = None
    camera: CameraInfo | None = None
    """The view of the mask."""


@command(GradePreview)
def preview_grade(context: CommandContext, request: GradePreview) -> Previewed:
    context.page.strokes.clear()
    context.clear_preview = True
    if request.look is None:
        return Previewed(gaussians=0)
    now = context.studio.session.snapshot
    splats = now.splats
    sh = grade_sh(splats.sh, _settings(context, request.look))
    if request.mask is not None:
        camera = _mask_camera(request)
        masks = [(camera, mask_from_upload(context, request.mask, camera))]
        sh = np.where(reached_gaussians(splats, masks)[:, None, None], sh, splats.sh)
    sh = limited(splats, context.studio.selection.weights(), sh)
    ids = changed_rows(splats, replace(splats, sh=sh))
    if len(ids):
        every = len(ids) == len(splats)  # as a rule; 100,000 Gaussians need not be copied for it
        new, old = (sh, splats.sh) if every else (sh[ids], splats.sh[ids])
        new = new[:, :1] if np.array_equal(new[:, 1:], old[:, 1:]) else new
        context.preview = frames.preview_colors(new, ids, len(splats), now.version)
        context.previewed_ids = ids
    return Previewed(gaussians=len(ids))


class GradeCommit(Command):
    """The sliders as an adjustment layer."""

    NAME = "look.commit"
    ANSWER = LayerMade
    look: GradeSliders
    name: Name = "Adjustment"
    mask: Blob | None = None
    camera: CameraInfo | None = None


@command(GradeCommit, writes=True)
def commit_grade(context: CommandContext, request: GradeCommit) -> LayerMade:
    context.clear_preview = True
    settings = _settings(context, request.look)
    edits = []
    if request.mask is not None:
        camera = _mask_camera(request)
        black = np.zeros((camera.height, camera.width, 3), np.float32)  # only the mask counts
        edits = [Edit(black, camera, mask_from_upload(context, request.mask, camera), request.name)]
    stored, attached = context.studio.selection.stored(), []
    if stored is not None:
        settings, attached = {**settings, SELECTION: stored[0]}, [stored[1]]
    with progress(context, "look"):
        layer = context.studio.session.add("look", edits, name=request.name, parameters=settings, attached=attached)
    words = [RawExpr("sp.Edit(picture, camera, mask)")] * len(edits)
    line = python_line("session.add", "look", words, name=request.name, parameters=settings)
    return layer_made(context, layer.id, line)


def _settings(context: CommandContext, sliders: GradeSliders) -> dict:
    space = context.studio.session.original.color_space
    return GradeSettings.from_dict({**sliders.model_dump(), "space": space}).to_dict()


def _mask_camera(request: GradePreview | GradeCommit) -> Camera:
    if request.camera is None:
        raise ValueError("look: a mask needs the camera that it was drawn in")
    return request.camera.to_camera()
