"""Previews of strokes: what the renderer shows of them, against what was painted."""

from __future__ import annotations

import base64
import gc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.lift.colors import recolor
from splatpainter.lift.sheets.paint import paint_view
from splatpainter.rendering import render
from splatpainter.server.protocol import CameraInfo
from splatpainter.server.strokes import stroke as stroke_module
from splatpainter.server.strokes.mirrored_stroke import MirroredStroke
from splatpainter.server.strokes.stroke import MIN_COLOR_CHANGE, Stroke
from splatpainter.session.measures.mirror_plane import mirrored_camera, parsed_plane
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats
from splatpainter.surface import recent_sights
from splatpainter.surface.estimate import Surface, SurfacePoints
from splatpainter.transforms import row_max
from tests.support import studio_scenes
from tests.support.studio_scenes import ball, view

SIZE, BOX = 96, (34, 38, 24, 20)


def with_preview(splats: Splats, preview: tuple[np.ndarray, np.ndarray]) -> Splats:
    ids, colors = preview
    sh = splats.sh.copy()
    sh[ids] = colors
    return replace(splats, sh=sh)


def square(color=(200, 40, 40, 255), width: int = BOX[2], height: int = BOX[3]) -> bytes:
    pixels = np.zeros((height, width, 4), np.uint8)
    pixels[:] = color
    return pixels.tobytes()


def shot(splats: Splats) -> np.ndarray:
    return np.clip(render(splats, view(SIZE)).colors[0], 0, 1)


def test_previews_compare_what_moved_alone_and_leave_nothing_unsent(monkeypatch: pytest.MonkeyPatch) -> None:
    splats, compared = ball(3000), []

    def counted(values: np.ndarray) -> np.ndarray:
        compared.append(len(values))
        return row_max(values)

    monkeypatch.setattr(stroke_module, "row_max", counted)
    stroke, visible = Stroke(view(SIZE)), splats
    stroke.prepare(splats, splats, 1)
    for x in range(BOX[0], BOX[0] + 24, 6):
        visible = with_preview(visible, stroke.preview(splats, splats, 1, stroke.patch(x, *BOX[1:], square())))
    canvas = stroke._canvas
    assert canvas is not None and len(compared) == 4
    # Far fewer than the view's, and never more than may move.
    assert 0 < max(compared) <= canvas.movable.sum() < len(canvas.view) // 2
    assert np.abs(canvas.colors - canvas.sent).max() <= MIN_COLOR_CHANGE
    # What a page put together from the previews is what the stroke has.
    ids = canvas.view.gaussian_ids[canvas.movable]
    everything = recolor(splats.sh[ids], canvas.view.unclamped_colors[canvas.movable], canvas.colors[canvas.movable])
    assert np.abs(visible.sh[ids] - everything).max() <= MIN_COLOR_CHANGE / SH_C0


def test_a_stroke_over_a_picture_leaves_what_it_does_not_cover() -> None:
    stroke, rng = Stroke(view(SIZE)), np.random.default_rng(0)
    stroke.patch(*BOX, rng.integers(0, 256, (BOX[3], BOX[2], 4), np.uint8).tobytes())
    render = rng.random((SIZE, SIZE, 3)).astype(np.float32) * 1.2  # over a picture that is brighter than white, too
    alpha = stroke.rgba[..., 3:].astype(np.float32) / 255
    expected = np.clip(render * (1 - alpha) + stroke.rgba[..., :3].astype(np.float32) / 255 * alpha, 0, 1)
    np.testing.assert_array_equal(stroke.over(render), expected)


def test_a_preview_brings_the_view_towards_the_paint_and_little_else() -> None:
    splats, before = ball(3000), shot(ball(3000))
    stroke = Stroke(view(SIZE))
    preview = stroke.preview(splats, splats, 1, stroke.patch(*BOX, square()))
    after = shot(with_preview(splats, preview))
    target = before.copy()
    mask = stroke.mask
    target[mask] = np.array([200, 40, 40]) / 255
    assert mask.sum() == BOX[2] * BOX[3]
    assert np.abs(after - target)[mask].mean() < 0.25 * np.abs(before - target)[mask].mean()
    assert np.abs(after - before)[~mask].mean() < 0.1 * np.abs(after - before)[mask].mean()
    assert (np.diff(preview[0]) > 0).all()


def test_nothing_shows_through_a_solid_surface() -> None:
    porous = ball(3000)
    splats = replace(porous, scales=2.2 * porous.scales)
    stroke = Stroke(view(SIZE))
    preview = stroke.preview(splats, splats, 1, stroke.patch(*BOX, square()))
    behind = view(SIZE, 180)
    front = np.abs(shot(with_preview(splats, preview)) - shot(splats))[stroke.mask].mean()
    back = np.abs(render(with_preview(splats, preview), behind).colors - render(splats, behind).colors)
    assert len(preview[0]) and back.mean() < 0.01 * front


def test_dabs_go_on_where_the_last_one_stopped() -> None:
    splats = ball(2000)
    stroke = Stroke(view(SIZE))
    current = splats
    errors = []
    for _ in range(4):
        preview = stroke.preview(splats, splats, 1, stroke.patch(*BOX, square()))
        current = with_preview(current, preview)
        errors.append(np.abs(shot(current) - np.array([200, 40, 40]) / 255)[stroke.mask].mean())
    assert errors == sorted(errors, reverse=True) and errors[-1] < errors[0]
    cleared = stroke.preview(splats, splats, 1, stroke.patch(*BOX, square((0, 0, 0, 0))))
    for _ in range(8):
        current = with_preview(current, cleared)
        cleared = stroke.preview(splats, splats, 1, stroke.patch(*BOX, square((0, 0, 0, 0))))
    assert np.abs(shot(current) - shot(splats)).mean() < 0.01


def test_a_changed_asset_is_projected_anew_and_the_whole_stroke_shown_on_it() -> None:
    splats = ball(2000)
    stroke = Stroke(view(SIZE))
    stroke.preview(splats, splats, 1, stroke.patch(*BOX, square()))
    darker = replace(splats, sh=(splats.sh * 0.2).astype(np.float32))
    preview = stroke.preview(darker, splats, 2, stroke.patch(0, 0, 4, 4, square((0, 0, 0, 0), 4, 4)))
    after = shot(with_preview(darker, preview))
    assert np.abs(after - np.array([200, 40, 40]) / 255)[stroke.mask].mean() < 0.2


def test_erasing_shows_the_original() -> None:
    original = ball(2000)
    painted = replace(original, sh=np.zeros_like(original.sh))
    stroke = Stroke(view(SIZE), erase=True)
    preview = stroke.preview(painted, original, 1, stroke.patch(*BOX, square((0, 0, 0, 255))))
    after, truth = shot(with_preview(painted, preview)), shot(original)
    assert np.abs(after - truth)[stroke.mask].mean() < 0.5 * np.abs(shot(painted) - truth)[stroke.mask].mean()


def test_half_transparent_paint_is_half_there() -> None:
    splats = ball(800)
    stroke = Stroke(view(SIZE))
    stroke.patch(*BOX, square((255, 255, 255, 128)))
    picture, before = stroke.picture(splats, splats, 1), shot(splats)
    half = before + 128 / 255 * (1 - before)
    assert np.allclose(picture[stroke.mask], half[stroke.mask], atol=1e-5)
    assert np.array_equal(picture[~stroke.mask], before[~stroke.mask])


def test_linear_assets_are_previewed_in_their_own_colours() -> None:
    splats = replace(ball(2000), color_space="linear")
    stroke = Stroke(view(SIZE))
    preview = stroke.preview(splats, splats, 1, stroke.patch(*BOX, square((188, 188, 188, 255))))
    after = render(with_preview(splats, preview), view(SIZE)).colors[0]
    assert abs(after[stroke.mask].mean() - 0.5) < 0.08  # sRGB 188 is half the light


@pytest.mark.parametrize("box", [(80, 80, 24, 20), (0, 0, 97, 1)])
def test_pixels_beside_the_view_are_refused(box: tuple[int, int, int, int]) -> None:
    with pytest.raises(ValueError, match="inside the view"):
        Stroke(view(SIZE)).patch(*box, b"")
    with pytest.raises(ValueError, match="bytes of RGBA"):
        Stroke(view(SIZE)).patch(0, 0, 4, 4, b"x" * 63)


def test_paint_beside_the_asset_previews_nothing() -> None:
    splats = ball(500)
    stroke = Stroke(view(SIZE))
    assert not len(stroke.preview(splats, splats, 1, stroke.patch(0, 0, 6, 6, square(width=6, height=6)))[0])


def drawn(splats: Splats, patches: int) -> tuple[Stroke, np.ndarray]:
    """(a stroke that grew so many patches to the right, the picture that it makes)."""
    stroke = Stroke(view(SIZE))
    stroke.prepare(splats, splats, 1)
    for k in range(patches):
        stroke.patch(BOX[0], BOX[1], 4 * (k + 1), BOX[3], square(width=4 * (k + 1)))
    return stroke, stroke.picture(splats, splats, 1)


def test_what_was_seen_of_the_surface_while_a_stroke_grew_is_not_asked_again_and_changes_no_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Nothing is kept of the edit before.
    monkeypatch.setattr(recent_sights, "RECENT_SIGHTS", replace(recent_sights.RECENT_SIGHTS, most_lines=0))
    splats = ball(3000)
    surface, queries, at = Surface.of(splats), [], Surface.at

    def counted(self: Surface, points: np.ndarray, *args: np.ndarray) -> SurfacePoints:
        queries.append(len(points))
        return at(self, points, *args)

    monkeypatch.setattr(Surface, "at", counted)
    stroke, picture = drawn(splats, 6)
    picture = picture.astype(np.float32)
    plain = paint_view(splats, surface, stroke.camera, picture, stroke.mask)
    unaided = sum(queries)
    assert stroke.look(surface) and not stroke.look(surface)
    queries.clear()
    painted = paint_view(splats, surface, stroke.camera, picture, stroke.mask)
    assert unaided > 100 and sum(queries) == 0
    for name in ATTRIBUTES:
        assert getattr(painted.splats, name).tobytes() == getattr(plain.splats, name).tobytes()
    # Of another asset's surface, or once the stroke is gone, nothing is known.
    paint_view(splats, Surface.of(splats), stroke.camera, picture, stroke.mask)
    assert sum(queries) == unaided
    camera, mask = stroke.camera, stroke.mask
    del stroke
    gc.collect()
    queries.clear()
    paint_view(splats, surface, camera, picture, mask)
    assert sum(queries) == unaided


def test_the_surface_is_looked_at_under_paint_that_grows_alone() -> None:
    splats = ball(3000)
    surface = Surface.of(splats)
    text = drawn(splats, 1)[0]  # it comes whole, and the pen goes up at once
    assert not text.has_grown and not text.look(surface)
    stroke = drawn(splats, 4)[0]
    assert stroke.has_grown and stroke.look(surface) and not stroke.has_grown
    moved, _ = drawn(splats, 6)
    moved.patch(*BOX, square((0, 0, 0, 0)))
    assert not moved.look(surface)
    eraser = Stroke(view(SIZE), erase=True)
    eraser.prepare(splats, splats, 1)
    for _ in range(6):
        eraser.patch(*BOX, square())
    assert not eraser.look(surface)


def test_a_mirrored_stroke_paints_both_sides_in_one_step(tmp_path: Path) -> None:
    """Previewed and painted on the mirrored view too; one undo takes both away."""
    camera = view(96, 20)
    with studio_scenes.live(studio_scenes.make_studio(tmp_path)) as live:
        session = live.studio.session
        info = CameraInfo.of(camera).model_dump()
        mirror = {"normal": [2.0, 0.0, 0.0], "offset": 0.0}
        stroke = live.post("paint.begin", camera=info, mirror=mirror)["stroke"]
        red = base64.b64encode(bytes([255, 0, 0, 255]) * 144).decode()
        one_side = live.post("paint.begin", camera=info)["stroke"]
        alone = live.post("paint.dab", stroke=one_side, x=30, y=40, width=12, height=12, rgba=red)["gaussians"]
        stroke = live.post("paint.begin", camera=info, mirror=mirror)["stroke"]
        both = live.post("paint.dab", stroke=stroke, x=30, y=40, width=12, height=12, rgba=red)["gaussians"]
        assert both > alone
        layer = live.post("paint.end", stroke=stroke, into_new="Paint")["layer"]
        assert len(layer["views"]) == 2 and len(session.history) == 2
        other = mirrored_camera(camera, parsed_plane((1, 0, 0), 0))
        for at, column in ((camera, 36), (other, 96 - 36)):
            color = render(session.splats, at).colors[0, 46, column]
            assert color[0] > 0.7 and color[1:].max() < 0.35
        live.post("undo")
        assert not session.layers


def test_mirrored_paint_that_keeps_shading_has_the_shading_of_its_own_side() -> None:
    splats = studio_scenes.ball()
    camera = view(96)
    first, half = Stroke(camera), MirroredStroke(mirrored_camera(camera, parsed_plane((1, 0, 0), 0)))
    half.keep = 1.0
    first.prepare(splats, splats, 0)
    half.prepare(splats, splats, 0)
    base = np.clip(first.base[40:52, 30:42], 0, 1)  # the colours are those below, a little redder
    rgba = (
        np.concatenate([base * 255 + (20, 0, 0), np.full((12, 12, 1), 255)], -1).clip(0, 255).round().astype(np.uint8)
    )
    half.follow(first, first.patch(30, 40, 12, 12, rgba.tobytes()), splats, splats, 0)
    expected = np.clip(half.base[40:52, 54:66] * 255 + (20, 0, 0), 0, 255)
    assert np.abs(half.rgba[40:52, 54:66, :3] - expected).mean() < 2
