"""Compile (or load) the kernels of this package."""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import look_at
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.unwrap import smoothed, thinned, unwrap
from splatpainter.surface.visible import visible_surface


def warm() -> None:
    """Estimate the surface of nine Gaussians that one view sees, and unwrap nine points."""
    x, y = (axis.ravel().astype(np.float32) for axis in np.meshgrid([-1, 0, 1], [-1, 0, 1]))
    ones = np.ones((9, 3), np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (9, 1))
    splats = Splats(np.stack([x, y, 0 * x], 1), quats, ones * [1, 1, 0.2], ones[:, 0] * 0.9, ones[:, None]).numpy()
    view = project(splats, look_at((0, 0, -5), (0, 0, 0), width=32, height=32))
    visible_surface(Surface.of(splats), splats, view, np.ones((32, 32), bool)).at(np.array([[16.0, 16.0]]))
    points = np.stack([x, y, 0 * x], 1).astype(np.float64)
    normals = np.tile(np.array([0.0, 0.0, 1.0]), (9, 1))
    thinned(points, normals, 1.0)
    points, normals = smoothed((points, normals), (points, normals), 1.5)
    unwrap(points, normals, np.array([0.0, 1.0, 0.0]), 1.0, (2.0, 2.0)).at(points, normals)
