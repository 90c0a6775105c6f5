"""How an asset's surface bends around each Gaussian: edges and crevices, for masks. Pure.

Between two points of a surface the normal turns by the curvature of the way: (n2 - n1) (p2 - p1) / |p2 - p1|². Summed
over the Gaussians within a radius r of one, this is the mean curvature H there; on a
sphere it is exact. The bend is the angle of the arc of curvature H over 2 r: 0 on a plane, above 0 where the surface is
an edge or a knob, below 0 in a crevice. Every Gaussian gets a value, and those that cannot be drawn 0.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from splatpainter.cameras import bounding_sphere
from splatpainter.kernels.parallel import run
from splatpainter.splats import Splats
from splatpainter.surface.unwrap import CELL_BITS, POINTS_PER_BLOCK, PointCells

RADIUS_SHARE = 0.025
"""Radius within which the surface is looked at, in radii of the asset, ..."""
MIN_WIDTHS = 3.0
"""... and in typical widths of its Gaussians, at least."""
MIN_SAMPLES = 6
"""Samples around a Gaussian; with fewer it counts as flat."""
MAX_SAMPLES = 40_000
"""Gaussians that stand for the surface; of more, so many are taken evenly."""
MIN_AGREEING_COSINE = -0.2
"""Cosine between normals below which they do not agree: what faces further away is the other side of something thin."""
MIN_OPACITY = 0.1
"""Fainter Gaussians are haze."""


def bend_degrees(splats: Splats) -> np.ndarray:
    """[N] float64 -180..180, of each Gaussian."""
    from splatpainter.lift.depth_normals import outward_normals

    out = np.zeros(len(splats))
    visible = np.flatnonzero(splats.drawable & (splats.opacities >= MIN_OPACITY))
    if len(visible) < MIN_SAMPLES:
        return out
    normals = outward_normals(splats).astype(np.float64)
    means = splats.means.astype(np.float64)
    chosen = visible[np.unique(np.linspace(0, len(visible) - 1, MAX_SAMPLES).astype(np.int64))]
    _, size = bounding_sphere(splats)
    widths = np.sort(splats.scales[chosen], 1)[:, 1]
    spread = math.sqrt(len(visible) / len(chosen))
    radius = max(RADIUS_SHARE * size, MIN_WIDTHS * float(np.median(widths)) * spread)
    drawable = np.flatnonzero(splats.drawable)
    cells = PointCells.of(means[chosen], radius)
    sums = np.zeros((len(drawable), 3))
    queries = np.ascontiguousarray(means[drawable]), np.ascontiguousarray(normals[drawable])
    run(_neighbour_sums, means[chosen], normals[chosen], *cells.arrays, radius, *queries, sums)
    count, turns, squares = sums.T
    curvature = np.where(count >= MIN_SAMPLES, turns / np.maximum(squares, 1e-30), 0.0)  # in units of the radius
    out[drawable] = np.degrees(np.clip(2 * curvature, -math.pi, math.pi))
    return out


def warm() -> None:
    """Compile (or load) the kernel."""
    points = np.eye(3)
    cells = PointCells.of(points, 1.0)
    run(_neighbour_sums, points, points, *cells.arrays, 1.0, points, points, np.zeros((3, 3)))


@njit(nogil=True, cache=True, error_model="numpy")
def _neighbour_sums(samples, facing, keys, order, corner, size, radius, points, normals, out, thread, threads):
    """out: [Q, 3] per point: how many samples are near, and in sum their (n2 - n1) (p2 - p1) and squared distances, in
    units of the radius."""
    for start in range(thread * POINTS_PER_BLOCK, points.shape[0], threads * POINTS_PER_BLOCK):
        for q in range(start, min(start + POINTS_PER_BLOCK, points.shape[0])):
            cx = int(math.floor((points[q, 0] - corner[0]) / size))
            cy = int(math.floor((points[q, 1] - corner[1]) / size))
            cz = int(math.floor((points[q, 2] - corner[2]) / size))
            for x in range(max(cx - 1, 0), cx + 2):
                for y in range(max(cy - 1, 0), cy + 2):
                    row = (x << 2 * CELL_BITS) | (y << CELL_BITS)
                    k = np.searchsorted(keys, row | max(cz - 1, 0))
                    while k < keys.shape[0] and keys[k] <= row | max(cz + 1, 0):
                        j = order[k]
                        k += 1
                        turn, square, cosine = 0.0, 0.0, 0.0
                        for axis in range(3):
                            away = (samples[j, axis] - points[q, axis]) / radius
                            turn += away * (facing[j, axis] - normals[q, axis])
                            square += away * away
                            cosine += facing[j, axis] * normals[q, axis]
                        if square <= 1.0 and cosine >= MIN_AGREEING_COSINE:
                            out[q, 0] += 1.0
                            out[q, 1] += turn
                            out[q, 2] += square
