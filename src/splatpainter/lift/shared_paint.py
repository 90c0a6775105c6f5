"""What the pictures of one edit paint in each other's views: a decal is painted from several cameras, each a part,
and every one of them sees what the others painted. Pure.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.lift.edit_views import EditView
from splatpainter.lift.masks import dilated
from splatpainter.lift.warping import MAX_DEPTH_DIFFERENCE, seen_in_both
from splatpainter.order_statistics import median

SPILL_PX = 1
"""Pixels around a mask that its paint reaches, as another view has them at other places."""


def paint_of_other_views(views: Sequence[EditView], depths: Sequence[np.ndarray]) -> list[np.ndarray]:
    """[H, W] bool of each view: pixels that show a place of the surface under the mask of another one. depths: [H, W] z
    of each view before the edit, 0 where there is nothing, at least where it may have changed something."""
    # How exactly depths are known is a matter of the asset: a camera that stands close knows them no better.
    painted_depths = [depth[view.mask & (depth > 0)] for view, depth in zip(views, depths, strict=True)]
    tolerance = MAX_DEPTH_DIFFERENCE * max((float(median(part)) for part in painted_depths if len(part)), default=0.0)
    out = []
    for k, (view, depth) in enumerate(zip(views, depths, strict=True)):
        shared = np.zeros(view.mask.shape, bool)
        for j, (other, other_depth) in enumerate(zip(views, depths, strict=True)):
            if j == k or other.mask.all():
                continue
            # A pixel shows another view's paint if both cameras see the same point of the old surface.
            same = seen_in_both(other.camera, other_depth, view.camera, depth, tolerance)
            ys, xs = np.nonzero(same & ~view.mask & ~shared)
            pixels, _ = other.camera.project(view.camera.unproject(depth[ys, xs], np.stack([xs, ys], 1) + 0.5))
            x, y = np.floor(pixels).astype(int).T
            shared[ys, xs] = dilated(other.mask, SPILL_PX)[y, x]
        out.append(shared)
    return out
