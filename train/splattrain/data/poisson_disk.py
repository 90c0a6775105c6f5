"""Even point sets on surfaces: candidates on triangles, Poisson-disk selection, neighbours. Knows no materials."""

from __future__ import annotations

import numpy as np

from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run

SAME_SIDE = 0.25
"""Points whose normals' cosine is below this lie on different sides of an edge or a wall and do not push each other."""
NEIGHBOURS = 5
"""Of a point, over which its distance to others is averaged."""
Grid = tuple[np.ndarray, np.ndarray, np.ndarray, np.float32, np.ndarray]
"""Points in cells: the last that came into each cell and the one that came before each point (int32, -1: none), the
lowest corner ([3] float32), the edge of a cell, and the number of cells along each axis ([3] int64)."""


def scatter(
    vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(face [count] int64, barycentric weights [count, 3] float32): area-weighted and stratified. Systematic sampling
    shares the points out over the faces; within a face they follow the R2 low-discrepancy sequence (Roberts 2018)."""
    corners = vertices.astype(np.float64)[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    ends = np.cumsum(area)
    positions = (np.arange(count) + rng.random(count)) * (ends[-1] / count)
    face = np.minimum(np.searchsorted(ends, positions, side="right"), len(faces) - 1)
    first = np.searchsorted(face, face)  # faces come in rising order: the k-th point of a face is its own index - first
    k = np.arange(count) - first
    shift = rng.random((len(faces), 2))[face]
    a = (shift[:, 0] + k * 0.7548776662466927) % 1
    b = (shift[:, 1] + k * 0.5698402909980532) % 1
    over = a + b > 1
    a, b = np.where(over, 1 - a, a), np.where(over, 1 - b, b)
    return face, np.stack([1 - a - b, a, b], 1).astype(np.float32)


def select(
    points: np.ndarray, normals: np.ndarray, count: int, spacing: float, rng: np.random.Generator, evenness: float = 0.8
) -> np.ndarray:
    """[count] int64 sorted indices of `points` [M, 3], M >= count, no two closer than a radius that shrinks from
    `evenness` * spacing until enough fit (dart throwing, Poisson disk). spacing: sqrt(area / count). normals [M, 3]."""
    order = rng.permutation(len(points))
    taken = np.zeros(len(points), np.bool_)
    radius = np.float32(evenness * spacing)
    points, normals = readonly(points, np.float32), readonly(normals, np.float32)
    heads, following, low, _, dims = _grid(points, points.min(0), points.max(0), radius)
    left, reach = np.array([count]), radius
    while left[0] > 0:
        reach = reach if reach > 0.05 * radius else np.float32(0)
        kernels.throw_points(points, normals, order, taken, heads, following, low, radius, reach, dims, left, 0, 1)
        reach = np.float32(reach * 0.9)
    return np.flatnonzero(taken)


def spacing_around(points: np.ndarray, normals: np.ndarray, typical: float) -> np.ndarray:
    """[N] float32 mean distance to the nearest NEIGHBOURS points of the same side, at most 2 * typical."""
    points, out = readonly(points, np.float32), np.empty(len(points), np.float32)
    grid = _filled(points, points.min(0), points.max(0), np.float32(2 * typical))
    run(kernels.take_mean_distances, points, readonly(normals, np.float32), *grid, out)
    return out


def nearest(
    points: np.ndarray, normals: np.ndarray, centers: np.ndarray, center_normals: np.ndarray, typical: float
) -> np.ndarray:
    """[N] int64 index of the centre closest to each point, where a different orientation counts as distance (`typical`
    for a right angle); -1 where no centre lies within 2 * typical."""
    arrays = [readonly(values, np.float32) for values in (points, normals, centers, center_normals)]
    points, centers, out = arrays[0], arrays[2], np.empty(len(points), np.int64)
    low, high = np.minimum(points.min(0), centers.min(0)), np.maximum(points.max(0), centers.max(0))
    grid = _filled(centers, low, high, np.float32(2 * typical))
    run(kernels.find_closest_centers, *arrays, *grid, np.float32(typical**2), out)
    return out


def grid_dims(low: np.ndarray, high: np.ndarray, cell: float | np.floating) -> np.ndarray:
    """[3] int64 cells of size `cell` from `low` [3] to `high` [3], at most 512 along an axis (far cells then share
    one)."""
    return np.minimum(np.floor((high - low) / max(float(cell), 1e-9)).astype(np.int64) + 1, 512)


def _grid(points: np.ndarray, low: np.ndarray, high: np.ndarray, cell: np.float32) -> Grid:
    """Room for points, in a grid in which none lies yet."""
    dims = grid_dims(low, high, cell)
    return np.full(int(np.prod(dims)), -1, np.int32), np.full(len(points), -1, np.int32), low, cell, dims


def _filled(points: np.ndarray, low: np.ndarray, high: np.ndarray, cell: np.float32) -> Grid:
    heads, following, low, cell, dims = grid = _grid(points, low, high, cell)
    kernels.fill_point_grid(points, low, cell, dims, heads, following, 0, 1)
    return grid
