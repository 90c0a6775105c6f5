"""The nearest set pixel of a mask, for every pixel."""

from __future__ import annotations

import numpy as np
from numba import njit


def nearest_pixels(mask: np.ndarray) -> np.ndarray:
    """[H, W] int32 flat index of the nearest set pixel, -1 where no pixel is set. mask: [H, W] bool.

    Four scans that pass on the nearest pixel of the neighbours (8SED; Danielsson 1980): exact but for rare errors of a
    fraction of a pixel."""
    height, width = mask.shape
    out = np.where(mask, np.arange(height * width, dtype=np.int32).reshape(height, width), np.int32(-1))
    out = np.ascontiguousarray(out, np.int32)
    _scan(out)
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _closer(nearest, y, x, v, u):
    """Let pixel (y, x) take over the nearest pixel of (v, u) if that is closer than its present one."""
    height, width = nearest.shape
    if v < 0 or v >= height or u < 0 or u >= width:
        return
    other = nearest[v, u]
    if other < 0:
        return
    dy, dx = other // width - y, other % width - x
    now = nearest[y, x]
    if now >= 0:
        ny, nx = now // width - y, now % width - x
        if ny * ny + nx * nx <= dy * dy + dx * dx:
            return
    nearest[y, x] = other


@njit(nogil=True, cache=True, error_model="numpy")
def _scan(nearest):
    height, width = nearest.shape
    for y in range(height):
        for x in range(width):
            _closer(nearest, y, x, y - 1, x - 1)
            _closer(nearest, y, x, y - 1, x)
            _closer(nearest, y, x, y - 1, x + 1)
            _closer(nearest, y, x, y, x - 1)
        for x in range(width - 1, -1, -1):
            _closer(nearest, y, x, y, x + 1)
    for y in range(height - 1, -1, -1):
        for x in range(width):
            _closer(nearest, y, x, y + 1, x - 1)
            _closer(nearest, y, x, y + 1, x)
            _closer(nearest, y, x, y + 1, x + 1)
            _closer(nearest, y, x, y, x - 1)
        for x in range(width - 1, -1, -1):
            _closer(nearest, y, x, y, x + 1)


def warm() -> None:
    """Compile (or load) the kernel."""
    nearest_pixels(np.eye(4, dtype=bool))
