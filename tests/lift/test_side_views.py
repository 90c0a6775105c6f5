"""The score from the side: paint that lies on the surface, paint that floats before it, and none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.edits import lift_local_views
from splatpainter.lift.side_views import SIDE_VIEWS, side_view_score, side_views
from splatpainter.splats import Splats
from splatpainter.voxels.grid import voxelize
from tests.support.lift_scenes import SH_C0, disk, front, sheet

RED = np.array([0.9, 0.1, 0.1], np.float32)


def in_red(splats: Splats) -> Splats:
    sh = np.zeros_like(splats.sh)
    sh[:, 0] = (RED - 0.5) / SH_C0
    return replace(splats, sh=sh)


def red_disk(splats: Splats, camera: Camera, radius: float) -> EditView:
    mask = disk(camera, camera.width / 2, camera.height / 2, radius)
    return edit_views(splats, [camera], [np.broadcast_to(RED, (*mask.shape, 3))], [mask])[0]


def test_paint_on_the_surface_scores_above_paint_before_it_above_none() -> None:
    splats, camera = sheet(80), front(128)
    view = red_disk(splats, camera, 30)
    inside = np.hypot(*splats.means[:, :2].T) < 30 / camera.fx * 3
    on = replace(splats, sh=np.where(inside[:, None, None], in_red(splats).sh, splats.sh))
    # The same disk, seen from the edited view, at a sixth of the way to the camera: right there, wrong from the side.
    part = in_red(splats.take(np.flatnonzero(inside)))
    share = np.float32(1 / 6)
    means = part.means * (1 - share) + np.array([0, 0, 3], np.float32) * share
    floating = splats.append(replace(part, means=means.astype(np.float32), scales=part.scales * (1 - share)))
    scores = [side_view_score(splats, after, view) for after in (on, floating, splats)]
    assert all(score.covered > 0.95 for score in scores)
    right, before, none = (score.psnr for score in scores)
    assert right is not None and before is not None and none is not None
    assert right > 22 and right > before + 5 > none + 5


def test_the_lift_of_a_sheet_holds_from_the_side() -> None:
    splats, camera = sheet(60), front(96)
    view = red_disk(splats, camera, 20)
    lifted = lift_local_views(splats, voxelize(splats), [view], "lift", features=False)
    before, after = (side_view_score(splats, s, view).psnr for s in (splats, lifted.splats))
    assert before is not None and after is not None and after > before + 8


def test_what_hides_the_paint_is_not_compared() -> None:
    splats, camera = sheet(80), front(128)
    # Two walls stand up beside the paint and hide it from left and right.
    upright = sheet(60, half=0.5)
    walls = [
        replace(
            upright,
            means=(upright.means[:, [2, 1, 0]] + np.array([x, 0, 0.5], np.float32)),
            quats=_turned(upright.quats),
        )
        for x in (-0.35, 0.35)
    ]
    hidden = splats.append(walls[0]).append(walls[1])
    views = [red_disk(s, camera, 12) for s in (splats, hidden)]
    free, between = (side_view_score(s, s, view).covered for s, view in zip((splats, hidden), views, strict=True))
    assert free > 0.95 and 0.4 < between < 0.75  # above and below still see it


def _turned(quats: np.ndarray) -> np.ndarray:
    """A quarter turn about y after each rotation: the sheet's z becomes x."""
    w, x, y, z = quats.T / np.float32(np.sqrt(2))
    return np.stack([w - y, x + z, y + w, z - x], 1).astype(np.float32)


def test_side_views_are_small_and_keep_to_the_paint() -> None:
    splats = sheet(40)
    camera = front(700)
    for mask in (disk(camera, 350, 350, 300), disk(camera, 350, 350, 3)):
        view = edit_views(splats, [camera], [np.zeros((700, 700, 3), np.float32)], [mask])[0]
        pairs = side_views(splats, splats, view)
        assert len(pairs) == 4 and all(max(pair.image.shape[:2]) <= SIDE_VIEWS.max_side_px for pair in pairs)
        assert all(pair.painted.any() and pair.expected.shape == pair.image.shape for pair in pairs)
    tall = np.zeros((700, 700), bool)
    tall[:, 699] = True  # one column at the border: beside the sheet
    view = edit_views(splats, [camera], [np.zeros((700, 700, 3), np.float32)], [tall])[0]
    score = side_view_score(splats, splats, view)
    assert side_views(splats, splats, view) == [] and score.psnr is None and score.covered == 0
    tall[:] = False
    tall[2:698, 350] = True  # one column over the sheet
    view = edit_views(splats, [camera], [np.zeros((700, 700, 3), np.float32)], [tall])[0]
    assert side_view_score(splats, splats, view).covered > 0.8
