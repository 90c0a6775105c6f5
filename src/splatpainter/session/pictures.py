"""Pictures and masks of layers as PNG bytes. What comes back is what went in at 8 bits; sizes are judged first."""

from __future__ import annotations

import io
import warnings

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.image_files import to_uint8
from splatpainter.sources.color import from_display, to_display
from splatpainter.splats import ColorSpace

LIMIT = 64_000_000
"""Pixels of one picture."""
THUMBNAIL = 96
"""Pixels of a thumbnail's longer side."""


def encode_picture(image: np.ndarray, space: ColorSpace = "srgb") -> bytes:
    """[H, W, 3] floats 0..1 in the asset's colour space -> PNG of display colours. Encoded fast rather than small."""
    return _png(to_uint8(to_display(image, space)))


def encode_mask(mask: np.ndarray) -> bytes:
    """[H, W] bool -> PNG of 0 and 255."""
    return _png(np.where(mask, 255, 0).astype(np.uint8))


def decode_picture(data: bytes, camera: Camera, where: str, space: ColorSpace = "srgb") -> np.ndarray:
    """[H, W, 3] float32 0..1 in the asset's colour space. Raises ValueError naming `where`: no PNG, damaged, not of the
    camera's size."""
    levels = from_display(np.arange(256, dtype=np.float32) / 255, space)
    return levels[_pixels(data, camera, where, "RGB")]


def decode_mask(data: bytes, camera: Camera, where: str) -> np.ndarray:
    """[H, W] bool. Raises ValueError as `decode_picture`."""
    return _pixels(data, camera, where, "L") > 127


def thumbnail(image: np.ndarray, mask: np.ndarray | None) -> bytes:
    """PNG of the part of a picture that was edited, THUMBNAIL pixels on its longer side at most."""
    from PIL import Image

    pixels = to_uint8(image)
    if mask is not None and mask.any():
        ys, xs = np.nonzero(mask)
        margin = 4 + max(np.ptp(ys), np.ptp(xs)) // 4
        top, left = max(ys.min() - margin, 0), max(xs.min() - margin, 0)
        pixels = pixels[top : ys.max() + margin + 1, left : xs.max() + margin + 1]
    small = Image.fromarray(pixels)
    small.thumbnail((THUMBNAIL, THUMBNAIL))
    return _png(np.asarray(small))


def _png(pixels: np.ndarray) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG", compress_level=1)
    return file.getvalue()


def _pixels(data: bytes, camera: Camera, where: str, mode: str) -> np.ndarray:
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own size warning: judged here
        try:
            with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
                if image.width * image.height > LIMIT:
                    raise ValueError(f"more than {LIMIT // 10**6} megapixels")
                if image.size != (camera.width, camera.height):
                    got, want = f"{image.width}x{image.height}", f"{camera.width}x{camera.height}"
                    raise ValueError(f"is {got}, its camera {want}")
                return np.asarray(image.convert(mode))
        except Exception as error:  # decoders of damaged files raise anything
            raise ValueError(f"{where}: expected a PNG of its camera's size ({error})") from None
