"""A picture that comes back: found its camera, put straight, compared. Changes nothing."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np

from splatpainter.cameras import Camera, find_camera
from splatpainter.sources.pictures import Picture, read_picture
from splatpainter.studio import pictures
from splatpainter.studio.actions import Call, handles
from splatpainter.studio.actions.common import camera_of, draw
from splatpainter.studio.blobs import Blob
from splatpainter.studio.describe import camera_to_wire
from splatpainter.studio.messages import looking as say
from splatpainter.studio.messages.base import PIXELS


@handles(say.PictureCheck)
def check(call: Call, command: say.PictureCheck) -> say.Checked:
    studio = call.studio
    blob = studio.blobs.get(command.picture, "picture")
    name = command.name or blob.name or "picture"
    picture = read_picture(blob.path)
    camera, found = _camera(call, command, blob, name, picture)
    notes, warnings = list(picture.notes), []
    wanted = (camera.width, camera.height)
    if picture.size != wanted:
        notes.append(f"resampled from {picture.size[0]}x{picture.size[1]} to its camera's {wanted[0]}x{wanted[1]}")
    render = np.clip(draw(studio.session.splats, camera), 0, 1)
    colors = _flat(picture.resized(*wanted), render)
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
    """The camera of a picture and where it was found. Raises ValueError where there is none, or its shape is wrong."""
    camera, found = _search(call, command, blob, name, picture)
    if camera.width * camera.height > PIXELS:
        raise ValueError(f"{name}: expected a view of at most {PIXELS // 10**6} megapixels; export a smaller one")
    if not pictures.same_shape(picture.size, (camera.width, camera.height)):
        got, want = f"{picture.size[0]}x{picture.size[1]}", f"{camera.width}x{camera.height}"
        raise ValueError(f"{name}: expected the shape of its view ({want}), got {got}; resize without cropping")
    return camera, found


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
        raise ValueError(
            f"{name}: it carries no camera and is like no exported view; turn to its view and drop it there"
        )
    return fitting[best].camera, "export"


def _flat(picture: Picture, render: np.ndarray) -> np.ndarray:
    """[H, W, 3] the picture over the render, where it is transparent."""
    if picture.alpha is None:
        return picture.colors
    return picture.alpha[..., None] * picture.colors + (1 - picture.alpha[..., None]) * render
