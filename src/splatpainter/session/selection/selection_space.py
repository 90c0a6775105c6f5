"""Selecting by where Gaussians lie: grow, shrink, feather, what hangs together, floaters. Pure.

Each Gaussian stands for points on its two longest axes, so that large ones reach as far as they do. Points that share
cubes of a few spacings hang together. A floater is a part of little surface beside the largest part.
"""

from __future__ import annotations

import numpy as np

from splatpainter.order_statistics import distinct
from splatpainter.rendering.pixel_shares import MEASURING_OPACITY
from splatpainter.session.selection.selection import snapped_weights, spacing
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix
from splatpainter.voxels.neighbours import components, joined_labels, nearest_within

SELECTED = 0.5
"""Weight from which a Gaussian counts as selected."""
REACH_SIGMAS = 1.5
"""Standard deviations to which a Gaussian's points reach."""
MAX_STEPS = 6
"""Points to either side along an axis; larger Gaussians have them farther apart."""
CUBE_SPACINGS = 1.5
"""Edge of the cubes in which points hang together."""
FLOATER_SHARE = 0.01
"""Largest share of the largest part's surface that a floater has at most."""


def grown(splats: Splats, weights: np.ndarray, radius: float) -> np.ndarray:
    """[N] float32: with everything visible within `radius` (world units) of what is selected."""
    selected, rest = _sides(splats, weights)
    _, distance = nearest_within(splats.means[selected], splats.means[rest], radius)
    out = weights.astype(np.float32).copy()
    out[rest[np.isfinite(distance)]] = 1
    return out


def shrunk(splats: Splats, weights: np.ndarray, radius: float) -> np.ndarray:
    """[N] float32: without what lies within `radius` of anything visible that is not selected."""
    selected, rest = _sides(splats, weights)
    _, distance = nearest_within(splats.means[rest], splats.means[selected], radius)
    out = weights.astype(np.float32).copy()
    out[selected[np.isfinite(distance)]] = 0
    return out


def feathered(splats: Splats, weights: np.ndarray, radius: float) -> np.ndarray:
    """[N] float32: from 1 to 0 over `radius` to either side of the edge of what is selected."""
    selected, rest = _sides(splats, weights)
    out = np.zeros(len(splats), np.float32)
    out[selected] = 1
    # From both sides, so that the edge itself has one half.
    for near, far, sign in ((selected, rest, 1), (rest, selected, -1)):
        _, distance = nearest_within(splats.means[far], splats.means[near], radius)
        inside = np.isfinite(distance)
        t = 0.5 + 0.5 * sign * distance[inside] / radius
        out[near[inside]] = t * t * (3 - 2 * t)
    return snapped_weights(out)


def parts(splats: Splats) -> np.ndarray:
    """[N] int64: which part of the asset each visible Gaussian hangs together with, the parts numbered by their first
    Gaussians; a faint one is of the part nearest to it within a cube, or of none: -1, as are invisible ones."""
    out = np.full(len(splats), -1, np.int64)
    ids = np.flatnonzero(splats.drawable & (splats.opacities > MEASURING_OPACITY))
    if not len(ids):
        return out
    size = CUBE_SPACINGS * spacing(splats)
    points, point_gaussians = _points(splats, ids, size)
    labels = components(points, size)
    first = np.unique(point_gaussians, return_index=True)[1]
    out[ids] = labels[first]
    # All points of one Gaussian are one part, however far apart: join what they touch.
    out = _joined(out, ids, point_gaussians, labels)
    faint = np.flatnonzero(splats.drawable & (splats.opacities > 0) & (out < 0))
    if len(faint):
        near, _ = nearest_within(splats.means[ids], splats.means[faint], size)
        out[faint[near >= 0]] = out[ids[near[near >= 0]]]
    return out


def connected(splats: Splats, weights: np.ndarray) -> np.ndarray:
    """[N] float32: all parts of which something is selected."""
    labels = parts(splats)
    chosen = distinct(labels[(weights >= SELECTED) & (labels >= 0)])
    return np.isin(labels, chosen).astype(np.float32) if len(chosen) else np.zeros(len(splats), np.float32)


def floaters(splats: Splats, share: float = FLOATER_SHARE) -> np.ndarray:
    """[N] float32: parts with at most `share` of the largest part's surface, and faint haze that touches no part."""
    labels = parts(splats)
    visible = splats.drawable & (splats.opacities > 0)
    if (labels < 0).all():
        return np.zeros(len(splats), np.float32)
    # By surface and not by number: a floater may be of many small Gaussians.
    area = surface_area(splats)
    totals = np.bincount(labels[labels >= 0], area[labels >= 0])
    small = totals <= share * totals.max()
    small[int(totals.argmax())] = False
    return (visible & ((labels < 0) | small[np.maximum(labels, 0)])).astype(np.float32)


def surface_area(splats: Splats) -> np.ndarray:
    """[N] float64 world units squared: of each ellipse along its two longest axes, as far as it is opaque."""
    scales = np.sort(splats.scales.astype(np.float64), 1)
    return np.pi * scales[:, 2] * scales[:, 1] * splats.opacities


def _sides(splats: Splats, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(ids that are selected, ids of the rest of what is visible)."""
    visible = splats.drawable & (splats.opacities > 0)
    selected = weights >= SELECTED
    return np.flatnonzero(visible & selected), np.flatnonzero(visible & ~selected)


def _points(splats: Splats, ids: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """(points [P, 3] of Gaussians, the mean of each first; [P] which of them each is of)."""
    means, scales = splats.means[ids].astype(np.float64), splats.scales[ids].astype(np.float64)
    axes = quat_to_matrix(splats.quats[ids].astype(np.float64))
    longest = np.argsort(-scales, 1, kind="stable")[:, :2]
    rows = np.arange(len(ids))
    one, two = axes[rows, :, longest[:, 0]], axes[rows, :, longest[:, 1]]
    reach = REACH_SIGMAS * np.take_along_axis(scales, longest, 1)
    # Large Gaussians stand for several points, or they would not reach what they touch.
    steps = np.minimum(np.ceil(reach / size - 0.5).clip(0), MAX_STEPS).astype(np.int64)
    points, point_gaussians = [means], [rows]
    for a in range(-MAX_STEPS, MAX_STEPS + 1):
        for b in range(-MAX_STEPS, MAX_STEPS + 1):
            some = np.flatnonzero((abs(a) <= steps[:, 0]) & (abs(b) <= steps[:, 1])) if a or b else rows[:0]
            if not len(some):
                continue
            share = np.array([a, b]) / np.maximum(steps[some], 1)
            if a and b and (share**2).sum(1).min() > 1:
                continue  # beside the ellipse
            offset = (share * reach[some])[:, :, None] * np.stack([one[some], two[some]], 1)
            points.append(means[some] + offset.sum(1))
            point_gaussians.append(some)
    return np.concatenate(points), np.concatenate(point_gaussians)


def _joined(out: np.ndarray, ids: np.ndarray, point_gaussians: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Parts that one Gaussian's points are in are one part."""
    merged = joined_labels(int(labels.max()) + 1, out[ids][point_gaussians], labels)
    out[ids] = merged[out[ids]]
    return out
