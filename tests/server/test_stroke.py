"""Previews of strokes: what the renderer shows of them, against what was painted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatpainter.rendering import render
from splatpainter.server.stroke import Stroke
from splatpainter.splats import Splats
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
