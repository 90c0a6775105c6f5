"""Numbers packed into words: unsigned fractions within a range, and unit quaternions as their smallest three. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def unpack_fields(words: np.ndarray, bits: Sequence[int]) -> np.ndarray:
    """[N] uint32 -> [N, len(bits)] int64 fields, the first one in the highest bits (of the lowest sum(bits))."""
    shifts = np.cumsum([0, *reversed(bits)])[:-1][::-1]
    fields = [(words >> np.uint32(s)).astype(np.int64) & ((1 << b) - 1) for s, b in zip(shifts, bits, strict=True)]
    return np.stack(fields, 1)


def pack_fields(fields: np.ndarray, bits: Sequence[int]) -> np.ndarray:
    """[N, len(bits)] non-negative integers that fit -> [N] uint32, the inverse of unpack_fields."""
    words = np.zeros(len(fields), np.uint32)
    for k, width in enumerate(bits):
        words = (words << np.uint32(width)) | fields[:, k].astype(np.uint32)
    return words


def quantise(values: np.ndarray, low: np.ndarray, high: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Values -> nearest of 0..levels between low and high (clamped; an empty or infinite range gives 0), int64. All
    broadcast."""
    with np.errstate(invalid="ignore", over="ignore"):  # of ranges that a file may hold and no value can lie in
        span, above = high - low, values - low
    usable = (span > 0) & np.isfinite(span)
    steps = np.divide(above, span, out=np.zeros(np.broadcast(values, span).shape), where=usable)
    return np.floor(np.clip(steps, 0, 1) * levels + 0.5).astype(np.int64)


def dequantise(fields: np.ndarray, low: np.ndarray, high: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """0..levels -> low..high, float64."""
    part = fields / levels.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        return low * (1 - part) + high * part


def unpack_quats(words: np.ndarray) -> np.ndarray:
    """[N] uint32 of 2-10-10-10 bits -> [N, 4] float64: the place of the largest component, then the other three in
    order, each 0..1023 for -1/sqrt(2)..1/sqrt(2)."""
    fields = unpack_fields(words, (2, 10, 10, 10))
    small = (fields[:, 1:] / 1023 - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (small * small).sum(1)))
    quats = np.empty((len(words), 4))
    rows = np.arange(len(words))
    others = np.arange(3) + (np.arange(3) >= fields[:, :1])
    quats[rows, fields[:, 0]] = largest
    quats[rows[:, None], others] = small
    return quats


def pack_quats(quats: np.ndarray) -> np.ndarray:
    """[N, 4] non-zero quaternions -> [N] uint32, the inverse of unpack_quats up to sign and rounding."""
    unit = quats / np.linalg.norm(quats.astype(np.float64), axis=1, keepdims=True)
    rows = np.arange(len(unit))
    largest = np.abs(unit).argmax(1)
    unit = np.where(unit[rows, largest] < 0, -1, 1)[:, None] * unit
    others = np.arange(3) + (np.arange(3) >= largest[:, None])
    small = np.clip(np.floor((unit[rows[:, None], others] / np.sqrt(2) + 0.5) * 1023 + 0.5), 0, 1023)
    return pack_fields(np.concatenate([largest[:, None], small], 1), (2, 10, 10, 10))
