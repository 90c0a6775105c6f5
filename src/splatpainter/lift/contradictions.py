"""Whether edited views contradict each other: of what both show and both edit, the later one wants something else."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.lift.edit_views import EditView
from splatpainter.lift.masks import box_mean, largest_channel
from splatpainter.lift.warping import ViewedChange
from splatpainter.rendering.cpu.recent_views import drawn_view
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class ContradictionThresholds:
    """When two views contradict each other. Colours 0..1. Close-ups of four assets (clean, fitted, two captures) 10 to
    50 degrees apart, share of the pixels: the same grade, inversion or sharpening in both, and pictures of the truth,
    0.00 to 0.19; opposite grades 0.74 to 1.00, on half of one picture 0.39 to 0.92, of a tenth 0.14 to 1.00. Stripes as
    fine as a coarse asset's Gaussians have 0.27."""

    reach: float = 1 / 8
    """Reach of the means in which changes are compared, in parts of the picture's longer side: detail that lies beside
    itself is no contradiction."""
    min_difference: float = 0.1
    """Difference of the mean changes from which a pixel contradicts."""
    relative_difference: float = 0.35
    """The same in parts of the larger of both changes; both have to be exceeded."""
    min_share: float = 0.4
    """Share of the pixels that both views edit from which the views do."""
    min_pixels: int = 64
    """Pixels that both edit, at least."""


CONTRADICTIONS = ContradictionThresholds()


def runs_that_agree(splats: Splats, views: Sequence[EditView]) -> list[list[EditView]]:
    """The views in their order, cut where one contradicts another of its run. splats: numpy, the asset that they are
    of."""
    runs: list[list[EditView]] = []
    changes: list[ViewedChange] = []
    for view in views:
        change = _change_of(view, drawn_view(splats, view.camera).depths)
        if not runs or any(_share(earlier, change) > CONTRADICTIONS.min_share for earlier in changes):
            runs.append([])
            changes = []
        runs[-1].append(view)
        changes.append(change)
    return runs


def _change_of(view: EditView, depth: np.ndarray) -> ViewedChange:
    mask = (view.mask & (depth > 0)).astype(np.float32)
    return ViewedChange(view.camera, (view.edited - view.before) * mask[..., None], mask, depth)


def _share(earlier: ViewedChange, later: ViewedChange) -> float:
    """Share of the pixels that both edit on which they want different things; 0 where there are too few."""
    moved = earlier.moved(later.camera, later.depth)
    both = (moved[..., 3] > 0.99) & (later.mask > 0)
    if both.sum() < CONTRADICTIONS.min_pixels:
        return 0.0
    reach = max(round(CONTRADICTIONS.reach * max(both.shape)), 1)
    weight = np.maximum(box_mean(both.astype(np.float32), reach), 1e-6)[..., None]
    first, second = (
        box_mean((change * both[..., None]).astype(np.float32), reach) / weight
        for change in (moved[..., :3], later.change)
    )
    apart, *sizes = (largest_channel(np.abs(change))[both] for change in (first - second, first, second))
    alike = np.maximum(CONTRADICTIONS.relative_difference * np.maximum(*sizes), CONTRADICTIONS.min_difference)
    return float((apart > alike).mean())
