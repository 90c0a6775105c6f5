"""The surface that decals on captures lie on: fused out of several views."""

from __future__ import annotations

import numpy as np

import splatpainter as sp
from splatpainter.decals.decal_fusion import fused_surface
from splatpainter.surface.estimate import Surface
from tests.support import surface_shapes

UP = np.array([0, 1.0, 0])
FRONT = np.array([0, 0, 1.0])


def fused(splats: sp.Splats, point: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, float]:
    def facing(direction: np.ndarray, pixel: float) -> sp.Camera:
        size = int(2.2 * radius / pixel)
        camera = sp.look_at(point + 5 * radius * direction, point, UP, width=size, height=size)
        focal = 5 * radius / pixel
        return sp.Camera(size, size, focal, focal, size / 2, size / 2, camera.world_to_camera)

    return fused_surface(splats, Surface.of(splats), (point, FRONT), UP, radius, facing)


def test_rough_box_is_closed_at_its_edge() -> None:
    """Gaussians that scatter about the faces by half a width: both faces, and no gap where they meet."""
    points, normals, voxel = fused(surface_shapes.box(5_000, noise=0.5), np.array([0.4, 0, 0.5]), 0.35)
    out = np.abs(points).max(1) - 0.5
    assert np.quantile(np.abs(out), 0.95) < 3 * voxel
    front, side = normals[:, 2] > 0.9, normals[:, 0] > 0.9
    assert min(front.sum(), side.sum()) > 500
    middle = points[np.abs(points[:, 1]) < 2 * voxel]
    angle = np.sort(np.arctan2(middle[:, 2] - 0.3, middle[:, 0] - 0.3))
    around = (angle > 0) & (angle < np.pi / 2)
    assert np.diff(angle[around]).max() < 0.15  # of 1.57 around the edge


def test_what_other_views_look_through_is_cut_off() -> None:
    """A plate of fog goes on beyond the front face: from the side there is nothing behind its edge."""
    box = surface_shapes.box(5_000)
    y, x = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(0.51, 0.62, 6)))
    plate = np.stack([x, y, np.full(len(x), 0.5)], 1)
    fog = surface_shapes.patches(plate, np.tile(FRONT, (len(plate), 1)), 0.02)
    points, _, voxel = fused(box.append(fog), np.array([0.4, 0, 0.5]), 0.35)
    assert points[:, 0].max() < 0.5 + 4 * voxel
