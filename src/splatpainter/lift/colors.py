"""Colour rounds: move Gaussians' colours so that their composite becomes a target picture, in one view or in several at
once; and two rounds on an asset whose geometry is settled (refine_colors_*), for what is left of the pictures' error.

A picture is linear in the Gaussians' colours, C_p = sum_i w_ip c_i + T_p background. One round is
c_i += sum_p w_ip m_p (I*_p - C_p) / sum_p w_ip m_p over *all* pixels of the Gaussian, edited or not (SIRT; as
sum_i w_ip <= 1 the error cannot rise). Few rounds are right: more write one view's noise into the Gaussians, and other
views pay. With a hold h_i on a Gaussian's old colour the round is a step of damped least squares: h_i is added to the
divisor and h_i (c_i - old) taken from the sum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.color import base_color
from splatpainter.kernels.arrays import aligned
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.kernels.rows import by_blocks
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.rendering.cpu.geometry import STEP_SIZES
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.rendering.cpu.recent_views import drawn_view
from splatpainter.rendering.cpu.sirt import CachedWeights, UncachedWeights, sirt_steps
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max

MAX_COLOR = 1.3
"""Upper bound of a lifted colour; the lower one is the renderer's clamp at 0, without which Gaussians compensate for
each other with colours that are never drawn (measured: 2 dB inside the mask, 0.5 dB on novel views)."""
MIN_CHANGE = 1 / 1024
"""Colours that move by no more than this keep their bits."""
MIN_SEEN_PX = 0.05
"""Pixels of weight from which a Gaussian counts as seen."""
MIN_SOLID_ALPHA = 0.9
"""Pixels that the asset covers by less than this do not count: their colour is the background's too."""
REFINE_ROUNDS = 2


def lift_colors(
    view: ProjectedView,
    target: np.ndarray,
    weights: np.ndarray,
    editable: Bools,
    rounds: int,
    hold: np.ndarray | None = None,
) -> np.ndarray:
    """Colours [M, 3] of all that is in view after `lift_editable`; of those that do not move, as they are."""
    out = view.colors.copy()
    if rounds:
        out[np.flatnonzero(editable)] = lift_editable(view, target, weights, editable, rounds, hold)
    return out


def lift_editable(
    view: ProjectedView,
    target: np.ndarray,
    weights: np.ndarray,
    editable: Bools,
    rounds: int,
    hold: np.ndarray | None = None,
    relaxation: float = 1.0,
    steps: CachedWeights | UncachedWeights | None = None,
) -> np.ndarray:
    """Colours [C, 3] towards this view after `rounds`, of the Gaussians that may move: of a stroke some thousands among
    hundreds of thousands. target: [H, W, 3]; weights: [H, W] m_p; editable: [M] bool, C of them; hold: [M] >= 0, what
    each one's old colour weighs beside sum_p w_ip m_p; relaxation: share of each step that is taken; steps: those of
    these arguments, if at hand."""
    first = view.colors_of(np.flatnonzero(editable))
    if not rounds:
        return first
    # A colour above the ceiling that the asset had already may stay: it is drawn, and pulling it down would show.
    colors, ceiling = first, np.maximum(first, MAX_COLOR)
    towards = steps or sirt_steps(view, target, weights, editable, first)
    total = towards.weight
    pull = np.zeros_like(total) if hold is None else hold[editable].astype(total.dtype)
    # Where the mask shows nothing of a Gaussian its step is 0, so that it keeps its colour exactly.
    step = np.where(total > 0, relaxation / np.maximum(total + pull, 1e-6), 0).astype(colors.dtype)[:, None]
    for _ in range(rounds):
        # The residual of all pixels at once: Gaussians that share a pixel share its error (Jacobi, not Gauss-Seidel),
        # so the order of Gaussians has no part in the result.
        gain = towards.residual(colors)
        colors = np.clip(colors + step * (gain - pull[:, None] * (colors - first)), 0, ceiling)
    return colors


def colors_towards(view: ProjectedView, splats: Splats, ids: Ids) -> np.ndarray:
    """[J, 3] colours of some of the splats ([J] int64) towards a view of them; base colours of those not in it."""
    entries, colors = view.entries[ids], base_color(splats.sh[ids, :1])
    seen = entries >= 0
    colors[seen] = view.unclamped_of(entries[seen])
    return colors


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
    keep their bits, and `sh` itself is returned where none does. editable, hold: [M] as in `lift_editable`; damping: as
    in `recolor`."""
    colors = lift_colors(view, target, np.ones(target.shape[:2], np.float32), editable, rounds, hold)
    before = view.unclamped_colors
    # Compared with what is drawn (clamped at 0): a colour below 0 that stays below 0 has not moved.
    moved = editable & (row_max(np.abs(colors - np.maximum(before, 0))) > MIN_CHANGE)
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
    out, size = np.empty_like(sh), math.prod(sh.shape[1:])

    def fill(block: slice) -> None:
        # The fraction of the old view dependence that stays falls with the size of the change.
        change = row_max(np.abs(target[block] - before[block]))  # [M]
        keep = (1 - (1 - damping) * np.clip(change / full_change, 0, 1))[:, None]  # [M, 1]
        constant = SH_C0 * sh[block, 0]
        varying = before[block] - 0.5 - constant  # what bands >= 1 add towards this view
        # Along all bands at once: rows of three numbers take numpy three times as long.
        out[block] = (sh[block].reshape(len(keep), size) * keep).reshape(len(keep), *sh.shape[1:])
        # The constant band takes what the kept bands do not give, so that this view shows the target exactly.
        out[block, 0] = (target[block] - 0.5 - keep * varying) / SH_C0

    by_blocks(fill, len(sh))
    return out


@dataclass(frozen=True)
class SolidView:
    """One edited view: where it counts, and what it shows of each Gaussian."""

    camera: Camera
    target: Floats = field(repr=False)
    """[H, W, 3] float32."""
    use: Floats = field(repr=False)
    """[H, W] float32: 1 where pixels count."""
    weight: Floats = field(repr=False)
    """[N] float32 pixels that show each Gaussian."""
    projected: ProjectedView = field(repr=False)
    """The asset before the edit, in this view."""

    @staticmethod
    def of(splats: Splats, camera: Camera, target: np.ndarray, mask: Bools) -> SolidView:
        """mask: [H, W] bool."""
        drawn = drawn_view(splats, camera)
        projected, use = drawn.view, (mask & (drawn.alphas > MIN_SOLID_ALPHA)).astype(np.float32)
        weight = np.zeros(len(splats), np.float32)
        # The picture back-projected here does not matter: only the sums of weights are read.
        weight[projected.gaussian_ids] = projected.backproject(target, use).weight
        return SolidView(camera, target, use, weight, projected)


def total_weight(views: Sequence[SolidView]) -> Floats:
    """[N] float32 pixels of all views that show each Gaussian."""
    return np.sum([view.weight for view in views], axis=0)


def joint_change(
    views: Sequence[SolidView],
    rounds: int,
    *,
    drawn: Sequence[ViewInRounds] | None = None,
    hold: float = 0.0,
    limit: float = MAX_COLOR,
) -> Floats:
    """[N, 3] float32 change of base colour after `rounds`; zeros for Gaussians that are not seen. drawn: the asset in
    each view, where it is no longer the one before the edit, or where what is written to is to serve again; hold:
    pixels of weight that pull every Gaussian back to no change; limit: the largest change."""
    total = total_weight(views)
    change, gain = np.zeros((2, len(total), 3), np.float32)
    drawn = drawn or [ViewInRounds.of(view.projected) for view in views]
    for _ in range(rounds):
        # Gains of all views are summed before the step, so that views that disagree meet in the middle, by weight.
        for now, view in zip(drawn, views, strict=True):
            now.add_gains(change, view, gain)
        run(kernels.step_changes, gain, total, hold, limit, change)

    def clear(block: slice) -> None:
        change[block][~(total[block] > MIN_SEEN_PX)] = 0

    by_blocks(clear, len(change))
    return change


@dataclass(frozen=True)
class ViewInRounds:
    """A view whose colours move from round to round. What is drawn and summed in each has its place once: at a million
    Gaussians a round would mostly wait for memory otherwise."""

    view: ProjectedView
    projected: np.ndarray = field(repr=False)
    """[M, 16] what is drawn: the view's own, in other colours."""
    sums: np.ndarray = field(repr=False)
    """[P, 4]"""

    @staticmethod
    def of(view: ProjectedView) -> ViewInRounds:
        projected = aligned(view.projected.shape, view.projected.dtype)
        projected[:] = view.projected
        return ViewInRounds(view, projected, aligned((len(view.flatten_ids), STEP_SIZES.sums), view.projected.dtype))

    def recolored(self, splats: Splats) -> ViewInRounds:
        """The same view of the splats with other SH coefficients, in the place of this one, which is used up."""
        view = self.view.recolored(splats, self.projected)
        return ViewInRounds.of(project(splats, self.view.camera)) if view is None else replace(self, view=view)

    def add_gains(self, change: np.ndarray, edit: SolidView, gain: np.ndarray) -> None:
        """gain [N, 3] += what the edit's picture asks for where the colours have moved by change [N, 3]; but nothing
        for Gaussians of weight 0: a view that lost a conflict says nothing about them."""
        ids = self.view.gaussian_ids
        run(kernels.set_changed_colors, ids, change, MAX_COLOR, self.projected)
        self.view.step_sums(edit.target, edit.use, self.projected, self.sums)
        run(kernels.add_gains, self.view.pair_offsets, self.sums, ids, edit.weight, gain)


def refine_colors_local(
    splats: Splats,
    pictures: Sequence[tuple[Camera, np.ndarray]],
    editable: Bools,
    rounds: int = REFINE_ROUNDS,
) -> Splats:
    """One view after the other: where they disagree, the latest wins. pictures: (camera, target [H, W, 3]), the full
    picture to reach: where nothing was edited it holds Gaussians that straddle the edit's edge; editable: [N] bool.
    Other Gaussians keep their bits."""
    for camera, target in pictures:
        # Only tiles that editable Gaussians touch can change; a dab so costs milliseconds.
        tiles = project(splats, camera, gaussian_mask=editable).tiles_of(editable)
        view = project(splats, camera, tiles=tiles)
        sh = painted_sh(splats.sh, view, target, editable[view.gaussian_ids], rounds, LOCAL_DEFAULTS.damping)
        splats = splats if sh is splats.sh else replace(splats, sh=sh)
    return splats


def refine_colors_global(splats: Splats, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]]) -> Splats:
    """All Gaussians that the views show, from all of them at once. views: (camera, target [H, W, 3], mask [H, W] bool);
    pixels that the asset covers by less than 0.9 do not count."""
    solid = [SolidView.of(splats, *view) for view in views]
    change = joint_change(solid, REFINE_ROUNDS, limit=np.inf)
    # Small moves keep their bits, so that receipts name as few Gaussians as possible.
    moved = (total_weight(solid) > MIN_SEEN_PX) & (np.abs(change).max(1) > MIN_CHANGE)
    if not moved.any():
        return splats
    sh = splats.sh.copy()
    sh[moved, 0] += change[moved] / SH_C0
    return replace(splats, sh=sh)
