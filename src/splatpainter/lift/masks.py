"""Which pixels of a returned picture were edited: the difference to the render, above what 8 bits and JPEG leave."""

from __future__ import annotations

import numpy as np

LEAST = 3.5 / 255
"""Differences up to here are rounding."""
MOST = 24 / 255
"""No picture is so noisy that larger differences are not edits."""


def change_mask(edited: np.ndarray, render: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels where `edited` differs from `render` (both [H, W, 3], 0..1) by more than the picture's noise.

    The noise is measured where the two agree best, so JPEG artefacts and dithering raise the bar for the whole picture;
    single stray pixels are dropped, and what remains grows by one pixel (the soft rim of a stroke)."""
    rounded = np.round(np.clip(render, 0, 1) * 255) / 255
    difference = np.abs(edited - rounded).max(-1)
    bar = float(np.clip(4 * np.median(_box(difference)) + LEAST, LEAST, MOST))
    core = _box(difference) > bar
    core &= _count(core) >= 4
    near = _count(core) > 0
    return near & (difference > LEAST) if bar <= 2 * LEAST else near


def _box(values: np.ndarray) -> np.ndarray:
    """3x3 mean."""
    padded = np.pad(values, 1, mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9


def _count(mask: np.ndarray) -> np.ndarray:
    """[H, W] int: set pixels in each 3x3 neighbourhood (outside the picture: none)."""
    padded = np.pad(mask.astype(np.int32), 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
