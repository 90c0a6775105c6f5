"""Smooth functions of the plane through scattered values: heights and tones that continue a border into a hole.

Heights are a base (a plane, or the sphere that fits points and normals: Guennebaud and Gross, "Algebraic Point Set
Surfaces", SIGGRAPH 2007) and a thin plate over it, the smoothing spline of Duchon (1977); tones are membranes: every
pixel the mean of its neighbours.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class SmoothSurfaceThresholds:
    """Thin plates and membranes over a hole. Source: taste."""

    max_knots: int = 500
    """Values that a thin plate is fitted to; of more, so many are taken."""
    robust_rounds: int = 4
    """Rounds of reweighting by residuals (Cauchy), after which outliers say little."""
    distances_per_block: int = 1 << 22
    """Distances in memory at a time."""
    coarsest_px: int = 6
    """Shorter side of the pyramid's last level, pixels."""
    membrane_sweeps: int = 40
    """Sweeps of a membrane on each level of its pyramid."""
    max_condition: float = 1e6
    """Largest condition number of the knots' linear functions: beyond it they lie on a line, and slopes across it are
    open (the least are taken)."""
    bending_weight: float = 1e-6
    """Weight of the bending energy for each knot (lengths over the extent): noise is smoothed, slopes at the rim
    stay."""


SMOOTH = SmoothSurfaceThresholds()


@dataclass(frozen=True)
class ThinPlate:
    """z(x, y) = a0 + a1 x + a2 y + sum_k w_k phi(|(x, y) - c_k|), phi(r) = r^2 log r."""

    knots: np.ndarray = field(repr=False)
    """[K, 2]."""
    weights: np.ndarray = field(repr=False)
    """[K + 3]."""
    scale: float
    """Lengths are divided by it."""

    @staticmethod
    def fit(points: np.ndarray, values: np.ndarray, noise: float, max_knots: int = SMOOTH.max_knots) -> ThinPlate:
        """points: [P, 2]; values: [P]; noise: expected deviation of a value, above which it counts for less."""
        # Every n-th point: the system grows with the cube of its knots.
        take = np.linspace(0, len(points) - 1, min(len(points), max_knots)).round().astype(int)
        scale = max(float(np.ptp(points, axis=0).max()), 1e-12)
        knots, heights = points[take] / scale, values[take].astype(np.float64)
        kernel = _phi(_distances(knots, knots))
        ones = np.concatenate([np.ones((len(knots), 1)), knots], 1)
        weights, solved = np.ones(len(knots)), np.zeros(len(knots) + 3)
        # Knots on a line leave the slope across it open; least squares takes none.
        on_line = np.linalg.cond(ones) > SMOOTH.max_condition
        for _ in range(SMOOTH.robust_rounds):
            stiff = np.diag(SMOOTH.bending_weight * len(knots) / weights)
            system = np.block([[kernel + stiff, ones], [ones.T, np.zeros((3, 3))]])
            right = np.append(heights, np.zeros(3))
            solved = np.linalg.lstsq(system, right, rcond=1e-12)[0] if on_line else np.linalg.solve(system, right)
            residual = heights - kernel @ solved[:-3] - ones @ solved[-3:]
            weights = 1 / (1 + (residual / max(2 * noise, 1e-12)) ** 2)
        return ThinPlate(knots, solved, scale)

    def at(self, points: np.ndarray) -> np.ndarray:
        """[Q] values at [Q, 2]."""
        out = np.empty(len(points))
        step = max(SMOOTH.distances_per_block // max(len(self.knots), 1), 1)
        # In blocks: all distances at once would not fit into memory.
        for start in range(0, len(points), step):
            part = points[start : start + step] / self.scale
            out[start : start + step] = _phi(_distances(part, self.knots)) @ self.weights[:-3]
            out[start : start + step] += self.weights[-3] + part @ self.weights[-2:]
        return out


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])


def _phi(r: np.ndarray) -> np.ndarray:
    return r * r * np.log(np.maximum(r, 1e-12))


def sphere_heights(points: np.ndarray, normals: np.ndarray, queries: np.ndarray) -> np.ndarray | None:
    """[Q] heights z over (x, y) [Q, 2] of the plane or sphere that fits points [P, 3] with upward normals [P, 3]; None
    where the sphere does not reach over all queries."""
    mean, mean_normal = points.mean(0), normals.mean(0)
    p = points - mean
    spread = (p * p).sum(1).mean()
    # Algebraic sphere in closed form: normals and points together fix its curvature.
    u4 = 0.5 * (p * normals).sum(1).mean() / max(spread, 1e-300)
    u = mean_normal  # of the shifted points, whose mean is 0
    u0 = -u4 * spread
    x, y = queries[:, 0] - mean[0], queries[:, 1] - mean[1]
    # u4 z^2 + u_z z + (u4 (x^2 + y^2) + u_x x + u_y y + u0) = 0, the root that goes over into the plane's.
    c = u4 * (x * x + y * y) + u[0] * x + u[1] * y + u0
    discriminant = u[2] ** 2 - 4 * u4 * c
    if u[2] <= 0.2 or (discriminant < 0.04 * u[2] ** 2).any():
        return None
    return mean[2] - 2 * c / (u[2] + np.sqrt(discriminant))


def membrane(values: np.ndarray, free: np.ndarray) -> Floats:
    """[H, W, C] float64: values where not free ([H, W] bool), continued so that every free pixel is the mean of its
    neighbours; coarse levels first."""
    height, width = free.shape
    out = np.where(free[..., None], 0, values).astype(np.float64)
    if free.all():
        return out
    # Coarse levels carry the tone across; sweeps at the fine one alone would need thousands.
    if min(height, width) > SMOOTH.coarsest_px:
        pad = ((0, height % 2), (0, width % 2))
        fixed = np.pad(~free, pad).astype(np.float64)
        sums = _blocks(np.pad(out, (*pad, (0, 0))) * fixed[..., None])
        counts = _blocks(fixed[..., None])
        coarse = membrane(sums / np.maximum(counts, 1), counts[..., 0] == 0)
        up = coarse.repeat(2, 0).repeat(2, 1)[:height, :width]
        out = np.where(free[..., None], up, out)
    else:
        out = np.where(free[..., None], values[~free].mean(0), out)
    counts = _neighbours(np.ones((height, width, 1)))
    for _ in range(SMOOTH.membrane_sweeps):
        out = np.where(free[..., None], _neighbours(out) / counts, out)
    return out


def _blocks(values: np.ndarray) -> np.ndarray:
    return values[::2, ::2] + values[1::2, ::2] + values[::2, 1::2] + values[1::2, 1::2]


def _neighbours(values: np.ndarray) -> np.ndarray:
    out = np.zeros_like(values)
    out[1:] += values[:-1]
    out[:-1] += values[1:]
    out[:, 1:] += values[:, :-1]
    out[:, :-1] += values[:, 1:]
    return out
