"""Which Gaussians masks on views mean: what an eraser, an adjustment or a region drawn on a picture reaches. Pure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.cameras import Camera
from splatpainter.splats import Splats

MIN_INSIDE_SHARE = 0.5
"""Share of a Gaussian's weight in the view that an eraser's mask must hold: those that straddle its edge do not bleed
outwards."""


def reached_gaussians(splats: Splats, views: Sequence[tuple[Camera, np.ndarray]]) -> Bools:
    """[N] bool: Gaussians that some masked view ((camera, [H, W] bool)) shows, mostly inside its mask; with one also
    those of its family that lie hidden under the mask, or paint would stay behind. Raises ValueError where a mask is
    empty or reaches no Gaussian."""
    from splatpainter.lift.local.local_edit import gaussians_in_mask
    from splatpainter.rendering.cpu.projected_view import project
    from splatpainter.voxels.grid import voxelize
    from splatpainter.voxels.raycast import editable_gaussians

    grid = voxelize(splats)
    out = np.zeros(len(splats), bool)
    for camera, mask in views:
        if not mask.any():
            raise ValueError("edit: nothing to do, the mask is empty")
        visible = gaussians_in_mask(splats, camera, mask, editable_gaussians(grid, splats, camera, mask))
        view = project(splats, camera)
        black = np.zeros((*mask.shape, 3), np.float32)
        inside = view.backproject(black, mask.astype(np.float32))
        total = view.backproject(black, np.ones(mask.shape, np.float32))
        reached = np.zeros(len(splats), bool)
        reached[view.gaussian_ids] = visible[view.gaussian_ids] & (inside.weight >= MIN_INSIDE_SHARE * total.weight)
        if splats.origin is not None:
            under = view.gaussian_ids[(inside.alpha > 0) & (inside.alpha >= MIN_INSIDE_SHARE * total.alpha)]
            family = splats.origin[under]
            reached[under] |= np.isin(family, splats.origin[reached]) & (family >= 0)
        out |= reached
    return out
