"""The generator of the demo asset: lattices, distances, noise and harmonics that it is made with."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree

from examples.still_life.light import sh_basis
from examples.still_life.noise import value_noise
from examples.still_life.shapes import MARGIN, quarter, revolve, revolved_distance, scatter, sweep, swept_distance
from splatpainter.rendering.reference import harmonics


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
    exact, measured = np.linalg.norm(points, axis=1) - 0.5, revolved_distance(ball)(points)
    near = exact < MARGIN
    np.testing.assert_allclose(measured[near], exact[near], atol=4e-3)
    assert (measured[~near] <= exact[~near] + 4e-3).all() and (measured[~near] > 0.05).all()
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
