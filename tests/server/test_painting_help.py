"""What the studio measures for its painting tools: surface blocks, the palette, fine detail."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.color import sh_from_color
from splatpainter.server.fine_detail import MIN_FINE_DETAIL, fine_detail, has_fine_detail
from splatpainter.server.palette import MAX_COLORS, main_colors
from splatpainter.server.protocol import CameraInfo
from splatpainter.splats import Splats
from tests.support import studio_scenes, surface_shapes
from tests.support.studio_scenes import view


def in_colors(colors: list[tuple[float, float, float]], counts: list[int]) -> Splats:
    """Gaussians of one size in these colours."""
    splats = studio_scenes.ball(sum(counts))
    shades = np.repeat(np.array(colors, np.float32), counts, 0)
    return replace(splats, sh=sh_from_color(shades)[:, None].astype(np.float32))


def test_surface_blocks_are_depths_and_normals(tmp_path: Path) -> None:
    sphere = surface_shapes.sphere(2000)
    with studio_scenes.live(studio_scenes.make_studio(tmp_path, sphere)) as live:
        answer = live.post("view.surface", camera=CameraInfo.of(view(128)).model_dump())
    table = np.frombuffer(base64.b64decode(answer["data"]), "<f4").reshape(answer["rows"], answer["columns"], 4)
    block, camera = answer["block"], view(128)
    ys, xs = np.nonzero(table[..., 0] > 0)
    assert len(ys) > 0.2 * table.shape[0] * table.shape[1]
    points = camera.unproject(table[ys, xs, 0], (np.stack([xs, ys], 1) + 0.5) * block)
    heights = np.abs(np.linalg.norm(points, axis=1) - 1)
    assert np.median(heights) < 0.02 and heights.max() < 0.15
    normals = table[ys, xs, 1:] @ camera.world_to_camera[:3, :3]
    assert np.median((normals * points).sum(1)) > 0.99  # outwards, of a unit sphere
    assert table[0, 0, 0] == 0  # beside it


def test_palette_names_the_colours_by_area() -> None:
    colors = [(0.1, 0.1, 0.3), (0.8, 0.2, 0.1), (0.9, 0.9, 0.8)]
    palette = main_colors(in_colors(colors, [60, 30, 200]), 8)
    assert np.allclose(palette, [colors[0], colors[1], colors[2]], atol=2e-3)  # dark to light; no colour twice
    assert len(main_colors(in_colors(colors, [60, 30, 200]), 1)) == 1
    many = main_colors(studio_scenes.ball(), MAX_COLORS)
    assert 8 < len(many) <= MAX_COLORS and many.min() >= 0 and many.max() <= 1
    assert np.array_equal(many, main_colors(studio_scenes.ball(), MAX_COLORS))


def test_palette_of_what_cannot_be_seen_is_empty() -> None:
    ball = studio_scenes.ball(20)
    assert main_colors(replace(ball, opacities=np.zeros(20, np.float32)), 5).shape == (0, 3)
    with pytest.raises(ValueError, match="1 to 24"):
        main_colors(ball, 0)


def test_fine_detail_is_that_of_the_surface_not_of_outlines() -> None:
    smooth = studio_scenes.ball(4000)
    plain = replace(smooth, sh=np.full((4000, 1, 3), 0.3, np.float32))
    speckled = replace(plain, sh=np.random.default_rng(1).uniform(-1, 1, (4000, 1, 1)).repeat(3, 2).astype(np.float32))
    fine = replace(speckled, scales=speckled.scales * 0.4)
    assert fine_detail(plain, view()) < 0.2 * MIN_FINE_DETAIL
    assert has_fine_detail(fine, view()) and not has_fine_detail(plain, view())
    assert fine_detail(replace(plain, opacities=np.zeros(4000, np.float32)), view()) == 0


def test_commands_answer_with_them(tmp_path: Path) -> None:
    with studio_scenes.live(studio_scenes.make_studio(tmp_path, in_colors([(0.2, 0.5, 0.7)], [300]))) as live:
        assert np.allclose(live.post("asset.palette")["colors"], [[0.2, 0.5, 0.7]], atol=2e-3)
        assert live.studio.state.asset.fine_detail is False


def test_the_latest_stroke_is_scored_from_the_side(tmp_path: Path) -> None:
    with studio_scenes.live(studio_scenes.make_studio(tmp_path, surface_shapes.sphere(1500))) as live:
        camera = CameraInfo.of(view()).model_dump()
        rgba = base64.b64encode(bytes([220, 40, 30, 255]) * 400).decode()
        for x in (30, 46):
            stroke = live.post("paint.begin", camera=camera)["stroke"]
            live.post("paint.dab", stroke=stroke, x=x, y=38, width=20, height=20, rgba=rgba)
            layers = live.studio.session.layers
            target = {"layer": layers[0].id} if layers else {"into_new": "Paint"}
            layer = live.post("paint.end", stroke=stroke, **target)["layer"]["id"]
        answer = live.post("aside", layer=layer)
        assert answer["psnr"] > 15 and answer["low"] is False
        (score,) = live.studio.session.strokes.side_scores(layer)
        assert score.psnr == answer["psnr"] and score.covered > 0.5
        empty = live.post("layer.new")["layer"]["id"]
        assert live.post("aside", layer=empty)["psnr"] is None
