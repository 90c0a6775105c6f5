"""What several pictures of one edit paint in each other's views, against where rays meet a known plane."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.lift.edit_views import edit_views
from splatpainter.lift.masks import dilated
from splatpainter.lift.shared_paint import paint_of_other_views
from tests.holes.test_body import ground

SIDE = 96


def camera(x: float) -> Camera:
    return look_at((x, 3.0, 1.0), (0, 0, 0), width=SIDE, height=SIDE, fov=36)


def on_ground(view: Camera) -> np.ndarray:
    """[H, W, 3] where the ray through each pixel's middle meets y = 0."""
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    rays = (
        np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x)], -1) @ view.world_to_camera[:3, :3]
    )
    return view.position - rays * (view.position[1] / rays[..., 1:2])


def test_each_view_knows_what_the_other_paints_in_it() -> None:
    splats, cameras = ground((0.5, 0.5, 0.5)), [camera(-1.2), camera(1.2)]
    points = [on_ground(view) for view in cameras]
    left, right = (
        (np.abs(p[..., 2]) < 0.3) & (p[..., 0] > a) & (p[..., 0] < b)
        for p, a, b in ((points[0], -0.6, 0.0), (points[1], 0.0, 0.6))
    )
    pictures = [np.full((SIDE, SIDE, 3), 0.9, np.float32)] * 2
    views = edit_views(splats, cameras, pictures, [left, right])
    depths = [view.depth for view in views]
    first, second = paint_of_other_views(views, [d for d in depths if d is not None])
    truth = (np.abs(points[0][..., 2]) < 0.3) & (points[0][..., 0] > 0) & (points[0][..., 0] < 0.6) & ~left
    assert truth.sum() > 100 and not (first & left).any() and not (second & right).any()
    assert first[truth].mean() > 0.97 and not (first & ~dilated(truth, 2)).any()
    alone = paint_of_other_views(views[:1], [d for d in depths[:1] if d is not None])
    assert not alone[0].any()


def test_a_camera_that_stands_close_asks_for_no_exacter_depths() -> None:
    """Depths of two views of one surface differ by what its Gaussians are thick, however near the cameras stand."""
    splats, cameras = ground((0.5, 0.5, 0.5)), [camera(-1.2), look_at((0.3, 0.4, 0), (0.3, 0, 0), (0, 0, 1), fov=60)]
    cameras[1] = cameras[1].resized(SIDE, SIDE)
    inside = np.abs(on_ground(cameras[1]) - (0.3, 0, 0)).max(-1) < 0.15
    far, near = edit_views(splats, cameras, [np.full((SIDE, SIDE, 3), 0.9, np.float32)] * 2, [~inside & False, inside])
    (x, y), _ = (values[0] for values in cameras[0].project(np.array([[0.3, 0, 0]])))
    mask = np.zeros((SIDE, SIDE), bool)
    mask[2:6, 2:6] = True
    assert far.depth is not None and near.depth is not None
    off = 0.02  # 5 % of the near camera's distance, 0.6 % of the far one's
    depths = [far.depth, near.depth + off]
    shared, _ = paint_of_other_views([replace(far, mask=mask), near], depths)
    assert shared[int(y), int(x)] and shared.sum() > 30
    assert not paint_of_other_views([replace(far, mask=mask), near], [far.depth, near.depth + 10 * off])[0].any()


def test_a_receipt_measures_outside_of_what_all_views_painted() -> None:
    splats, cameras = ground((0.5, 0.5, 0.5)), [camera(-1.2), camera(1.2)]
    edits, outside = [], []
    for view, low in zip(cameras, (-0.6, 0.0), strict=True):
        point = on_ground(view)
        mask = (np.abs(point[..., 2]) < 0.3) & (point[..., 0] > low) & (point[..., 0] < low + 0.6)
        image = sp.render(splats, view).colors[0]
        image[mask] = (0.9, 0.1, 0.1)
        edits.append(sp.Edit(image, view, mask))
        outside.append((np.abs(point[..., 2]) > 0.35) | (np.abs(point[..., 0]) > 0.65))
    painter = sp.Painter()
    after = painter.apply(painter.encode(splats), edits)
    assert after.receipt is not None
    for score, edit, far in zip(after.receipt.views, edits, outside, strict=True):
        before, now = (np.clip(sp.render(s, edit.camera).colors[0], 0, 1) for s in (splats, after.splats))
        error = ((now - before) ** 2)[far].mean()
        assert score.psnr_outside is not None and -10 * math.log10(max(error, 1e-12)) > 30, "nothing else changed"
        apart = ((now - before) ** 2)[~edit.mask].mean()
        assert score.psnr_outside > -10 * math.log10(apart) + 6, "what the other view painted does not count"
