"""Environments as projects hold them: reduced to what light needs of them, as the bytes of a picture, so that a layer
that was lit by a file is the same where that file is not."""

from __future__ import annotations

import struct

import numpy as np

from splatpainter.image_files import bytes_of_png, bytes_to_png
from splatpainter.lights.sky_maps import SkyMap, lat_long
from splatpainter.system.quick_dataclass import dataclass

MAGIC = b"sky1"


@dataclass(frozen=True)
class HeldSizes:
    """Source: degree 2 of SH, which is what lights an asset, is the same to 0.1 % at half of this."""

    rows: int = 128
    """Of a reduced environment; columns are twice as many."""
    brightest: float = 60000.0
    """Largest value, over the mean of all: what half floats hold."""
    max_rows: int = 1024
    """Of one that is read: a stranger's project may claim anything."""


HELD = HeldSizes()


def sky_to_png(sky: SkyMap) -> bytes:
    """PNG that holds an environment, at most HELD.rows rows, as half floats over its mean."""
    picture = _reduced(sky.radiance.astype(np.float64), HELD.rows)
    _, areas = lat_long(*picture.shape[:2])
    mean = float((picture * areas[..., None]).sum()) / float(3 * areas.sum())
    levels = np.minimum(picture / mean, HELD.brightest).astype("<f2")
    return bytes_to_png(MAGIC + struct.pack("<II", *picture.shape[:2]) + levels.tobytes())


def sky_of_png(data: bytes, name: str, note: str = "") -> SkyMap:
    """The inverse. Raises ValueError naming it: another picture, damaged, black."""
    where = f"light: the environment {ascii(name)[1:-1]}"
    try:
        flat = bytes_of_png(data, 12 + 12 * HELD.max_rows**2)
        height, width = struct.unpack_from("<II", flat, 4)
        if flat[:4] != MAGIC or not 0 < height <= HELD.max_rows or not 0 < width <= 2 * HELD.max_rows:
            raise ValueError("it is another picture")
        levels = np.frombuffer(flat, "<f2", 3 * height * width, 12).reshape(height, width, 3).astype(np.float32)
        if not np.isfinite(levels).all() or levels.min() < 0 or not levels.any():
            raise ValueError("its light is black, negative or not finite")
    except (ValueError, struct.error) as error:
        raise ValueError(f"{where}: expected the picture of one that a project holds ({error})") from None
    return SkyMap(levels, name, note)


def _reduced(picture: np.ndarray, rows: int) -> np.ndarray:
    """[h, w, 3] float64 means over equal parts of a lat-long picture, of at most so many rows."""
    for axis, most in ((0, rows), (1, 2 * rows)):
        count = picture.shape[axis]
        if count <= most:
            continue
        # Sums up to each edge, which may lie inside a pixel: their differences are means over any width.
        sums = np.concatenate([np.zeros_like(picture.take([0], axis)), np.cumsum(picture, axis)], axis)
        edges = np.linspace(0, count, most + 1)
        below = np.minimum(edges.astype(int), count - 1)
        shape = [1, 1, 1]
        shape[axis] = most + 1
        share = (edges - below).reshape(shape)
        at = sums.take(below, axis) * (1 - share) + sums.take(below + 1, axis) * share
        picture = np.diff(at, axis=axis) * (most / count)
    return np.maximum(picture, 0)
