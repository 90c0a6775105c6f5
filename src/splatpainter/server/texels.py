"""Colours of rows as the page's textures hold them, for previews: a third of the bytes of floats, and nothing to
convert on arrival. The same numbers as web/src/splats/rows.ts and sh.ts make of floats. Pure.
"""

from __future__ import annotations

import numpy as np

from splatpainter.kernels.parallel import each
from splatpainter.splats import SH_C0

LARGEST = 65504.0
"""Of a half float."""
PIECE = 8192
"""Rows encoded at a time: they fit the processor's cache, and threads share the pieces."""


def base_halves(sh: np.ndarray) -> np.ndarray:
    """[N, K, 3] SH -> [N, 3] float16 base colours 0.5 + Y_0 sh_0; NaN becomes 0."""
    colors = np.nan_to_num(0.5 + SH_C0 * sh[:, 0].astype(np.float64), nan=0, posinf=LARGEST, neginf=-LARGEST)
    return np.clip(colors, -LARGEST, LARGEST).astype(np.float32).astype(np.float16)


def harmonic_codes(sh: np.ndarray) -> np.ndarray:
    """[N, K, 3] SH -> [N, K - 1] uint32, one per coefficient but the first: three 8-bit magnitudes over a shared power
    of two, value = byte / 255 * 2^(exponent - 15), the exponent's 5 bits and three sign bits (red lowest)."""
    if not len(sh) or sh.shape[1] == 1:
        return np.zeros((len(sh), sh.shape[1] - 1), np.uint32)
    return np.concatenate(each(_codes, [sh[start : start + PIECE] for start in range(0, len(sh), PIECE)]))


def _codes(sh: np.ndarray) -> np.ndarray:
    red, green, blue = (np.nan_to_num(np.ascontiguousarray(sh[:, 1:, k], np.float32)) for k in range(3))
    largest = np.maximum(np.maximum(np.abs(red), np.abs(green)), np.abs(blue))
    share, power = np.frexp(largest)
    exponent = np.clip(power - (share == 0.5) + 15, 0, 31)  # ceil(log2(largest)) + 15
    scale = np.ldexp(np.float32(255), 15 - exponent)
    code = exponent.astype(np.uint32) << 27
    for k, channel in enumerate((red, green, blue)):
        magnitude = np.minimum(np.abs(channel) * scale + np.float32(0.5), 255)
        code |= magnitude.astype(np.uint32) << (8 * k)
        code |= (channel < 0).astype(np.uint32) << (24 + k)
    return np.where(largest > 0, code, np.uint32(0))


def sh_of(halves: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """What a screen makes of them: [N, 3] and [N, K - 1] -> SH [N, K, 3] float32."""
    out = np.empty((len(halves), 1 + codes.shape[1], 3), np.float32)
    out[:, 0] = (halves.astype(np.float64) - 0.5) / SH_C0
    unit = np.ldexp(np.float32(1 / 255), (codes >> 27).astype(np.int32) - 15)
    for k in range(3):
        sign = np.where(codes >> (24 + k) & 1, np.float32(-1), np.float32(1))
        out[:, 1:, k] = (codes >> (8 * k) & 255).astype(np.float32) * unit * sign
    return out
