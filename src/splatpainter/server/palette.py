"""The main colours of an asset, to paint with: k-means of its Gaussians' colours in OKLab, by the area that they cover.
Pure; the same asset has the same palette."""

from __future__ import annotations

import numpy as np

from splatpainter.color import base_color, oklab, to_display
from splatpainter.splats import Splats

MAX_SAMPLES = 20_000
"""Gaussians that are looked at; of more, so many are taken evenly."""
MAX_COLORS = 24
CLUSTERING_ROUNDS = 12
MIN_OPACITY = 0.1
"""Fainter Gaussians are haze."""
MIN_DISTANCE = 0.03
"""Distance in OKLab between two colours of a palette; closer ones look the same."""


def main_colors(splats: Splats, count: int) -> np.ndarray:
    """[C, 3] display sRGB 0..1 of at most `count` colours that differ, dark to light; fewer where there are not so
    many, none where nothing is visible. Raises ValueError: count not 1 to MAX_COLORS."""
    if not 1 <= count <= MAX_COLORS:
        raise ValueError(f"palette: expected 1 to {MAX_COLORS} colours, got {count}")
    # Haze covers much and is no colour that anybody sees.
    visible = np.flatnonzero(splats.drawable & (splats.opacities >= MIN_OPACITY))
    if not len(visible):
        return np.zeros((0, 3), np.float32)
    # Evenly over the rows and without chance, so that the same asset gives the same palette.
    ids = visible[np.unique(np.linspace(0, len(visible) - 1, MAX_SAMPLES).astype(np.int64))]
    colors = np.clip(to_display(base_color(splats.sh[ids]), splats.color_space), 0, 1).astype(np.float64)
    # Weighed by the area that is seen: the two larger sides. The largest ones are held down, for a backdrop of a
    # few huge Gaussians would outweigh everything else.
    sides = np.sort(splats.scales[ids].astype(np.float64), 1)
    weights = splats.opacities[ids] * np.minimum(
        sides[:, 1] * sides[:, 2], np.quantile(sides[:, 1] * sides[:, 2], 0.98)
    )
    points = oklab(colors)
    groups = _k_means(points, weights, count)
    means = [np.average(colors[groups == k], axis=0, weights=weights[groups == k]) for k in range(groups.max() + 1)]
    # The commonest first; of two that look the same only it is kept.
    chosen: list[np.ndarray] = []
    by_weight = np.argsort([-weights[groups == k].sum() for k in range(len(means))], kind="stable")
    for mean in (means[k] for k in by_weight):
        near = [np.linalg.norm(oklab(mean[None]) - oklab(other[None])) < MIN_DISTANCE for other in chosen]
        if not any(near):
            chosen.append(mean)
    # Dark to light: a palette is found again by its order.
    chosen.sort(key=lambda color: float(oklab(color[None])[0, 0]))
    return np.array(chosen, np.float32)


def _k_means(points: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """[N] int64 group of each point, 0 to groups - 1, none of them empty. The first centre is the mean; each further
    one the point whose weighted squared distance from those before is largest."""
    # No weight is 0, or a group of invisible points would have no mean.
    weights = np.maximum(weights, 1e-12 * max(float(weights.max()), 1e-30))
    centers = [np.average(points, axis=0, weights=weights)]
    nearest = ((points - centers[0]) ** 2).sum(1)
    # Far and heavy points first: they lie in groups of their own, and no start by chance is needed.
    while len(centers) < count and nearest.max() > 1e-6:
        centers.append(points[int((nearest * np.sqrt(weights)).argmax())])
        nearest = np.minimum(nearest, ((points - centers[-1]) ** 2).sum(1))
    table = np.array(centers)
    groups = np.zeros(len(points), np.int64)
    for _ in range(CLUSTERING_ROUNDS):
        groups = ((points[:, None] - table[None]) ** 2).sum(2).argmin(1)
        # Groups that lost all their points go, so that none has an empty mean.
        _, groups = np.unique(groups, return_inverse=True)
        table = np.array(
            [np.average(points[groups == k], axis=0, weights=weights[groups == k]) for k in range(groups.max() + 1)]
        )
    return groups
