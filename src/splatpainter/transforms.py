"""Rotations, directions and real spherical harmonics, each once. Knows no files, no cameras and no Gaussians.

Quaternions are w, x, y, z. Spherical harmonics have the order and signs of 3D Gaussian Splatting: with the
Condon-Shortley phase, as INRIA and KHR_gaussian_splatting have them; functions of `FloatsOrTensor` take numpy or torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from splatpainter.array_types import Floats, FloatsOrTensor
from splatpainter.kernels import portable
from splatpainter.splats import MIN_QUAT, SH_C0

JACOBI_SWEEPS = 6
"""Off the diagonal of 3 x 3 matrices 1e-16 of the largest eigenvalue is left after five, at most."""
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
"""Angle between neighbours of a Fibonacci lattice, radians."""


def quat_to_matrix(quats: FloatsOrTensor) -> FloatsOrTensor:
    """[N, 4] quaternions of any non-zero norm -> [N, 3, 3] rotation matrices; their columns are the rotated axes."""
    if isinstance(quats, np.ndarray):
        unit = quats / np.maximum(row_norm(quats)[:, None], MIN_QUAT)
    else:
        unit = quats / quats.norm(dim=1, keepdim=True)
    w, x, y, z = unit.T
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return stacked(entries, quats).reshape(-1, 3, 3)


def turned(matrix: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """[N, 3, 3] products of a matrix [3, 3] with each of some rotations [N, 3, 3]. Row by row, and each sum from the
    first term to the last: the bits of einsum in a third of its time, and of no BLAS."""
    first, second, third = (rotations[:, j] for j in range(3))
    rows = [row[0] * first + row[1] * second + row[2] * third for row in matrix]
    return np.stack(rows, 1)


def row_max(values: np.ndarray) -> np.ndarray:
    """[N, C] of few columns -> [N] the largest of each row; NaN where there is one. numpy's own reduction along so
    short an axis takes several times longer."""
    out = values[:, 0]
    for column in values.T[1:]:
        out = np.maximum(out, column)
    return out


def row_mean(values: np.ndarray) -> np.ndarray:
    """[..., C] floats of few columns -> [...] the mean of each row, added from the first column to the last: the bits
    of numpy's own mean, which takes five times longer along so short an axis."""
    total = values[..., 0] + np.zeros((), values.dtype)
    for column in range(1, values.shape[-1]):
        total += values[..., column]
    total /= values.shape[-1]
    return total


def row_norm(values: np.ndarray) -> np.ndarray:
    """[N, C] of few columns -> [N] the lengths of the rows: squares are added from the first column to the last, in an
    eighth of the time of numpy's own norm along so short an axis."""
    total = values[:, 0] * values[:, 0]
    for column in values.T[1:]:
        total += column * column
    return np.sqrt(total)


def matrix_to_quat(matrices: np.ndarray) -> np.ndarray:
    """[N, 3, 3] rotation matrices -> [N, 4] unit quaternions whose largest component is positive.

    4 q q^T is linear in the matrix; its row with the largest diagonal gives q without cancellation (Shepperd 1978).
    """
    # All four rows of 4 q q^T are made and one is chosen for each matrix: cheaper for many than a branch for each.
    m = matrices
    d0, d1, d2 = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    squares = np.stack([1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2], 1)
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    outer = [squares[:, 0], wx, wy, wz, wx, squares[:, 1], xy, xz, wy, xy, squares[:, 2], yz, wz, xz, yz, squares[:, 3]]
    quats = np.stack(outer, 1).reshape(-1, 4, 4)[np.arange(len(m)), squares.argmax(1)]
    return quats / row_norm(quats)[:, None]


def principal_axes(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal axes of symmetric matrices [N, 3, 3]: (eigenvalues [N, 3], rising; right-handed axes [N, 3, 3], in
    columns), float64.

    Cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, 8.5), each for all matrices at once: additions,
    products and square roots alone, so that bits are the same on every machine, which LAPACK's are not.
    """
    values = np.array(covariances, np.float64)
    axes = np.broadcast_to(np.eye(3), values.shape).copy()
    for _ in range(JACOBI_SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            # The smaller of the two angles that clear this entry: the larger would exchange eigenvalues that are sorted
            # already.
            off, half = values[:, p, q], (values[:, q, q] - values[:, p, p]) / 2
            reach = np.abs(half) + np.sqrt(half * half + off * off)
            tangent = np.where(half < 0, -off, off) / np.where(reach > 0, reach, 1)
            cosine = (1 / np.sqrt(tangent * tangent + 1))[:, None]
            sine = tangent[:, None] * cosine
            for matrix in (values, values.transpose(0, 2, 1), axes):
                one, other = matrix[:, :, p].copy(), matrix[:, :, q].copy()
                matrix[:, :, p], matrix[:, :, q] = cosine * one - sine * other, sine * one + cosine * other
    # Sorted, and the first axis made from the other two: exchanging columns may have left a mirrored frame.
    squares = values[:, range(3), range(3)]
    order = np.argsort(squares, 1, kind="stable")
    axes = np.take_along_axis(axes, order[:, None, :], 2)
    axes[:, :, 0] = np.cross(axes[:, :, 1], axes[:, :, 2])
    return np.take_along_axis(squares, order, 1), axes


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """[3, 3] float64: the rotation nearest to a matrix [3, 3] of positive determinant (Frobenius), its polar factor."""
    squares, axes = (of[0] for of in principal_axes(portable.matmul(matrix.T, matrix)[None]))
    return portable.matmul(portable.matmul(matrix, axes / np.sqrt(squares)), axes.T)


def inverses(matrices: np.ndarray) -> np.ndarray:
    """[N, B, B] of symmetric positive definite matrices [N, B, B], in their dtype: Gauss-Jordan elimination in float64,
    for all of them at once, with the same bits on every machine."""
    # Without pivoting, which positive definite matrices do not need, and which would make each take its own path.
    left = np.array(matrices, np.float64)
    count = left.shape[1]
    out = np.broadcast_to(np.eye(count), left.shape).copy()
    for k in range(count):
        pivot = left[:, k, k, None].copy()
        left[:, k] /= pivot
        out[:, k] /= pivot
        for j in range(count):
            if j != k:
                factor = left[:, j, k, None].copy()
                left[:, j] -= factor * left[:, k]
                out[:, j] -= factor * out[:, k]
    return out.astype(matrices.dtype)


def fibonacci_sphere(count: int, offset: float = 0.5) -> Floats:
    """[count, 3] float64 unit directions spread evenly over the sphere, from +y down. offset: turn of the lattice about
    y in steps of GOLDEN_ANGLE."""
    i = np.arange(count)
    y = 1 - 2 * (i + 0.5) / count
    angle = (i + offset) * GOLDEN_ANGLE
    ring = np.sqrt(1 - y * y)
    return np.stack([ring * portable.cos(angle), y, ring * portable.sin(angle)], 1)


def sh_basis(directions: FloatsOrTensor, degree: int) -> FloatsOrTensor:
    """[..., (degree + 1)^2] of unit directions [..., 3], in their dtype. degree: 0 to 4."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    # Constants of real spherical harmonics in the order and signs of INRIA's rasteriser, which files follow.
    basis = [np.full_like(x, SH_C0) if isinstance(x, np.ndarray) else x.new_full(x.shape, SH_C0)]
    if degree >= 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 3:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    if degree >= 4:
        basis += [
            2.5033429417967046 * x * y * (xx - yy),
            -1.7701307697799304 * y * z * (3 * xx - yy),
            0.9461746957575601 * x * y * (7 * zz - 1),
            -0.6690465435572892 * y * z * (7 * zz - 3),
            0.10578554691520431 * (zz * (35 * zz - 30) + 3),
            -0.6690465435572892 * x * z * (7 * zz - 3),
            0.47308734787878004 * (xx - yy) * (7 * zz - 1),
            -1.7701307697799304 * x * z * (xx - 3 * yy),
            0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return stacked(basis, directions)


def sh_rotations(matrix: np.ndarray, degree: int) -> list[np.ndarray]:
    """For every band l, the [2l+1, 2l+1] matrix that turns its coefficients with the object: c'(d) = c(matrix^T d).

    Solved from the basis functions at more directions than unknowns; exact to float64 rounding.
    """
    # What the turned function shows in a direction is what the old one showed in the direction turned back.
    directions = fibonacci_sphere(64, 0)
    turned_back = portable.matmul(directions, np.asarray(matrix, np.float64))
    before, after = sh_basis(turned_back, degree), sh_basis(directions, degree)
    bands = [slice(l * l, (l + 1) * (l + 1)) for l in range(degree + 1)]
    ones, solved = np.ones(len(directions)), []
    for band in bands:  # over so even directions the functions are orthogonal, nearly: normal equations lose nothing
        right = portable.transposed_product(after[:, band], before[:, band])
        solved.append(snapped(portable.solved(portable.gram(after[:, band], ones), right)))
    return solved


def snapped(values: np.ndarray) -> np.ndarray:
    """float64 values without the rounding noise around -1, 0 and 1: turns by multiples of 90 degrees stay clean."""
    values = np.asarray(values, np.float64)
    nearest = np.round(values)
    return np.where(np.abs(values - nearest) < 1e-12, nearest, values)


def stacked(values: list[Any], like: Any) -> Any:
    """The arrays stacked along a new last axis."""
    if isinstance(like, np.ndarray):
        return np.stack(values, -1)
    import torch

    return torch.stack(values, -1)
