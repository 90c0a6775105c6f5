"""A classifier of points in feature space, solved exactly: ridge regression on random Fourier features.

Two questions have the same form, theta = (sum_i w_i phi_i phi_i^T + ridge)^-1 sum_i v_i phi_i. With labels of both
kinds (`two_class`) both classes weigh the same and the answer is 1 among positives and 0 among negatives. Where the
rest is not labelled (`density_ratio`) it is the density of the positives over that of everything, by least squares
(Kanamori, Hido, Sugiyama, "A least-squares approach to direct importance estimation", 2009): constant on what the
positives are a random part of, and near 0 elsewhere.

Features: cos(W x + b), W normal, b uniform (Rahimi, Recht, "Random features for large-scale kernel machines", 2007).
Sums are taken in a fixed order in float64, so the solution has the same bits for any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from splatpainter.kernels.parallel import run

FEATURES = 192
"""Random Fourier features."""
POINTS_PER_BLOCK = 64
"""Points that a thread takes at a time."""


@dataclass(frozen=True)
class Projections:
    """The random Fourier features: the same numbers always."""

    directions: np.ndarray = field(repr=False)
    """[F, FEATURES] float32."""
    phases: np.ndarray = field(repr=False)
    """[FEATURES] float32, turns 0..1."""

    @staticmethod
    def of(inputs: int, seed: int = 0) -> Projections:
        """Projections for points of `inputs` coordinates, in units of the kernel's standard deviation."""
        rng = np.random.default_rng([seed, inputs, 811])
        directions = rng.standard_normal((inputs, FEATURES)) / (2 * np.pi)
        return Projections(directions.astype(np.float32), rng.random(FEATURES).astype(np.float32))

    def features(self, points: np.ndarray) -> np.ndarray:
        """[M, FEATURES] float32 of points [M, F]."""
        out = np.empty((len(points), FEATURES), np.float32)
        run(_features, np.ascontiguousarray(points, np.float32), self.directions, self.phases, out)
        return out

    def predict(self, points: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """[M] float32 theta . features, which are not kept."""
        out = np.empty(len(points), np.float32)
        arrays = (np.ascontiguousarray(points, np.float32), self.directions, self.phases)
        run(_predict, *arrays, theta.astype(np.float32), out)
        return out


def two_class(features: np.ndarray, positive: np.ndarray, weights: np.ndarray, ridge: float) -> np.ndarray:
    """[FEATURES] float64 theta. features: [M, FEATURES]; positive: [M] bool, some and not all; weights: [M] > 0."""
    inside, outside = np.where(positive, weights, 0), np.where(positive, 0, weights)
    w = inside / inside.sum(dtype=np.float64) + outside / outside.sum(dtype=np.float64)
    return _solved(features, w, w * positive, ridge)


def density_ratio(features: np.ndarray, positive: np.ndarray, weights: np.ndarray, ridge: float) -> np.ndarray:
    """[FEATURES] float64 theta. Arguments as of `two_class`; all of them count as the rest."""
    inside = np.where(positive, weights, 0)
    w = weights / weights.sum(dtype=np.float64)
    return _solved(features, w, inside / inside.sum(dtype=np.float64), ridge)


def _solved(features: np.ndarray, weights: np.ndarray, values: np.ndarray, ridge: float) -> np.ndarray:
    gram = np.zeros((FEATURES, FEATURES))
    right = np.zeros(FEATURES)
    columns = np.ascontiguousarray(features, np.float64)
    run(_sums, columns, weights.astype(np.float64), values.astype(np.float64), gram, right)
    gram[np.diag_indices(FEATURES)] += ridge
    _cholesky_solve(gram, right)
    return right


@njit(nogil=True, cache=True, error_model="numpy")
def _cosine(turns):
    """cos(2 pi turns) to 4e-6: sin(2 pi y) by its series for |y| <= 1/4."""
    part = turns - np.floor(turns + np.float32(0.5))
    y = np.float32(0.25) - abs(part)
    z = y * y
    series = np.float32(-76.705860) + z * np.float32(42.058694)
    series = np.float32(-41.341702) + z * (np.float32(81.605249) + z * series)
    return y * (np.float32(6.2831853) + z * series)


@njit(nogil=True, cache=True, error_model="numpy")
def _row(points, i, directions, phases, out):
    for d in range(out.shape[0]):
        out[d] = phases[d]
    for f in range(points.shape[1]):
        x = points[i, f]
        for d in range(out.shape[0]):
            out[d] += x * directions[f, d]
    for d in range(out.shape[0]):
        out[d] = _cosine(out[d])


@njit(nogil=True, cache=True, error_model="numpy")
def _features(points, directions, phases, out, thread, threads):
    for start in range(thread * POINTS_PER_BLOCK, points.shape[0], threads * POINTS_PER_BLOCK):
        for i in range(start, min(start + POINTS_PER_BLOCK, points.shape[0])):
            _row(points, i, directions, phases, out[i])


@njit(nogil=True, cache=True, error_model="numpy")
def _predict(points, directions, phases, theta, out, thread, threads):
    row = np.empty(theta.shape[0], np.float32)
    for start in range(thread * POINTS_PER_BLOCK, points.shape[0], threads * POINTS_PER_BLOCK):
        for i in range(start, min(start + POINTS_PER_BLOCK, points.shape[0])):
            _row(points, i, directions, phases, row)
            total = 0.0
            for d in range(row.shape[0]):
                total += row[d] * theta[d]
            out[i] = total


@njit(nogil=True, cache=True, error_model="numpy")
def _sums(features, weights, values, gram, right, thread, threads):
    """Rows of the normal matrix and of the right side, shared out row by row: each sum is one thread's, in order."""
    count = features.shape[1]
    for i in range(features.shape[0]):
        for a in range(thread, count, threads):
            w = weights[i] * features[i, a]
            right[a] += values[i] * features[i, a]
            for b in range(count):
                gram[a, b] += w * features[i, b]


@njit(nogil=True, cache=True, error_model="numpy")
def _cholesky_solve(matrix, right):
    """right <- matrix^-1 right for a symmetric positive matrix, which is overwritten."""
    n = right.shape[0]
    for j in range(n):
        for k in range(j):
            scale = matrix[j, k]
            for i in range(j, n):
                matrix[i, j] -= matrix[i, k] * scale
        root = max(matrix[j, j], 1e-300) ** 0.5
        for i in range(j, n):
            matrix[i, j] /= root
    for i in range(n):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]


def warm() -> None:
    """Compile (or load) the kernels."""
    projections = Projections.of(2)
    points = np.random.default_rng(0).random((8, 2)).astype(np.float32)
    theta = two_class(projections.features(points), np.arange(8) < 4, np.ones(8), 1e-3)
    projections.predict(points, theta)
