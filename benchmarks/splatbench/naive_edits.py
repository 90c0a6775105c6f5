"""Local edits as anybody would write them first, to measure ours against. Knows no masks beyond the one given.

Both solve colours by rounds of the lift, c_i += sum_p w_ip m_p (I*_p - C_p) / sum_p w_ip (lift/colors.py says why that
works), on Gaussians that are as coarse as they were, or of which each that the mask shows was cut into four.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import SH_C0, Splats
from splatpainter.transforms import quat_to_matrix

COLOR_ROUNDS = 5
MIN_WEIGHT_PX = 1e-3
"""Gaussians of which a view shows less do not change."""
MIN_SPLIT_PX = 0.05
"""Pixels of weight within the mask from which a Gaussian is cut."""
CHILD_SCALE, CHILD_STEP = 0.55, 1.1
"""Standard deviation of a child, and distance between two, over the parent's standard deviation."""


def color_rounds(
    splats: Splats, camera: Camera, target: np.ndarray, mask: np.ndarray, rounds: int = COLOR_ROUNDS
) -> Splats:
    """`splats` (numpy) with base colours towards `target` [H, W, 3] inside mask [H, W] bool; the rest stays."""
    view = project(splats, camera)
    weights = mask.astype(np.float32)
    visible = view.backproject(target, np.ones_like(weights)).weight
    step = np.where(visible > MIN_WEIGHT_PX, 1 / np.maximum(visible, MIN_WEIGHT_PX), 0)[:, None]
    colors = view.colors.copy()
    for _ in range(rounds):
        colors += step * view.sirt_step(target, weights, np.maximum(colors, 0))[0]
    sh = splats.sh.copy()
    sh[view.gaussian_ids, 0] += (colors - view.colors) / SH_C0
    return replace(splats, sh=sh)


def cut_in_four(splats: Splats, camera: Camera, mask: np.ndarray) -> Splats:
    """Every Gaussian that the masked pixels show as 2 x 2 on its two long axes: the first takes its index, the others
    go last."""
    view = project(splats, camera)
    weights = mask.astype(np.float32)
    visible = view.backproject(np.zeros((*mask.shape, 3), np.float32), weights).weight
    ids = np.sort(view.gaussian_ids[visible > MIN_SPLIT_PX])
    parents = splats.take(ids)
    n = np.arange(len(ids))
    rotation = quat_to_matrix(parents.quats)
    axes = np.argsort(-parents.scales, 1)[:, :2]
    steps = [CHILD_STEP * parents.scales[n, axis][:, None] * rotation[n, :, axis] for axis in axes.T]
    scales = parents.scales.copy()
    scales[n[:, None], axes] *= CHILD_SCALE
    means = [parents.means + a * steps[0] + b * steps[1] for a in (-0.5, 0.5) for b in (-0.5, 0.5)]
    all_means, all_scales = splats.means.copy(), splats.scales.copy()
    all_means[ids], all_scales[ids] = means[0], scales
    out = replace(splats, means=all_means, scales=all_scales)
    for corner in means[1:]:
        out = out.append(replace(parents, means=corner.astype(np.float32), scales=scales))
    return out


def split_and_color(splats: Splats, camera: Camera, target: np.ndarray, mask: np.ndarray) -> Splats:
    """`cut_in_four`, then `color_rounds`."""
    return color_rounds(cut_in_four(splats, camera, mask), camera, target, mask)
