"""The nearest neighbours of every point among all of them, and means over them. numba, no tree.

Points are sorted by the cube that they lie in; a search widens ring by ring. Every point is answered alone, so nothing
depends on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from splatpainter.kernels.parallel import run
from splatpainter.kernels.search import first_not_below

NEIGHBOURS = 16
"""Neighbours of a point, itself the first."""
POINTS_PER_CUBE = 4.0
"""Points per cube, about, of the cubes that hold any."""
MAX_RINGS = 3
"""Cubes around its own into which a search looks."""
MAX_TESTED = 4096
"""Points that one search looks at: a million points at one place cost no more."""
BITS = 20
"""Bits of a cube's index along each axis."""
POINTS_PER_BLOCK = 256
"""Points that a thread takes at a time."""


def neighbours(points: np.ndarray) -> np.ndarray:
    """[M, NEIGHBOURS] int32: each point, then those nearest to it in rising distance; where a search meets fewer, the
    point itself again. points: [M, 3] finite."""
    count = len(points)
    out = np.empty((count, NEIGHBOURS), np.int32)
    if count:
        size = _cube_size(points)
        low = np.quantile(points, 0.001, axis=0) - size * (1 << (BITS - 2))
        cells = np.floor((points.astype(np.float64) - low) / size).clip(MAX_RINGS, (1 << BITS) - 1 - MAX_RINGS)
        cells = cells.astype(np.int64)
        keys = (cells[:, 0] << 2 * BITS) | (cells[:, 1] << BITS) | cells[:, 2]
        order = np.argsort(keys, kind="stable")
        run(_nearest, np.ascontiguousarray(points, np.float64), keys[order], order, cells, size, out)
    return out


def _cube_size(points: np.ndarray) -> float:
    """World units: halved from the asset's size until cubes hold POINTS_PER_CUBE points."""
    low, high = np.quantile(points, [0.01, 0.99], axis=0).astype(np.float64)
    extent = max(float((high - low).max()), 1e-12)
    for level in range(1, 17):
        size = extent / 2**level
        cells = np.floor((points - low) / size).clip(-(2**19), 2**19).astype(np.int64) + 2**19
        occupied = len(np.unique((cells[:, 0] << 2 * BITS) | (cells[:, 1] << BITS) | cells[:, 2]))
        if len(points) <= POINTS_PER_CUBE * occupied:
            break
    return size


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest(points, keys, order, cells, size, out, thread, threads):
    count = out.shape[1]
    best, square = np.empty(count, np.int64), np.empty(count)
    for start in range(thread * POINTS_PER_BLOCK, points.shape[0], threads * POINTS_PER_BLOCK):
        for i in range(start, min(start + POINTS_PER_BLOCK, points.shape[0])):
            for ring in range(1, MAX_RINGS + 1):
                filled, tested = 0, 0
                for x in range(cells[i, 0] - ring, cells[i, 0] + ring + 1):
                    for y in range(cells[i, 1] - ring, cells[i, 1] + ring + 1):
                        row = (x << 2 * BITS) | (y << BITS)
                        k = first_not_below(keys, 0, keys.shape[0], row | (cells[i, 2] - ring))
                        last = row | (cells[i, 2] + ring)
                        while k < keys.shape[0] and keys[k] <= last and tested < MAX_TESTED:
                            j = order[k]
                            k += 1
                            tested += 1
                            if j == i:
                                continue
                            dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                            dz = points[j, 2] - points[i, 2]
                            distance = dx * dx + dy * dy + dz * dz
                            if filled == count - 1 and distance >= square[filled - 1]:
                                continue
                            slot = filled if filled < count - 1 else filled - 1
                            while slot > 0 and square[slot - 1] > distance:
                                square[slot], best[slot] = square[slot - 1], best[slot - 1]
                                slot -= 1
                            square[slot], best[slot] = distance, j
                            filled = min(filled + 1, count - 1)
                if filled == count - 1 and (square[filled - 1] <= (ring * size) ** 2 or tested >= MAX_TESTED):
                    break
            out[i, 0] = i
            for n in range(count - 1):
                out[i, n + 1] = best[n] if n < filled else i


def weighted_means(values: np.ndarray, weights: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([M, C], [M, C]) float32 mean and standard deviation of values [M, C] over neighbours near [M, K] by weights
    [M] > 0."""
    mean, deviation = np.empty_like(values, np.float32), np.empty_like(values, np.float32)
    arrays = (np.ascontiguousarray(values, np.float32), np.ascontiguousarray(weights, np.float32))
    run(_means, *arrays, np.ascontiguousarray(near), mean, deviation)
    return mean, deviation


@njit(nogil=True, cache=True, error_model="numpy")
def _means(values, weights, near, mean, deviation, thread, threads):
    for start in range(thread * POINTS_PER_BLOCK, near.shape[0], threads * POINTS_PER_BLOCK):
        for i in range(start, min(start + POINTS_PER_BLOCK, near.shape[0])):
            total = 0.0
            for n in range(near.shape[1]):
                total += weights[near[i, n]]
            for c in range(values.shape[1]):
                first, second = 0.0, 0.0
                for n in range(near.shape[1]):
                    w, v = weights[near[i, n]] / total, values[near[i, n], c]
                    first += w * v
                    second += w * v * v
                mean[i, c] = first
                deviation[i, c] = max(second - first * first, 0.0) ** 0.5


def smoothed(
    values: np.ndarray, target: np.ndarray, hold: np.ndarray, links: np.ndarray, near: np.ndarray, rounds: int
) -> np.ndarray:
    """[M] float32 after `rounds` of x_i = hold_i target_i + (1 - hold_i) sum_n links_in x_near(i,n). hold: [M] 0..1;
    links: [M, K], rows sum to 1."""
    now, after = values.astype(np.float32), np.empty(len(values), np.float32)
    fixed = [np.ascontiguousarray(array, np.float32) for array in (target, hold, links)]
    for _ in range(rounds):
        run(_smooth, now, *fixed, np.ascontiguousarray(near), after)
        now, after = after, now
    return now


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth(now, target, hold, links, near, after, thread, threads):
    for start in range(thread * POINTS_PER_BLOCK, near.shape[0], threads * POINTS_PER_BLOCK):
        for i in range(start, min(start + POINTS_PER_BLOCK, near.shape[0])):
            total = 0.0
            for n in range(near.shape[1]):
                total += links[i, n] * now[near[i, n]]
            after[i] = hold[i] * target[i] + (1 - hold[i]) * total


def warm() -> None:
    """Compile (or load) the kernels."""
    points = np.random.default_rng(0).random((40, 3)).astype(np.float32)
    near, ones = neighbours(points), np.ones(40, np.float32)
    weighted_means(points, ones, near)
    smoothed(ones, ones, ones, np.full(near.shape, 1 / NEIGHBOURS, np.float32), near, 1)
