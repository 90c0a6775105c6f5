"""Clusters of rows for colour transfer: k-means on colour, position and normal. Knows no pictures."""

from __future__ import annotations

import numpy as np

from splatpainter.lift.global_edit import outward_normals
from splatpainter.splats import SH_C0, Splats

ROUNDS = 20
"""Most rounds of k-means; it usually settles earlier."""
BLOCK = 1 << 14
"""Rows compared with the centres at a time."""


def row_features(splats: Splats, ring: int = 8) -> np.ndarray:
    """[N, 9] float32 base colour, position and outward normal, each group of three centred and scaled to a variance of
    1 in all. Rows that cannot be drawn get zeros (the middle). ring: views that decide which side is outside."""
    drawable = splats.drawable
    own = splats.take(drawable)
    groups = (np.clip(0.5 + SH_C0 * own.sh[:, 0], 0, 1), own.means, outward_normals(own, ring))
    out = np.zeros((len(splats), 9), np.float32)
    out[drawable] = np.concatenate([_scaled(group.astype(np.float64)) for group in groups], 1)
    return out


def kmeans(features: np.ndarray, count: int, seed: int) -> np.ndarray:
    """[N] int64 labels 0..K-1 of `features` [N, D] by Lloyd's rounds from k-means++ centres (Arthur & Vassilvitskii
    2007); K = `count`, or fewer where there are fewer different rows. Every label is in use."""
    centers = _spread(features, count, np.random.default_rng(seed))
    labels = _nearest(features, centers)
    for _ in range(ROUNDS):
        sizes = np.bincount(labels, minlength=len(centers))
        sums = np.stack([np.bincount(labels, column, len(centers)) for column in features.T], 1)
        centers = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], centers)
        before, labels = labels, _nearest(features, centers)
        if np.array_equal(before, labels):
            break
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def _scaled(values: np.ndarray) -> np.ndarray:
    centered = values - values.mean(0)
    return centered / max(float(np.sqrt((centered**2).sum(1).mean())), 1e-9)


def _spread(features: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """[K, D] centres drawn one after the other, each with a chance in proportion to the squared distance from those
    before."""
    chosen = [int(rng.integers(len(features)))]
    near = np.full(len(features), np.inf)
    while len(chosen) < count:
        near = np.minimum(near, ((features - features[chosen[-1]]).astype(np.float64) ** 2).sum(1))
        if not near.sum() > 0:
            break
        chosen.append(int(rng.choice(len(features), p=near / near.sum())))
    return features[chosen].astype(np.float64)


def _nearest(features: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """[N] int64 index of the nearest centre."""
    labels = np.empty(len(features), np.int64)
    squares = (centers**2).sum(1)
    for first in range(0, len(features), BLOCK):
        part = slice(first, first + BLOCK)
        labels[part] = (squares - 2 * features[part] @ centers.T).argmin(1)
    return labels
