"""The parts of the demo; tests/test_wheel.py runs all of it."""

from __future__ import annotations

import numpy as np

from splatpainter.commands import demo
from splatpainter.commands.parts.demo_paint import evening, lettering, stroke, sun
from splatpainter.commands.parts.demo_sheet import Panel, animation, overview


def test_the_asset_stands_upright_for_every_other_program() -> None:
    """In the file y points down, as in captures: the default ring sees the lid above the board."""
    from splatpainter.cameras import orbit
    from splatpainter.demo_asset import demo_view

    ours, theirs = demo.view(0, 0, 64, (0, 0, 0)), demo_view(64)
    turned = theirs.world_to_camera @ np.diag([-1, -1, 1, 1])
    assert np.allclose(ours.world_to_camera, turned, atol=1e-9)
    right = demo.view(30, 0, 64, (0, 0, 0)).position - ours.position
    assert right @ ours.world_to_camera[0, :3] > 0, "a positive azimuth moves the camera to the right"
    assert demo.view(0, 20, 64, (0, 0, 0)).position[1] < ours.position[1], "and a positive elevation up (y down)"
    ring = orbit((0, 0, 0), 3, 1, up=(0, -1, 0))[0]
    assert ring.world_to_camera[1, :3] @ (0, 1, 0) > 0


def test_a_stroke_is_soft_swells_and_runs_dry() -> None:
    alpha = stroke(400, (0.2, 0.5), (0.8, 0.5), 0.06, 0.02)
    assert alpha.shape == (400, 400) and alpha.min() == 0 and 0.9 < alpha.max() < 1
    columns = np.flatnonzero(alpha.max(0) > 0.5)
    assert abs(columns[0] - 80) < 6 and 250 < columns[-1] <= 320
    thickness = (alpha > 0.5).sum(0)
    assert thickness[90:220].max() > 1.5 * thickness[84]
    assert ((alpha > 0.05) & (alpha < 0.9)).sum() > 0.1 * (alpha > 0.05).sum(), "soft edges"
    dry = alpha[:, 290]
    assert np.abs(np.diff((dry > 0.5).astype(int))).sum() > 2, "hairs part at the end"


def test_lettering_is_placed_and_smooth() -> None:
    alpha = lettering(400, "tea", (0.5, 0.4), 0.1, 0.0)
    y, x = np.nonzero(alpha > 0.5)
    assert abs((x.min() + x.max()) / 2 - 200) < 6 and abs(y.mean() - 160) < 12
    assert 20 < np.ptp(y) < 45
    assert ((alpha > 0.1) & (alpha < 0.9)).any()


def test_the_sticker_has_a_white_border_all_around() -> None:
    picture = np.asarray(sun()).astype(int)
    alpha = picture[..., 3]
    assert alpha[0].max() == alpha[:, 0].max() == 0 and alpha[384, 384] == 255
    inner = alpha == 255
    rim = inner & ~(np.roll(inner, 4, 0) & np.roll(inner, -4, 0) & np.roll(inner, 4, 1) & np.roll(inner, -4, 1))
    assert (picture[rim][:, :3].min(1) > 230).mean() > 0.95


def test_the_evening_is_warm_on_the_left_and_dim_on_the_right() -> None:
    graded = evening(np.full((4, 100, 3), 0.7))
    assert graded[0, 5, 0] > 0.7 > graded[0, 5, 2] and graded[0, 95].max() < 0.5
    assert (np.diff(graded[0, :, 0]) <= 0).all()


def test_the_overview_holds_every_panel_and_the_film_every_frame() -> None:
    colors = [(0.9, 0.1, 0.1), (0.1, 0.9, 0.1), (0.1, 0.1, 0.9), (0.9, 0.9, 0.1)]
    panels = [Panel(np.full((50, 50, 3), color), "title", "line") for color in colors]
    sheet = overview(panels, columns=2, width=640)
    assert sheet.shape[1] == 640
    for color in colors:
        share = (np.abs(sheet - np.array(color) * 255).max(-1) < 3).mean()
        assert 0.12 < share < 0.25
    film, ending = animation([np.full((8, 8, 3), k / 3) for k in range(4)])
    assert ending == ".webp" and film[:4] == b"RIFF" and film[8:12] == b"WEBP"
