"""Hashed value noise and signed distances of brush marks: the raw material of paint.py. No colours here."""

from __future__ import annotations

import numpy as np


def hashed(cells: np.ndarray, seed: int) -> np.ndarray:
    """[N] in 0..1: a fixed pseudo-random number per integer cell. cells: [N, D] integers."""
    h = np.full(cells.shape[0], (seed * 0x9E3779B1 + 0x7F4A7C15) & 0xFFFFFFFF, np.uint32)
    for column in cells.T:
        h = (h ^ column.astype(np.int64).astype(np.uint32)) * np.uint32(0x85EBCA6B)
        h ^= h >> np.uint32(13)
        h *= np.uint32(0xC2B2AE35)
        h ^= h >> np.uint32(16)
    return h.astype(np.float64) / 4294967296.0


def value_noise(points: np.ndarray, seed: int) -> np.ndarray:
    """[N] smooth noise in -1..1 with features about one unit wide. points: [N, 2 or 3]."""
    base = np.floor(points).astype(np.int64)
    f = points - base
    f = f * f * f * (f * (f * 6 - 15) + 10)
    total = np.zeros(len(points))
    dims = points.shape[1]
    for corner in range(1 << dims):
        bits = [(corner >> axis) & 1 for axis in range(dims)]
        weight = np.ones(len(points))
        for axis, bit in enumerate(bits):
            weight *= f[:, axis] if bit else 1 - f[:, axis]
        total += weight * hashed(base + bits, seed)
    return 2 * total - 1


def fractal_noise(points: np.ndarray, seed: int, octaves: int = 3) -> np.ndarray:
    """[N] sum of octaves of value noise, each twice as fine and half as strong; about -1..1."""
    total = np.zeros(len(points))
    for octave in range(octaves):
        total += value_noise(points * 2.0**octave + 17.3 * octave, seed + octave) * 0.5**octave
    return total / (2 - 0.5 ** (octaves - 1))


def specks(points: np.ndarray, cell: float, share: float, radius: tuple[float, float], seed: int) -> np.ndarray:
    """[N] 0..1: round dots scattered in space, at most one per cubic cell. cell and radius in world units; share: the
    part of cells that hold a dot."""
    index = np.floor(points / cell).astype(np.int64)
    size = radius[0] + (radius[1] - radius[0]) * hashed(index, seed) ** 3
    middle = np.stack([hashed(index, seed + 1 + axis) for axis in range(3)], 1)
    margin = size[:, None] / cell  # a dot stays within its own cell, so that one look-up is enough
    middle = (index + margin + middle * (1 - 2 * margin)) * cell
    gap = np.linalg.norm(points - middle, axis=1)
    return (hashed(index, seed + 7) < share) * edge(gap - size * 0.8, size * 0.5)


def edge(distance: np.ndarray, width: np.ndarray | float) -> np.ndarray:
    """[N] 1 inside (distance < 0), 0 outside, smooth over +- width."""
    t = np.clip(0.5 - distance / (2 * width), 0, 1)
    return t * t * (3 - 2 * t)


def leaf(
    x: np.ndarray, y: np.ndarray, angle: np.ndarray | float, length: float, half: np.ndarray | float
) -> np.ndarray:
    """[N] distance to a leaf that starts at the origin and grows along `angle` (radians from x): pointed at the tip,
    rounder at the stalk. Sizes in the units of x and y; negative inside."""
    along = (x * np.cos(angle) + y * np.sin(angle)) / length
    off = np.abs(y * np.cos(angle) - x * np.sin(angle))
    t = np.clip(along, 0, 1)
    outline = half * 2.2 * np.sqrt(t) * (1 - t) ** 0.85 * (1 + 0.3 * t)
    beyond = np.maximum(np.maximum(-along, along - 1), 0) * length
    return np.hypot(np.maximum(off - outline, 0), beyond) + np.minimum(off - outline, 0)


def wrapped(values: np.ndarray, period: float) -> np.ndarray:
    """[N] values moved by whole periods into -period/2 .. period/2."""
    return (values + period / 2) % period - period / 2
