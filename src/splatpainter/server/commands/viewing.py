"""Renders, picking, coverage. Nothing here changes the asset."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from typing import Literal

import numpy as np
from pydantic import Field

from splatpainter.cameras import Camera
from splatpainter.color import to_display
from splatpainter.io.files import sha256, writing
from splatpainter.pictures.view_search import NamedView, thumbnail
from splatpainter.rendering.profiles import Profile
from splatpainter.server import picking
from splatpainter.server.commands.context import CommandContext, RawExpr, command, python_line, render_display
from splatpainter.server.describe import up_axis
from splatpainter.server.option_fields import PaintLimits
from splatpainter.server.protocol import (
    MAX_VIEW_PIXELS,
    Answer,
    Blob,
    CameraInfo,
    Command,
    FileName,
    Point,
    Rgb,
)
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.session.kinds.painted_layers import PaintedLayer
from splatpainter.session.project.asset_files import view_files_of
from splatpainter.session.replay.conflicts import PREDICTED, SEEN
from splatpainter.session.replay.conflicts import coverage as covered
from splatpainter.view_files import Aov, PictureOptions

MAX_EXPORT_PIXELS = 1 << 24
"""Most pixels of an exported view: 4096 x 4096."""
PREVIEW_SHARE = 0.4
"""Share of the size of a view that is larger than those on the screen: at most MAX_VIEW_PIXELS again."""
PNG_LEVEL = 1
"""Fast: nobody waits for the last few per cent."""


class PictureMade(Answer):
    picture: Blob
    """A PNG."""
    file: str | None = None
    """Name in the watched folder, where it was written there."""


class ViewRender(Command):
    """The server's float render of a view, as a PNG with its camera inside."""

    NAME = "view.render"
    ANSWER = PictureMade
    camera: CameraInfo
    which: Literal["now", "original"] = "now"
    below: str | None = None
    """Layer whose paint, and what is above it, is left out."""
    profile: Profile = "inria"
    """Which renderer to match; pictures to be painted on have the default."""


@command(ViewRender)
def render_view(context: CommandContext, request: ViewRender) -> PictureMade:
    studio, camera = context.studio, request.camera.to_camera()
    splats = studio.session.splats if request.which == "now" else studio.original
    if request.below is not None:
        # Without the layer and what is above: what a stroke in it is painted over.
        splats = studio.session.layers.below(request.below)
    blob = studio.blobs.put(png_bytes(render_display(splats, camera, request.profile), camera), "render.png")
    keyword = "" if request.profile == "inria" else f", profile={request.profile!r}"
    return PictureMade(picture=blob.sha256, python=f"sp.render(session.splats, camera{keyword})")


class ViewExported(PictureMade):
    picture: Blob
    """The exported picture where it is an 8-bit PNG with a background at the view's size, else such a preview."""
    url: str | None = None
    """Address of the download: the picture, or a zip of it, its AOVs and its sidecar; None for "folder"."""
    name: str = ""
    """Name of what is downloaded."""


class ViewExport(Command):
    """A render to edit elsewhere. to "folder": written into the watched folder as NAME.png with its sidecar; when it is
    saved over, a `picture` event follows."""

    NAME = "view.export"
    ANSWER = ViewExported
    camera: CameraInfo
    to: Literal["download", "folder"] = "download"
    name: FileName = "view"
    size: int | None = Field(default=None, ge=16, le=8192)
    """Pixels of the longer side; None: as the camera says."""
    format: Literal["png", "exr"] = "png"
    bits: Literal[8, 16, 32] | None = None
    """Bits of a colour sample: PNG 8 or 16, OpenEXR 16 or 32; None: the smaller."""
    transparent: Literal["straight", "premultiplied"] | None = None
    """An alpha channel in place of the background; OpenEXR is always premultiplied."""
    aovs: list[Aov] = Field(default_factory=list, max_length=5)
    """Files beside the picture, NAME.AOV.png or .exr."""
    profile: Profile = "inria"


@command(ViewExport, background=True, bound=True)
def export_view(context: CommandContext, request: ViewExport) -> ViewExported:
    studio, camera = context.studio, request.camera.to_camera(MAX_EXPORT_PIXELS)
    snapshot = studio.session.snapshot
    bits, aovs = request.bits, tuple(request.aovs)
    options = PictureOptions(request.format, bits, request.transparent, aovs, request.profile, PNG_LEVEL)
    sized = camera if request.size is None else resized(camera, request.size)
    preview_camera = camera
    # Larger than may be painted: the page gets a smaller picture to compare with.
    if camera.width * camera.height > MAX_VIEW_PIXELS:
        preview_camera = resized(camera, round(max(camera.width, camera.height) * PREVIEW_SHARE))
    image = render_display(snapshot.splats, preview_camera, request.profile)
    context.ticket.report(0, "rendering the view")
    outputs = view_files_of(snapshot.splats, snapshot.state.edited, sized, request.name, options)
    # One picture alone is sent as it is; with files beside it they go together.
    first, file, url, download = next(iter(outputs)), None, None, ""
    if request.to == "folder":
        file = _write_to_folder(context, outputs)
    else:
        path = studio.downloads.folder() / (first if len(outputs) == 2 else f"{request.name}.zip")
        with writing(path) as out:
            if len(outputs) == 2:  # it carries what the sidecar says
                out.write(outputs[first])
            else:
                with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as bundle:
                    for name, data in outputs.items():
                        bundle.writestr(name, data)
        url, download = studio.downloads.add(path), path.name
    plain = (options.format, options.depth, options.transparent, sized) == ("png", 8, None, preview_camera)
    preview = outputs[first] if plain else png_bytes(image, preview_camera)
    blob = studio.blobs.put(preview, f"{request.name}.png")
    # Remembered, so that the picture is known again when it comes back without its camera.
    studio.exports.note(NamedView(first, sized, thumbnail(image)))
    keywords = {"bits": bits, "transparent": request.transparent, "aovs": list(aovs) or None}
    keywords["profile"] = None if request.profile == "inria" else request.profile
    line = python_line("session.files.export_view", first, RawExpr("camera"), **keywords)
    return ViewExported(picture=blob.sha256, file=file, url=url, name=download, python=line)


def resized(camera: Camera, size: int) -> Camera:
    """The same view with `size` pixels on its longer side. Raises ValueError: too many in all."""
    view = camera.with_longest_side(size)
    if view.width * view.height > MAX_EXPORT_PIXELS:
        pixels = f"{view.width}x{view.height}"
        raise ValueError(f"view: expected at most {MAX_EXPORT_PIXELS / 1e6:.1f} megapixels, got {pixels}")
    return view


def _write_to_folder(context: CommandContext, outputs: Mapping[str, bytes]) -> str:
    """Write files into the watched folder; returns the name of the first."""
    studio = context.studio
    if studio.folder is None:
        raise ValueError("view: the studio was started without a folder; download the picture instead")
    paths = [studio.folder.file(name, new=True) for name in outputs]
    for path, data in zip(paths, outputs.values(), strict=True):
        studio.written[path.name] = sha256(data)  # before the watcher sees it
        with writing(path) as file:
            file.write(data)
    return paths[0].name


class Picked(Answer):
    hit: bool
    """Whether the asset covers the pixel by more than half; else depth, point and gaussian_id are None."""
    depth: float | None
    """z, world units."""
    point: Point | None
    """World coordinates."""
    gaussian_id: int | None
    """The Gaussian that gives the pixel most of its colour."""
    color: Rgb
    """Colour as seen, display sRGB 0..1."""


class Pick(Command):
    NAME = "pick"
    ANSWER = Picked
    camera: CameraInfo
    x: float
    y: float
    """Pixels; the first pixel's centre is 0.5, 0.5."""


@command(Pick)
def pick(context: CommandContext, request: Pick) -> Picked:
    splats, camera = context.studio.session.splats, request.camera.to_camera()
    color, hit = picking.pick(splats, camera, request.x, request.y)
    rgb = np.clip(to_display(color, splats.color_space), 0, 1).tolist()
    if hit is None:
        return Picked(hit=False, depth=None, point=None, gaussian_id=None, color=rgb)
    return Picked(hit=True, depth=hit.depth, point=hit.point.tolist(), gaussian_id=hit.gaussian_id, color=rgb)


class Covered(Answer):
    seen: int
    """Gaussians that edited views show."""
    predicted: int
    """Gaussians that global layers changed without having seen them."""
    picture: Blob
    """PNG of the view, of its size: green seen, red predicted, transparent neither."""
    next_view: CameraInfo | None
    """Faces the largest area that was predicted and not seen; None where there is none."""


class CoverageShow(Command):
    """What of the current asset was seen by edited views and what is predicted."""

    NAME = "coverage"
    ANSWER = Covered
    camera: CameraInfo


@command(CoverageShow)
def coverage(context: CommandContext, request: CoverageShow) -> Covered:
    studio, camera = context.studio, request.camera.to_camera()
    snapshot = studio.session.snapshot
    splats, kinds = snapshot.splats, covered(snapshot.state.edited, len(snapshot.splats))
    picture = picking.coverage_picture(splats, kinds, camera)
    view = picking.next_view(splats, kinds, camera, np.array(studio.state.asset.center), up_axis(studio.session))
    return Covered(
        seen=int((kinds == SEEN).sum()),
        predicted=int((kinds == PREDICTED).sum()),
        picture=studio.blobs.put(png_bytes(picture), "coverage.png").sha256,
        next_view=None if view is None else CameraInfo.of(view),
        python="session.layers.coverage()",
    )


class ConfidencePicture(Answer):
    picture: Blob
    """PNG of the view, of its size: green sure, yellow at the threshold, red and blue not reached, transparent 0."""


class SpreadShow(Command):
    """How sure a layer of mode spread is of what a view shows."""

    NAME = "spread.show"
    ANSWER = ConfidencePicture
    camera: CameraInfo
    layer: str


@command(SpreadShow)
def show_spread(context: CommandContext, request: SpreadShow) -> ConfidencePicture:
    from splatpainter.spread.overlay import confidence_overlay

    studio, session = context.studio, context.studio.session
    confidence, splats = session.layers.confidence(request.layer), session.splats
    if len(confidence) != len(splats):
        raise ValueError("spread: the asset has changed meanwhile; ask again")
    operation = session.layers.by_id(request.layer).operation
    assert isinstance(operation, PaintedLayer), "it has a confidence"
    threshold = operation.spread_options().threshold
    picture = confidence_overlay(splats, confidence, threshold, request.camera.to_camera())
    blob = studio.blobs.put(png_bytes(picture), "confidence.png")
    return ConfidencePicture(picture=blob.sha256, python=python_line("session.layers.confidence", request.layer))


class LeftOut(Answer):
    picture: Blob
    """PNG of the view, of its size: opaque where paint would be left out by more than half, else transparent."""
    pixels: int
    """How many those are."""


class LimitsShow(Command):
    """Which pixels of a view the limits would leave out if all of it was painted. Right to about a block of 1/128 of
    the view's longer side; what the view sees is kept, so other limits on the same view come quickly."""

    NAME = "paint.limits"
    ANSWER = LeftOut
    camera: CameraInfo
    limits: PaintLimits = PaintLimits()


@command(LimitsShow)
def show_limits(context: CommandContext, request: LimitsShow) -> LeftOut:
    studio, limits = context.studio, request.limits.options()
    mask = studio.session.surface.left_out(request.camera.to_camera(), **limits)
    picture = np.where(mask[..., None], np.uint8(255), np.uint8(0)).repeat(4, 2)
    blob = studio.blobs.put(png_bytes(picture), "limits.png")
    line = python_line("session.surface.left_out", RawExpr("camera"), **limits)
    return LeftOut(picture=blob.sha256, pixels=int(mask.sum()), python=line)
