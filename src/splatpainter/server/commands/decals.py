"""Texts and pictures laid on the surface under a pixel, unwrapped over it."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from pydantic import Field

from splatpainter.decals.decal_placement import blocks_of
from splatpainter.decals.decals import LITTLE_COVERAGE, Decal
from splatpainter.operations.decal import LayDecal
from splatpainter.painter import Method
from splatpainter.pictures.picture_reader import Picture, read_picture
from splatpainter.server.commands.context import (
    CommandContext,
    RawExpr,
    command,
    naming_errors,
    progress,
    python_line,
)
from splatpainter.server.commands.painting import NO_LIMITS, within_selection
from splatpainter.server.describe import layer_info, up_axis
from splatpainter.server.message import options_message
from splatpainter.server.option_fields import PaintLimits
from splatpainter.server.protocol import (
    Answer,
    Blob,
    CameraInfo,
    Command,
    LayerMade,
    Name,
    Placed,
    Unit,
)


class DecalLaid(LayerMade):
    coverage: Unit
    """Share of what is opaque in the picture that lies on the surface; the rest hangs over its edges."""
    views: int
    """Number of cameras that it was painted from."""
    note: str = ""
    """What to know of it, one line; "" where nothing is remarkable."""


class PlacedDecal(options_message("DecalOptions", LayDecal, ("angle", "wrap")), Command):
    """Where a decal lies on the surface."""

    camera: CameraInfo
    x: float
    y: float
    """Pixel under which its middle lies."""
    width: float = Field(gt=0)
    """World units along the surface."""
    replaces: str | None = None
    """Layer that it replaces, as in paint.end."""


class DecalLay(PlacedDecal):
    """A text or a picture as a layer of paint that lies on the surface under a pixel, unwrapped over it: painted from
    one to six cameras that face parts of it."""

    NAME = "decal.lay"
    ANSWER = DecalLaid
    picture: Blob
    """The picture, with alpha where it is not a rectangle."""
    placed: Placed | None = None
    """What can be changed later."""
    gesture: Name | None = None
    """Gesture as in layer.set, with `replaces`."""
    name: Name = "Decal"
    method: Method = "auto"
    limits: PaintLimits = PaintLimits()


@command(DecalLay, writes=True)
def lay_decal(context: CommandContext, request: DecalLay) -> DecalLaid:
    studio, session = context.studio, context.studio.session
    blob = studio.blobs.get(request.picture, "picture")
    # The picture is read before anything is laid: a damaged one must change nothing.
    with naming_errors(blob.path, blob.name or "picture"):
        picture = read_picture(blob.path)
    at, camera = (request.x, request.y), request.camera.to_camera()
    # Up is the world's, so that a decal on what lies flat stands as the view does.
    level = up_axis(session)
    decal = Decal(picture, at, camera, request.width, request.angle, request.wrap, request.name, level)
    # What can be changed later is stored with the layer, its picture included.
    attached: list[bytes] = []
    options: dict[str, Any] = request.limits.options()
    if request.placed is not None:
        options["placed"] = request.placed.model_dump()
        if request.placed.image is not None:
            attached = [studio.picture_bytes(request.placed.image)[0]]
    with progress(context, "laying it on the surface"):
        laid = session.surface.laid(decal, replaces=request.replaces)
        # Cut to what is selected; views in which nothing of that is seen are left out.
        edits = [part for edit in laid.edits if (part := within_selection(studio, edit, required=False)) is not None]
        if not edits:
            raise ValueError(f"{request.name}: nothing of it lies on what is selected; deselect first")
        # In place of an old content the layer keeps its position, opacity and blend.
        if request.replaces is not None:
            layer = session.layers.replace_views(
                request.replaces,
                edits,
                name=request.name,
                gesture=request.gesture,
                attached=attached,
                **{**NO_LIMITS, **options},
            )
        else:
            layer = session.layers.add(
                "paint", edits, name=request.name, method=request.method, attached=attached, **options
            )
    # The page previewed the decal itself; the layer takes its place.
    context.clear_preview = True
    decal_line = python_line(
        "sp.Decal", RawExpr("picture"), at, RawExpr("camera"), request.width, request.angle, request.wrap, level=level
    )
    edits_line = RawExpr(f"session.surface.laid({decal_line}).edits")
    line = python_line("session.layers.add", "paint", edits_line, name=request.name)
    return DecalLaid(
        layer=layer_info(session, layer),
        python=line,
        coverage=laid.coverage,
        views=len(edits),
        # Only where a good part hangs over the edges: else the note would be said each time.
        note=laid.note if laid.coverage < LITTLE_COVERAGE else "",
    )


class DecalMap(Answer):
    block: int
    """Pixels of the view along a side of the blocks."""
    columns: int
    rows: int
    data: str
    """Base64 of [rows, columns, 2] float32, little-endian: which place of the picture the middle of each block shows,
    world units right and up of the picture's; NaN: none."""


class DecalShow(PlacedDecal):
    """Where decal.lay would lay a picture, as a view shows it. Nothing changes."""

    NAME = "decal.show"
    ANSWER = DecalMap
    columns: int = Field(ge=1, le=65536)
    """Size of the picture, pixels."""
    rows: int = Field(ge=1, le=65536)
    view: CameraInfo
    """On which it is shown."""


@command(DecalShow, background=True)
def show_decal(context: CommandContext, request: DecalShow) -> DecalMap:
    session = context.studio.session
    # Only the picture's size says where it lies: just as when it is laid, so that both are surveyed once.
    plain = Picture(np.broadcast_to(np.float32(1), (request.rows, request.columns, 3)), None)
    camera, level = request.camera.to_camera(), up_axis(session)
    at, width = (request.x, request.y), request.width
    decal = Decal(plain, at, camera, width, request.angle, request.wrap, level=level)
    view, block = blocks_of(request.view.to_camera())
    # On blocks: the page needs the place of each to draw the preview, not every pixel's.
    table = session.surface.decal_map(decal, view, replaces=request.replaces)
    rows, columns = table.shape[:2]
    data = base64.b64encode(table.astype("<f4").tobytes()).decode()
    return DecalMap(block=block, columns=columns, rows=rows, data=data)
