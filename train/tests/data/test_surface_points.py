"""Points for edits, found in depth maps of a plane and of a ball, whose normals are known."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splattrain.data.edits import EditDesign
from splattrain.data.edits.content import Recoloring
from splattrain.data.edits.surface_points import MIN_VIEW_COSINE, facing_normals, interior, random_surface_point

CAMERA = look_at((0.3, 0.4, 4), (0, 0, 0), width=64, height=64, fov=30)


def ball_depth() -> tuple[np.ndarray, np.ndarray]:
    """([H, W] z-depth of the unit ball, 0 beside it, [H, W] its alpha)."""
    eye, rays = CAMERA.rays()
    eye, rays = eye.astype(np.float64), rays.astype(np.float64)
    half = (rays * eye).sum(-1)
    root = half**2 - (eye @ eye - 1)
    distance = np.where(root > 0, -half - np.sqrt(np.maximum(root, 0)), 0)
    return distance * (rays @ CAMERA.forward), (root > 0).astype(np.float32)


def test_points_of_a_ball_lie_on_it_and_face_the_view() -> None:
    depth, alpha = ball_depth()
    for seed in range(20):
        point = random_surface_point([CAMERA], depth[None], alpha[None], np.random.default_rng(seed))
        assert np.linalg.norm(point.position) == pytest.approx(1, abs=1e-6)
        assert point.normal @ point.position > 0.995
        line = CAMERA.position - point.position
        assert point.normal @ line / np.linalg.norm(line) >= MIN_VIEW_COSINE
    with pytest.raises(ValueError, match="no part of its surface faces a view"):
        random_surface_point([CAMERA], 0 * depth[None], 0 * alpha[None], np.random.default_rng(0))


def test_normals_point_to_the_eye_and_the_interior_has_all_neighbours() -> None:
    depth, alpha = ball_depth()
    inside = interior(alpha > 0.5)
    assert inside.sum() < (alpha > 0.5).sum() and not inside[[0, -1]].any()
    normals, cosines = facing_normals(CAMERA.unproject(depth), CAMERA.position)
    assert (cosines[inside] > 0).all() and np.abs(np.linalg.norm(normals[inside], axis=-1) - 1).max() < 1e-9


def test_the_region_of_a_recolouring_holds_what_it_may_reach() -> None:
    recoloring = Recoloring(np.array([0.2, 0.1, 0.0]), 0.3, 0)
    design = EditDesign("recolor", CAMERA, recoloring)
    ring = np.random.default_rng(0).normal(size=(200, 3))
    points = recoloring.position + 0.3 * ring / np.linalg.norm(ring, axis=1, keepdims=True)
    pixels, _ = CAMERA.project(points)
    x, y = pixels.astype(int).T
    assert design.region[y, x].mean() > 0.9 and 0.01 < design.region.mean() < 0.3
