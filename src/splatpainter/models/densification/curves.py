"""Points in the order in which a space-filling curve visits them: neighbours on the curve are neighbours in space.

Z-order (Morton 1966) interleaves the bits of the coordinates; Hilbert's curve also never jumps (Skilling 2004,
"Programming the Hilbert curve"). Both come also with x and z exchanged, which cuts space elsewhere.
"""

from __future__ import annotations

import numpy as np

BITS = 10
"""Of each coordinate: 1,024 cells per edge."""
CURVES = ("z", "hilbert", "z-turned", "hilbert-turned")


def cells(means: np.ndarray, lo: np.ndarray, size: float, bits: int = BITS) -> np.ndarray:
    """[M, 3] int64 cells of the points [M, 3] in the cube of edge `size` at `lo`; points outside: the nearest cell."""
    count = 1 << bits
    place = np.floor((means.astype(np.float64) - lo) * (count / size))
    return np.clip(place, 0, count - 1).astype(np.int64)


def z_order(cell: np.ndarray, bits: int = BITS) -> np.ndarray:
    """[M] int64 keys of cells [M, 3]: bits x y z x y z ... from the highest to the lowest."""
    key = np.zeros(len(cell), np.int64)
    for bit in range(bits - 1, -1, -1):
        for axis in range(3):
            key = key << 1 | (cell[:, axis] >> bit & 1)
    return key


def hilbert(cell: np.ndarray, bits: int = BITS) -> np.ndarray:
    """[M] int64 keys of cells [M, 3]: each cell's distance along the curve."""
    x = [cell[:, axis].copy() for axis in range(3)]
    for bit in range(bits - 1, 0, -1):  # undo the turns of each octant, from the largest to the smallest
        low = (1 << bit) - 1
        for axis in range(3):
            mirrored = (x[axis] >> bit & 1).astype(bool)
            swap = np.where(mirrored, 0, (x[0] ^ x[axis]) & low)
            x[0] = np.where(mirrored, x[0] ^ low, x[0]) ^ swap
            x[axis] = x[axis] ^ swap
    for axis in (1, 2):  # Gray code
        x[axis] = x[axis] ^ x[axis - 1]
    turn = np.zeros(len(cell), np.int64)
    for bit in range(bits - 1, 0, -1):
        turn = np.where(x[2] >> bit & 1, turn ^ ((1 << bit) - 1), turn)
    return z_order(np.stack([axis ^ turn for axis in x], 1), bits)


def along(means: np.ndarray, lo: np.ndarray, size: float, curve: str) -> np.ndarray:
    """[M] int64 the points in the order of one of CURVES; points of one cell keep their order."""
    cell = cells(means, lo, size)
    if curve.endswith("-turned"):
        cell = cell[:, ::-1]
    key = hilbert(cell) if curve.startswith("hilbert") else z_order(cell)
    return np.argsort(key, kind="stable")


def windows(count: int, window: int) -> list[int]:
    """Lengths of the runs of `window` points that `count` points are cut into; the last one may be shorter."""
    return [window] * (count // window) + ([count % window] if count % window else [])
