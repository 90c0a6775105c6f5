"""The bundled still life: promises of its docstring, and a surface that is closed, aligned and glossy."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from splatpainter.cameras import look_at, orbit
from splatpainter.demo_asset import BACKGROUND, CALM, LIFT, demo_asset, demo_view
from splatpainter.demo_asset.light import sh_basis
from splatpainter.demo_asset.noise import value_noise
from splatpainter.demo_asset.shapes import MARGIN, quarter, revolve, revolved_distance, scatter, sweep, swept_distance
from splatpainter.rendering import render
from splatpainter.rendering.reference import harmonics
from splatpainter.splats import Splats, rows_sha256


@pytest.fixture(scope="module")
def splats() -> Splats:
    return demo_asset()


def matrices(quats: np.ndarray) -> np.ndarray:
    """[N, 3, 3] from w, x, y, z, by scipy."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()


def colours(splats: Splats, eye: np.ndarray) -> np.ndarray:
    """[N, 3] what the rows show towards `eye`."""
    away = splats.means - eye
    basis = sh_basis(away / np.linalg.norm(away, axis=1, keepdims=True))
    return np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, splats.sh), 0)


def glazed(splats: Splats) -> np.ndarray:
    """[N] bool: rows on the pot's belly, lid and knob (its axis stands at x = 0, z = -0.14)."""
    radius = np.hypot(splats.means[:, 0], splats.means[:, 2] + 0.14)
    return (splats.means[:, 1] > 0.1 - LIFT) & (radius < 0.52)


def test_what_the_docstring_promises(splats: Splats) -> None:
    assert 60_000 <= len(splats) <= 90_000
    assert splats.sh_degree == 3
    assert splats.drawable.all()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert getattr(splats, name).dtype == np.float32
    assert (splats.scales > 0).all()
    assert splats.opacities.min() >= 0.85 and splats.opacities.max() <= 0.99
    low, high = splats.means.min(0), splats.means.max(0)
    np.testing.assert_allclose(high - low, [2.0, 1.1, 2.0], atol=0.05)
    np.testing.assert_allclose((low + high) / 2, 0, atol=0.05)
    np.testing.assert_allclose(np.linalg.norm(splats.quats, axis=1), 1, atol=1e-5)


def test_two_processes_make_the_same_rows_without_torch_or_numba(splats: Splats) -> None:
    code = (
        "import sys; from splatpainter.demo_asset import demo_asset; from splatpainter.splats import rows_sha256;"
        "print(rows_sha256(demo_asset()), sorted({'torch', 'numba', 'scipy'} & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert answer.split(maxsplit=1) == [rows_sha256(splats), "[]\n"]


def test_rows_are_flat_and_lie_in_the_surface(splats: Splats) -> None:
    assert (splats.scales.argmin(1) == 2).all()
    np.testing.assert_allclose(splats.scales[:, 2] / splats.scales[:, :2].min(1), 0.1, rtol=1e-4)
    # Oracle for the normal: the plane through each row's neighbours, on the belly away from spout and handle.
    belly = glazed(splats) & (np.abs(splats.means[:, 1] + 0.1) < 0.1) & (np.abs(splats.means[:, 0]) < 0.3)
    rows = np.nonzero(belly)[0]
    near = splats.means[rows][KDTree(splats.means[rows]).query(splats.means[rows], k=12)[1]]
    plane = np.linalg.svd(near - near.mean(1, keepdims=True))[2][:, 2]
    short = matrices(splats.quats[rows])[:, :, 2]
    assert np.quantile(np.abs(np.einsum("ni,ni->n", plane, short)), 0.01) > 0.97
    outwards = splats.means[rows] - [0, splats.means[rows, 1].mean(), -0.14]
    assert (np.einsum("ni,ni->n", outwards, short) > 0).mean() > 0.99


def test_no_row_is_far_from_its_neighbours(splats: Splats) -> None:
    gap = KDTree(splats.means).query(splats.means, k=4)[0][:, 3]
    assert (gap / splats.scales[:, :2].max(1)).max() < 4


def test_the_glaze_shows_different_light_to_different_views_and_the_highlight_moves(splats: Splats) -> None:
    pot = splats.take(glazed(splats))
    bands = np.abs(pot.sh[:, 1:]).max((1, 2))
    assert np.median(bands) > 0.03
    brightest = []
    for side in (-1.5, 1.5):
        eye = np.array([side, 0.9, 3.2])
        light = colours(pot, eye).mean(1)
        facing = np.einsum("ni,ni->n", matrices(pot.quats)[:, :, 2], eye - pot.means) > 0
        top = facing & (light > np.quantile(light[facing], 0.99))
        brightest.append(pot.means[top].mean(0))
    assert brightest[1][0] - brightest[0][0] > 0.1


def test_colours_stay_sane_from_every_side(splats: Splats) -> None:
    normals = matrices(splats.quats)[:, :, 2]
    for camera in orbit((0, 0, 0), 3.7, 6, elevation=20):
        front = np.einsum("ni,ni->n", normals, camera.position - splats.means) > 0
        shown = colours(splats, camera.position)[front]
        assert np.quantile(shown, 0.001) >= 0 and np.quantile(shown, 0.999) < 1.35


def test_basis_is_orthonormal_and_is_the_renderers() -> None:
    # Gauss-Legendre in z times equal steps around: exact for products of degree-3 harmonics.
    z, weight = np.polynomial.legendre.leggauss(8)
    turn = np.arange(16) * np.pi / 8
    ring = np.sqrt(1 - z * z)
    points = np.stack([np.outer(ring, np.cos(turn)), np.outer(ring, np.sin(turn)), np.outer(z, np.ones(16))], -1)
    basis = sh_basis(points).reshape(-1, 16)
    gram = basis.T @ (np.repeat(weight, 16)[:, None] * basis) * np.pi / 8
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)
    flat = points.reshape(-1, 3)
    np.testing.assert_allclose(basis, harmonics(torch.from_numpy(flat), 16).numpy(), atol=1e-6)


def test_lattice_is_even_on_a_ball() -> None:
    angle = np.linspace(-np.pi / 2, np.pi / 2, 60)
    ball = revolve(np.stack([np.cos(angle), np.sin(angle)], 1).tolist(), 800)
    u, v, size = scatter(ball, lambda at: np.full(len(at), 0.05), np.random.default_rng(0))
    points, normals, _ = ball.frames(u, v)
    np.testing.assert_allclose(len(u), 4 * np.pi / 0.05**2, rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=2e-3)
    assert np.einsum("ni,ni->n", normals, points).min() > 0.99
    gap = KDTree(points).query(points, k=2)[0][:, 1] / 0.05
    assert gap.min() > 0.5 and gap.max() < 1.4
    # A row's four parts surround it at a quarter of its size along and around.
    parts = ball.points(*quarter(ball, u, v, size)[:2]).reshape(-1, 4, 3)
    belt = np.abs(points[:, 1]) < 0.9
    away = np.linalg.norm(parts[belt] - points[belt][:, None], axis=2) / size[belt, None]
    np.testing.assert_allclose(away, np.sqrt(2) / 4, atol=0.03)


def test_distances_of_ball_and_straight_tube_are_exact_nearby_and_never_too_large() -> None:
    points = np.random.default_rng(3).uniform(-0.6, 0.6, (2000, 3))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 60)
    ball = revolve(np.stack([0.5 * np.cos(angle), 0.5 * np.sin(angle)], 1).tolist(), 800)
    exact, found = np.linalg.norm(points, axis=1) - 0.5, revolved_distance(ball)(points)
    near = exact < MARGIN
    np.testing.assert_allclose(found[near], exact[near], atol=4e-3)
    assert (found[~near] <= exact[~near] + 4e-3).all() and (found[~near] > 0.05).all()
    tube = sweep([(-0.4, 0, 0.2), (0, 0, 0.2), (0.4, 0, 0.2)])
    inside = np.abs(points[:, 0]) < 0.35
    radius = np.hypot(points[:, 1], points[:, 2])
    near = inside & (radius < 0.25)
    np.testing.assert_allclose(swept_distance(tube)(points)[near], radius[near] - 0.2, atol=2e-3)


def test_noise_is_smooth_and_centred() -> None:
    points = np.random.default_rng(4).uniform(-50, 50, (20_000, 3))
    noise = value_noise(points, 1)
    assert abs(noise.mean()) < 0.02 and 0.2 < noise.std() < 0.6 and np.abs(noise).max() <= 1
    assert np.abs(value_noise(points + 1e-4, 1) - noise).max() < 2e-3


def test_the_pot_is_closed_and_its_belly_calm_in_the_recommended_view(splats: Splats) -> None:
    sides = [look_at((3.6 * x, 0.4, 3.6 * z - 0.14), (0, 0, -0.14), width=200, height=200, fov=33) for x, z in
             ((0, 1), (1, 0), (0, -1), (-1, 0))]  # fmt: skip
    alpha = render(splats, sides).alphas[..., 0]
    assert alpha[:, 85:110, 85:115].min() > 0.98
    picture = render(splats, demo_view(200)).colors[0]
    np.testing.assert_allclose(picture[:8, :8], np.broadcast_to(BACKGROUND, (8, 8, 3)), atol=1e-3)
    left, top, right, bottom = (round(200 * part) for part in CALM)
    belly = picture[top:bottom, left:right]
    assert belly.min() > 0.38 and belly.mean() > 0.75 and belly.std((0, 1)).max() < 0.12
