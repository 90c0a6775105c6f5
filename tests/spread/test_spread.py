"""Mode spread: what is reached, what keeps its bits, and what colours it takes, on a board of two materials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.cameras import look_at
from splatpainter.color import from_display, to_display
from splatpainter.kernels.parallel import THREADS_VARIABLE
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.masks import dilated
from splatpainter.painter import Asset, Edit, EditSettings, Painter
from splatpainter.pictures.edit_files import MAX_CLEAR_ALPHA, PictureFile
from splatpainter.pictures.picture_reader import Picture
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, SH_C0, ColorSpace, Splats
from splatpainter.spread.options import SpreadOptions
from splatpainter.spread.soft_edges import MIN_TEACHING_COVER, on_other_ground, paint_alone
from tests.support.lift_scenes import db, differing
from tests.support.spread_scenes import CAMERA, PAINT, SIDE, board, left_half, lit, painted_picture

BACK = np.arange(2 * SIDE**2) >= SIDE**2


def spread(splats: Splats, mask: np.ndarray, threshold: float | None = None) -> Asset:
    options = None if threshold is None else SpreadOptions(threshold)
    painter = Painter(settings=EditSettings(spread_options=options))
    return painter.apply(painter.encode(splats), [Edit(painted_picture(splats), CAMERA, mask)], "spread")


def stroke() -> np.ndarray:
    """[H, W] bool: a round part of the left half."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    return left_half() & (np.hypot(x - 23, y - 36) < 9)


@pytest.mark.parametrize("mask", [left_half(), stroke()], ids=["all of it", "a stroke"])
def test_the_material_changes_behind_and_nothing_else(mask: np.ndarray) -> None:
    splats = board(degree=1)
    result = spread(splats, mask)
    left, changed = splats.means[:, 0] < -0.05, differing(splats, result.splats)
    assert changed[left & BACK].mean() > 0.98 and not changed[~left & BACK & (splats.means[:, 0] > 0.15)].any()
    assert result.receipt is not None and result.receipt.mode == "spread"
    np.testing.assert_array_equal(result.receipt.touched, np.flatnonzero(changed))
    assert result.receipt.untouched_sha256_before == result.receipt.untouched_sha256_after
    assert ("in the middle of the material" in result.receipt.note) == (mask.sum() < left_half().sum())
    assert result.confidence is not None and len(result.confidence) == len(result.splats)
    assert result.confidence[: len(splats)][left & BACK].min() > 0.5


def test_colors_keep_the_light_that_lies_on_them() -> None:
    splats = board()
    result = spread(splats, left_half())
    ids = np.flatnonzero((splats.means[:, 0] < -0.1) & BACK)
    light = (0.4 + 0.15 * splats.means[ids, 1])[:, None]
    colors = 0.5 + SH_C0 * result.splats.sh[ids, 0]
    assert np.abs(colors - lit(PAINT, light)).mean() < 0.03  # the noise of the board, and of a linear fit
    before = 0.5 + SH_C0 * splats.sh[ids, 0]
    assert np.abs(before - lit(PAINT, light)).mean() > 0.15


@pytest.mark.parametrize("mask", [left_half(), stroke()], ids=["all of it", "a stroke"])
def test_the_edited_view_shows_the_picture_and_no_rim_of_old_colour(mask: np.ndarray) -> None:
    splats, painter, picture = board(), Painter(), painted_picture(board())
    local = painter.apply(painter.encode(splats), [Edit(picture, CAMERA, mask)])
    result = spread(splats, mask)
    assert local.receipt is not None and result.receipt is not None
    (one,), (other,) = local.receipt.views, result.receipt.views
    assert one.psnr_after is not None and other.psnr_after is not None and other.psnr_after > one.psnr_after - 1
    inner = left_half() & ~dilated(~left_half(), 3)
    assert db(np.clip(render(result.splats, CAMERA).colors[0], 0, 1), picture, inner) > 27


def soft(mask: np.ndarray, width: int) -> np.ndarray:
    """[H, W] float32 cover that rises from a mask's edge inwards, over `width` pixels."""
    rings = np.stack([~dilated(~mask, k) for k in range(width)])
    return np.asarray(rings.mean(0), np.float32)


@pytest.mark.parametrize("mask", [left_half(), stroke()], ids=["all of it", "a stroke"])
def test_a_soft_edge_is_no_rim_of_old_colour_and_teaches_no_weaker_one(mask: np.ndarray) -> None:
    """Taken for the paint itself, mixtures are a rim beside the colour that was spread: 19 and 13 dB there."""
    splats, picture = board(), painted_picture(board())
    before, cover = render(splats, CAMERA).colors[0], soft(mask, 7)
    mixed = (before + cover[..., None] * (picture - before)).astype(np.float32)
    painter = Painter()
    edit = Edit(mixed, CAMERA, mask, cover=cover)
    result = painter.apply(painter.encode(splats), [edit], "spread")
    assert result.receipt is not None and (result.receipt.views[0].psnr_after or 0) > 29, "judged where all is paint"
    inner = mask & (cover < 1) & left_half() & ~dilated(~left_half(), 3)
    assert inner.sum() > 100
    assert db(np.clip(render(result.splats, CAMERA).colors[0], 0, 1), picture, inner) > 28
    ids = np.flatnonzero((splats.means[:, 0] < -0.1) & BACK)
    light = (0.4 + 0.15 * splats.means[ids, 1])[:, None]
    assert np.abs(0.5 + SH_C0 * result.splats.sh[ids, 0] - lit(PAINT, light)).mean() < 0.035


def test_a_transparent_picture_over_the_view_says_how_thick_its_paint_is() -> None:
    """As an image editor exports a layer of paint: the same as a brush, whose cover is known."""
    splats, mask = board(), left_half()
    paint, cover = painted_picture(splats), soft(left_half(), 7)
    picture = PictureFile(Path("paint.png"), Picture(paint, 0.6 * cover), (72, 72), CAMERA, None, ("",))
    edit = picture.edit(splats, "spread")
    assert edit.cover is not None and edit.mask is not None
    np.testing.assert_allclose(edit.cover, cover, atol=1e-6)
    np.testing.assert_array_equal(edit.mask, 0.6 * cover > MAX_CLEAR_ALPHA)
    assert picture.edit(splats).cover is None and replace(picture, cut_out=True).edit(splats, "spread").cover is None
    picture = replace(picture, picture=replace(picture.picture, alpha=cover))
    painter = Painter()
    result = painter.apply(painter.encode(splats), [picture.edit(splats, "spread")], "spread")
    inner = mask & (cover < 1) & (cover > 0) & ~dilated(~mask, 3)
    assert db(np.clip(render(result.splats, CAMERA).colors[0], 0, 1), paint, inner) > 28, "a rim of the old colour"


def test_full_cover_changes_nothing() -> None:
    splats, picture = board(), painted_picture(board())
    painter, ones = Painter(), np.ones((CAMERA.height, CAMERA.width))
    edits = [Edit(picture, CAMERA, stroke(), cover=cover) for cover in (None, ones)]
    first, second = (painter.apply(painter.encode(splats), [edit], "spread").splats for edit in edits)
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    local = [painter.apply(painter.encode(splats), [replace(e, cover=0.5 * ones)]).splats for e in edits[:1]]
    np.testing.assert_array_equal(local[0].sh, painter.apply(painter.encode(splats), edits[:1]).splats.sh)


@pytest.mark.parametrize("space", ["srgb", "linear"])
def test_paint_over_other_ground_is_what_the_brush_would_have_made(space: ColorSpace) -> None:
    rng = np.random.default_rng(0)
    ground, other, paint = (from_display(rng.uniform(0.2, 0.8, (20, 20, 3)), space) for _ in range(3))
    cover = rng.uniform(0, 1, (20, 20)).astype(np.float32)

    def brushed(below: np.ndarray) -> np.ndarray:
        old, new = to_display(below, space), to_display(paint, space)
        return from_display(old + cover[..., None] * (new - old), space)

    mask = np.ones((20, 20), bool)
    view = EditView(look_at((0, 0, 1), (0, 0, 0), width=20, height=20), brushed(ground), mask, ground, cover=cover)
    np.testing.assert_allclose(on_other_ground(view, other, space).edited, brushed(other), atol=1e-5)
    alone = paint_alone(view, space)
    np.testing.assert_array_equal(alone.mask, cover >= MIN_TEACHING_COVER)
    np.testing.assert_allclose(alone.edited[alone.mask], paint[alone.mask], atol=1e-5)
    faint = replace(view, cover=0.4 * cover)
    assert paint_alone(faint, space) is faint, "nothing says what the paint is"


def test_a_lower_threshold_reaches_more_and_one_reaches_nothing() -> None:
    splats = board()
    counts = [int(differing(splats, spread(splats, left_half(), t).splats)[BACK].sum()) for t in (0.02, 0.55, 1.0)]
    assert counts[0] > counts[1] > counts[2] == 0


def test_any_number_of_threads_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    splats, results = board(), []
    for threads in ("1", "3"):
        monkeypatch.setenv(THREADS_VARIABLE, threads)
        results.append(spread(splats, stroke()))
    assert not differing(results[0].splats, results[1].splats).any()
    np.testing.assert_array_equal(results[0].confidence, results[1].confidence)


def test_examples_of_several_views_count_together() -> None:
    splats = board()
    other = replace(CAMERA, world_to_camera=CAMERA.world_to_camera @ np.diag([-1.0, 1, -1, 1]))
    edits = [Edit(painted_picture(splats, c), c, left_half()) for c in (CAMERA,)]
    mask = np.zeros_like(left_half())
    mask[30:40, 45:55] = True  # from behind, left is right
    edits.append(Edit(painted_picture(splats, other), other, mask))
    painter = Painter()
    result = painter.apply(painter.encode(splats), edits, "spread")
    assert differing(splats, result.splats)[BACK & (splats.means[:, 0] < -0.1)].mean() > 0.98


def test_gaussians_that_cannot_be_drawn_stay() -> None:
    splats = board()
    means = splats.means.copy()
    means[[5, 900]] = np.nan
    result = spread(replace(splats, means=means), left_half())
    changed = differing(replace(splats, means=means), result.splats)
    assert not changed[[5, 900]].any() and changed[BACK].any()


def test_what_cannot_be_spread_says_why() -> None:
    splats, painter = board(), Painter()
    asset, picture = painter.encode(splats), painted_picture(splats)
    with pytest.raises(ValueError, match="all that the views show was edited"):
        painter.apply(asset, [Edit(picture, CAMERA, np.ones_like(left_half()))], "spread")
    with pytest.raises(ValueError, match="mode spread is made by the lift alone, got 'fit'"):
        painter.apply(asset, [Edit(picture, CAMERA, left_half())], "spread", "fit")
    for bad in (-0.1, 1.5, float("nan")):
        with pytest.raises(ValueError, match="expected spread_threshold from 0 to 1"):
            SpreadOptions(bad)
