"""Distances to the nearest points, on a uniform grid. Knows no splats."""

from __future__ import annotations

import numpy as np
from numba import njit

from splatpainter.kernels.parallel import run
from splatpainter.splats import MAX_MAGNITUDE

BLOCK = 256
"""Points that a thread takes at a time."""
MOST_CELLS = 1 << 22


def mean_squares(points: np.ndarray, count: int = 3) -> np.ndarray:
    """[M] float32 mean squared distance of each point ([M, 3]) to its `count` nearest others (fewer where there are
    fewer; infinite for a single point, and for points beyond float32's squares or not finite)."""
    points = np.ascontiguousarray(points, np.float32)
    near = (np.abs(points) <= MAX_MAGNITUDE).all(1)
    if not near.all():
        out = np.full(len(points), np.inf, np.float32)
        out[near] = mean_squares(points[near], count)
        return out
    if len(points) < 2:
        return np.full(len(points), np.inf, np.float32)
    count = min(count, len(points) - 1)
    low, high = np.quantile(points, [0.01, 0.99], axis=0).astype(
        np.float64
    )  # outliers share the border's cells: slower, not wrong
    size = np.maximum(high - low, 1e-6 * max(float((high - low).max()), 1e-12))
    cell = float((np.prod(size) / len(points)) ** (1 / 3))
    cell = max(cell, float((np.prod(np.sort(size)[1:]) / len(points)) ** (1 / 2)) / 4, float(size.max()) / 1024)
    shape = np.maximum(np.ceil(size / cell), 1).astype(np.int64)
    while shape.prod() > MOST_CELLS:
        cell *= 2
        shape = np.maximum(np.ceil(size / cell), 1).astype(np.int64)
    cells = np.clip((points - low) / cell, 0, shape - 1).astype(np.int64)
    keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    order = np.argsort(keys, kind="stable")
    starts = np.searchsorted(keys[order], np.arange(shape.prod() + 1))
    out = np.empty(len(points), np.float32)
    run(_search, points, points[order], order, cells, starts, shape, np.float32(cell), count, out)
    return out


@njit(nogil=True, cache=True, error_model="numpy", boundscheck=False)
def _search(points, listed, order, cells, starts, shape, cell, count, out, thread, threads):
    best = np.empty(count, np.float32)
    reach = max(shape[0], shape[1], shape[2])
    for block in range(thread, (len(points) + BLOCK - 1) // BLOCK, threads):
        for i in range(block * BLOCK, min(len(points), (block + 1) * BLOCK)):
            best[:] = np.inf
            cx, cy, cz = cells[i]
            for ring in range(reach + 1):
                # All points of the cells within ring - 1 are seen: nothing nearer than that is left.
                bound = (ring - 1) * cell
                if ring > 1 and best[count - 1] <= bound * bound:
                    break
                for x in range(max(cx - ring, 0), min(cx + ring + 1, shape[0])):
                    for y in range(max(cy - ring, 0), min(cy + ring + 1, shape[1])):
                        inner = abs(x - cx) < ring and abs(y - cy) < ring
                        for side in range(2 * ring + 1):
                            z = cz - ring + side
                            if z < 0 or z >= shape[2] or (inner and 0 < side < 2 * ring):
                                continue
                            key = (x * shape[1] + y) * shape[2] + z
                            for j in range(starts[key], starts[key + 1]):
                                if order[j] == i:
                                    continue
                                a = listed[j, 0] - points[i, 0]
                                b = listed[j, 1] - points[i, 1]
                                c = listed[j, 2] - points[i, 2]
                                d = a * a + b * b + c * c
                                if d < best[count - 1]:
                                    k = count - 1
                                    while k > 0 and best[k - 1] > d:
                                        best[k] = best[k - 1]
                                        k -= 1
                                    best[k] = d
            total = np.float32(0)
            for k in range(count):
                total += best[k]
            out[i] = total / count
