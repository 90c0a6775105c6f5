"""Colour rounds of one view: move Gaussians' colours so that their composite becomes a target picture.

A picture is linear in the Gaussians' colours, C_p = sum_i w_ip c_i + T_p background. One round is
c_i += sum_p w_ip m_p (I*_p - C_p) / sum_p w_ip m_p over *all* pixels of the Gaussian, edited or not (SIRT; as
sum_i w_ip <= 1 the error cannot rise). Few rounds are right: more write one view's noise into the Gaussians, and other
views pay. With a hold h_i on a Gaussian's old colour the round is a step of damped least squares: h_i is added to the
divisor and h_i (c_i - old) taken from the sum.
"""

from __future__ import annotations

import numpy as np

from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.splats import SH_C0

MAX_COLOR = 1.3
"""Upper bound of a lifted colour; the lower one is the renderer's clamp at 0, without which Gaussians compensate for
each other with colours that are never drawn (measured: 2 dB inside the mask, 0.5 dB on novel views)."""
MIN_CHANGE = 1 / 1024
"""Colours that move by no more than this keep their bits."""


def lift_colors(
    view: ProjectedView,
    target: np.ndarray,
    weights: np.ndarray,
    editable: np.ndarray,
    rounds: int,
    hold: np.ndarray | None = None,
) -> np.ndarray:
    """Colours [M, 3] towards this view after `rounds`. target: [H, W, 3]; weights: [H, W] m_p; editable: [M] bool,
    Gaussians that may move; hold: [M] >= 0, what each one's old colour weighs beside sum_p w_ip m_p."""
    out = view.colors.copy()
    if not rounds:
        return out
    first = out[editable]
    colors, ceiling = first, np.maximum(first, MAX_COLOR)
    towards = sirt_steps(view, target, weights, editable)
    total = towards.weight
    pull = np.zeros_like(total) if hold is None else hold[editable].astype(total.dtype)
    step = np.where(total > 0, 1 / np.maximum(total + pull, 1e-6), 0).astype(colors.dtype)[:, None]
    for _ in range(rounds):
        gain = towards.residual(colors)
        colors = np.clip(colors + step * (gain - pull[:, None] * (colors - first)), 0, ceiling)
    out[editable] = colors
    return out


def painted_sh(
    sh: np.ndarray,
    view: ProjectedView,
    target: np.ndarray,
    editable: np.ndarray,
    rounds: int,
    damping: float,
    hold: np.ndarray | None = None,
) -> np.ndarray:
    """[N, K, 3] SH coefficients after `rounds` towards the target [H, W, 3] at every pixel; Gaussians that do not move
    keep their bits, and `sh` itself is returned where none does. editable, hold: [M] as in `lift_colors`; damping: as
    in `recolor`."""
    colors = lift_colors(view, target, np.ones(target.shape[:2], np.float32), editable, rounds, hold)
    before = view.unclamped_colors
    moved = editable & (np.abs(colors - np.maximum(before, 0)).max(1) > MIN_CHANGE)
    if not moved.any():
        return sh
    out, ids = sh.copy(), view.gaussian_ids[moved]
    out[ids] = recolor(sh[ids], before[moved], colors[moved], damping)
    return out


def recolor(
    sh: np.ndarray, before: np.ndarray, target: np.ndarray, damping: float = 0.3, full_change: float = 0.3
) -> np.ndarray:
    """SH coefficients [M, K, 3] whose colour towards the edited view is `target` [M, 3] instead of `before` [M, 3]
    (unclamped).

    One view cannot know view dependence: bands above the first are kept, but scaled down to `damping` as the change
    approaches `full_change` (0..1), so that a repainted highlight does not shine through the paint from other sides."""
    change = np.abs(target - before).max(1)  # [M]
    keep = (1 - (1 - damping) * np.clip(change / full_change, 0, 1))[:, None]  # [M, 1]
    constant = SH_C0 * sh[:, 0]
    varying = before - 0.5 - constant  # what bands >= 1 add towards this view
    out = sh * keep[..., None]
    out[:, 0] = (target - 0.5 - keep * varying) / SH_C0
    return out.astype(sh.dtype)
