"""Whatever is done with an asset far from zero comes out as with the same asset at zero: views of its own, too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.painter import Edit, Painter
from splatpainter.splats import Splats
from tests.support.cli_scenes import ball
from tests.support.far_assets import UTM, moved_camera

CAMERA = sp.look_at((0.0, -0.8, -3.5), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=96, height=96)


def camera_of(splats: Splats, camera: sp.Camera = CAMERA) -> sp.Camera:
    """In world coordinates."""
    return moved_camera(camera, splats.offset)


def painted(splats: Splats) -> Edit:
    image = np.clip(sp.render(splats, camera_of(splats)).colors[0], 0, 1).copy()
    mask = np.zeros(image.shape[:2], bool)
    mask[40:56, 40:56] = True
    image[mask] = (0.1, 0.6, 0.2)
    return Edit(image, camera_of(splats), mask)


def applied(splats: Splats, mode: Any, **settings: Any) -> list[np.ndarray]:
    painter = Painter.load("lift").with_settings(aside=True, **settings)
    result = painter.apply(painter.encode(splats), [painted(splats)], mode)
    receipt = result.receipt
    assert receipt is not None and result.splats.offset == splats.offset
    view = receipt.views[0]
    aside = [value or 0.0 for pair in receipt.aside for value in pair]
    return [result.splats.means, result.splats.sh, np.array([view.psnr_after, view.psnr_outside, *aside])]


def local_edit(splats: Splats) -> list[np.ndarray]:
    return applied(splats, "local")


def spread_edit(splats: Splats) -> list[np.ndarray]:
    return applied(splats, "spread")


def global_edit(splats: Splats) -> list[np.ndarray]:
    return applied(splats, "global")


def decal(splats: Splats) -> list[np.ndarray]:
    from splatpainter.decals.decals import Decal

    picture = np.zeros((16, 16, 3), np.uint8)
    picture[:, ::4] = (220, 40, 40)
    painter = Painter.load("lift")
    asset = painter.encode(splats)
    views = Decal(picture, (48.0, 48.0), camera_of(splats), 0.5).views(asset)
    result = painter.apply(asset, views)
    return [result.splats.means, result.splats.sh]


def filled(splats: Splats) -> list[np.ndarray]:
    from splatpainter.source_edits.fill import fill

    gone = np.linalg.norm(splats.means - (0, 0, -1), axis=1) < 0.45
    result = fill(splats, gone.astype(np.float32))
    assert result.splats.offset == splats.offset and len(result.splats) > len(splats)
    return [result.splats.means, result.splats.opacities, result.splats.sh]


def normals(splats: Splats) -> list[np.ndarray]:
    from splatpainter.lift.depth_normals import outward_normals

    small = ball(400, radius=0.5, degree=0)
    middle = np.array([2.4, 0, 0], np.float32)
    both = splats.append(replace(small, means=small.means + middle, offset=splats.offset))
    out = outward_normals(both)
    # Of the small ball half looks towards the middle of all: only views from around tell which side is out.
    assert ((out[len(splats) :] * small.means).sum(1) > 0).mean() > 0.9
    return [out]


def surface(splats: Splats) -> list[np.ndarray]:
    from splatpainter.surface.estimate import Surface
    from splatpainter.view_files import draw_passes

    passes = draw_passes(splats, camera_of(splats).relative_to(splats.offset), ("normal",), surface=Surface.of(splats))
    assert passes.normal is not None and passes.depth.max() > 2
    return [passes.depth, passes.normal]


def planned_views(splats: Splats) -> list[np.ndarray]:
    from splatpainter.source_edits.coverage import plan_views

    plan = plan_views(splats, size=96, max_views=3)
    assert len(plan.cameras) == 3 and min(plan.gains) > 0
    return [np.array(plan.gains), np.stack([camera.forward for camera in plan.cameras])]


def turned(splats: Splats) -> list[np.ndarray]:
    from splatpainter.server.describe import home_view
    from splatpainter.session.measures.orientation import measure, view_detail

    orientation = measure(splats)
    center, radius, view = home_view(splats, (0, -1, 0), orientation.front)
    return [center, np.array([radius, orientation.front, *view_detail(splats, view)])]


def weights(splats: Splats) -> list[np.ndarray]:
    from splatpainter.grading.color_match import seen_weights

    out = seen_weights(splats)
    assert (out > 0).mean() > 0.9
    return [out]


@pytest.mark.parametrize(
    "act", [local_edit, spread_edit, global_edit, decal, filled, normals, surface, planned_views, turned, weights]
)
def test_far_is_as_near(act: Callable[[Splats], list[np.ndarray]]) -> None:
    near = ball(1500, degree=0)
    here, there = act(near), act(replace(near, offset=UTM))
    for one, two in zip(here, there, strict=True):
        assert one.shape == two.shape
        np.testing.assert_allclose(two, one, atol=2e-3)
