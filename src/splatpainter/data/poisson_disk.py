"""Even point sets on surfaces: candidates on triangles, Poisson-disk selection, neighbours. Knows no materials.

Kernels keep all they call in this file, so that numba's cache sees every edit.
"""

from __future__ import annotations

import numpy as np
from numba import njit

SAME_SIDE = 0.25
"""Points whose normals' cosine is below this lie on different sides of an edge or a wall and do not push each other."""
NEIGHBOURS = 5
"""Of a point, over which its distance to others is averaged."""


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
    low = points.min(0)
    radius = np.float32(evenness * spacing)
    dims = grid_dims(points, radius)
    heads = np.full(int(np.prod(dims)), -1, np.int32)
    following = np.full(len(points), -1, np.int32)
    left, reach = count, radius
    while left > 0:
        reach = reach if reach > 0.05 * radius else np.float32(0)
        left = _throw(points, normals, order, taken, heads, following, low, radius, reach, dims, left)
        reach = np.float32(reach * 0.9)
    return np.flatnonzero(taken)


def spacing_around(points: np.ndarray, normals: np.ndarray, typical: float) -> np.ndarray:
    """[N] float32 mean distance to the nearest NEIGHBOURS points of the same side, at most 2 * typical."""
    cell = np.float32(2 * typical)
    dims = grid_dims(points, cell)
    heads, following = _fill(points, points.min(0), cell, dims)
    return _mean_distance(points, normals, heads, following, points.min(0), cell, dims, NEIGHBOURS)


def nearest(
    points: np.ndarray, normals: np.ndarray, centers: np.ndarray, center_normals: np.ndarray, typical: float
) -> np.ndarray:
    """[N] int64 index of the centre closest to each point, where a different orientation counts as distance (`typical`
    for a right angle); -1 where no centre lies within 2 * typical."""
    cell = np.float32(2 * typical)
    low = np.minimum(points.min(0), centers.min(0))
    dims = grid_dims(np.stack([low, np.maximum(points.max(0), centers.max(0))]), cell)
    heads, following = _fill(centers, low, cell, dims)
    return _closest(points, normals, centers, center_normals, heads, following, low, cell, dims, np.float32(typical**2))


def grid_dims(points: np.ndarray, cell: float | np.floating) -> np.ndarray:
    """[3] int64 cells of size `cell` that cover the points, at most 512 along an axis (far cells then share one)."""
    return np.minimum(np.floor(np.ptp(points, axis=0) / max(float(cell), 1e-9)).astype(np.int64) + 1, 512)


@njit(nogil=True, cache=True, error_model="numpy")
def _cell(p, low, cell, dims):
    x = min(int((p[0] - low[0]) / cell), dims[0] - 1)
    y = min(int((p[1] - low[1]) / cell), dims[1] - 1)
    z = min(int((p[2] - low[2]) / cell), dims[2] - 1)
    return x, y, z


@njit(nogil=True, cache=True, error_model="numpy")
def _fill(points, low, cell, dims):
    heads = np.full(dims[0] * dims[1] * dims[2], -1, np.int32)
    following = np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        x, y, z = _cell(points[i], low, cell, dims)
        cell_index = (x * dims[1] + y) * dims[2] + z
        following[i] = heads[cell_index]
        heads[cell_index] = i
    return heads, following


@njit(nogil=True, cache=True, error_model="numpy")
def _throw(points, normals, order, taken, heads, following, low, cell, reach, dims, left):
    """Takes points in `order` that keep `reach` from those taken before, until none are left to take."""
    limit = reach * reach
    for i in order:
        if taken[i]:
            continue
        if left == 0:
            break
        p, n = points[i], normals[i]
        x, y, z = _cell(p, low, cell, dims)
        free = True
        for cx in range(max(x - 1, 0), min(x + 2, dims[0])):
            for cy in range(max(y - 1, 0), min(y + 2, dims[1])):
                for cz in range(max(z - 1, 0), min(z + 2, dims[2])):
                    j = heads[(cx * dims[1] + cy) * dims[2] + cz]
                    while j >= 0 and free:
                        q, m = points[j], normals[j]
                        a, b, c = p[0] - q[0], p[1] - q[1], p[2] - q[2]
                        if a * a + b * b + c * c < limit and n[0] * m[0] + n[1] * m[1] + n[2] * m[2] > SAME_SIDE:
                            free = False
                        j = following[j]
                if not free:
                    break
            if not free:
                break
        if free:
            taken[i] = True
            cell_index = (x * dims[1] + y) * dims[2] + z
            following[i] = heads[cell_index]
            heads[cell_index] = i
            left -= 1
    return left


@njit(nogil=True, cache=True, error_model="numpy")
def _mean_distance(points, normals, heads, following, low, cell, dims, neighbours):
    out = np.empty(len(points), np.float32)
    best = np.empty(neighbours, np.float32)
    for i in range(len(points)):
        p, n = points[i], normals[i]
        best[:] = cell * cell
        x, y, z = _cell(p, low, cell, dims)
        for cx in range(max(x - 1, 0), min(x + 2, dims[0])):
            for cy in range(max(y - 1, 0), min(y + 2, dims[1])):
                for cz in range(max(z - 1, 0), min(z + 2, dims[2])):
                    j = heads[(cx * dims[1] + cy) * dims[2] + cz]
                    while j >= 0:
                        q, m = points[j], normals[j]
                        a, b, c = p[0] - q[0], p[1] - q[1], p[2] - q[2]
                        d = a * a + b * b + c * c
                        same = n[0] * m[0] + n[1] * m[1] + n[2] * m[2] > SAME_SIDE
                        if d < best[neighbours - 1] and j != i and same:
                            k = neighbours - 1
                            while k > 0 and best[k - 1] > d:
                                best[k] = best[k - 1]
                                k -= 1
                            best[k] = d
                        j = following[j]
        total = np.float32(0)
        for k in range(neighbours):
            total += np.sqrt(best[k])
        out[i] = total / neighbours
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _closest(points, normals, centers, center_normals, heads, following, low, cell, dims, turn):
    out = np.full(len(points), -1, np.int64)
    for i in range(len(points)):
        p, n = points[i], normals[i]
        x, y, z = _cell(p, low, cell, dims)
        nearest_square = np.float32(1e30)
        for cx in range(max(x - 1, 0), min(x + 2, dims[0])):
            for cy in range(max(y - 1, 0), min(y + 2, dims[1])):
                for cz in range(max(z - 1, 0), min(z + 2, dims[2])):
                    j = heads[(cx * dims[1] + cy) * dims[2] + cz]
                    while j >= 0:
                        q, m = centers[j], center_normals[j]
                        a, b, c = p[0] - q[0], p[1] - q[1], p[2] - q[2]
                        cosine = n[0] * m[0] + n[1] * m[1] + n[2] * m[2]
                        d = a * a + b * b + c * c + turn * (1 - cosine)
                        if d < nearest_square:
                            nearest_square = d
                            out[i] = j
                        j = following[j]
    return out
