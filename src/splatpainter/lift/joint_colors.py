"""Colour rounds over several views at once: the change of base colour that takes the error of all of them down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.colors import MAX_COLOR
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import Splats

MIN_SEEN_PX = 0.05
"""Pixels of weight from which a Gaussian counts as seen."""
MIN_SOLID_ALPHA = 0.9
"""Pixels that the asset covers by less than this do not count: their colour is the background's too."""


@dataclass(frozen=True)
class SolidView:
    """One edited view: where it counts, and what it shows of each Gaussian."""

    camera: Camera
    target: np.ndarray = field(repr=False)
    """[H, W, 3] float32."""
    use: np.ndarray = field(repr=False)
    """[H, W] float32: 1 where pixels count."""
    weight: np.ndarray = field(repr=False)
    """[N] float32 pixels that show each Gaussian."""
    projected: ProjectedView = field(repr=False)
    """The asset before the edit, in this view."""

    @staticmethod
    def of(splats: Splats, camera: Camera, target: np.ndarray, mask: np.ndarray) -> SolidView:
        """mask: [H, W] bool."""
        projected = project(splats, camera)
        _, alpha, _ = projected.rasterize()
        use = (mask & (alpha > MIN_SOLID_ALPHA)).astype(np.float32)
        weight = np.zeros(len(splats), np.float32)
        weight[projected.gaussian_ids] = projected.backproject(target, use).weight
        return SolidView(camera, target, use, weight, projected)


def total_weight(views: Sequence[SolidView]) -> np.ndarray:
    """[N] float32 pixels of all views that show each Gaussian."""
    return np.sum([view.weight for view in views], axis=0)


def joint_change(
    views: Sequence[SolidView],
    rounds: int,
    *,
    projected: Sequence[ProjectedView] | None = None,
    hold: float = 0.0,
    limit: float = MAX_COLOR,
) -> np.ndarray:
    """[N, 3] float32 change of base colour after `rounds`; zeros for Gaussians that are not seen. projected: the asset
    in each view, where it is no longer the one before the edit; hold: pixels of weight that pull every Gaussian back to
    no change; limit: the largest change."""
    projected = projected or [view.projected for view in views]
    total = total_weight(views)
    change = np.zeros((len(total), 3), np.float32)
    for _ in range(rounds):
        gain = np.zeros_like(change)
        for now, view in zip(projected, views, strict=True):
            ids, before = now.gaussian_ids, now.unclamped_colors
            colors = np.clip(before + change[ids], 0, np.maximum(before, MAX_COLOR))
            gain_here = now.sirt_step(view.target, view.use, colors)[0]
            gain[ids] += np.where(view.weight[ids, None] > 0, gain_here, 0)
        change += (gain - hold * change) / np.maximum(total + hold, 1e-6)[:, None]
        np.clip(change, -limit, limit, out=change)
    return np.where(total[:, None] > MIN_SEEN_PX, change, 0)
