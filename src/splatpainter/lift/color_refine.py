"""Colour rounds on an asset whose geometry is settled: what is left of the edited pictures' error, on chosen Gaussians.

After the networks they bring the result nearer to the pictures; before them they say roughly what an edit wants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.colors import MIN_CHANGE, painted_sh
from splatpainter.lift.joint_colors import MIN_SEEN_PX, SolidView, joint_change, total_weight
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import SH_C0, Splats

REFINE_ROUNDS = 2


def refine_colors_local(
    splats: Splats,
    pictures: Sequence[tuple[Camera, np.ndarray]],
    editable: np.ndarray,
    rounds: int = REFINE_ROUNDS,
) -> Splats:
    """One view after the other: where they disagree, the latest wins. pictures: (camera, target [H, W, 3]), the full
    picture to reach: where nothing was edited it holds Gaussians that straddle the edit's edge; editable: [N] bool.
    Other Gaussians keep their bits."""
    for camera, target in pictures:
        tiles = project(splats, camera, gaussian_mask=editable).tiles_of(editable)
        view = project(splats, camera, tiles=tiles)
        sh = painted_sh(splats.sh, view, target, editable[view.gaussian_ids], rounds, LOCAL_DEFAULTS.damping)
        splats = splats if sh is splats.sh else replace(splats, sh=sh)
    return splats


def refine_colors_global(
    splats: Splats, views: Sequence[tuple[Camera, np.ndarray, np.ndarray]], rounds: int = REFINE_ROUNDS
) -> Splats:
    """All Gaussians that the views show, from all of them at once. views: (camera, target [H, W, 3], mask [H, W] bool);
    pixels that the asset covers by less than 0.9 do not count."""
    solid = [SolidView.of(splats, *view) for view in views]
    change = joint_change(solid, rounds, limit=np.inf)
    moved = (total_weight(solid) > MIN_SEEN_PX) & (np.abs(change).max(1) > MIN_CHANGE)
    if not moved.any():
        return splats
    sh = splats.sh.copy()
    sh[moved, 0] += change[moved] / SH_C0
    return replace(splats, sh=sh)
