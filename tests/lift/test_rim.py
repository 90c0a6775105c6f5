"""The detail layer keeps off outlines, and is left to the last view that shows a part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.cameras import Camera
from splatpainter.lift.edit_views import edit_views
from splatpainter.lift.edits import _shown_again, lift_local_views
from splatpainter.lift.local import patch
from splatpainter.lift.local.local_edit import LocalLift, lift_local
from splatpainter.lift.local.patch import PATCHING
from splatpainter.lift.masks import dilated
from splatpainter.lift.options import LocalOptions
from splatpainter.rendering import render
from splatpainter.splats import Splats
from splatpainter.voxels.grid import voxelize
from tests.lift.test_global import BACK, FRONT, NEAR_FRONT, ball, covered, draw

BALL = ball(1500)
COARSE = LocalOptions(max_halvings=0)
"""Nothing is split, so that there is much for the detail layer to mend."""


def striped(splats: Splats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(picture, mask): narrow dark stripes across what the view shows, up to its outline and a little beside it."""
    picture, mask = draw(splats, camera).copy(), dilated(covered(splats, camera), 1)
    mask[:30] = mask[60:] = False  # an edit of most of the picture would count as a close-up
    stripes = mask & (np.arange(camera.width)[None, :] % 6 < 2)
    picture[stripes] = (0.05, 0.0, 0.1)
    return picture, mask


def test_no_detail_rows_at_an_outline(monkeypatch: pytest.MonkeyPatch) -> None:
    picture, mask = striped(BALL, FRONT)
    lifted = lift_local(BALL, FRONT, picture, mask, COARSE)
    beside = render(BALL, FRONT).alphas[0, ..., 0] < 0.5
    y, x = pixels_of(lifted)
    assert len(x) > 100 and not dilated(beside, PATCHING.silhouette_margin_px)[y, x].any()
    assert dilated(beside, PATCHING.silhouette_margin_px + 2)[y, x].any(), "it goes as near as it may"
    monkeypatch.setattr(patch, "PATCHING", replace(patch.PATCHING, silhouette_margin_px=0))
    y, x = pixels_of(lift_local(BALL, FRONT, picture, mask, COARSE))
    assert dilated(beside, PATCHING.silhouette_margin_px)[y, x].sum() > 20


def pixels_of(lifted: LocalLift) -> tuple[np.ndarray, np.ndarray]:
    """(y, x) of the pixels of FRONT that the appended rows lie on."""
    new = lifted.splats.means[len(BALL) :]
    position = new @ FRONT.world_to_camera[:3, :3].T + FRONT.world_to_camera[:3, 3]
    x = (FRONT.fx * position[:, 0] / position[:, 2] + FRONT.cx).astype(int)
    return (FRONT.fy * position[:, 1] / position[:, 2] + FRONT.cy).astype(int), x


def test_an_undrawn_part_of_the_picture_is_no_outline() -> None:
    """A dab in the middle works on a few tiles; beyond them nothing is known, and nothing is to be avoided."""
    picture, _ = striped(BALL, FRONT)
    mask = np.zeros((FRONT.height, FRONT.width), bool)
    mask[32:48, 32:48] = True  # a whole tile
    lifted = lift_local(BALL, FRONT, np.where(mask[..., None], picture, draw(BALL, FRONT)), mask, COARSE)
    inside = np.abs(draw(lifted.splats, FRONT) - picture)[mask].mean()
    plain = lift_local(BALL, FRONT, picture, mask, LocalOptions(max_halvings=0, max_error=1.0))
    assert inside < 0.7 * np.abs(draw(plain.splats, FRONT) - picture)[mask].mean()


def views_of(*cameras: Camera) -> list:
    made = [striped(BALL, camera) for camera in cameras]
    return edit_views(BALL, list(cameras), [picture for picture, _ in made], [mask for _, mask in made])


def test_a_part_that_is_shown_again_gets_its_detail_from_the_last_view() -> None:
    grid = voxelize(BALL)
    assert _shown_again(BALL, grid, views_of(FRONT)) == [False]
    assert _shown_again(BALL, grid, views_of(FRONT, NEAR_FRONT)) == [True, False]
    assert _shown_again(BALL, grid, views_of(FRONT, BACK)) == [False, False]
    assert _shown_again(BALL, grid, views_of(FRONT, BACK, NEAR_FRONT)) == [True, False, False]


def test_each_side_keeps_its_own_detail() -> None:
    grid = voxelize(BALL)

    def appended(*cameras: Camera) -> int:
        return len(lift_local_views(BALL, grid, views_of(*cameras), "lift", COARSE, features=False).splats) - len(BALL)

    front, back, both = appended(FRONT), appended(BACK), appended(FRONT, BACK)
    assert 0.8 * (front + back) < both < 1.25 * (front + back)
    assert appended(FRONT, NEAR_FRONT) < 0.75 * (front + appended(NEAR_FRONT))
