"""16-bit linear pictures: OpenEXR with half floats, in memory, through Mitsuba's Bitmap.

Half rather than 16-bit PNG: light has no upper end (a lamp is 1000 times paper), a half keeps 11 significant bits at
every level, and every compositor opens it. Range 6e-8 to 65504.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from splatpainter.data.mitsuba_backend import use_mitsuba

HALF_MAX = 65504.0


def encode_exr(image: np.ndarray) -> bytes:
    """[H, W, C] linear values, C = 1, 3 or 4 -> the bytes of an OpenEXR file of halves. Values above HALF_MAX become
    HALF_MAX. Raises ValueError for other shapes and for NaN."""
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise ValueError(f"EXR: expected an image [H, W, 1, 3 or 4], got {list(image.shape)}")
    if np.isnan(image).any():
        raise ValueError(f"EXR: {int(np.isnan(image).sum())} values are NaN")
    mi = use_mitsuba()
    half = np.clip(image, -HALF_MAX, HALF_MAX).astype(np.float16)
    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(half)).write(stream, mi.Bitmap.FileFormat.OpenEXR)
    return bytes(stream.raw_buffer())


def decode_exr(data: bytes, where: str = "EXR") -> np.ndarray:
    """The bytes of an OpenEXR file -> [H, W, C] float32. Raises ValueError naming `where`."""
    mi = use_mitsuba()
    # By a file: reading past the end of a MemoryStream never returns (Mitsuba 3.9).
    with tempfile.TemporaryDirectory(prefix="splatpainter-exr-") as folder:
        path = Path(folder) / "picture.exr"
        path.write_bytes(data)
        try:
            bitmap = mi.Bitmap(str(path))
        except RuntimeError as error:
            reason = " ".join(str(error).replace(str(path), "").split())
            raise ValueError(f"{where}: cannot be read as OpenEXR ({reason})") from None
    pixels = np.array(bitmap, dtype=np.float32)
    return pixels if pixels.ndim == 3 else pixels[..., None]
