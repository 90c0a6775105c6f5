"""Texts and pictures laid on the surface under a pixel, unwrapped over it."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from splatpainter.painter import Method
from splatpainter.server.commands.context import (
    CommandContext,
    RawExpr,
    command,
    naming_errors,
    progress,
    python_line,
)
from splatpainter.server.commands.painting import within_selection
from splatpainter.server.describe import layer_info
from splatpainter.server.protocol import (
    Blob,
    CameraInfo,
    Command,
    LayerMade,
    Name,
    PaintLimits,
    Placed,
    Unit,
)
from splatpainter.session.document import PLACED
from splatpainter.sources.decals import LITTLE_COVERAGE, Decal
from splatpainter.sources.picture_reader import read_picture


class DecalLaid(LayerMade):
    coverage: Unit
    """Share of what is opaque in the picture that lies on the surface; the rest hangs over its edges."""
    views: int
    """Number of cameras that it was painted from."""
    note: str = ""
    """What to know of it, one line; "" where nothing is remarkable."""


class DecalLay(Command):
    """A text or a picture as a layer of paint that lies on the surface under a pixel, unwrapped over it: painted from
    one to six cameras that face parts of it."""

    NAME = "decal.lay"
    ANSWER = DecalLaid
    camera: CameraInfo
    x: float
    y: float
    """Pixel under which its middle lies."""
    picture: Blob
    """The picture, with alpha where it is not a rectangle."""
    width: float = Field(gt=0)
    """World units along the surface."""
    angle: float = 0.0
    """Degrees, counter-clockwise as seen from outside; at 0 its up is the view's."""
    wrap: float = Field(default=180.0, gt=0, le=180)
    """Degrees by which the surface may turn away from where it faces under the pixel; 180: no limit."""
    placed: Placed | None = None
    """What can be changed later."""
    replaces: str | None = None
    """Layer that it replaces, as in paint.end."""
    gesture: Name | None = None
    """Gesture as in layer.set, with `replaces`."""
    name: Name = "Decal"
    method: Method = "auto"
    limits: PaintLimits = PaintLimits()


@command(DecalLay, writes=True)
def lay_decal(context: CommandContext, request: DecalLay) -> DecalLaid:
    studio, session = context.studio, context.studio.session
    blob = studio.blobs.get(request.picture, "picture")
    with naming_errors(blob.path, blob.name or "picture"):
        picture = read_picture(blob.path)
    at, camera = (request.x, request.y), request.camera.to_camera()
    decal = Decal(picture, at, camera, request.width, request.angle, request.wrap, request.name)
    attached: list[bytes] = []
    parameters: dict[str, Any] = request.limits.parameters()
    if request.placed is not None:
        parameters[PLACED] = request.placed.model_dump()
        if request.placed.image is not None:
            attached = [studio.picture_bytes(request.placed.image)[0]]
    with progress(context, "laying it on the surface"):
        laid = session.laid(decal, replaces=request.replaces)
        edits = [part for edit in laid.edits if (part := within_selection(studio, edit, required=False)) is not None]
        if not edits:
            raise ValueError(f"{request.name}: nothing of it lies on what is selected; deselect first")
        options: dict[str, Any] = {"name": request.name, "parameters": parameters}
        if request.replaces is not None:
            layer = session.replace_views(
                request.replaces, edits, **options, gesture=request.gesture, attached=attached
            )
        else:
            layer = session.add("paint", edits, **options, method=request.method, attached=attached)
    context.clear_preview = True
    decal_line = python_line(
        "sp.Decal", RawExpr("picture"), at, RawExpr("camera"), request.width, request.angle, request.wrap
    )
    line = python_line("session.add", "paint", RawExpr(f"session.laid({decal_line}).edits"), name=request.name)
    return DecalLaid(
        layer=layer_info(session, layer),
        python=line,
        coverage=laid.coverage,
        views=len(edits),
        note=laid.note if laid.coverage < LITTLE_COVERAGE else "",
    )
