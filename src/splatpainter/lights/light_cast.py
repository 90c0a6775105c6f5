"""The colour that a light has in the mean: what of an asset's hue belongs to it, and what to the materials.

Bayes on a grid of colours. Materials: half of them are nearly neutral, the others spread about a warm tone. Lights:
those of 40 photographed environments. One asset counts as one witness: its materials are no independent draws. What
its highlights say (`highlight_color`) is a witness of its own.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.kernels import portable
from splatpainter.lights.highlight_color import HighlightColor

NEUTRAL_SHARE, NEUTRAL_STD = 0.5, 0.08
"""Of the materials, and how far natural logarithms of their red and blue over green lie from 0."""
WARM_MEAN, WARM_COVARIANCE = (0.20, -0.26), ((0.143, -0.092), (-0.092, 0.144))
"""Of the others: twice the covariance of the mean albedos of 61 training meshes."""
OUTLIERS = 0.05
"""Share of materials of any hue."""
LIGHT_MEAN, LIGHT_COVARIANCE = (-0.020, 0.075), ((0.0342, -0.0225), (-0.0225, 0.0682))
"""Of 40 environments' mean radiance."""
HUE_RANGE = 1.2
"""Natural logarithms of red and blue over green that count; beyond, a channel is nearly black."""
GRID_RANGE, GRID_STEPS = 0.6, 25
"""Of the lights that are tried. Hues are gathered at the same steps, each shared by the four around it."""
DARK = 0.005
"""Added to linear colours, so that logarithms of dark ones stay small."""


def cast(colors: np.ndarray, weights: np.ndarray, highlights: HighlightColor | None = None) -> np.ndarray:
    """[3] float64 of mean 1: the likely colour of the light in the mean. colors: [M, 3] linear, without their shading;
    weights: [M]; highlights: what they say of it."""
    logs = portable.log(np.maximum(colors.astype(np.float64), 0) + DARK)
    # Clipped, as a channel that is nearly black says nothing of the light's hue.
    hues = np.stack([logs[:, 0] - logs[:, 1], logs[:, 2] - logs[:, 1]], 1).clip(-HUE_RANGE, HUE_RANGE)
    total = float(portable.total(weights))
    if not total > 0:
        return np.ones(3)
    axis = np.linspace(-GRID_RANGE, GRID_RANGE, GRID_STEPS)
    grid = np.stack([np.repeat(axis, GRID_STEPS), np.tile(axis, GRID_STEPS)], 1)
    # Lights and hues lie on one lattice: a material's is their difference, and its density is looked up.
    step = 2 * GRID_RANGE / (GRID_STEPS - 1)
    amounts = _gathered(hues / step, weights) / total
    reach, half = len(amounts) // 2, GRID_STEPS // 2
    offsets = np.arange(-reach - half, reach + half + 1) * step
    apart = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), -1).reshape(-1, 2)
    density = portable.log(_material_density(apart)).reshape(len(offsets), len(offsets))
    # As a mean, so that one asset is one witness: its materials are no independent draws.
    chance = np.empty(len(grid))
    for k in range(len(grid)):
        red, blue = 2 * half - k // GRID_STEPS, 2 * half - k % GRID_STEPS
        part = density[red : red + len(amounts), blue : blue + len(amounts)]
        chance[k] = float(portable.total(amounts * part))
    chance += _log_normal(grid, LIGHT_MEAN, LIGHT_COVARIANCE)
    if highlights is not None:
        chance += highlights.log_chance(grid)
    chance = portable.exp(chance - chance.max())
    # The mean of what is likely, not the likeliest: one asset seldom decides.
    red, blue = (chance[:, None] * grid).sum(0) / chance.sum()
    color = np.array([portable.exp(float(red)), 1.0, portable.exp(float(blue))])
    return color / color.mean()


def _gathered(positions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """[K, K] sums of weights [M] on a lattice around the middle point, which is 0: each of the positions [M, 2] lies
    between four points."""
    reach = math.ceil(HUE_RANGE * (GRID_STEPS - 1) / (2 * GRID_RANGE)) + 1
    out = np.zeros((2 * reach + 1) ** 2)
    low = np.floor(positions).astype(np.int64)
    part = positions - low
    for first, second in ((0, 0), (0, 1), (1, 0), (1, 1)):
        share = np.abs(1 - first - part[:, 0]) * np.abs(1 - second - part[:, 1])
        cell = (low[:, 0] + first + reach) * (2 * reach + 1) + low[:, 1] + second + reach
        out += np.bincount(cell, weights * share, len(out))
    return out.reshape(2 * reach + 1, 2 * reach + 1)


def _material_density(hues: np.ndarray) -> np.ndarray:
    """[M] of hues [M, 2], per unit area."""
    narrow = ((NEUTRAL_STD**2, 0.0), (0.0, NEUTRAL_STD**2))
    neutral = portable.exp(_log_normal(hues, (0.0, 0.0), narrow))
    warm = portable.exp(_log_normal(hues, WARM_MEAN, WARM_COVARIANCE))
    anywhere = 1 / (2 * HUE_RANGE) ** 2
    return (1 - OUTLIERS) * (NEUTRAL_SHARE * neutral + (1 - NEUTRAL_SHARE) * warm) + OUTLIERS * anywhere


def _log_normal(
    values: np.ndarray,
    mean: tuple[float, float],
    covariance: tuple[tuple[float, float], tuple[float, float]],
) -> np.ndarray:
    (a, b), (_, c) = covariance
    determinant = a * c - b * b
    x, y = values[:, 0] - mean[0], values[:, 1] - mean[1]
    return -0.5 * (c * x * x - 2 * b * x * y + a * y * y) / determinant - portable.log(
        2 * math.pi * math.sqrt(determinant)
    )
