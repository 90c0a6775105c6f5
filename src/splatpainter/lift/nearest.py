"""The nearest set pixel of a mask, for every pixel."""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Bools, Ids
from splatpainter.kernels.arrays import aligned
from splatpainter.kernels.library import kernels

INT32 = np.dtype(np.int32)
NOWHERE = -(1 << 20)
"""Coordinate of pixels that know of no set pixel: farther away than any."""


def nearest_pixels(mask: Bools) -> Ids:
    """[H, W] int32 flat index of the nearest set pixel, -1 where no pixel is set. mask: [H, W] bool.

    Four scans that pass on the nearest pixel of the neighbours (8SED; Danielsson 1980): exact but for rare errors of a
    fraction of a pixel."""
    height, width = mask.shape
    assert max(mask.shape) <= 1 << 14, f"nearest_pixels: {width} x {height} pixels"  # twice the square is an int32
    rows = np.flatnonzero(mask.any(1))
    if not len(rows):
        return np.full((height, width), -1, np.int32)
    # With one column more on both sides and one row more above and below: no neighbour has to be asked for.
    (y, x), out = aligned((2, (height + 2) * (width + 2)), INT32), aligned((height, width), INT32)
    y[:], x[:] = NOWHERE, NOWHERE
    kernels.find_nearest_pixels(np.ascontiguousarray(mask, bool), y, x, int(rows[0]), out, 0, 1)
    return out
