"""What several actions need: renders, edits from uploaded pictures, progress, Python lines."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera, find_alpha
from splatpainter.painter import Edit, Mode
from splatpainter.rendering.profiles import Profile
from splatpainter.server.actions import Call
from splatpainter.server.describe import camera_from_wire, layer_info
from splatpainter.server.messages.base import PIXELS
from splatpainter.server.messages.painting import EditView, LayerMade
from splatpainter.server.messages.state import Camera as WireCamera
from splatpainter.server.pictures import same_shape
from splatpainter.sources.color import to_display
from splatpainter.sources.files import FileEdit, unmultiplied
from splatpainter.sources.pictures import read_mask, read_picture, resample
from splatpainter.splats import Splats


class Word(str):
    """A piece of Python that stands for itself in a line, not a string literal."""

    __repr__ = str.__str__


def python_line(function: str, *words: Any, **named: Any) -> str:
    """A call as one would write it; fields that are None are left out."""
    parts = [repr(word) for word in words]
    parts += [f"{name}={value!r}" for name, value in named.items() if value is not None]
    return f"{function}({', '.join(parts)})"


def camera_of(camera: WireCamera) -> Camera:
    """A client's camera. Raises ValueError: not rigid, more pixels than a view may have."""
    return camera_from_wire(camera, PIXELS)


@contextlib.contextmanager
def called(path: Path, name: str) -> Iterator[None]:
    """Errors about the file at `path` are said of what its owner calls it."""
    try:
        yield
    except ValueError as error:
        if str(path) not in str(error):
            raise
        raise ValueError(str(error).replace(str(path), name)) from None


def draw(splats: Splats, camera: Camera, profile: Profile = "inria") -> np.ndarray:
    """[H, W, 3] display colours."""
    from splatpainter.rendering import render

    return to_display(render(splats, camera, profile=profile).colors[0], splats.color_space)


def draw_alpha(splats: Splats, camera: Camera) -> np.ndarray:
    """[H, W] how much of each pixel the asset covers, 0..1."""
    from splatpainter.rendering import render

    return render(splats, camera).alphas[0, ..., 0]


@contextlib.contextmanager
def progress(call: Call, stage: str) -> Iterator[None]:
    """Let the session report what it computes, and stop it where the command was cancelled."""
    session = call.studio.session
    call.ticket.report(0, stage)
    session.progress = lambda done, total, name: call.ticket.report(done / max(total, 1), name)
    try:
        yield
    finally:
        session.progress = None


def layer_made(call: Call, layer: str, python: str) -> LayerMade:
    """The answer with a layer as it now is."""
    session = call.studio.session
    return LayerMade(layer=layer_info(session, session.layer(layer)), python=python)


def edit_of(call: Call, view: EditView, mode: Mode) -> Edit:
    """An uploaded picture as an edit of the asset as it now is; transparent pixels change nothing."""
    camera = camera_of(view.camera)
    wanted = (camera.width, camera.height)
    blob = call.studio.blobs.get(view.picture, "picture")
    name = Path(blob.name or "picture")
    with called(blob.path, str(name)):
        picture = read_picture(blob.path)
    _check_shape(str(name), picture.size, wanted)
    mask = None if view.mask is None else mask_of(call, view.mask, camera)
    kind = find_alpha(blob.path)
    fitted = unmultiplied(picture, kind).resized(*wanted)
    source = FileEdit(name, fitted, picture.size, camera, mask, picture.notes, cut_out=kind is not None)
    return source.edit(call.studio.session.splats, mode)


def mask_of(call: Call, blob: str, camera: Camera) -> np.ndarray:
    """[H, W] bool of an uploaded mask. Raises ValueError where it is empty or of another shape than the camera."""
    kept = call.studio.blobs.get(blob, "picture")
    with called(kept.path, kept.name or "mask"):
        mask = read_mask(kept.path)
    wanted = (camera.width, camera.height)
    _check_shape(kept.name or "mask", (mask.shape[1], mask.shape[0]), wanted)
    if not mask.any():
        raise ValueError(f"{kept.name or 'mask'}: is empty; expected some pixels that are not black")
    return mask if mask.shape[::-1] == wanted else resample(mask.astype(np.float32), *wanted) > 0.25


def _check_shape(name: str, size: tuple[int, int], wanted: tuple[int, int]) -> None:
    if not same_shape(size, wanted):
        raise ValueError(
            f"{name}: expected the shape of its view ({wanted[0]}x{wanted[1]}), got {size[0]}x{size[1]}; "
            "resize without cropping"
        )
