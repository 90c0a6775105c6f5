"""The asset that an artist has: few, large, irregular Gaussians over the same surface as the dense surfels."""

from __future__ import annotations

import numpy as np

from splatpainter.transforms import matrix_to_quat, quat_to_matrix
from splattrain.data import poisson_disk

PATCH_OVERLAP = 2.0
"""Standard deviation of a Gaussian over that of the patch that it stands for, so that neighbours overlap."""

MIN_OPENNESS = 0.06
"""Openness below which a surfel does not count as part of what a captured asset shows."""


def coarsened(surfels: dict[str, np.ndarray], count: int, seed: int, roughness: float) -> dict[str, np.ndarray]:
    """The fields of `count` Gaussians that stand for the surfels (fields of Surfels as numpy): see
    surfels.coarse_asset, which checks the arguments."""
    rng = np.random.default_rng([seed, count, 7])
    layers = round(0.3 * roughness * count)
    solid = count - layers
    # Area per surfel: a surfel's standard deviation is SIZE times the mean distance of five neighbours.
    step = float(np.median(surfels["scales"][:, 0])) / 0.6
    spacing = step * float(np.sqrt(len(surfels["means"]) / solid))
    captured = _captured(surfels, 0.7 * spacing)
    if captured.sum() >= count:
        surfels = {k: v[captured] for k, v in surfels.items()}
    points, facing = surfels["means"], quat_to_matrix(surfels["quats"])[..., 2].astype(np.float32)
    even = poisson_disk.select(points, facing, round((1 - 0.4 * roughness) * solid), spacing, rng, evenness=1.0)
    rest = np.setdiff1d(np.arange(len(points)), even, assume_unique=True)
    centers = np.concatenate([even, rng.choice(rest, solid - len(even), replace=False)])
    patch = poisson_disk.nearest(points, facing, points[centers], facing[centers], spacing)
    patch[centers] = np.arange(solid)
    means = _patch_means(surfels, patch, solid)
    scales, quats = _shapes(surfels, patch, means, spacing)
    means |= {"scales": scales, "quats": quats, "opacities": np.full(solid, 0.99)}
    if layers:
        lit = np.flatnonzero(means["occlusion"] >= np.median(means["occlusion"]))  # a dark layer would look like dirt
        copies = rng.choice(lit, layers)
        means = {k: np.concatenate([v, v[copies]]) for k, v in means.items()}
    return _roughened(means, solid, spacing, roughness, rng)


def _captured(surfels: dict[str, np.ndarray], reach: float) -> np.ndarray:
    """[N] bool: surfels that a captured asset has Gaussians for. Left out are those deep inside and the darker side of
    walls thinner than `reach`: Gaussians as large as the wall is thick would let it shine through."""
    points, facing, light = (
        surfels["means"],
        quat_to_matrix(surfels["quats"])[..., 2].astype(np.float32),
        surfels["occlusion"],
    )
    other = poisson_disk.nearest(points, -facing, points, facing, reach)
    gap = np.linalg.norm(points - points[other], axis=1)
    back = (other >= 0) & (gap < reach) & ((facing * facing[other]).sum(1) < -0.5)
    return (light > MIN_OPENNESS) & ~(back & (light < 0.8 * light[other]))


MEANS = ("means", "normals", "albedo", "metallic", "roughness", "occlusion", "transfer")


def _patch_means(surfels: dict[str, np.ndarray], patch: np.ndarray, count: int) -> dict[str, np.ndarray]:
    """Means over each patch [count, ...]; surfels of no patch (-1) are left out."""
    inside = patch >= 0
    index = patch[inside]
    number = np.maximum(np.bincount(index, minlength=count), 1)
    out = {}
    for name in MEANS:
        values = surfels[name][inside].reshape(len(index), -1)
        sums = np.stack([np.bincount(index, column, count) for column in values.T], 1)
        out[name] = (sums / number[:, None]).reshape(count, *surfels[name].shape[1:])
    out["normals"] /= np.maximum(np.linalg.norm(out["normals"], axis=1, keepdims=True), 1e-9)
    return out


def _shapes(
    surfels: dict[str, np.ndarray], patch: np.ndarray, means: dict[str, np.ndarray], spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """(scales [R, 3], quats [R, 4]) from the covariance of each patch, grown to meet its neighbours; thinnest last."""
    inside = patch >= 0
    index, count = patch[inside], len(means["means"])
    number = np.maximum(np.bincount(index, minlength=count), 1)
    away = surfels["means"][inside] - means["means"][index]
    spread = np.empty((count, 3, 3))
    for a in range(3):
        for b in range(a + 1):
            spread[:, a, b] = spread[:, b, a] = np.bincount(index, away[:, a] * away[:, b], count) / number
    # A patch of one or two surfels has no shape of its own: a disk across its normal is mixed in.
    disk = np.eye(3) - means["normals"][:, :, None] * means["normals"][:, None, :]
    few = 1.0 / number
    spread += few[:, None, None] * disk * (0.28 * spacing) ** 2
    values, axes = np.linalg.eigh(spread)  # rising: the thin axis first
    values, axes = values[:, ::-1], axes[:, :, ::-1].copy()
    axes[np.linalg.det(axes) < 0, :, 2] *= -1
    scales = PATCH_OVERLAP * np.sqrt(np.maximum(values, 1e-16))
    low = np.array([0.42, 0.42, 0.03]) * spacing
    high = np.array([1.5, 1.1, 0.35]) * spacing
    return np.clip(scales, low, high), matrix_to_quat(axes)


def _roughened(
    gaussians: dict[str, np.ndarray], solid: int, spacing: float, roughness: float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Jitter as real assets have it; those from `solid` on become faint layers."""
    count = len(gaussians["means"])
    out = dict(gaussians)
    layer = np.arange(count) >= solid
    shift = 0.12 * roughness * spacing * rng.standard_normal((count, 3))
    lift = np.where(
        layer, 0.45 * spacing * rng.standard_normal(count), 0.06 * roughness * spacing * rng.standard_normal(count)
    )
    out["means"] = gaussians["means"] + shift + lift[:, None] * gaussians["normals"]
    size = np.exp(
        0.45 * roughness * rng.standard_normal((count, 1)) * [1, 1, 1]
        + 0.3 * roughness * rng.standard_normal((count, 3))
    )
    out["scales"] = gaussians["scales"] * np.where(layer[:, None], 1.25 * size, np.maximum(size, 0.8))
    quats = gaussians["quats"] + 0.12 * roughness * rng.standard_normal((count, 4))
    out["quats"] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    faint = 0.99 - 0.49 * roughness * rng.random(count) ** 3
    out["opacities"] = np.where(layer, rng.uniform(0.1, 0.5, count), faint)
    return out
