"""Morton order, for those who ask for it: io never sorts rows by itself. Pure."""

from __future__ import annotations

import numpy as np

BITS = 21
"""Bits an axis: three of them fill a 64-bit key."""


def morton_order(means: np.ndarray) -> np.ndarray:
    """[N] int64 row indices along the Z-order curve over the bounding box of `means` [N, 3]; equal places keep their
    order, rows that are not finite come last.

    `splats.take(morton_order(splats.means))` before writing a new compressed PLY makes its chunks small in space, and
    so their 11-bit positions fine (docs/formats.md has numbers); it also changes row indices, so it is never automatic.
    """
    finite = np.isfinite(means).all(1)
    kept = means[finite].astype(np.float64)
    keys = np.full(len(means), np.iinfo(np.uint64).max, np.uint64)
    if len(kept):
        low = kept.min(0)
        span = np.maximum(kept.max(0) - low, np.finfo(np.float64).tiny)
        cells = ((kept - low) / span * (2**BITS - 1)).astype(np.uint64)
        keys[finite] = (
            _spread(cells[:, 0]) | (_spread(cells[:, 1]) << np.uint64(1)) | (_spread(cells[:, 2]) << np.uint64(2))
        )
    return np.argsort(keys, kind="stable")


def _spread(values: np.ndarray) -> np.ndarray:
    """Two zero bits between the bits of 21-bit numbers, by halving the gaps (five doublings)."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values
