"""Frames: harmonics by their published polynomials, flips and rotations by what they do to colour and shape."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from splatpainter.io.frames import flip, move, move_back, quaternion_of, sh_basis, sh_flip_signs
from tests.support.io_assets import random_splats
from tests.support.io_packed import covariances, same_bits


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def random_rotation(seed: int) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def test_basis_is_the_published_one() -> None:
    """Appendix A of KHR_gaussian_splatting, degrees 0-3."""
    d = directions(200)
    x, y, z = d.T
    published = [
        np.full_like(x, 0.2820947917738781),
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        1.092548430592079 * x * y,
        -1.092548430592079 * y * z,
        0.3153915652525200 * (2 * z * z - x * x - y * y),
        -1.092548430592079 * x * z,
        0.5462742152960395 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644657 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644657 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    assert np.abs(sh_basis(d, 3) - np.stack(published, 1)).max() < 1e-12


def test_basis_is_orthonormal() -> None:
    """Exact quadrature of the products of degree 8: Gauss-Legendre in z, equal steps around it."""
    z, weights = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * np.pi / 8
    radius = np.sqrt(1 - z * z)
    d = np.stack([np.outer(radius, np.cos(phi)), np.outer(radius, np.sin(phi)), np.outer(z, np.ones(16))], -1)
    basis = sh_basis(d.reshape(-1, 3), 4)
    gram = basis.T @ (basis * np.repeat(weights * np.pi / 8, 16)[:, None])
    assert np.abs(gram - np.eye(25)).max() < 1e-12


@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=3)))
def test_flip(signs: tuple[int, int, int]) -> None:
    d, splats = directions(50), random_splats(30, 4)
    assert np.abs(sh_basis(d * signs, 4) - sh_basis(d, 4) * sh_flip_signs(25, signs)).max() < 1e-12
    flipped = flip(splats, signs)
    # What is seen of the mirrored object from the mirrored direction is what was seen before.
    assert np.abs(sh_basis(d * signs, 4) @ flipped.sh - sh_basis(d, 4) @ splats.sh).max() < 1e-5
    mirror = np.diag(signs).astype(float)
    assert np.allclose(covariances(flipped), mirror @ covariances(splats) @ mirror, rtol=1e-5, atol=1e-9)
    assert np.array_equal(flipped.means, splats.means * np.array(signs, np.float32))
    assert same_bits(flip(flipped, signs), splats)


@pytest.mark.parametrize("seed", range(4))
def test_move(seed: int) -> None:
    d, splats, turn = directions(50), random_splats(30, 4, seed), random_rotation(seed)
    shift = np.array([1.0, -2.0, 0.5])
    moved = move(splats, turn, 1.7, shift)
    assert np.allclose(moved.means, 1.7 * splats.means @ turn.T + shift, atol=1e-5)
    assert np.allclose(covariances(moved), 1.7**2 * turn @ covariances(splats) @ turn.T, rtol=1e-4, atol=1e-8)
    assert np.abs(sh_basis(d @ turn.T, 4) @ moved.sh - sh_basis(d, 4) @ splats.sh).max() < 1e-5
    back = move_back(moved, turn, 1.7, shift)
    for name in ("means", "quats", "scales", "sh"):
        assert np.allclose(getattr(back, name), getattr(splats, name), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_are_exact(axis: int) -> None:
    splats = random_splats(30, 4)
    turn = np.where(np.arange(3) == axis, 1.0, -1.0)
    moved = move(splats, np.diag(turn))
    assert np.array_equal(moved.means, splats.means * turn.astype(np.float32))
    assert np.array_equal(np.sort(np.abs(moved.quats), 1), np.sort(np.abs(splats.quats), 1))
    assert same_bits(move_back(moved, np.diag(turn)), splats)


def test_quaternion_of() -> None:
    rotations = [random_rotation(seed) for seed in range(20)]
    rotations += [np.diag(s) for s in ([1.0, 1, 1], [1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    for rotation in rotations:
        w, x, y, z = quaternion_of(rotation)
        built = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        assert np.abs(np.array(built) - rotation).max() < 1e-12
