"""The nearest neighbours of every point among all of them, and means over them. No tree.

Points are sorted by the cube that they lie in; a search widens ring by ring. Every point is answered alone, so nothing
depends on the number of threads.
"""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class NeighbourSearchThresholds:
    """The search for neighbours in cubes. Source: taste; they bound the time of a search."""

    neighbours: int = 16
    """Neighbours of a point, itself the first."""
    points_per_cube: float = 4.0
    """Points per cube, about, of the cubes that hold any."""
    max_rings: int = 3
    """Cubes around its own into which a search looks."""
    max_tested: int = 4096
    """Points that one search looks at: a million points at one place cost no more."""


SEARCH = NeighbourSearchThresholds()


BITS = 20
"""Bits of a cube's index along each axis."""


def neighbours(points: np.ndarray) -> Ids:
    """[M, SEARCH.neighbours] int32: each point, then those nearest to it in rising distance; where a search meets
    fewer, the point itself again. points: [M, 3] finite."""
    count = len(points)
    out = np.empty((count, SEARCH.neighbours), np.int32)
    if count:
        # Cubes are numbered from a corner far below the points, so that outliers keep positive indices.
        size = _cube_size(points)
        low = np.quantile(points, 0.001, axis=0) - size * (1 << (BITS - 2))
        cells = np.floor((points.astype(np.float64) - low) / size).clip(
            SEARCH.max_rings, (1 << BITS) - 1 - SEARCH.max_rings
        )
        cells = cells.astype(np.int64)
        keys = (cells[:, 0] << 2 * BITS) | (cells[:, 1] << BITS) | cells[:, 2]
        order = np.argsort(keys, kind="stable")
        run(
            kernels.find_neighbours,
            readonly(points, np.float64),
            keys[order],
            order,
            readonly(cells, np.int64),
            size,
            out,
        )
    return out


def _cube_size(points: np.ndarray) -> float:
    """World units: halved from the asset's size until cubes hold SEARCH.points_per_cube points."""
    low, high = np.quantile(points, [0.01, 0.99], axis=0).astype(np.float64)
    extent = max(float((high - low).max()), 1e-12)
    # Occupied cubes, not all cubes: surfaces fill few of them.
    size = extent
    for _ in range(16):
        size /= 2
        cells = np.floor((points - low) / size).clip(-(2**19), 2**19).astype(np.int64) + 2**19
        occupied = len(np.unique((cells[:, 0] << 2 * BITS) | (cells[:, 1] << BITS) | cells[:, 2]))
        if len(points) <= SEARCH.points_per_cube * occupied:
            break
    return size


def weighted_means(values: np.ndarray, weights: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([M, C], [M, C]) float32 mean and standard deviation of values [M, C] over neighbours near [M, K] by weights
    [M] > 0."""
    mean, deviation = np.empty_like(values, np.float32), np.empty_like(values, np.float32)
    arrays = (np.ascontiguousarray(values, np.float32), np.ascontiguousarray(weights, np.float32))
    run(kernels.take_neighbour_means, *arrays, np.ascontiguousarray(near), mean, deviation)
    return mean, deviation


def smoothed(
    values: np.ndarray, target: np.ndarray, hold: np.ndarray, links: np.ndarray, near: np.ndarray, rounds: int
) -> Floats:
    """[M] float32 after `rounds` of x_i = hold_i target_i + (1 - hold_i) sum_n links_in x_near(i,n). hold: [M] 0..1;
    links: [M, K], rows sum to 1."""
    now, after = values.astype(np.float32), np.empty(len(values), np.float32)
    fixed = [np.ascontiguousarray(array, np.float32) for array in (target, hold, links)]
    for _ in range(rounds):
        run(kernels.smooth_once, now, *fixed, np.ascontiguousarray(near), after)
        now, after = after, now
    return now
