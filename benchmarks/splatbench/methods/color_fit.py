"""Colour transfer: relighting as a change of colours learnt from the relit views alone, without any network.

Three rows, from stiff to loose: one affine map of display colours for the whole asset; one per cluster of Gaussians;
and every Gaussian by itself, where those that no view shows keep their colours. Stand-ins for methods that estimate the
target light (Reinhard et al., "Color Transfer between Images", 2001, for the idea), cheap, and strong at one view.

Affine maps: a picture is linear in the Gaussians' colours, C_p = sum_i w_ip c_i + T_p background. If every Gaussian of
cluster k takes the colour A_k c_i + b_k, then C_p = sum_k (A_k S_kp + b_k a_kp) + T_p background, with the cluster's
composite S_k over black and its alpha a_k: linear in the unknowns, so the fit is exact whatever shines through what.

Gaussian by Gaussian: each round solves, for every Gaussian i alone, min over change d_i of
sum_vp w_ivp |r_vp - B_iv d_i|^2 + sum_v,p w_ivp (d_i + k_i - k0_i)^T L (d_i + k_i - k0_i), with the residual r of the
pictures as they are, the SH basis B_iv towards view v, the coefficients k0_i before the edit, and L = 0 for the
constant band, DAMPING * Y_00^2 above. As sum_i w_ip <= 1 this majorises the error of the pictures together with that
penalty: all may step at once, and the sum cannot rise (Instant Colorization's setting, arXiv 2604.17155; the formulas
are this package's). With the constant band alone it is the SIRT iteration of lift/colors.py.

P pixels, K clusters or SH coefficients, N Gaussians, M of them drawn, V views.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from splatbench.cases import Budget, EditStep
from splatbench.methods import EditResult, EditTask, Method
from splatpainter.color import base_color, sh_from_color
from splatpainter.lift.depth_normals import outward_normals
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import SH_C0, Splats
from splatpainter.transforms import sh_basis

MIN_ALPHA = 0.9
"""Pixels that the asset covers by less are not learnt from: there the edited view may show another silhouette."""
AFFINE_RIDGE = 1e-7
"""Towards "no change" of the one map, relative to the pixels: decides only what the pictures do not."""
IDENTITY = np.eye(4)[:, :3]
"""[4, 3]: (r, g, b, 1) @ IDENTITY = (r, g, b)."""
CLUSTERS = 32
CLUSTER_RIDGE = 0.05
"""Pull of each cluster's map towards the one of the whole asset, in parts of the pixels per cluster."""
KMEANS_ROUNDS = 20
SOLVER_STEPS = 5
"""Closed-form steps of all Gaussians at once."""
DAMPING = 0.3
"""Damping of SH bands >= 1 in the fit by Gaussians: few views cannot know view dependence."""
DEGREE = 3
"""Degree of the SH that this fit may change."""
MIN_WEIGHT_PX = 0.05
"""Gaussians with less weight than this in all views together keep their colours."""
MAX_BASE_COLOR = 1.3
"""Base colours stay in 0..MAX_BASE_COLOR (or where they were): one drawn as 0 would sink without end."""
SOLVE_BLOCK = 1 << 13
"""Gaussians solved at a time."""


@dataclass(frozen=True)
class ViewTarget:
    """An edited view beside what the asset shows there."""

    frame: ProjectedView
    """The asset, projected: M Gaussians."""
    target: np.ndarray
    """[H, W, 3] float32 the edited view."""
    use: np.ndarray
    """[H, W] bool: pixels in the mask that the asset covers."""


def view_targets(splats: Splats, step: EditStep) -> list[ViewTarget]:
    """The edited views of a step. Raises ValueError where none shows a solid part of the asset."""
    views = []
    for (camera, target), mask in zip(step.edited, step.masks, strict=True):
        frame = project(splats, camera)
        use = mask & (frame.rasterize()[1] > MIN_ALPHA)
        views.append(ViewTarget(frame, np.ascontiguousarray(target, np.float32), use))
    if not any(view.use.any() for view in views):
        raise ValueError(
            f"colour transfer: no masked pixel shows the asset (alpha above {MIN_ALPHA}); check masks, cameras"
        )
    return views


# Affine maps, one or one per cluster.


def fit_affine(views: Sequence[ViewTarget]) -> np.ndarray:
    """[4, 3] float64 M of the new colours (r, g, b, 1) @ M, fitted on all used pixels."""
    gram, rhs, _ = _normal_equations(views, np.zeros(views[0].frame.num_gaussians, np.int64), 1)
    penalty = AFFINE_RIDGE * _pixels(views)
    return np.linalg.solve(gram + penalty * np.eye(4), rhs + penalty * IDENTITY)


def fit_clusters(views: Sequence[ViewTarget], labels: np.ndarray, ridge: float) -> tuple[np.ndarray, np.ndarray]:
    """One affine map per cluster, all of them solved for together.

    labels: [N] int64 cluster of each Gaussian, 0..K-1; ridge: weight of the pull towards the one map of `fit_affine`,
    in parts of the pixels per cluster. Returns ([K, 4, 3] float64, [K] pixels' worth of alpha that the views show of
    each cluster); a cluster that no used pixel shows gets the one map."""
    count = int(labels.max()) + 1
    one = fit_affine(views)
    gram, rhs, visible = _normal_equations(views, labels, count)
    start = np.tile(one, (count, 1))  # [4 K, 3]
    penalty = ridge * _pixels(views) / count
    change = np.linalg.solve(gram + penalty * np.eye(4 * count), rhs - gram @ start)
    return (start + change).reshape(count, 4, 3), visible


def recolored(splats: Splats, maps: np.ndarray, labels: np.ndarray | None = None) -> Splats:
    """The Gaussians with their colours mapped: base colours by the affine map, SH bands >= 1 by its linear part, so
    that the colour towards every direction is mapped. maps: [K, 4, 3]; labels: [N] which one, None: the only one. Those
    that cannot be drawn keep their bits."""
    affine = maps[np.zeros(len(splats), np.int64) if labels is None else labels]  # [N, 4, 3]
    linear, shift = affine[:, :3], affine[:, 3]
    sh = np.einsum("nki,nij->nkj", splats.sh.astype(np.float64), linear)
    base = np.einsum("ni,nij->nj", base_color(splats.sh.astype(np.float64)), linear) + shift
    sh[:, 0] = sh_from_color(base)
    return replace(splats, sh=np.where(splats.drawable[:, None, None], sh, splats.sh).astype(splats.sh.dtype))


def cluster_features(splats: Splats) -> np.ndarray:
    """[N, 9] float32 base colour, position and outward normal, each group of three centred and scaled to a variance of
    1 in all. Gaussians that cannot be drawn get zeros (the middle)."""
    drawable = splats.drawable
    visible = splats.take(drawable)
    groups = (np.clip(base_color(visible.sh), 0, 1), visible.means, outward_normals(visible))
    out = np.zeros((len(splats), 9), np.float32)
    out[drawable] = np.concatenate([_scaled(group.astype(np.float64)) for group in groups], 1)
    return out


def kmeans(features: np.ndarray, count: int, seed: int) -> np.ndarray:
    """[N] int64 labels 0..K-1 of `features` [N, D], all in use; K = `count`, or fewer where there are fewer different
    features."""
    from scipy.cluster.vq import kmeans2

    count = min(count, len(np.unique(features, axis=0)))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "One of the clusters is empty")  # it is left out below
        _, labels = kmeans2(features, count, KMEANS_ROUNDS, minit="++", rng=np.random.default_rng(seed))
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def _scaled(values: np.ndarray) -> np.ndarray:
    centered = values - values.mean(0)
    return centered / max(float(np.sqrt((centered**2).sum(1).mean())), 1e-9)


def _normal_equations(
    views: Sequence[ViewTarget], labels: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(gram [4K, 4K], right-hand side [4K, 3], [K] summed alpha) of the fit over all views, float64."""
    gram, rhs, visible = np.zeros((4 * count, 4 * count)), np.zeros((4 * count, 3)), np.zeros(count)
    for view in views:
        if not view.use.any():
            continue
        _, alpha, _ = view.frame.rasterize()
        background = np.asarray(view.frame.camera.background)
        target = (view.target - (1 - alpha[..., None]) * background)[view.use].astype(np.float64)
        features = _features(view, labels, count).astype(np.float64)
        gram += features.T @ features
        rhs += features.T @ target
        visible += features[:, 3::4].sum(0)
    return gram, rhs, visible


def _features(view: ViewTarget, labels: np.ndarray, count: int) -> np.ndarray:
    """[P, 4K] of the used pixels: per cluster its composite over black and its alpha."""
    frame = replace(view.frame, camera=replace(view.frame.camera, background=(0.0, 0.0, 0.0)))
    cluster = labels[frame.gaussian_ids]  # [M]
    out = np.empty((int(view.use.sum()), count, 4), np.float32)
    for k in range(count):
        inside = (cluster == k)[:, None].astype(np.float32)
        out[:, k, :3] = frame.rasterize(frame.colors * inside)[0][view.use]
    for first in range(0, count, 3):  # the alphas of three clusters at a time, as red, green and blue
        three = np.stack([cluster == k for k in range(first, first + 3)], 1).astype(np.float32)
        alphas = frame.rasterize(three)[0][view.use]
        width = min(3, count - first)
        out[:, first : first + width, 3] = alphas[:, :width]
    return out.reshape(len(out), 4 * count)


def _pixels(views: Sequence[ViewTarget]) -> int:
    return sum(int(view.use.sum()) for view in views)


# Gaussian by Gaussian.


def fit_gaussians(
    splats: Splats, views: Sequence[ViewTarget], rounds: int, damping: float, degree: int
) -> tuple[Splats, np.ndarray]:
    """(the splats with new SH, [N] bool which were seen). degree: bands above are left as they are (at most the
    asset's). Raises nothing; Gaussians that are not seen keep their bits."""
    count = min((degree + 1) ** 2, splats.sh.shape[1])
    total = np.zeros(len(splats))
    parts = []  # (view, [M, K] basis, [M] weight)
    for view in views:
        basis = basis_towards(splats.means[view.frame.gaussian_ids], view.frame.camera.position, splats.sh.shape[1])
        weight = view.frame.backproject(view.target, view.use.astype(np.float32)).weight.astype(np.float64)
        parts.append((view, basis, weight))
        total[view.frame.gaussian_ids] += weight
    seen = total > MIN_WEIGHT_PX
    index = np.cumsum(seen) - 1  # Gaussian -> among the S seen ones
    start = splats.sh[seen].astype(np.float64)  # [S, K, 3]
    penalty = np.full(count, damping * SH_C0**2)
    penalty[0] = 0
    gram = np.zeros((len(start), count, count))
    for view, basis, weight in parts:
        drawn = seen[view.frame.gaussian_ids]
        b = basis[drawn][:, :count]
        gram[index[view.frame.gaussian_ids[drawn]]] += weight[drawn][:, None, None] * b[:, :, None] * b[:, None, :]
    gram[:, range(count), range(count)] += total[seen][:, None] * penalty
    sh = start.copy()
    low, high = np.minimum(base_color(start), 0), np.maximum(base_color(start), MAX_BASE_COLOR)
    for _ in range(rounds):
        rhs = -total[seen][:, None, None] * penalty[:, None] * (sh - start)[:, :count]
        for view, basis, _ in parts:
            gaussian_ids = view.frame.gaussian_ids
            drawn = seen[gaussian_ids]
            colors = view.frame.unclamped_colors.astype(np.float64).copy()
            colors[drawn] = 0.5 + np.einsum("mk,mkj->mj", basis[drawn], sh[index[gaussian_ids[drawn]]])
            painted = np.maximum(colors, 0).astype(view.frame.projected.dtype)
            gain, _ = view.frame.sirt_step(view.target, view.use.astype(np.float32), painted)
            rhs[index[gaussian_ids[drawn]]] += basis[drawn][:, :count, None] * gain[drawn][:, None].astype(np.float64)
        for first in range(0, len(gram), SOLVE_BLOCK):
            block = slice(first, first + SOLVE_BLOCK)
            sh[block, :count] += np.linalg.solve(gram[block], rhs[block])
        sh[:, 0] = sh_from_color(np.clip(base_color(sh), low, high))
    out = splats.sh.copy()
    out[seen] = sh.astype(out.dtype)
    return replace(splats, sh=out), seen


def basis_towards(means: np.ndarray, eye: np.ndarray, count: int) -> np.ndarray:
    """[M, K] float64 real spherical harmonics towards `means` [M, 3] from `eye` [3]; K = `count`, a square."""
    direction = means.astype(np.float64) - eye
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    return sh_basis(direction, round(count**0.5) - 1)


# Rows.

Fit = Callable[[Splats, list[ViewTarget], int], tuple[Splats, dict[str, float]]]
"""(asset, views, seed) -> (recoloured asset, numbers)."""


def by_one_map(splats: Splats, views: list[ViewTarget], seed: int) -> tuple[Splats, dict[str, float]]:
    return recolored(splats, fit_affine(views)[None]), {}


def by_clusters(splats: Splats, views: list[ViewTarget], seed: int) -> tuple[Splats, dict[str, float]]:
    """One map per cluster of Gaussians alike in colour, position and normal."""
    labels = kmeans(cluster_features(splats), CLUSTERS, seed)
    maps, visible = fit_clusters(views, labels, CLUSTER_RIDGE)
    return recolored(splats, maps, labels), {
        "clusters": float(len(maps)),
        "clusters_seen": float((visible > 1).sum()),
    }


def by_gaussian(splats: Splats, views: list[ViewTarget], seed: int) -> tuple[Splats, dict[str, float]]:
    fitted, seen = fit_gaussians(splats, views, SOLVER_STEPS, DAMPING, DEGREE)
    return fitted, {"rows_seen": float(seen.sum())}


def edit(fit: Fit, note: str, task: EditTask, budget: Budget) -> EditResult:
    """Recolour the asset by its edited views. Raises ValueError for a local edit, and where no masked pixel shows the
    asset."""
    if task.step.mode != "global":
        raise ValueError(f"colour transfer: is for global edits, got a {task.step.mode} one ({task.step.kind})")
    start = time.perf_counter()
    splats, numbers = fit(task.asset, view_targets(task.asset, task.step), budget.seed)
    seconds = time.perf_counter() - start
    return EditResult(splats, 0.0, seconds, numbers=numbers, note=note)


def _method(name: str, label: str, fit: Fit, note: str, settings: str) -> Method:
    label = f"Colour transfer, {label}"
    return Method(f"transfer-{name}", label, partial(edit, fit, note), ("relight",), version=lambda _: settings)


METHODS = (
    _method(
        "affine",
        "one affine map",
        by_one_map,
        "one affine map of display colours, least squares on all masked pixels; SH bands >= 1 by its linear part",
        "1",
    ),
    _method(
        "clusters",
        f"{CLUSTERS} clusters",
        by_clusters,
        f"an affine map for each of {CLUSTERS} clusters (k-means on colour, position, normal), solved together, "
        f"ridge {CLUSTER_RIDGE:g} towards the one map of the whole asset, which clusters out of view get",
        f"2-{CLUSTERS}-{CLUSTER_RIDGE:g}",
    ),
    _method(
        "rows",
        "per Gaussian",
        by_gaussian,
        f"least squares per Gaussian, {SOLVER_STEPS} closed-form rounds, SH bands >= 1 damped by {DAMPING:g}; those "
        "out of view keep their colours",
        f"1-{SOLVER_STEPS}-{DAMPING:g}-{DEGREE}",
    ),
)
