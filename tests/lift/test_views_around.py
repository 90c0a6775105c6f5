"""Views of an asset from around, with edits moved there: at their own scale, and less of them from aside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.local import views_around as module
from splatpainter.lift.local.views_around import views_around
from splatpainter.splats import Splats
from tests.support.lift_scenes import sheet

PX = 96


def closeup() -> Camera:
    return look_at((0, 0, 3), (0, 0, 0), width=PX, height=PX, fov=14, background=(1, 1, 1))


def edit(splats: Splats, color: float) -> EditView:
    picture = np.full((PX, PX, 3), color, np.float32)
    return edit_views(splats, [closeup()], [picture], [np.ones((PX, PX), bool)])[0]


def changes(splats: Splats, view: EditView, *, directional: bool) -> list[tuple[float, float]]:
    """(degrees from the sheet's front, mean absolute change of the middle of the picture) of every view."""
    out = []
    for camera, target, use in views_around(splats, [view], directional=directional):
        before = sp.render(splats, camera).colors[0]
        center = slice(module.VIEWS_AROUND.edge_px // 2 - 2, module.VIEWS_AROUND.edge_px // 2 + 2)
        middle = (center, center)
        assert (use[middle] > 0).all()
        cosine = camera.position[2] / np.linalg.norm(camera.position)
        out.append((float(np.degrees(np.arccos(cosine))), float(np.abs(target - before)[middle].mean())))
    return out


@pytest.fixture(scope="module")
def asset() -> Splats:
    """Grey, opaque, from -1 to 1."""
    splats = sheet(40, degree=1, opacity=0.98)
    return replace(splats, sh=np.zeros_like(splats.sh))


def test_edits_are_seen_from_their_side_and_fade_from_aside(asset) -> None:
    view = edit(asset, 0.9)
    everywhere, faded = (changes(asset, view, directional=directional) for directional in (False, True))
    assert len(faded) == 2 * len(everywhere)
    assert any(angle < 40 and change > 0.3 for angle, change in faded)
    assert all(change < 0.05 for angle, change in faded if angle > 70)
    assert any(angle > 70 and change > 0.1 for angle, change in everywhere)


def test_gaps_that_close_when_they_are_small_are_no_edit(asset) -> None:
    """Gaussians with gaps between them in the close-up, fewer from afar: what is asked for is what they still lack."""
    gaps = replace(asset, scales=(asset.scales * [0.4, 0.4, 1]).astype(np.float32))
    view = edit(gaps, 0.5)
    assert view.before.mean() > 0.5 + 0.2
    (target,) = (target for camera, target, _ in views_around(gaps, [view], directional=True) if camera.position[2] > 4)
    assert abs(np.mean(target[60:68, 60:68]) - 0.5) < 0.02


def test_an_edit_beside_the_asset_changes_nothing(asset) -> None:
    camera = look_at((0, 0, 3), (9, 0, 3), width=PX, height=PX, fov=40)
    view = edit_views(asset, [camera], [np.zeros((PX, PX, 3), np.float32)], [np.ones((PX, PX), bool)])[0]
    assert all(change < 1e-6 for _, change in changes(asset, view, directional=False))
