"""Planes of symmetry: found on shapes whose plane is given, and cameras that see the mirror image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.rendering import render
from splatpainter.session.measures.mirror_plane import MirrorPlane, find_mirror_plane, mirrored_camera, parsed_plane
from splatpainter.splats import Splats
from tests.support import surface_shapes

UP = (0.0, -1.0, 0.0)


def symmetric(plane: MirrorPlane, count: int = 900) -> Splats:
    """Round Gaussians in random colours beside a plane, and their mirror images."""
    rng = np.random.default_rng(3)
    points = rng.normal(size=(count, 3)) * (0.7, 0.5, 0.3) + (0.4, 0.1, 0)
    colors = rng.uniform(-1, 1, (count, 1, 3))
    means = np.concatenate([points, plane.mirrored(points)]).astype(np.float32)
    scales = np.full((2 * count, 3), 0.05, np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (2 * count, 1))
    sh = np.concatenate([colors, colors]).astype(np.float32)
    return Splats(means, quats, scales, np.full(2 * count, 0.9, np.float32), sh)


@pytest.mark.parametrize(("normal", "offset"), [((1, 0, 0), 0.2), ((0.6, 0.1, 0.8), -0.3)])
def test_the_plane_of_a_symmetric_asset_is_found(normal: tuple[float, float, float], offset: float) -> None:
    plane = parsed_plane(normal, offset)
    result = find_mirror_plane(symmetric(plane), UP)
    side = np.sign(np.dot(result.normal, plane.normal))
    assert abs(np.dot(result.normal, plane.normal)) > np.cos(np.radians(2))
    assert result.offset * side == pytest.approx(plane.offset, abs=0.03)
    assert result.agreement > 0.8


def test_of_several_planes_an_upright_one_is_taken() -> None:
    pipe = surface_shapes.cylinder(2500, height=1.0)  # it has a level one, and any upright one through its axis
    result = find_mirror_plane(pipe, UP)
    assert abs(result.normal[1]) < 0.05 and abs(result.offset) < 0.03 and result.agreement > 0.8
    assert result == find_mirror_plane(pipe, UP)
    with pytest.raises(ValueError, match="8 opaque"):
        find_mirror_plane(replace(pipe, opacities=np.zeros(len(pipe), np.float32)), UP)


def test_the_mirrored_camera_sees_the_mirror_image() -> None:
    plane = parsed_plane((2.0, 0.4, -0.6), 0.5)
    asset = symmetric(plane)
    camera = look_at((1.2, -0.6, -3), (0.2, 0, 0), UP, width=90, height=60, fov=45)
    camera = replace(camera, cx=40.0)
    other = mirrored_camera(camera, plane)
    assert np.linalg.det(other.world_to_camera[:3, :3]) == pytest.approx(1)
    first, second = (render(asset, one).colors[0] for one in (camera, other))
    assert np.abs(first - second[:, ::-1]).mean() < 1e-3
    assert np.abs(first - second).mean() > 0.02
    again = mirrored_camera(other, plane)
    np.testing.assert_allclose(again.world_to_camera, camera.world_to_camera, atol=1e-9)
    assert again.cx == camera.cx


@pytest.mark.parametrize(("normal", "offset"), [((0, 0, 0), 0.0), ((1, 0, 0), float("nan")), ((1e300, 0, 0), 0.0)])
def test_what_is_no_plane_is_refused(normal: tuple[float, float, float], offset: float) -> None:
    with pytest.raises(ValueError, match="mirror: expected"):
        parsed_plane(normal, offset)


def test_points_are_mirrored() -> None:
    plane = parsed_plane((0, 2, 0), 1.0)
    np.testing.assert_allclose(plane.mirrored(np.array([[1.0, 2.0, 3.0]])), [[1, -1, 3]])
