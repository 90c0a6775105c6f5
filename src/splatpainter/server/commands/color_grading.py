"""Colours of the whole asset or of what is selected: sliders, a LUT, the colours of a picture, one new colour; shown at
once, kept as an adjustment layer."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import Field

from splatpainter.cameras import Camera
from splatpainter.color import from_hex
from splatpainter.grading.color_grading import GradeSettings, HueBand
from splatpainter.grading.color_match import AffineMap, ColorMap, ColorMatch, NewColor, Recolor
from splatpainter.grading.color_transfer import LUT, RECOLOR, transfer_parameters, with_table
from splatpainter.grading.cube_lut import CubeLut, read_cube
from splatpainter.io import files
from splatpainter.lift.masked_gaussians import reached_gaussians
from splatpainter.operations.grade import fitted
from splatpainter.painter import Edit
from splatpainter.pictures.picture_reader import read_picture
from splatpainter.server import frames
from splatpainter.server.commands.context import (
    CommandContext,
    RawExpr,
    command,
    layer_made,
    mask_from_upload,
    naming_errors,
    progress,
    python_line,
)
from splatpainter.server.current_selection import limited
from splatpainter.server.message import options_message
from splatpainter.server.protocol import Blob, CameraInfo, Command, LayerMade, Name, Previewed
from splatpainter.server.studio import Studio
from splatpainter.session import Session
from splatpainter.session.kinds.look_layers import look_of
from splatpainter.session.replay.layer_blending import ADJUSTMENTS, adjust_sh
from splatpainter.splats import BLOCK_ROWS, Splats, changed_rows


class HueSliders(options_message("HueOptions", HueBand, [entry.name for entry in fields(HueBand)])):
    """A change of one range of hues."""


class GradeSliders(
    options_message(
        "SliderOptions",
        GradeSettings,
        [entry.name for entry in fields(GradeSettings) if entry.name != "space"],
        parts={HueBand: HueSliders},
    )
):
    """Global sliders; zeros change nothing."""


class ColorTransfer(options_message("TransferOptions", GradeSettings, ("strength",))):
    """Colours that come from elsewhere."""

    kind: Literal["lut", "match", "recolor"]
    file: Blob | None = None
    """File of a lut (a .cube table) or a match (a reference picture)."""
    color: str | None = Field(default=None, pattern="^#[0-9a-fA-F]{6}$")
    """Colour of recolor."""


class GradePreview(Command):
    """Show the sliders, or colours from elsewhere, on all Gaussians, or on those that a mask reaches, without a layer:
    the colours come as a frame with the PREVIEW flag. Neither: end the preview."""

    NAME = "look.preview"
    ANSWER = Previewed
    look: GradeSliders | None = None
    transfer: ColorTransfer | None = None
    mask: Blob | None = None
    camera: CameraInfo | None = None
    """The view of the mask."""


@command(GradePreview)
def preview_grade(context: CommandContext, request: GradePreview) -> Previewed:
    context.page.strokes.clear()
    # A new preview replaces the one before, also where it shows nothing.
    context.clear_preview = True
    # Neither sliders nor colours: the preview is over.
    if request.look is None and request.transfer is None:
        return Previewed(gaussians=0)
    snapshot = context.studio.session.snapshot
    splats = snapshot.splats
    reached = None
    if request.mask is not None:
        camera = _mask_camera(request)
        reached = reached_gaussians(splats, [(camera, mask_from_upload(context, request.mask, camera))])
    settings, attached = _parameters(context, request, splats, reached)
    tables = {files.sha256(data): data for data in attached}
    # Tables are looked up by their hash, as a layer would do it, so that preview and layer agree.
    sh = adjust_sh(splats.sh, with_table(settings, tables.__getitem__), ADJUSTMENTS)
    if reached is not None:
        sh = np.where(reached[:, None, None], sh, splats.sh)
    # Limited by the mask and by what is selected, each as far as it reaches.
    sh = limited(splats, context.studio.selection.weights(), sh)
    # Only what differs is sent, and of that only base colours where the rest is unchanged.
    ids = changed_rows(splats, replace(splats, sh=sh))
    if len(ids):
        every = len(ids) == len(splats)  # as a rule; 100,000 Gaussians need not be copied for it
        new, old = (sh, splats.sh) if every else (sh[ids], splats.sh[ids])
        new = new[:, :1] if _same_bands(new, old) else new
        context.preview = frames.preview_colors(new, ids, len(splats), snapshot.version)
        context.previewed_ids = ids
    return Previewed(gaussians=len(ids))


def _same_bands(new: np.ndarray, old: np.ndarray) -> bool:
    """Whether no coefficient but the first of SH ([C, K, 3] each) differs: mostly the first rows tell that some do."""
    blocks = (slice(k, k + BLOCK_ROWS) for k in range(0, len(new), BLOCK_ROWS))
    return all(np.array_equal(new[block, 1:], old[block, 1:]) for block in blocks)


class GradeCommit(Command):
    """The sliders, or colours from elsewhere, as an adjustment layer."""

    NAME = "look.commit"
    ANSWER = LayerMade
    look: GradeSliders | None = None
    transfer: ColorTransfer | None = None
    name: Name = "Adjustment"
    mask: Blob | None = None
    camera: CameraInfo | None = None


@command(GradeCommit, writes=True)
def commit_grade(context: CommandContext, request: GradeCommit) -> LayerMade:
    context.clear_preview = True
    session, edits, reached = context.studio.session, [], None
    if request.mask is not None:
        camera = _mask_camera(request)
        mask = mask_from_upload(context, request.mask, camera)
        # A mask needs a view and no picture: what is inside it is what the look changes.
        black = np.zeros((camera.height, camera.width, 3), np.float32)  # only the mask counts
        edits, reached = [Edit(black, camera, mask, request.name)], reached_gaussians(session.splats, [(camera, mask)])
    settings, attached = _parameters(context, request, session.splats, reached)
    stored = context.studio.selection.stored()
    # The selection as it is now belongs to the layer; what is selected later does not move it.
    if stored is not None:
        attached = [*attached, stored[1]]
    look = look_of(settings, None if stored is None else stored[0])
    with progress(context, "look"):
        layer = session.layers.add(look, edits, name=request.name, attached=attached)
    words = [RawExpr("sp.Edit(picture, camera, mask)")] * len(edits)
    options = {name: value for name, value in look.changes().items() if name != "method"}
    line = python_line("session.layers.add", "look", words, name=request.name, **options)
    return layer_made(context, layer.id, line)


def _parameters(
    context: CommandContext, request: GradePreview | GradeCommit, splats: Splats, reached: np.ndarray | None
) -> tuple[dict[str, Any], list[bytes]]:
    """(parameters of the layer, the pictures that it keeps). reached: [N] bool the Gaussians that a mask reaches."""
    # Sliders are the same for every asset and need no fitting.
    if request.transfer is None and request.look is not None:
        return settings_of(context.studio, request.look), []
    if request.transfer is None or request.look is not None:
        raise ValueError("look: expected either sliders or colours from elsewhere")
    transfer, studio = request.transfer, context.studio
    # Fitted to what it will change: the colours of the rest have no say.
    weights = studio.selection.weights()
    if reached is not None:
        weights = reached.astype(np.float32) if weights is None else weights * reached
    look, name = _look(context, transfer)
    # Fitting looks at all Gaussians; a slider of strength asks for it many times a second.
    key = (studio.session.version, studio.selection.revision, transfer.kind, transfer.file, transfer.color)
    cached = _latest_fits.get(studio.session)
    if cached is None or cached[0] != key or reached is not None:
        cached = _latest_fits[studio.session] = (key, fitted(splats, look, weights))
    function = cached[1]
    assert isinstance(function, CubeLut | AffineMap | NewColor)
    return transfer_parameters(function, name, transfer.strength, studio.session.original.color_space)


_latest_fits: WeakKeyDictionary[Session, tuple[tuple, ColorMap]] = WeakKeyDictionary()
"""The latest colours from elsewhere, fitted: a slider of their strength need not have them fitted again."""


def _look(context: CommandContext, transfer: ColorTransfer) -> tuple[CubeLut | ColorMatch | Recolor, str]:
    """(what is fitted, its name for people)."""
    if transfer.kind == RECOLOR:
        color = None if transfer.color is None else from_hex(transfer.color)
        # From one colour or from a file; both together would leave one without effect.
        if transfer.color is None or color is None or transfer.file is not None:
            raise ValueError("look: expected a colour, and no file, to recolour with")
        return Recolor(color), transfer.color
    if transfer.file is None or transfer.color is not None:
        raise ValueError("look: expected a file, and no colour: a .cube table, or a reference picture")
    blob = context.studio.blobs.get(transfer.file, "lut" if transfer.kind == LUT else "picture")
    name = blob.name or transfer.kind
    with naming_errors(blob.path, name):
        if transfer.kind == LUT:
            return cube_of(blob.path), name
        return ColorMatch(read_picture(blob.path), name), name


@lru_cache(maxsize=2)
def cube_of(path: Path) -> CubeLut:
    """The table of an upload, whose path is its hash."""
    return read_cube(path)


def settings_of(studio: Studio, sliders: GradeSliders) -> dict[str, Any]:
    """Parameters of a layer."""
    space = studio.session.original.color_space
    return GradeSettings.from_dict({**sliders.model_dump(), "space": space}).to_dict()


def _mask_camera(request: GradePreview | GradeCommit) -> Camera:
    if request.camera is None:
        raise ValueError("look: a mask needs the camera that it was drawn in")
    return request.camera.to_camera()
