"""First Gaussians for an optimisation: round Gaussians at coloured points, or at the points that depth maps show.

As 3DGS starts from a sparse point cloud (Kerbl et al. 2023, Section 5): a Gaussian's size is the root mean squared
distance to its three nearest neighbours. Numpy only. M points, V views of H x W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import sh_from_color
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run, threads
from splatpainter.splats import MAX_MAGNITUDE, SH_COUNTS, ColorSpace, Splats

OPACITY = 0.1
"""Opacity of the first Gaussians, as in 3DGS."""
MIN_ALPHA = 0.5
"""Pixels with less alpha have no depth to speak of."""
MAX_SIZE_RATIO = 16
"""Gaussians larger than this many times the median Gaussian are made this large: a stray point has no near
neighbours."""
MAX_CELLS = 1 << 22


def from_points(
    points: np.ndarray,
    colors: np.ndarray,
    sh_degree: int = 3,
    *,
    opacity: float = OPACITY,
    size: float = 1.0,
    color_space: ColorSpace = "srgb",
) -> Splats:
    """M round Gaussians of one colour each. points: [M, 3] world units; colors: [M, 3] 0..1; opacity: 0..1 of all
    Gaussians; size: standard deviation over the root mean squared distance to the three nearest points.

    Raises ValueError for shapes that do not fit, no points, or values that are not finite."""
    points, colors = np.asarray(points, np.float32), np.asarray(colors, np.float32)
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != colors.shape or len(points) == 0:
        raise ValueError(
            f"points: expected [M, 3] points and as many colours, got {list(points.shape)} and {list(colors.shape)}"
        )
    if not (np.isfinite(points).all() and np.isfinite(colors).all()):
        raise ValueError("points: expected finite points and colours, got NaN or infinite ones")
    if sh_degree not in SH_COUNTS.values():
        raise ValueError(f"points: expected an SH degree from 0 to 4, got {sh_degree}")
    scales = size * _spacing(points)
    sh = np.zeros((len(points), (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = sh_from_color(colors)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(points), 1))
    opacities = np.full(len(points), opacity, np.float32)
    return Splats(
        points.copy(),
        quats,
        np.repeat(scales[:, None], 3, 1).astype(np.float32),
        opacities,
        sh,
        color_space=color_space,
    )


def from_depths(
    cameras: Sequence[Camera],
    colors: np.ndarray,
    depths: np.ndarray,
    alphas: np.ndarray,
    count: int,
    seed: int = 0,
    sh_degree: int = 3,
    *,
    opacity: float = OPACITY,
    size: float = 1.0,
) -> Splats:
    """`count` Gaussians at points that the views show, drawn evenly over the surface (a pixel counts as the area that
    it covers, seen straight on).

    colors: [V, H, W, 3] 0..1; depths: [V, H, W] z-depth, world units; alphas: [V, H, W] 0..1, pixels above SOLID have
    a point. Raises ValueError: shapes that do not fit, or no such pixel."""
    shape = (len(cameras), *np.shape(depths)[1:])
    if np.shape(colors) != (*shape, 3) or np.shape(depths) != shape or np.shape(alphas) != shape or count < 1:
        raise ValueError(
            f"depth maps: expected colours [V, H, W, 3], depths and alphas [V, H, W] of {len(cameras)} cameras and at "
            f"least one Gaussian, got {list(np.shape(colors))}, {list(np.shape(depths))}, {list(np.shape(alphas))}, "
            f"{count}"
        )
    rng = np.random.default_rng(seed)
    # Silhouettes mix the object's depth with nothing's.
    solid = (np.asarray(alphas) > MIN_ALPHA) & (np.asarray(depths) > 0) & np.isfinite(depths)
    view, y, x = np.nonzero(solid)
    if not len(view):
        raise ValueError("depth maps: expected some opaque pixels, got none; do the cameras see the object?")
    z = np.asarray(depths, np.float64)[solid]
    focal = np.array([camera.fx * camera.fy for camera in cameras])
    keys = rng.exponential(size=len(view)) / (z**2 / focal[view])  # the smallest are a draw weighted by area
    if count <= len(view):
        chosen, jitter = np.argpartition(keys, count - 1)[:count], np.zeros((count, 2))
    else:  # every pixel, again and again, elsewhere within the pixel
        chosen = np.concatenate([np.arange(len(view)), rng.integers(len(view), size=count - len(view))])
        jitter = rng.uniform(-0.5, 0.5, (count, 2))
        jitter[: len(view)] = 0
    view, y, x, z = view[chosen], y[chosen], x[chosen], z[chosen]
    points = np.empty((count, 3))
    for k, camera in enumerate(cameras):
        inside = view == k
        pixels = np.stack([x[inside], y[inside]], 1) + 0.5 + jitter[inside]
        points[inside] = camera.unproject(z[inside], pixels)
    return from_points(points, np.clip(colors[view, y, x], 0, 1), sh_degree, opacity=opacity, size=size)


def _spacing(points: np.ndarray) -> np.ndarray:
    """[M] root mean squared distance to the three nearest, world units, within reason."""
    # Twins at one place have no distance, strays too much of it: both get the typical one or a bound.
    gap = np.sqrt(mean_neighbour_squares(points))
    finite = gap[np.isfinite(gap) & (gap > 0)]
    if not len(finite):
        return np.full(len(points), 0.01)
    typical = float(np.median(finite))
    return np.clip(np.nan_to_num(gap, posinf=typical), typical / MAX_SIZE_RATIO, typical * MAX_SIZE_RATIO)


def mean_neighbour_squares(points: np.ndarray, count: int = 3) -> np.ndarray:
    """[M] float32 mean squared distance of each point ([M, 3]) to its `count` nearest others (fewer where there are
    fewer; infinite for a single point, and for points beyond float32's squares or not finite)."""
    points = np.ascontiguousarray(points, np.float32)
    # Points beyond what can be drawn would stretch the grid over nothing.
    near = (np.abs(points) <= MAX_MAGNITUDE).all(1)
    if not near.all():
        out = np.full(len(points), np.inf, np.float32)
        out[near] = mean_neighbour_squares(points[near], count)
        return out
    if len(points) < 2:
        return np.full(len(points), np.inf, np.float32)
    count = min(count, len(points) - 1)
    low, high = np.quantile(points, [0.01, 0.99], axis=0).astype(
        np.float64
    )  # outliers share the border's cells: slower, not wrong
    size = np.maximum(high - low, 1e-6 * max(float((high - low).max()), 1e-12))
    # About one point a cell, by volume and, for surfaces, by area; bounded so that the table stays small.
    cell = float((np.prod(size) / len(points)) ** (1 / 3))
    cell = max(cell, float((np.prod(np.sort(size)[1:]) / len(points)) ** (1 / 2)) / 4, float(size.max()) / 1024)
    shape = np.maximum(np.ceil(size / cell), 1).astype(np.int64)
    while shape.prod() > MAX_CELLS:
        cell *= 2
        shape = np.maximum(np.ceil(size / cell), 1).astype(np.int64)
    cells = np.clip((points - low) / cell, 0, shape - 1).astype(np.int64)
    keys = (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]
    order = np.argsort(keys, kind="stable")
    starts = np.searchsorted(keys[order], np.arange(shape.prod() + 1))
    out = np.empty(len(points), np.float32)
    grid = (points[order], order, cells, starts, shape, float(np.float32(cell)))
    run(kernels.neighbour_squares, points, *grid, count, out, np.empty((threads(), count), np.float32))
    return out
