"""Smooth functions of the plane through scattered values: heights and tones that continue a border into a hole.

Heights are a base (a plane, or the sphere that fits points and normals: Guennebaud and Gross, "Algebraic Point Set
Surfaces", SIGGRAPH 2007) and a thin plate over it, the smoothing spline of Duchon (1977); tones are membranes: every
pixel the mean of its neighbours.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.kernels import portable
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import principal_axes


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
    min_upright: float = 0.2
    """Least height of the mean normal of what a sphere is fitted to."""
    min_cosine: float = 0.2
    """Least cosine between a sphere's normal and up, over that of the mean normal, up to which it has heights."""
    max_condition: float = 1e6
    """Largest ratio of the knots' extents: beyond it they lie on a line, and slopes across it are open (none are
    taken)."""
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
        linear, back = _linear_functions(knots)
        weights, solved = np.ones(len(knots)), np.zeros(len(knots) + 3)
        for _ in range(SMOOTH.robust_rounds):
            stiff = kernel.copy()
            np.fill_diagonal(stiff, SMOOTH.bending_weight * len(knots) / weights)  # phi(0) = 0
            bent, slopes = _bent_and_linear(stiff, linear, heights)
            solved = np.concatenate([bent, portable.matmul(slopes, back)])
            residual = heights - portable.matmul(bent, kernel) - portable.matmul(slopes, linear.T)
            weights = 1 / (1 + (residual / max(2 * noise, 1e-12)) ** 2)
        return ThinPlate(knots, solved, scale)

    def at(self, points: np.ndarray) -> np.ndarray:
        """[Q] values at [Q, 2]."""
        out = np.empty(len(points))
        step = max(SMOOTH.distances_per_block // max(len(self.knots), 1), 1)
        # In blocks: all distances at once would not fit into memory.
        for start in range(0, len(points), step):
            part = points[start : start + step] / self.scale
            out[start : start + step] = portable.matmul(_phi(_distances(part, self.knots)), self.weights[:-3, None])[
                :, 0
            ]
            out[start : start + step] += self.weights[-3] + (part * self.weights[-2:]).sum(1)
        return out


def _linear_functions(knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([K, L] the linear functions that knots [K, 2] tell apart, [L, 3] each as a0, a1, a2): three, but on a line those
    along it alone, as slopes across are open, and at one place the constant."""
    middle = knots.mean(0)
    extents, axes = (
        of[0] for of in principal_axes(np.pad(portable.gram(knots - middle, np.ones(len(knots))), (0, 1))[None])
    )
    # The third dimension of the axes is empty: of extent 0, and so first; two flat ones may come in either order.
    axes_apart = [axes[:2, k] for k in range(3) if extents[k] > max(extents[2], 1e-24) / SMOOTH.max_condition**2]
    linear = [np.ones(len(knots)), *(((knots - middle) * axis).sum(1) for axis in axes_apart)]
    back = [np.array([1.0, 0.0, 0.0]), *(np.append(-portable.dot(middle, axis), axis) for axis in axes_apart)]
    return np.stack(linear, 1), np.stack(back)


def _bent_and_linear(kernel: np.ndarray, linear: np.ndarray, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(w [K], a [L]) of kernel w + linear a = heights, linear^T w = 0. kernel [K, K] is positive definite on what is
    orthogonal to linear [K, L] (Wahba, Spline Models for Observational Data, 1990, 2.4): no pivots, no LAPACK."""
    count, columns = linear.shape
    upper, system, right = linear.copy(), kernel.copy(), heights.copy()
    reflections = []
    # Q of linear = Q R by Householder's reflections, applied to both sides.
    for k in range(columns):
        normal = np.zeros(count)
        normal[k:] = upper[k:, k]
        normal[k] += np.copysign(portable.length(normal), normal[k])
        normal /= portable.length(normal)
        reflections.append(normal)
        upper -= 2 * normal[:, None] * portable.matmul(normal, upper)
        system -= 2 * normal[:, None] * portable.matmul(normal, system)
        system -= 2 * portable.matmul(system, normal[:, None]) * normal
        right = right - 2 * normal * portable.dot(normal, right)
    rest, bent = slice(columns, None), np.zeros(count)
    if count > columns:
        bent[rest] = portable.solved(system[rest, rest], right[rest, None])[:, 0]
    below = right[:columns] - portable.matmul(system[:columns, rest], bent[rest, None])[:, 0]
    slopes = np.zeros(columns)
    for k in reversed(range(columns)):
        slopes[k] = (below[k] - portable.dot(upper[k, k + 1 : columns], slopes[k + 1 :])) / upper[k, k]
    for normal in reversed(reflections):
        bent -= 2 * normal * portable.dot(normal, bent)
    return bent, slopes


def _distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return portable.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])


def _phi(r: np.ndarray) -> np.ndarray:
    return r * r * portable.log(np.maximum(r, 1e-12))


def sphere_heights(points: np.ndarray, normals: np.ndarray, queries: np.ndarray) -> np.ndarray | None:
    """[Q] heights z over (x, y) [Q, 2] of the plane or sphere that fits points [P, 3] with upward normals [P, 3], NaN
    where it does not reach; None: it stands on its side."""
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
    if u[2] <= SMOOTH.min_upright:
        return None
    # Near its silhouette a small error of place is a large one of height.
    reached = np.where(discriminant < (SMOOTH.min_cosine * u[2]) ** 2, np.nan, discriminant)
    return mean[2] - 2 * c / (u[2] + np.sqrt(reached))


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
