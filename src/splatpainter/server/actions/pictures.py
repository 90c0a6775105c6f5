"""A picture that comes back: found its camera, put straight, compared. Changes nothing."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np

from splatpainter.cameras import Alpha, Camera, find_alpha, find_camera
from splatpainter.server import pictures
from splatpainter.server.actions import Call, handles
from splatpainter.server.actions.common import camera_of, draw, draw_alpha
from splatpainter.server.blobs import Blob
from splatpainter.server.crops import Crop, error_at, find_crop
from splatpainter.server.describe import camera_to_wire
from splatpainter.server.messages import looking as say
from splatpainter.server.messages.base import PIXELS
from splatpainter.sources.color import to_display
from splatpainter.sources.files import over_render, unmultiplied
from splatpainter.sources.pictures import Picture, read_picture

CUT_FROM = 8
"""Latest exported views that a picture without a camera may be a part of."""
CLEARLY = 0.5
"""A picture of its view's shape is a part of it only where that agrees better by this factor."""


@handles(say.PictureCheck)
def check(call: Call, command: say.PictureCheck) -> say.Checked:
    studio = call.studio
    blob = studio.blobs.get(command.picture, "picture")
    name = command.name or blob.name or "picture"
    picture = read_picture(blob.path)
    camera, found = _camera(call, command, blob, name, picture)
    kind = _alpha_kind(call, blob, name)
    picture = unmultiplied(picture, kind)
    notes, warnings = list(picture.notes), []
    wanted = (camera.width, camera.height)
    render = _drawn(call, camera)
    crop = _crop(picture, render)
    if crop is None and not pictures.same_shape(picture.size, wanted):
        got, want = f"{picture.size[0]}x{picture.size[1]}", f"{wanted[0]}x{wanted[1]}"
        raise ValueError(
            f"{name}: expected the shape of its view ({want}) or a part of it, got {got}, which is like no part; "
            "resize without cropping"
        )
    shift = (0, 0)
    if crop is not None:
        colors = render.copy()
        colors[crop.window] = _flat(picture, render[crop.window], (crop.width, crop.height))
        notes.append(f"a part of its view: {crop.width}x{crop.height} at {crop.x}, {crop.y}; the rest is as it was")
    else:
        if picture.size != wanted:
            notes.append(f"resampled from {picture.size[0]}x{picture.size[1]} to its camera's {wanted[0]}x{wanted[1]}")
        colors = _flat(picture, render, wanted) if kind is None else _cut_out(call, picture, render, camera)
        shift = pictures.shift_of(colors, render)
    if shift != (0, 0):
        colors = pictures.moved_back(colors, render, *shift)
        notes.append(f"moved back by {shift[0]}, {shift[1]} pixels")
    mask = pictures.changed(colors, render, command.threshold)
    share = float(mask.mean())
    if camera.asset_sha256 not in (None, studio.original.sha256):
        text = "The picture was rendered from another asset: every difference counts as an edit."
        warnings.append(say.PictureWarning(message=text))
    if share > pictures.WHOLE:
        text = f"{100 * share:.0f} % of the picture changed. If it was regraded as a whole, use it as a look (global)."
        warnings.append(say.PictureWarning(message=text))
    else:
        faint = pictures.faint_changes(colors, render, mask)
        if faint.mean() > pictures.SPREAD * (1 - share):
            text = (
                f"{100 * faint.mean():.0f} % of the picture changed a little outside the edit; it will be left alone."
            )
            shown = studio.blobs.put(pictures.png_bytes(pictures.overlay(faint)), "outside.png").sha256
            warnings.append(say.PictureWarning(message=text, picture=shown))
    if not mask.any():
        warnings.append(say.PictureWarning(message="The picture does not differ from the asset as it is now."))
    return say.Checked(
        camera=camera_to_wire(camera),
        found=found,
        picture=studio.blobs.put(pictures.png_bytes(colors), name).sha256,
        mask=studio.blobs.put(pictures.png_bytes(mask), "mask.png").sha256,
        share=share,
        shift=shift,
        notes=notes,
        warnings=warnings,
    )


def _camera(call: Call, command: say.PictureCheck, blob: Blob, name: str, picture: Picture) -> tuple[Camera, say.Found]:
    """The camera of a picture and where it was found. Raises ValueError where there is none."""
    camera, found = _search(call, command, blob, name, picture)
    pixels = camera.width * camera.height
    if pixels > PIXELS:  # a view that was exported larger than one is painted: the picture is shrunk with it
        scale = (PIXELS / pixels) ** 0.5
        camera = camera.resized(max(1, int(scale * camera.width)), max(1, int(scale * camera.height)))
    return camera, found


def _alpha_kind(call: Call, blob: Blob, name: str) -> Alpha | None:
    """How a picture that was exported without a background keeps its colours, as it or its sidecar says."""
    kind = find_alpha(blob.path)
    if kind is None and call.studio.folder is not None:
        with contextlib.suppress(ValueError):
            kind = find_alpha(blob.path, call.studio.folder.file(f"{Path(Path(name).name).stem}.json"))
    return kind


def _cut_out(call: Call, picture: Picture, render: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W, 3] a picture that was exported without a background, with the view's background."""
    fitted = picture.resized(camera.width, camera.height)
    if fitted.alpha is None:
        return fitted.colors
    splats = call.studio.session.splats
    cover = draw_alpha(splats, camera)
    red, green, blue = to_display(np.array(camera.background), splats.color_space).tolist()
    return over_render(fitted.colors, fitted.alpha, render, cover, (red, green, blue))


def _search(call: Call, command: say.PictureCheck, blob: Blob, name: str, picture: Picture) -> tuple[Camera, say.Found]:
    studio = call.studio
    if command.camera is not None:
        return camera_of(command.camera), "given"
    with contextlib.suppress(ValueError):
        return find_camera(blob.path), "chunk"
    stem = Path(Path(name).name).stem
    if studio.folder is not None and stem:
        with contextlib.suppress(ValueError):
            sidecar = studio.folder.file(f"{stem}.json")
            return find_camera(blob.path, sidecar), "sidecar"
    fitting = [e for e in studio.exports if pictures.same_shape(picture.size, (e.camera.width, e.camera.height))]
    for export in reversed(fitting):
        if Path(export.name).stem == stem and stem != "view":
            return export.camera, "export"
    colors = picture.colors if picture.alpha is None else picture.colors * picture.alpha[..., None]
    best = pictures.most_alike(colors, [export.small for export in fitting])
    if best is None:
        cropped = _cut_from(call, colors)
        if cropped is not None:
            return cropped, "export"
        raise ValueError(
            f"{name}: it carries no camera and is like no exported view; turn to its view and drop it there"
        )
    return fitting[best].camera, "export"


def _crop(picture: Picture, render: np.ndarray) -> Crop | None:
    """The part of the view that the picture shows; None where it shows all of it, or none that can be told."""
    height, width = render.shape[:2]
    if picture.size == (width, height):
        return None
    found = find_crop(_opaque(picture), render)
    if found is not None and pictures.same_shape(picture.size, (width, height)):
        whole = error_at(_opaque(picture, (width, height)), render)
        return found if found.error < CLEARLY * whole else None
    return found


def _cut_from(call: Call, colors: np.ndarray) -> Camera | None:
    """The latest exported view that a picture is a part of."""
    for export in list(call.studio.exports)[: -CUT_FROM - 1 : -1]:
        call.ticket.check()
        if find_crop(colors, _drawn(call, export.camera)) is not None:
            return export.camera
    return None


def _drawn(call: Call, camera: Camera) -> np.ndarray:
    return np.clip(draw(call.studio.session.splats, camera), 0, 1)


def _opaque(picture: Picture, size: tuple[int, int] | None = None) -> np.ndarray:
    """[H, W, 3] its colours over black."""
    own = picture.resized(*(size or picture.size))
    return own.colors if own.alpha is None else own.colors * own.alpha[..., None]


def _flat(picture: Picture, render: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """[H, W, 3] the picture at a size over the render, where it is transparent."""
    own = picture.resized(*size)
    if own.alpha is None:
        return own.colors
    return own.alpha[..., None] * own.colors + (1 - own.alpha[..., None]) * render
