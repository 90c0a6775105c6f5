"""Colour transfer by affine maps: one for the asset, or one per cluster of rows, fitted to pictures by least squares.

A picture is linear in the rows' colours, C_p = sum_i w_ip c_i + T_p background. If every row of cluster k takes the
colour A_k c_i + b_k, then C_p = sum_k (A_k S_kp + b_k a_kp) + T_p background, with the cluster's own composite S_k over
black and its own alpha a_k: linear in the unknowns, so the fit is exact whatever shines through what.
Knows no protocol and no clock. P pixels, K clusters, N rows, M rows drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatbench.cases import Step
from splatpainter.cameras import Camera
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import SH_C0, Splats

SOLID = 0.9
"""Pixels that the asset covers by less are not learnt from: there the edited view may show another silhouette."""
TINY = 1e-7
"""Ridge towards "no change" of the one map, relative to the pixels: decides only what the pictures do not."""
IDENTITY = np.eye(4)[:, :3]
"""[4, 3]: (r, g, b, 1) @ IDENTITY = (r, g, b)."""


@dataclass(frozen=True)
class Shown:
    """An edited view beside what the asset shows there."""

    frame: ProjectedView
    """The asset, projected: M rows."""
    target: np.ndarray
    """[H, W, 3] float32 the edited view."""
    use: np.ndarray
    """[H, W] bool: pixels in the mask that the asset covers."""


def shown(splats: Splats, step: Step) -> list[Shown]:
    """The edited views of a step. Raises ValueError where none shows a solid part of the asset."""
    out = []
    for camera, target, mask in zip(step.edited.cameras, step.edited.colors, step.masks, strict=True):
        frame = project(splats, camera)
        use = mask & (frame.rasterize()[1] > SOLID)
        out.append(Shown(frame, np.ascontiguousarray(target, np.float32), use))
    if not any(view.use.any() for view in out):
        raise ValueError(
            f"colour transfer: no masked pixel shows the asset (alpha above {SOLID}); check masks, cameras"
        )
    return out


def fit_affine(views: Sequence[Shown]) -> np.ndarray:
    """[4, 3] float64 M of the new colours (r, g, b, 1) @ M, fitted on all used pixels."""
    gram, rhs, _ = _normal(views, np.zeros(views[0].frame.num_gaussians, np.int64), 1)
    penalty = TINY * _pixels(views)
    return np.linalg.solve(gram + penalty * np.eye(4), rhs + penalty * IDENTITY)


def fit_clusters(views: Sequence[Shown], labels: np.ndarray, ridge: float) -> tuple[np.ndarray, np.ndarray]:
    """One affine map per cluster, all of them solved for together.

    labels: [N] int64 cluster of each row, 0..K-1; ridge: weight of the pull towards the one map of `fit_affine`, in
    parts of the pixels per cluster. Returns ([K, 4, 3] float64, [K] pixels' worth of alpha that the views show of each
    cluster); a cluster that no used pixel shows gets the one map."""
    count = int(labels.max()) + 1
    one = fit_affine(views)
    gram, rhs, seen = _normal(views, labels, count)
    start = np.tile(one, (count, 1))  # [4 K, 3]
    penalty = ridge * _pixels(views) / count
    change = np.linalg.solve(gram + penalty * np.eye(4 * count), rhs - gram @ start)
    return (start + change).reshape(count, 4, 3), seen


def recolored(splats: Splats, maps: np.ndarray, labels: np.ndarray | None = None) -> Splats:
    """The rows with their colours mapped: base colours by the affine map, SH bands >= 1 by its linear part, so that the
    colour towards every direction is mapped. maps: [K, 4, 3]; labels: [N] which one, None: the only one. Rows that
    cannot be drawn keep their bits."""
    own = maps[np.zeros(len(splats), np.int64) if labels is None else labels]  # [N, 4, 3]
    linear, shift = own[:, :3], own[:, 3]
    sh = np.einsum("nki,nij->nkj", splats.sh.astype(np.float64), linear)
    base = np.einsum("ni,nij->nj", 0.5 + SH_C0 * splats.sh[:, 0].astype(np.float64), linear) + shift
    sh[:, 0] = (base - 0.5) / SH_C0
    return replace(splats, sh=np.where(splats.drawable[:, None, None], sh, splats.sh).astype(splats.sh.dtype))


def _normal(views: Sequence[Shown], labels: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(gram [4K, 4K], right-hand side [4K, 3], [K] summed alpha) of the fit over all views, float64."""
    gram, rhs, seen = np.zeros((4 * count, 4 * count)), np.zeros((4 * count, 3)), np.zeros(count)
    for view in views:
        if not view.use.any():
            continue
        image, alpha, _ = view.frame.rasterize()
        behind = np.asarray(view.frame.camera.background)
        wanted = (view.target - (1 - alpha[..., None]) * behind)[view.use].astype(np.float64)
        features = _features(view, labels, count).astype(np.float64)
        gram += features.T @ features
        rhs += features.T @ wanted
        seen += features[:, 3::4].sum(0)
    return gram, rhs, seen


def _features(view: Shown, labels: np.ndarray, count: int) -> np.ndarray:
    """[P, 4K] of the used pixels: per cluster its composite over black and its alpha."""
    frame = on_black(view.frame)
    member = labels[frame.gaussian_ids]  # [M]
    out = np.empty((int(view.use.sum()), count, 4), np.float32)
    for k in range(count):
        here = (member == k)[:, None].astype(np.float32)
        out[:, k, :3] = frame.rasterize(frame.colors * here)[0][view.use]
    for first in range(0, count, 3):  # the alphas of three clusters at a time, as red, green and blue
        some = np.stack([member == k for k in range(first, first + 3)], 1).astype(np.float32)
        alphas = frame.rasterize(some)[0][view.use]
        width = min(3, count - first)
        out[:, first : first + width, 3] = alphas[:, :width]
    return out.reshape(len(out), 4 * count)


def on_black(frame: ProjectedView) -> ProjectedView:
    """The same view over a black background."""
    camera: Camera = replace(frame.camera, background=(0.0, 0.0, 0.0))
    return replace(frame, camera=camera)


def _pixels(views: Sequence[Shown]) -> int:
    return sum(int(view.use.sum()) for view in views)
