"""Colour rounds of the lift: move rows' colours so that their composite becomes a wanted picture.

A picture is linear in the rows' colours, C_p = sum_i w_ip c_i + T_p background. One round is
c_i += sum_p w_ip m_p (I*_p - C_p) / sum_p w_ip m_p over *all* pixels of the row, edited or not (SIRT; as
sum_i w_ip <= 1 the error cannot rise). Few rounds are right: more write one view's noise into the rows, and other
views pay. With a hold h_i on a row's old colour the round is a step of damped least squares: h_i is added to the
divisor and h_i (c_i - old) taken from the sum.
"""

from __future__ import annotations

import numpy as np

from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.splats import SH_C0

BRIGHTEST = 1.3
"""Upper bound of a lifted colour; the lower one is the renderer's clamp at 0, without which rows compensate for each
other with colours that are never drawn (measured: 2 dB inside the mask, 0.5 dB on novel views)."""


def lift_colors(
    frame: ProjectedView,
    target: np.ndarray,
    weights: np.ndarray,
    editable: np.ndarray,
    rounds: int,
    hold: np.ndarray | None = None,
) -> np.ndarray:
    """Colours [M, 3] towards this view after `rounds`. target: [H, W, 3]; weights: [H, W] m_p; editable: [M] bool, rows
    that may move; hold: [M] >= 0, what each row's old colour weighs beside sum_p w_ip m_p."""
    out = frame.colors.copy()
    if not rounds:
        return out
    first = out[editable]
    colors, ceiling = first, np.maximum(first, BRIGHTEST)
    towards = sirt_steps(frame, target, weights, editable)
    total = towards.weight
    pull = np.zeros_like(total) if hold is None else hold[editable].astype(total.dtype)
    step = np.where(total > 0, 1 / np.maximum(total + pull, 1e-6), 0).astype(colors.dtype)[:, None]
    for _ in range(rounds):
        gain = towards.residual(colors)
        colors = np.clip(colors + step * (gain - pull[:, None] * (colors - first)), 0, ceiling)
    out[editable] = colors
    return out


def recolor(
    sh: np.ndarray, seen: np.ndarray, wanted: np.ndarray, damping: float = 0.3, full: float = 0.3
) -> np.ndarray:
    """SH coefficients [M, K, 3] whose colour towards the edited view is `wanted` [M, 3] instead of `seen` [M, 3]
    (unclamped).

    One view cannot know view dependence: bands above the first are kept, but scaled down to `damping` as the change
    approaches `full` (0..1), so that a repainted highlight does not shine through the paint from other sides."""
    change = np.abs(wanted - seen).max(1)  # [M]
    keep = (1 - (1 - damping) * np.clip(change / full, 0, 1))[:, None]  # [M, 1]
    constant = SH_C0 * sh[:, 0]
    varying = seen - 0.5 - constant  # what bands >= 1 add towards this view
    out = sh * keep[..., None]
    out[:, 0] = (wanted - 0.5 - keep * varying) / SH_C0
    return out.astype(sh.dtype)
