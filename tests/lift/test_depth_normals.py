"""Depth of the surface in a view."""

from __future__ import annotations

import numpy as np

from splatpainter.kernels.library import kernels
from splatpainter.lift.depth_normals import VISIBLE_NORMALS


def test_medians_are_those_of_the_depths_around() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 3, (23, 31)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0  # nothing there
    depth[8:12] = 2.0  # ties
    medians = np.zeros_like(depth)
    kernels.take_depth_medians(depth, medians, 0, 1)
    for y, x in np.ndindex(depth.shape):
        rows, columns = (
            slice(max(k - VISIBLE_NORMALS.smoothing_px, 0), k + VISIBLE_NORMALS.smoothing_px + 1) for k in (y, x)
        )
        near = np.sort(depth[rows, columns][depth[rows, columns] > 0])
        assert medians[y, x] == (near[len(near) // 2] if depth[y, x] else 0)
