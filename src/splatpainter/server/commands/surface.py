"""What painting tools ask of the asset: the surface of a view, its main colours."""

from __future__ import annotations

import base64

from pydantic import Field

from splatpainter.painting.edit_receipt import LOW_ASIDE_DB, MIN_ASIDE_COVERED
from splatpainter.server.commands.context import CommandContext, command
from splatpainter.server.describe import up_axis
from splatpainter.server.palette import MAX_COLORS, main_colors
from splatpainter.server.protocol import Answer, CameraInfo, Command, Point, Rgb, Unit
from splatpainter.session.measures.mirror_plane import find_mirror_plane


class SurfaceSeen(Answer):
    block: int
    """Pixels along a side of the blocks."""
    columns: int
    rows: int
    data: str
    """Base64 of [rows, columns, 4] float32, little-endian: z-depth of the surface in the block's middle (0: none that
    is trusted) and its unit normal towards the camera, camera space."""


class ViewSurface(Command):
    """Where the surface lies that a view sees, on blocks of about 1/128 of its longer side."""

    NAME = "view.surface"
    ANSWER = SurfaceSeen
    camera: CameraInfo


@command(ViewSurface)
def view_surface(context: CommandContext, request: ViewSurface) -> SurfaceSeen:
    # On blocks: tools want to know where the surface lies, not how each pixel looks.
    table, block = context.studio.session.surface.blocks(request.camera.to_camera())
    rows, columns = table.shape[:2]
    data = base64.b64encode(table.astype("<f4").tobytes()).decode()
    return SurfaceSeen(block=block, columns=columns, rows=rows, data=data)


class Palette(Answer):
    colors: list[Rgb]
    """Display sRGB 0..1, dark to light; fewer than asked for where the asset has not so many."""


class AssetPalette(Command):
    """The main colours of the asset as it is now, by the area that they cover."""

    NAME = "asset.palette"
    ANSWER = Palette
    count: int = Field(default=12, ge=1, le=MAX_COLORS)


@command(AssetPalette)
def asset_palette(context: CommandContext, request: AssetPalette) -> Palette:
    colors = main_colors(context.studio.session.splats, request.count)
    return Palette(colors=[[round(float(value), 4) for value in color] for color in colors])


class SymmetryPlane(Answer):
    normal: Point
    """Unit."""
    offset: float
    """normal x = offset, world units."""
    agreement: Unit
    """Agreement of the asset with its mirror image; 1: they are the same."""


class SymmetryFind(Command):
    """The plane in which the original is most nearly its own mirror image."""

    NAME = "symmetry.find"
    ANSWER = SymmetryPlane


@command(SymmetryFind)
def find_symmetry(context: CommandContext, request: SymmetryFind) -> SymmetryPlane:
    session = context.studio.session
    plane = find_mirror_plane(session.original, up_axis(session))
    return SymmetryPlane(normal=list(plane.normal), offset=plane.offset, agreement=plane.agreement)


class AsideSeen(Answer):
    psnr: float | None
    """dB against the painted picture moved to the sides, of the view that is worst; None: nothing could be compared."""
    low: bool
    """Whether it is so low that one should look from other views."""


class AsideScored(Command):
    """How a layer's latest stroke, or its edited pictures, look 35 degrees from the side."""

    NAME = "aside"
    ANSWER = AsideSeen
    layer: str


@command(AsideScored, background=True)
def score_aside(context: CommandContext, request: AsideScored) -> AsideSeen:
    scores = context.studio.session.strokes.side_scores(request.layer)
    # Views that see hardly anything of the paint would score by chance.
    values = [score.psnr for score in scores if score.psnr is not None and score.covered > MIN_ASIDE_COVERED]
    worst = min(values, default=None)
    return AsideSeen(psnr=worst, low=worst is not None and worst < LOW_ASIDE_DB)
