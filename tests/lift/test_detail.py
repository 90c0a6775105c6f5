"""The detail layer: as few Gaussians as the picture's edges allow, before the surface, in their pixels' colours."""

from __future__ import annotations

import numpy as np
import pytest

from splatpainter.lift.local.detail import DETAIL, detail_layer
from splatpainter.lift.local.local_edit import lift_local
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import project
from tests.support.lift_scenes import base_colors, db, disk, front, sheet

CAMERA = front(96)
DARK, LIGHT = np.array([0.1, 0.2, 0.3]), np.array([0.9, 0.8, 0.2])


def halves(degrees: float) -> np.ndarray:
    """[96, 96, 3] two colours on both sides of a line through the middle."""
    y, x = np.mgrid[:96, :96] + 0.5 - 48
    angle = np.radians(degrees)
    side = x * np.cos(angle) + y * np.sin(angle) > 0
    return np.where(side[..., None], LIGHT, DARK).astype(np.float32)


@pytest.mark.parametrize("degrees", [0, 90, 30])
def test_few_gaussians_follow_an_edge(degrees):
    splats, target = sheet(30, opacity=0.99), halves(degrees)
    view = project(splats, CAMERA)
    pixels = disk(CAMERA, 48, 48, 20)
    layer = detail_layer(splats, view, pixels, target)
    assert layer is not None and len(layer.splats) == len(layer.parent_entries) < pixels.sum() / 5
    assert (view.gaussian_ids[layer.parent_entries] < len(splats)).all()
    inner = disk(CAMERA, 48, 48, 18)
    picture = render(splats.append(layer.splats), CAMERA).colors[0]
    each = detail_layer(splats, view, pixels, target, DETAIL.smallest_px)
    assert each is not None and len(each.splats) == pixels.sum()  # one per pixel
    assert db(picture, target, inner) > (24 if degrees % 90 == 0 else 22)
    colors = base_colors(layer.splats)
    assert np.minimum(np.abs(colors - DARK).max(1), np.abs(colors - LIGHT).max(1)).max() < 1e-3
    depths = CAMERA.to_camera(layer.splats.means)[:, 2]
    assert depths.max() < CAMERA.to_camera(splats.means)[:, 2].min()  # not hidden behind a flat sheet


def test_gaussians_are_long_along_edges_and_round_where_there_is_one_colour():
    splats, target = sheet(30, opacity=0.99), halves(0)
    layer = detail_layer(splats, project(splats, CAMERA), disk(CAMERA, 48, 48, 20), target)
    assert layer is not None
    pixel = CAMERA.to_camera(layer.splats.means)[:, 2] / CAMERA.fx
    long, wide = (np.sort(layer.splats.scales, 1)[:, k] / pixel / DETAIL.width for k in (2, 1))
    at_edge = np.abs(CAMERA.to_camera(layer.splats.means)[:, 0] / pixel) < 1
    assert at_edge.any() and (wide[at_edge] < 0.6).all() and np.median(long[at_edge]) > 1.8
    assert long.max() < 1.1 * max(DETAIL.reaches_px) and (wide > 1.9).any()


def test_paint_on_a_flat_sheet_is_crisp():
    splats, mask = sheet(30, degree=2), disk(CAMERA, 48, 48, 14)
    target = np.where(mask[..., None], LIGHT, render(splats, CAMERA).colors[0]).astype(np.float32)
    lifted = lift_local(splats, CAMERA, target, mask)
    assert db(render(lifted.splats, CAMERA).colors[0], target, mask) > 25
    assert len(lifted.parents) < mask.sum()


def test_no_pixels_no_layer():
    splats = sheet(10)
    assert detail_layer(splats, project(splats, CAMERA), np.zeros((96, 96), bool), halves(0)) is None
