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

from dataclasses import field

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.kernels import portable
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.system.quick_dataclass import dataclass

FEATURES = 192
"""Random Fourier features."""


@dataclass(frozen=True)
class Projections:
    """The random Fourier features: the same numbers always."""

    directions: Floats = field(repr=False)
    """[F, FEATURES] float32."""
    phases: Floats = field(repr=False)
    """[FEATURES] float32, turns 0..1."""

    @staticmethod
    def of(inputs: int, seed: int = 0) -> Projections:
        """Projections for points of `inputs` coordinates, in units of the kernel's standard deviation."""
        rng = np.random.default_rng([seed, inputs, 811])
        # In turns, as the kernel's cosine takes them.
        directions = rng.standard_normal((inputs, FEATURES)) / (2 * np.pi)
        return Projections(directions.astype(np.float32), rng.random(FEATURES).astype(np.float32))

    def features(self, points: np.ndarray) -> Floats:
        """[M, FEATURES] float32 of points [M, F]."""
        out = np.empty((len(points), FEATURES), np.float32)
        run(kernels.take_fourier_features, np.ascontiguousarray(points, np.float32), self.directions, self.phases, out)
        return out

    def predict(self, points: np.ndarray, theta: np.ndarray) -> Floats:
        """[M] float32 theta . features, which are not kept."""
        out = np.empty(len(points), np.float32)
        arrays = (np.ascontiguousarray(points, np.float32), self.directions, self.phases)
        run(kernels.predict_from_features, *arrays, theta.astype(np.float32), out)
        return out


def two_class(features: np.ndarray, positive: Bools, weights: np.ndarray, ridge: float) -> Floats:
    """[FEATURES] float64 theta. features: [M, FEATURES]; positive: [M] bool, some and not all; weights: [M] > 0."""
    inside, outside = np.where(positive, weights, 0), np.where(positive, 0, weights)
    # Each class weighs one: a stroke has few Gaussians, the rest of the view many.
    w = inside / portable.total(inside, np.float64) + outside / portable.total(outside, np.float64)
    return _solved(features, w, w * positive, ridge)


def density_ratio(features: np.ndarray, positive: np.ndarray, weights: np.ndarray, ridge: float) -> Floats:
    """[FEATURES] float64 theta. Arguments as of `two_class`; all of them count as the rest."""
    inside = np.where(positive, weights, 0)
    w = weights / portable.total(weights, np.float64)
    return _solved(features, w, inside / portable.total(inside, np.float64), ridge)


def _solved(features: np.ndarray, weights: np.ndarray, values: np.ndarray, ridge: float) -> np.ndarray:
    gram = np.zeros((FEATURES, FEATURES))
    right = np.zeros(FEATURES)
    points = np.ascontiguousarray(features, np.float32)
    run(kernels.add_normal_equations, points, weights.astype(np.float64), values.astype(np.float64), gram, right)
    # Weights sum to one or two, so the ridge means the same for any number of examples.
    gram[np.diag_indices(FEATURES)] += ridge
    kernels.solve_symmetric(gram, right[:, None], 0, 1)
    return right
