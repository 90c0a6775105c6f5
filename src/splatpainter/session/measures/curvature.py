"""How an asset's surface bends around each Gaussian: edges and crevices, for masks. Pure.

Between two points of a surface the normal turns by the curvature of the way: (n2 - n1) (p2 - p1) / |p2 - p1|². Summed
over the Gaussians within a radius r of one, this is the mean curvature H there; on a
sphere it is exact. The bend is the angle of the arc of curvature H over 2 r: 0 on a plane, above 0 where the surface is
an edge or a knob, below 0 in a crevice. Every Gaussian gets a value, and those that cannot be drawn 0.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.cameras import bounding_sphere
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.splats import Splats
from splatpainter.surface.unwrap import PointCells

RADIUS_SHARE = 0.025
"""Radius within which the surface is looked at, in radii of the asset."""
MIN_WIDTHS = 3.0
"""The same radius in typical widths of its Gaussians, at least."""
MIN_SAMPLES = 6
"""Samples around a Gaussian; with fewer it counts as flat."""
MAX_SAMPLES = 40_000
"""Gaussians that stand for the surface; of more, so many are taken evenly."""
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
    # A part stands for all where there are many; the radius grows with their distance.
    chosen = visible[np.unique(np.linspace(0, len(visible) - 1, MAX_SAMPLES).astype(np.int64))]
    _, size = bounding_sphere(splats)
    widths = np.sort(splats.scales[chosen], 1)[:, 1]
    spread = math.sqrt(len(visible) / len(chosen))
    radius = max(RADIUS_SHARE * size, MIN_WIDTHS * float(np.median(widths)) * spread)
    drawable = np.flatnonzero(splats.drawable)
    cells = PointCells.of(means[chosen], radius)
    sums = np.zeros((len(drawable), 3))
    queries = np.ascontiguousarray(means[drawable]), np.ascontiguousarray(normals[drawable])
    samples = cells.sorted_rows(means[chosen], normals[chosen])
    run(kernels.sum_turns, samples, cells.keys, cells.corner, radius, *queries, sums)
    count, turns, squares = sums.T
    # Too few neighbours say nothing, and a mask should not speckle there.
    curvature = np.where(count >= MIN_SAMPLES, turns / np.maximum(squares, 1e-30), 0.0)  # in units of the radius
    out[drawable] = np.degrees(np.clip(2 * curvature, -math.pi, math.pi))
    return out
