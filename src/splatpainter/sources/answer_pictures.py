"""Pictures on their way to a source and back: what a request holds as PNG, and what came back, read within bounds.

Maps go out as the control networks of image generators want them. Depth: near is bright, nothing is black. Normals:
R right, G up, B towards the viewer, and a surface that faces the viewer where there is nothing.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from splatpainter.image_files import CAMERA_KEYWORD, encode_png, quantized
from splatpainter.pictures.picture_reader import Picture, read_picture
from splatpainter.sources.picture_source import PictureRequest, SourceError

MAX_ANSWER_BYTES = 256 << 20
"""Most bytes of a picture file that a source gives."""


def image_png(request: PictureRequest) -> bytes:
    """The view as 8-bit PNG with its camera inside."""
    # The camera travels inside the picture, so that a program that saves it on gives it back by itself.
    pixels = quantized(request.image)
    return encode_png(pixels, {CAMERA_KEYWORD: request.camera.to_json()} if request.camera is not None else None)


def mask_png(request: PictureRequest) -> bytes:
    """[H, W] grey PNG: white may change, black stays; all white without a mask."""
    # A source that wants a mask always gets one: white all over says that everything may change.
    mask = np.ones(request.image.shape[:2], np.float32) if request.mask is None else request.mask
    return encode_png(quantized(mask), data=True)


def alpha_png(request: PictureRequest) -> bytes:
    """[H, W] grey PNG: white is the asset, black the background."""
    return encode_png(quantized(request.alpha), data=True)


def depth_levels(request: PictureRequest) -> np.ndarray:
    """[H, W] float32: 1 the nearest surface, 0.1 the farthest, 0 nothing. Raises SourceError: the request has none."""
    if request.depth is None:
        raise SourceError("depth: this view has no depth map; give an asset and a camera, not a picture alone")
    # Distances that are no numbers are nothing: one of them would spoil the scale of all.
    depth = np.nan_to_num(np.asarray(request.depth(), np.float32))
    drawn = depth > 0
    if not drawn.any():
        return np.zeros(depth.shape, np.float32)
    near, far = float(depth[drawn].min()), float(depth[drawn].max())
    # From near to far, scaled to this view: control networks know only nearer and farther, never world units.
    levels = 1 - 0.9 * (depth - near) / max(far - near, 1e-12)
    return np.where(drawn, levels, 0).astype(np.float32)


def depth_png(request: PictureRequest, bits: int = 8) -> bytes:
    """`depth_levels` as grey PNG of 8 or 16 bits."""
    return encode_png(quantized(depth_levels(request), bits), data=True)


def normal_colors(request: PictureRequest) -> np.ndarray:
    """[H, W, 3] float32 0..1. Raises SourceError: the request has none."""
    if request.normal is None:
        raise SourceError("normal: this view has no normals; give an asset and a camera, not a picture alone")
    normal = np.nan_to_num(np.asarray(request.normal(), np.float32))
    # From the camera's axes to those of normal maps, which have y up and z towards the viewer.
    towards_viewer = normal * np.array([1, -1, -1], np.float32)
    nothing = np.linalg.norm(normal, axis=-1, keepdims=True) < 1e-3
    return 0.5 + 0.5 * np.where(nothing, np.array([0, 0, 1], np.float32), towards_viewer)


def normal_png(request: PictureRequest) -> bytes:
    """`normal_colors` as 8-bit PNG."""
    return encode_png(quantized(normal_colors(request)), data=True)


def reference_png(reference: np.ndarray) -> bytes:
    """[h, w, 3] a reference picture as 8-bit PNG."""
    return encode_png(quantized(reference))


def read_answer(data: bytes, source: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """([h, w, 3 or 4] float32 display colours and straight alpha, notes) of a picture file in memory. Errors as
    `read_answer_file`."""
    # An empty answer is a fault of its own; as a picture it would only be called damaged.
    if not data:
        raise SourceError(f"source {source}: answered with an empty picture")
    if len(data) > MAX_ANSWER_BYTES:
        raise SourceError(f"source {source}: answered with more than {MAX_ANSWER_BYTES >> 20} MiB")
    # By way of a file, so that answers in memory and in files are read by one reader, within its bounds.
    with tempfile.TemporaryDirectory(prefix="splatpainter-answer-") as folder:
        path = Path(folder) / "answer"
        path.write_bytes(data)
        return read_answer_file(path, source)


def read_answer_file(path: Path, source: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """As `read_answer`, for a file. Raises SourceError in one line: no picture, damaged, too many bytes or pixels,
    animated, inks in place of colours."""
    what = f"source {source}: its picture"
    try:
        # The length is looked at before anything is decoded.
        if path.is_file() and path.stat().st_size > MAX_ANSWER_BYTES:
            raise SourceError(f"{what}: expected at most {MAX_ANSWER_BYTES >> 20} MiB")
        picture = read_picture(path, inks=False)
    except SourceError:
        raise
    except ValueError as error:
        # The name of the temporary file says nothing to anybody; the source's name does.
        raise SourceError(f"{what}: {str(error).removeprefix(f'{path}: ')}") from None
    return with_alpha(picture), picture.notes


def with_alpha(picture: Picture) -> np.ndarray:
    """[H, W, 3] the colours, or [H, W, 4] with straight alpha where there is any."""
    if picture.alpha is None:
        return picture.colors
    return np.concatenate([picture.colors, picture.alpha[..., None]], -1)
