"""Rotations and spherical harmonics: against scipy, and by what must hold of them; torch as numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatpainter.transforms import (
    fibonacci_sphere,
    inverses,
    matrix_to_quat,
    nearest_rotation,
    principal_axes,
    quat_to_matrix,
    row_max,
    row_mean,
    row_norm,
    sh_basis,
    sh_rotations,
    snapped,
    turned,
)

HALF_TURNS = [np.diag(signs) for signs in ([1.0, 1, 1], [1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]


def random_rotations(count: int) -> np.ndarray:
    return Rotation.random(count, rng=np.random.default_rng(7)).as_matrix()


def random_directions(count: int) -> np.ndarray:
    d = np.random.default_rng(3).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("flatness", [1.0, 1e-2, 1e-6, 0.0])
def test_principal_axes_are_those_of_lapack(flatness: float) -> None:
    rng = np.random.default_rng(5)
    axes, scales = random_rotations(200), np.sort(rng.uniform(0.1, 3, (200, 3)), 1) * (flatness, 1, 1)
    covariances = (axes * scales[:, None, :] ** 2) @ axes.transpose(0, 2, 1)
    covariances[:4] = [np.zeros((3, 3)), np.eye(3), np.diag([3.0, 1, 2]), np.ones((3, 3))]
    squares, result = principal_axes(covariances)
    largest = np.maximum(squares[:, -1:], 1e-30)
    np.testing.assert_allclose(squares / largest, np.linalg.eigvalsh(covariances) / largest, atol=1e-14)
    np.testing.assert_allclose((result * squares[:, None, :]) @ result.transpose(0, 2, 1), covariances, atol=3e-14)
    np.testing.assert_allclose(result.transpose(0, 2, 1) @ result, np.broadcast_to(np.eye(3), result.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(result), 1, atol=1e-14)


@pytest.mark.parametrize("size", [1, 4])
def test_inverses_are_those_of_lapack(size: int) -> None:
    half = np.random.default_rng(6).normal(size=(50, size, size))
    matrices = half @ half.transpose(0, 2, 1) + 0.1 * np.eye(size)
    np.testing.assert_allclose(inverses(matrices), np.linalg.inv(matrices), rtol=1e-9, atol=1e-9)
    assert inverses(matrices.astype(np.float32)).dtype == np.float32


def test_quaternions_of_any_norm_are_rotations_as_scipy_says() -> None:
    quats = np.random.default_rng(0).normal(0, 3, (50, 4))
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(quat_to_matrix(quats), expected, atol=1e-14)
    np.testing.assert_array_equal(quat_to_matrix(torch.from_numpy(quats)).numpy(), quat_to_matrix(quats))
    assert quat_to_matrix(quats.astype(np.float32)).dtype == np.float32
    np.testing.assert_allclose(quat_to_matrix(1e-14 * quats), expected, atol=1e-12)  # the smallest that are drawn


def test_matrices_are_the_quaternions_they_came_from() -> None:
    matrices = np.concatenate([random_rotations(200), HALF_TURNS])
    quats = matrix_to_quat(matrices)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(quat_to_matrix(quats), matrices, atol=1e-14)
    assert (quats[np.arange(len(quats)), np.abs(quats).argmax(1)] > 0).all()
    np.testing.assert_array_equal(quats[-4:], np.eye(4))


def test_the_fibonacci_sphere_is_even() -> None:
    for offset in (0, 0.5):
        directions = fibonacci_sphere(400, offset)
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-14)
        np.testing.assert_allclose(directions.mean(0), 0, atol=0.01)
        np.testing.assert_allclose(directions.T @ directions / 400, np.eye(3) / 3, atol=0.01)
    near = np.sort(1 - directions @ directions.T, 1)[:, 1]
    assert near.min() > 0.4 * near.max()


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_are_orthonormal(degree: int) -> None:
    # Gauss-Legendre in z times equal steps around: exact for products of these.
    z, weights = np.polynomial.legendre.leggauss(12)
    angles = 2 * np.pi * np.arange(24) / 24
    ring = np.sqrt(1 - z * z)[:, None]
    d = np.stack([ring * np.cos(angles), ring * np.sin(angles), np.repeat(z[:, None], 24, 1)], -1)
    basis = sh_basis(d, degree)
    assert basis.shape == (12, 24, (degree + 1) ** 2)
    gram = np.einsum("i,ijk,ijl->kl", weights * (2 * np.pi / 24), basis, basis)
    np.testing.assert_allclose(gram, np.eye((degree + 1) ** 2), atol=1e-14)


def test_harmonics_are_those_of_legendre_with_the_condon_shortley_phase() -> None:
    """Y_lm = n_lm p_lm(z) Re or Im (x + iy)^|m|, p by the recursion over l; torch and float32 alike."""
    x, y, z = random_directions(100).T
    expected = np.empty((100, 25))
    for m in range(5):
        before, here = np.zeros_like(z), np.full_like(z, (-1) ** m * math.prod(range(2 * m - 1, 0, -2)))
        for l in range(m, 5):
            if l > m:
                before, here = here, (z * (2 * l - 1) * here - (l + m - 1) * before) / (l - m)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m))
            part = norm * (math.sqrt(2) if m else 1) * here * (x + 1j * y) ** m
            expected[:, l * l + l - m] = part.imag
            expected[:, l * l + l + m] = part.real  # of m = 0 too
    d = random_directions(100)
    np.testing.assert_allclose(sh_basis(d, 4), expected, atol=1e-14)
    np.testing.assert_array_equal(sh_basis(torch.from_numpy(d), 4).numpy(), sh_basis(d, 4))
    single = sh_basis(d.astype(np.float32), 4)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, expected, atol=1e-5)


def test_coefficients_turn_with_the_world() -> None:
    d, coefficients = random_directions(50), np.random.default_rng(1).normal(size=25)
    for rotation in random_rotations(5):
        bands = sh_rotations(rotation, 4)
        turned = np.concatenate([band @ coefficients[l * l : (l + 1) ** 2] for l, band in enumerate(bands)])
        np.testing.assert_allclose(sh_basis(d @ rotation.T, 4) @ turned, sh_basis(d, 4) @ coefficients, atol=1e-12)
        for band in bands:
            np.testing.assert_allclose(band @ band.T, np.eye(len(band)), atol=1e-12)
    for rotation in HALF_TURNS:
        assert all(np.array_equal(np.abs(band), np.eye(len(band))) for band in sh_rotations(rotation, 4))


def test_noise_around_whole_numbers_is_removed() -> None:
    np.testing.assert_array_equal(snapped(np.array([1 + 1e-14, -1e-13, 0.5, 1e-9])), [1, 0, 0.5, 1e-9])


def test_turned_rotations_and_the_largest_of_short_rows() -> None:
    rng = np.random.default_rng(3)
    for dtype in (np.float32, np.float64):
        matrix, rotations = rng.normal(size=(3, 3)).astype(dtype), rng.normal(size=(50, 3, 3)).astype(dtype)
        out = turned(matrix, rotations)
        assert out.dtype == dtype
        np.testing.assert_allclose(out, matrix @ rotations, rtol=0, atol=32 * float(np.finfo(dtype).eps))
    values = rng.normal(size=(40, 3))
    values[5, 1] = np.nan
    for count in (1, 2, 3):
        np.testing.assert_array_equal(row_max(values[:, :count]), values[:, :count].max(1))
    assert row_max(np.zeros((0, 2))).shape == (0,)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_lengths_of_rows_are_numpys_to_the_last_bit(dtype: type):
    rng = np.random.default_rng(4)
    for count, columns in ((0, 3), (1, 4), (700, 2), (700, 3), (700, 4)):
        values = (rng.normal(size=(count, columns)) * 10.0 ** rng.uniform(-9, 9, (count, 1))).astype(dtype)
        lengths = row_norm(values)
        assert lengths.dtype == dtype
        np.testing.assert_array_equal(lengths, np.linalg.norm(values, axis=1))


def test_the_nearest_rotation_is_the_polar_factor():
    rng = np.random.default_rng(5)
    for quat in rng.normal(size=(20, 4)):
        stretch = np.eye(3) + 0.2 * rng.normal(size=(3, 3))
        matrix = quat_to_matrix((quat / np.linalg.norm(quat))[None])[0] @ (stretch @ stretch.T)
        left, _, right = np.linalg.svd(matrix)
        np.testing.assert_allclose(nearest_rotation(matrix), left @ right, atol=1e-12)
    assert np.array_equal(nearest_rotation(np.eye(3)), np.eye(3))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_means_of_short_rows_are_numpys_bit_for_bit(dtype: type) -> None:
    values = np.random.default_rng(7).normal(size=(40, 53, 4)).astype(dtype)
    for count in range(1, 5):
        for given in (values[..., :count], values[:, 0, :count], np.ascontiguousarray(values[..., :count])):
            out = row_mean(given)
            assert out.dtype == dtype
            np.testing.assert_array_equal(out, np.ascontiguousarray(given).mean(-1))
    assert row_mean(np.zeros((0, 3), dtype)).shape == (0,)
