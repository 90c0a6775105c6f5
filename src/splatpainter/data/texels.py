"""Looking up texture maps: bilinear, repeating, through a table (sRGB to linear). No filtering beyond that."""

from __future__ import annotations

import numpy as np
from numba import njit

_coded = np.arange(256) / 255
LINEAR = np.where(_coded <= 0.04045, _coded / 12.92, ((_coded + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""[256] sRGB byte -> linear 0..1 (IEC 61966-2-1)."""
PLAIN = _coded.astype(np.float32)
"""[256] byte -> 0..1."""


def look_up(pixels: np.ndarray, uvs: np.ndarray, table: np.ndarray = PLAIN) -> np.ndarray:
    """[M, C] float32: table[pixels] interpolated at uvs [M, 2] (v up, repeating). pixels: [h, w, C] uint8."""
    return _bilinear(np.ascontiguousarray(pixels), np.ascontiguousarray(uvs, np.float32), table)


@njit(nogil=True, cache=True, error_model="numpy")
def _bilinear(pixels, uvs, table):
    h, w, channels = pixels.shape
    out = np.empty((len(uvs), channels), np.float32)
    for i in range(len(uvs)):
        u, v = uvs[i, 0], np.float32(1) - uvs[i, 1]
        x = (u - np.floor(u)) * w - np.float32(0.5)
        y = (v - np.floor(v)) * h - np.float32(0.5)
        left, top = np.floor(x), np.floor(y)
        fx, fy = x - left, y - top
        x0, y0 = int(left) % w, int(top) % h
        x1, y1 = (x0 + 1) % w, (y0 + 1) % h
        for c in range(channels):
            upper = table[pixels[y0, x0, c]] * (1 - fx) + table[pixels[y0, x1, c]] * fx
            lower = table[pixels[y1, x0, c]] * (1 - fx) + table[pixels[y1, x1, c]] * fx
            out[i, c] = upper * (1 - fy) + lower * fy
    return out
