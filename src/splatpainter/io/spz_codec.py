"""The packed words of SPZ: one function each way for every attribute stream. Knows no file and no coordinate frame.

N = rows. Packed streams are uint8 [N, width]; unpacked values are activated float32 as in `Splats`. The formulas are
those of SPZ's own README and reference implementation.
"""

from __future__ import annotations

import numpy as np

from splatpainter.io import raw

COLOR_SCALE = 0.15
"""A colour byte is 255 * (COLOR_SCALE * sh0 + 0.5): base colours from -0.44 to 1.44 in steps of 1/136."""
POSITION_LIMIT = 1 << 23
"""A 24-bit position lies in -POSITION_LIMIT .. POSITION_LIMIT - 1, in steps of 2^-fractional_bits."""


def unpack_positions(packed: np.ndarray, fractional_bits: int) -> np.ndarray:
    """[N, 9] bytes -> [N, 3]: signed 24-bit little-endian fixed point; exact in float32."""
    words = packed.reshape(-1, 3, 3).astype(np.int32)
    fixed = words[..., 0] | words[..., 1] << 8 | words[..., 2] << 16
    fixed -= (fixed & 0x800000) << 1
    return np.ldexp(fixed.astype(np.float32), -fractional_bits)


def pack_positions(means: np.ndarray, fractional_bits: int) -> np.ndarray:
    """[N, 3] -> [N, 9] bytes. The caller has checked `fits`."""
    fixed = np.rint(np.ldexp(means.astype(np.float64), fractional_bits)).astype(np.int32)
    return np.stack([fixed >> shift & 255 for shift in (0, 8, 16)], -1).astype(np.uint8).reshape(-1, 9)


def fits(means: np.ndarray, fractional_bits: int) -> np.ndarray:
    """[N] bool: rows whose positions 24 bits can hold."""
    fixed = np.rint(np.ldexp(means.astype(np.float64), fractional_bits))
    return np.asarray(np.logical_and(fixed >= -POSITION_LIMIT, fixed < POSITION_LIMIT).all(1))


def unpack_half_positions(packed: np.ndarray) -> np.ndarray:
    """[N, 6] bytes -> [N, 3]: the float16 positions of version 1."""
    return packed.reshape(-1, 6).view("<f2").astype(np.float32)


def pack_half_positions(means: np.ndarray) -> np.ndarray:
    """[N, 3] -> [N, 6] bytes."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(means, dtype="<f2").view(np.uint8).reshape(-1, 6)


def unpack_scales(packed: np.ndarray) -> np.ndarray:
    """[N, 3] bytes -> [N, 3] scales: log-scale = byte / 16 - 10, so 4.5e-5 to 378 in steps of 6.4 %."""
    return raw.exp(packed.astype(np.float32) / 16 - 10)


def pack_scales(scales: np.ndarray) -> np.ndarray:
    """[N, 3] -> [N, 3] bytes; smaller and larger scales take the nearest end of the range."""
    return _byte((raw.log(scales).astype(np.float64) + 10) * 16)


def unpack_opacities(packed: np.ndarray) -> np.ndarray:
    """[N, 1] bytes -> [N]."""
    return (packed.reshape(-1).astype(np.float64) / 255).astype(np.float32)


def pack_opacities(opacities: np.ndarray) -> np.ndarray:
    """[N] -> [N, 1] bytes."""
    return _byte(opacities.astype(np.float64) * 255)[:, None]


def unpack_colors(packed: np.ndarray) -> np.ndarray:
    """[N, 3] bytes -> [N, 3] coefficients of Y_00."""
    return ((packed.astype(np.float64) / 255 - 0.5) / COLOR_SCALE).astype(np.float32)


def pack_colors(base: np.ndarray) -> np.ndarray:
    """[N, 3] coefficients of Y_00 -> [N, 3] bytes."""
    return _byte((base.astype(np.float64) * COLOR_SCALE + 0.5) * 255)


def unpack_quats_first_three(packed: np.ndarray) -> np.ndarray:
    """[N, 3] bytes -> [N, 4] w, x, y, z of versions 1 and 2: byte / 127.5 - 1, and w >= 0 from the unit norm."""
    vector = packed.astype(np.float64) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (vector * vector).sum(1, keepdims=True)))
    return np.concatenate([w, vector], 1).astype(np.float32)


def pack_quats_first_three(quats: np.ndarray) -> np.ndarray:
    """[N, 4] w, x, y, z of any non-zero norm -> [N, 3] bytes."""
    unit = _unit(quats)
    vector = unit[:, 1:] * np.where(unit[:, :1] < 0, -1, 1)
    return _byte((vector + 1) * 127.5)


def unpack_quats_smallest_three(packed: np.ndarray) -> np.ndarray:
    """[N, 4] bytes -> [N, 4] w, x, y, z of versions 3 and 4.

    A little-endian word: in bits 30-31 which of x, y, z, w is the largest; below it the other three in that order, each
    a sign bit and 9 bits of magnitude in steps of sqrt(1/2) / 511.
    """
    words = packed.reshape(-1, 4).view("<u4")[:, 0].astype(np.int64)
    largest = words >> 30
    xyzw = np.zeros((len(words), 4))
    for component in (3, 2, 1, 0):
        stored = largest != component
        value = (words & 511) * (np.sqrt(0.5) / 511)
        xyzw[:, component] = np.where(stored, np.where(words & 512, -value, value), 0)
        words = np.where(stored, words >> 10, words)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw * xyzw).sum(1)))
    xyzw[np.arange(len(xyzw)), largest] = rest
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)


def pack_quats_smallest_three(quats: np.ndarray) -> np.ndarray:
    """[N, 4] w, x, y, z of any non-zero norm -> [N, 4] bytes."""
    xyzw = _unit(quats)[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(1)
    xyzw *= np.where(xyzw[np.arange(len(xyzw)), largest] < 0, -1, 1)[:, None]
    words = largest.astype(np.int64)
    for component in range(4):
        value = xyzw[:, component]
        magnitude = np.minimum(np.rint(np.abs(value) * (511 / np.sqrt(0.5))), 511).astype(np.int64)
        words = np.where(largest == component, words, words << 10 | np.where(value < 0, 512, 0) | magnitude)
    return words.astype("<u4").view(np.uint8).reshape(-1, 4)


def unpack_sh(packed: np.ndarray) -> np.ndarray:
    """[N, 3 (K - 1)] bytes -> [N, K - 1, 3] coefficients of bands >= 1: byte / 128 - 1, colour channel fastest."""
    return (packed.astype(np.float32) / 128 - 1).reshape(len(packed), packed.shape[1] // 3, 3)


def pack_sh(rest: np.ndarray, bits: tuple[int, int]) -> np.ndarray:
    """[N, K - 1, 3] -> [N, 3 (K - 1)] bytes. bits: precision kept of band 1 and of the higher bands, 1-8.

    Coarser values pack better; readers need not know. 0 stays 0 at any precision.
    """
    # Rounded once, to the bucket itself: two roundings, as the reference does, would add half a step of error.
    steps = np.where(np.arange(rest.shape[1]) < 3, 1 << (8 - bits[0]), 1 << (8 - bits[1]))[:, None]
    return _byte(np.rint(rest.astype(np.float64) * 128 / steps) * steps + 128).reshape(len(rest), 3 * rest.shape[1])


def _unit(quats: np.ndarray) -> np.ndarray:
    wide = quats.astype(np.float64)
    return wide / np.linalg.norm(wide, axis=1, keepdims=True)


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
