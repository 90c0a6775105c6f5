"""The nearest set pixel of a mask, for every pixel."""

from __future__ import annotations

import numpy as np
from numba import njit

NOWHERE = -(1 << 20)
"""Coordinate of pixels that know of no set pixel: farther away than any."""


def nearest_pixels(mask: np.ndarray) -> np.ndarray:
    """[H, W] int32 flat index of the nearest set pixel, -1 where no pixel is set. mask: [H, W] bool.

    Four scans that pass on the nearest pixel of the neighbours (8SED; Danielsson 1980): exact but for rare errors of a
    fraction of a pixel."""
    height, width = mask.shape
    rows = np.flatnonzero(mask.any(1))
    out = np.full((height, width), -1, np.int32)
    if len(rows):
        # With one column more on both sides and one row more above and below: no neighbour has to be asked for.
        y, x = (np.full((height + 2) * (width + 2), NOWHERE, np.int32) for _ in range(2))
        _scan(np.ascontiguousarray(mask), y, x, int(rows[0]), out)
    return out


@njit(nogil=True, cache=True, error_model="numpy", boundscheck=False)
def _scan(mask, nearest_y, nearest_x, first, out):
    """nearest_y, nearest_x: [(H + 2) (W + 2)] int32 NOWHERE; first: row of the first set pixel, before which there is
    nothing to pass on downwards."""
    height, width = mask.shape
    stride = width + 2
    for y in range(height):
        for x in range(width):
            if mask[y, x]:
                nearest_y[(y + 1) * stride + x + 1], nearest_x[(y + 1) * stride + x + 1] = y, x
    for turn in range(2):
        step = 1 if turn == 0 else -1
        begin, end = (first, height) if turn == 0 else (height - 1, -1)
        for y in range(begin, end, step):
            for sweep in range(2):
                for k in range(width):
                    x = k if sweep == 0 else width - 1 - k
                    here = (y + 1) * stride + x + 1
                    best_y, best_x = nearest_y[here], nearest_x[here]
                    best = (best_y - y) * (best_y - y) + (best_x - x) * (best_x - x)
                    if best == 0:
                        continue
                    # The row before this one, from left to right, then the pixel before this one.
                    for j in range(3 if sweep == 0 else 0):
                        other = here - step * stride - 1 + j
                        dy, dx = nearest_y[other] - y, nearest_x[other] - x
                        if dy * dy + dx * dx < best:
                            best, best_y, best_x = dy * dy + dx * dx, nearest_y[other], nearest_x[other]
                    other = here - 1 if sweep == 0 else here + 1
                    dy, dx = nearest_y[other] - y, nearest_x[other] - x
                    if dy * dy + dx * dx < best:
                        best_y, best_x = nearest_y[other], nearest_x[other]
                    nearest_y[here], nearest_x[here] = best_y, best_x
    for y in range(height):
        for x in range(width):
            here = (y + 1) * stride + x + 1
            if nearest_y[here] != NOWHERE:
                out[y, x] = nearest_y[here] * width + nearest_x[here]
