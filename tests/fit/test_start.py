"""First Gaussians: sizes from neighbours, centres from depth maps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from splatpainter.cameras import look_at
from splatpainter.fit.start import from_depths, from_points, mean_neighbour_squares

SH_C0 = 0.5 / np.sqrt(np.pi)


def clouds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "box": rng.random((500, 3)),
        "plane": rng.standard_normal((900, 3)) * [1, 1, 0],
        "line": rng.standard_normal((200, 1)) * [[1.0, 2.0, 0.0]],
        "outliers": np.concatenate([rng.standard_normal((800, 3)), 1000 * rng.standard_normal((9, 3))]),
        "repeated": np.repeat(rng.random((10, 3)), 7, 0),
        "one place": np.ones((5, 3)),
        "three": rng.random((3, 3)),
        "two": rng.random((2, 3)),
    }


@pytest.mark.parametrize("name", clouds())
def test_distances_are_those_of_a_tree(name: str) -> None:
    points = clouds()[name].astype(np.float32)
    count = min(3, len(points) - 1)
    near = KDTree(points.astype(np.float64)).query(points.astype(np.float64), k=count + 1)[0][:, 1:]
    np.testing.assert_allclose(mean_neighbour_squares(points), (near**2).mean(1), rtol=1e-5, atol=1e-12)


def test_points_of_a_lattice() -> None:
    """Every point of a cubic lattice of spacing 0.5 has three neighbours at 0.5, so that is every Gaussian's size."""
    points = np.stack(np.meshgrid(*[np.arange(4) * 0.5] * 3), -1).reshape(-1, 3)
    colors = np.tile([0.2, 0.5, 1.0], (len(points), 1))
    gaussians = from_points(points, colors, sh_degree=2, opacity=0.3)
    assert len(gaussians) == 64 and gaussians.sh_degree == 2 and gaussians.drawable.all()
    np.testing.assert_allclose(gaussians.scales, 0.5, rtol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0], colors, atol=1e-6)
    assert not gaussians.sh[:, 1:].any() and np.all(gaussians.opacities == np.float32(0.3))
    np.testing.assert_array_equal(gaussians.means, points.astype(np.float32))


def test_strays_and_repeated_points_get_sizes_within_reason() -> None:
    points = np.concatenate(
        [np.random.default_rng(0).random((300, 3)), [[50.0, 0, 0], [0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]]
    )
    gaussians = from_points(points, np.zeros_like(points))
    typical = np.median(gaussians.scales)
    assert gaussians.scales.max() <= 16.01 * typical and gaussians.scales.min() >= typical / 16.01
    assert from_points(np.zeros((1, 3)), np.zeros((1, 3))).drawable.all()


def test_depths_of_a_plane_become_points_of_the_plane() -> None:
    """Two views of z = 0, whose depth along each ray is known in closed form; the colour tells the place."""
    cameras = [
        look_at((0.3, 0.2, 3), (0, 0, 0), width=40, height=30),
        look_at((-1, 0.5, 2), (0, 0, 0), width=40, height=30),
    ]
    depths, colors = [], []
    for camera in cameras:
        origin, rays = camera.rays()
        far = -origin[2] / rays[..., 2]
        hits = origin + far[..., None] * rays
        depths.append(far * (rays @ camera.forward))
        colors.append(0.5 + 0.1 * hits)
    alphas = np.ones((2, 30, 40))
    alphas[0, :, :20] = 0.2  # too transparent to have a depth
    gaussians = from_depths(cameras, np.array(colors), np.array(depths), alphas, 700, seed=1, sh_degree=1)
    assert len(gaussians) == 700 and gaussians.sh_degree == 1
    np.testing.assert_allclose(gaussians.means[:, 2], 0, atol=1e-5)
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0], 0.5 + 0.1 * gaussians.means, atol=1e-5)
    u = gaussians.means @ cameras[0].world_to_camera[:3, :3].T + cameras[0].world_to_camera[:3, 3]
    assert (u[:, 0] < 0).any(), "the second view shows the left half too"
    again = from_depths(cameras, np.array(colors), np.array(depths), alphas, 700, seed=1, sh_degree=1)
    assert np.array_equal(gaussians.means, again.means)


def test_more_gaussians_than_pixels_lie_between_the_pixels() -> None:
    camera = look_at((0, 0, 2), (0, 0, 0), width=8, height=8)
    gaussians = from_depths([camera], np.full((1, 8, 8, 3), 0.5), np.full((1, 8, 8), 2.0), np.ones((1, 8, 8)), 300)
    assert len(gaussians) == 300 and len(np.unique(gaussians.means.round(6), axis=0)) == 300
    np.testing.assert_allclose(gaussians.means[:, 2], 0, atol=1e-6)


def test_near_and_far_surfaces_get_equal_shares_per_area() -> None:
    """The left half of the picture is a plane at depth 1, the right one at depth 3: nine times the area."""
    camera = look_at((0, 0, 5), (0, 0, 0), width=60, height=60)
    depth = np.where(np.arange(60) < 30, 1.0, 3.0) * np.ones((1, 60, 1))
    gaussians = from_depths([camera], np.full((1, 60, 60, 3), 0.5), depth, np.ones((1, 60, 60)), 500)
    far = int((gaussians.means[:, 2] < 3).sum())
    assert abs(far / 500 - 0.9) < 0.05


def test_what_cannot_be_used() -> None:
    camera, grey = look_at((0, 0, 2), (0, 0, 0), width=4, height=4), np.full((1, 4, 4, 3), 0.5)
    with pytest.raises(ValueError, match=r"got none"):
        from_depths([camera], grey, np.ones((1, 4, 4)), np.zeros((1, 4, 4)), 10)
    with pytest.raises(ValueError, match=r"got \[1, 4, 4, 3\], \[1, 5, 4\]"):
        from_depths([camera], grey, np.ones((1, 5, 4)), np.ones((1, 4, 4)), 10)
    with pytest.raises(ValueError, match="expected .M, 3. points"):
        from_points(np.zeros((4, 3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="finite"):
        from_points(np.full((4, 3), np.nan), np.zeros((4, 3)))
    with pytest.raises(ValueError, match="degree"):
        from_points(np.zeros((4, 3)), np.zeros((4, 3)), sh_degree=7)
