"""Zoom-ins: detail arrives and is seen from other sides too, and what the close-ups do not show stays."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter.cameras import Camera, look_at
from splatpainter.fit import edited as fit_module
from splatpainter.lift import edits as edits_module
from splatpainter.lift.edit_views import EditView, edit_views
from splatpainter.lift.local import wide_edit
from splatpainter.lift.local.local_edit import WIDE_EDIT_FRACTION, fills_view
from splatpainter.lift.local.wide_edit import WideLift, lift_wide
from splatpainter.lift.masks import changed_throughout, median_change
from splatpainter.lift.options import LOCAL_DEFAULTS
from splatpainter.metrics import psnr
from splatpainter.painter import Asset, Edit, Painter
from splatpainter.rendering.cpu.projected_view import tiles_of_mask
from splatpainter.splats import SH_C0, Splats, rows_sha256
from splatpainter.surface.estimate import Surface
from splatpainter.voxels.grid import voxelize
from tests.support.lift_scenes import front, rod, sheet

PX = 64


def closeup(x: float, y: float) -> Camera:
    return look_at((x, y, 1.6), (x / 3, y / 3, 0), width=PX, height=PX, fov=40, background=(0.5, 0.5, 0.5))


def with_detail(side: int) -> Splats:
    """A plane with stripes that only a fine one can show."""
    splats = sheet(side, degree=1, opacity=0.95)
    sh = splats.sh.copy()
    sh[:, 0] = ((0.5 + 0.35 * np.sin(24 * splats.means[:, :1] + [0, 1, 2])) - 0.5) / SH_C0
    return replace(splats, sh=(sh * [[1], [0], [0], [0]]).astype(np.float32))


def box(front_side: Splats) -> Splats:
    """The plane, and a second one behind it, back to back."""
    behind = sheet(24, z=-0.3, degree=1, opacity=0.95)
    return front_side.append(behind)


def picture(splats: Splats, camera: Camera) -> np.ndarray:
    return np.clip(sp.render(splats, camera).colors[0], 0, 1)


@pytest.fixture(scope="module")
def asset() -> Splats:
    return box(sheet(24, degree=1, opacity=0.95))


@pytest.fixture(scope="module")
def views(asset: Splats) -> list[EditView]:
    cameras = [closeup(0.3, 0.2), closeup(-0.35, -0.1)]
    pictures = [picture(box(with_detail(120)), camera) for camera in cameras]
    return edit_views(asset, cameras, pictures, [np.ones((PX, PX), bool)] * 2)


@pytest.fixture(scope="module")
def lifted(asset: Splats, views: list[EditView]) -> WideLift:
    """On one thread."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLATPAINTER_THREADS", "1")
        return lift_wide(asset, views, LOCAL_DEFAULTS)


def test_detail_arrives_and_is_seen_from_another_side(asset, views, lifted) -> None:
    for view in views:
        before, after = (psnr(picture(splats, view.camera), view.edited) for splats in (asset, lifted.splats))
        assert after > before + 9
    other = closeup(0.05, -0.3)
    truth = picture(box(with_detail(120)), other)
    assert psnr(picture(lifted.splats, other), truth) > psnr(picture(asset, other), truth) + 7


def test_gaussians_that_are_off_are_moved_before_they_take_colours(monkeypatch) -> None:
    """A plane whose Gaussians are too large and lie half a spacing beside where they should."""
    truth, positions = with_detail(48), with_detail(48).means
    beside = np.random.default_rng(0).normal(0, 0.02, positions.shape) * [1, 1, 0]
    means, scales = positions + beside, truth.scales * [2, 2, 1]
    crooked = replace(truth, means=means.astype(np.float32), scales=scales.astype(np.float32))
    cameras = [look_at((x, 0.1, 1.3), (0, 0, 0), width=PX, height=PX, fov=40) for x in (0.9, -0.9)]
    views = edit_views(crooked, cameras, [picture(truth, c) for c in cameras], [np.ones((PX, PX), bool)] * 2)
    moved, between = lift_wide(crooked, views, LOCAL_DEFAULTS).splats, [closeup(0.05, -0.3), closeup(-0.1, 0.3)]
    monkeypatch.setattr(wide_edit, "_moved", lambda splats, views: splats)
    recolored = lift_wide(crooked, views, LOCAL_DEFAULTS).splats
    before, colors, both = (
        np.mean([psnr(picture(splats, camera), picture(truth, camera)) for camera in between])
        for splats in (crooked, recolored, moved)
    )
    assert both > colors + 0.2 and colors > before


def test_sizes_change_fast_only_where_gaussians_are_badly_placed(asset, monkeypatch) -> None:
    """Not for detail finer than they are, and not for other colours."""
    camera, rates = closeup(0.0, 0.0), []
    before, detailed = picture(asset, camera), with_detail(48)
    beside = np.random.default_rng(0).normal(0, 0.02, detailed.means.shape) * [1, 1, 0]
    crooked = replace(detailed, means=(detailed.means + beside).astype(np.float32))
    stripes = 0.1 * np.sign(np.sin(np.arange(PX) * 2.4))[None, :, None]
    monkeypatch.setattr(fit_module, "fit_edited", lambda *given: rates.append(given[-1].rate_scales) or given[1])
    pairs = ((asset, before + stripes), (asset, 0.7 * before), (crooked, picture(detailed, camera)))
    for splats, edited in pairs:
        lift_wide(splats, edit_views(splats, [camera], [edited], [np.ones((PX, PX), bool)]), LOCAL_DEFAULTS)
    assert rates == pytest.approx([wide_edit.WIDE_EDITS.rate_scales[0]] * 2 + [wide_edit.WIDE_EDITS.rate_scales[1]])


def test_gaussians_stay_where_moving_explains_nothing(asset, views) -> None:
    noise = np.random.default_rng(5).uniform(-0.2, 0.2, (PX, PX, 1)).astype(np.float32)
    noisy = [replace(view, edited=np.clip(view.before + noise, 0, 1)) for view in views]
    after = lift_wide(asset, noisy, LOCAL_DEFAULTS)
    same = np.setdiff1d(np.arange(24 * 24), after.parents)
    assert len(after.touched) > len(same) > 0  # colours have changed, of unsplit ones too
    for name in ("means", "quats", "scales", "opacities"):
        assert getattr(after.splats, name)[same].tobytes() == getattr(asset, name)[same].tobytes()


def test_gaussians_are_moved_towards_the_picture_and_the_asset_beside_its_mask(asset, monkeypatch) -> None:
    """Only the tiles of the mask were rendered before the edit; the others are no picture to reach."""
    camera, mask, pictures = closeup(0.0, 0.0), np.zeros((PX, PX), bool), []
    mask[:, :48] = True
    before, edited = picture(asset, camera), picture(box(with_detail(48)), camera)
    rendered, alpha = np.where(mask[..., None], before, 0), np.asarray(mask, np.float32)
    view = EditView(camera, edited, mask, rendered, alpha=alpha, tiles=tiles_of_mask(mask))
    monkeypatch.setattr(fit_module, "fit_edited", lambda before, lifted, views, *rest: pictures.extend(views) or lifted)
    lift_wide(asset, [view], LOCAL_DEFAULTS)
    ((_, target),) = pictures
    np.testing.assert_allclose(target, np.where(mask[..., None], edited, before), atol=1e-5)


def test_what_the_views_do_not_show_stays(asset, lifted) -> None:
    camera = look_at((0.4, 0.3, -3), (0, 0, 0), width=PX, height=PX, fov=42)
    assert psnr(picture(lifted.splats, camera), picture(asset, camera)) > 45
    touched = np.zeros(len(asset), bool)
    touched[lifted.touched] = True
    assert 0 < touched[: 24 * 24].sum() and not touched[24 * 24 :].any()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        old, new = getattr(asset, name), getattr(lifted.splats, name)[: len(asset)]
        assert old[~touched].tobytes() == new[~touched].tobytes()
    assert len(lifted.parents) == len(lifted.splats) - len(asset) > 100 and touched[lifted.parents].all()


def test_colors_change_towards_the_views_that_changed_them(asset, monkeypatch) -> None:
    """A lighter close-up from one side: moved Gaussians are hardly lighter from the other, those that stay are."""
    side = {
        x: look_at((x, 0, 0.7), (0, 0, 0), width=PX, height=PX, fov=30, background=(0.5, 0.5, 0.5)) for x in (-2, 2)
    }
    before = {x: picture(asset, camera) for x, camera in side.items()}
    view = edit_views(asset, [side[2]], [np.clip(before[2] + 0.15, 0, 1)], [np.ones((PX, PX), bool)])[0]
    middle, lighter = np.s_[32:64, 32:64], {}
    for name, moved in (("moved", replace), ("stay", lambda splats: splats)):
        monkeypatch.setattr(wide_edit, "_moved", lambda splats, views, moved=moved: moved(splats))
        after = lift_wide(asset, [view], LOCAL_DEFAULTS).splats
        lighter[name] = [float((picture(after, side[x]) - before[x])[middle].mean()) for x in (2, -2)]
    assert min(near for near, _ in lighter.values()) > 0.08
    assert lighter["moved"][1] < 0.6 * lighter["stay"][1]


def test_from_afar_nothing_has_changed(asset, views) -> None:
    """Close-ups of the asset's own mean colours: what is sharper near is the same when it is small."""
    far = look_at((0, 0, 9), (0, 0, 0), width=48, height=48, fov=25)
    sharper = [
        replace(view, edited=np.clip(view.before + 0.08 * np.sign(np.sin(np.arange(PX) * 2.1))[None, :, None], 0, 1))
        for view in views
    ]
    after = lift_wide(asset, sharper, LOCAL_DEFAULTS).splats
    assert psnr(picture(after, far), picture(asset, far)) > 35


def test_equal_bits_for_any_number_of_threads(asset, views, lifted, monkeypatch) -> None:
    monkeypatch.setenv("SPLATPAINTER_THREADS", "3")
    again = lift_wide(asset, views, LOCAL_DEFAULTS)
    assert rows_sha256(again.splats) == rows_sha256(lifted.splats)


def test_pictures_without_a_mask_that_differ_everywhere_are_lifted_together(asset, views, lifted) -> None:
    edits = [Edit(view.edited, view.camera, None) for view in views]
    result = Painter.load("lift").apply(Asset(asset), edits)
    assert rows_sha256(result.splats) == rows_sha256(lifted.splats)
    receipt = result.receipt
    assert receipt is not None and not len(receipt.removed) and "beside the asset" not in receipt.note


def test_paint_and_noise_are_not_taken_for_detail(asset, views) -> None:
    camera = front(PX)
    before, alpha = picture(asset, camera), np.asarray(sp.render(asset, camera).alphas[0, ..., 0])
    painted = np.round(before * 255) / 255
    painted[30:50, 20:60] = (0.9, 0.1, 0.1)
    assert not changed_throughout(painted, before, alpha)
    file = io.BytesIO()
    Image.fromarray((painted * 255).astype(np.uint8)).save(file, "JPEG", quality=85)
    assert not changed_throughout(np.asarray(Image.open(file), np.float32) / 255, before, alpha)
    assert not changed_throughout(before, before, np.zeros_like(alpha))
    assert changed_throughout(views[0].edited, views[0].before, np.ones((PX, PX), np.float32))


def test_fine_detail_is_told_from_noise_and_jpeg() -> None:
    """Stripes that averaging over 9 x 9 pixels takes away; noise as strong, and what JPEG leaves of a textured view."""
    camera, splats = front(2 * PX), sheet(40, opacity=0.95)
    before, alpha = picture(splats, camera), np.asarray(sp.render(splats, camera).alphas[0, ..., 0])
    stripes = 0.06 * np.sin(np.arange(2 * PX) * 1.2)[None, :, None]
    noise = np.random.default_rng(2).normal(0, 0.06, before.shape)
    assert changed_throughout(np.clip(before + stripes, 0, 1), before, alpha)
    assert not changed_throughout(np.clip(before + noise, 0, 1), before, alpha)
    busy = np.clip(before + stripes, 0, 1)
    for quality in (50, 75):
        file = io.BytesIO()
        Image.fromarray((busy * 255).astype(np.uint8)).save(file, "JPEG", quality=quality)
        assert not changed_throughout(np.asarray(Image.open(file), np.float32) / 255, busy, alpha)


def test_strong_detail_of_fine_gaussians_is_no_new_paint(monkeypatch) -> None:
    """Stripes finer than the Gaussians, and the same view with its colours exchanged: both differ from it by 0.2."""
    splats, camera = sheet(40, opacity=0.95), front(PX)
    before, calls = picture(splats, camera), []
    monkeypatch.setattr(edits_module, "lift_wide", lambda *given: calls.append(given) or lift_wide(*given))
    grid = voxelize(splats, 32)
    stripes = np.clip(before + 0.3 * np.sign(np.sin(np.arange(PX) * 2.1))[None, :, None], 0, 1)
    for edited, is_detail in ((stripes, True), (before[..., [1, 2, 0]], False)):
        calls.clear()
        view = edit_views(splats, [camera], [edited], [np.ones((PX, PX), bool)])[0]
        assert median_change(edited, before, np.asarray(view.alpha)) > edits_module.EDITS.min_repainted
        edits_module.lift_local_views(splats, grid, [view], "lift", features=False, surface=Surface.of(splats))
        assert bool(calls) == is_detail


def test_detail_of_a_thin_object_is_detail_however_little_of_the_picture_it_fills() -> None:
    """From close by: a third of the picture, all that it shows of the asset, of which most lies beside."""
    asset, truth = rod(12, 26), rod(48, 120, 0.1)
    camera, beside = (
        look_at(position, (0, 0, 0), width=PX, height=PX, fov=50, background=(0.5, 0.5, 0.5))
        for position in ((0.05, 0.1, 1.2), (0.4, -0.6, 1.0))
    )
    mask = sp.render(truth, camera).alphas[0, ..., 0] > 0.5
    assert mask.mean() < WIDE_EDIT_FRACTION
    (view,) = edit_views(asset, [camera], [picture(truth, camera)], [mask])
    lifted = edits_module.lift_local_views(asset, None, [view], "lift", surface=Surface.of(asset))
    assert not len(lifted.replaced)  # no sheet
    before, after = (psnr(picture(splats, beside), picture(truth, beside)) for splats in (asset, lifted.splats))
    assert after > before + 1.5
    # Part of what is shown is paint, and so is a view of the whole asset.
    half = mask & (np.arange(PX) < PX // 2)
    assert fills_view(asset, camera, mask) and not fills_view(asset, camera, half)
    distant = look_at((0, 0, 3), (0, 0, 0), width=PX, height=PX, fov=42)
    assert not fills_view(asset, distant, sp.render(asset, distant).alphas[0, ..., 0] > 0.5)
    # New colours that its Gaussians can follow are paint in such a close-up, too.
    inverted = replace(view, edited=np.where(mask[..., None], 1 - view.before, view.before))
    assert len(edits_module.lift_local_views(asset, None, [inverted], "lift", surface=Surface.of(asset)).replaced)


def test_the_next_edit_of_a_thin_close_up_is_of_a_close_up_still() -> None:
    """The Gaussians that the first one added lie in its picture, and are then most of the asset's."""
    asset, truth = rod(12, 26), rod(48, 120, 0.1)
    camera = look_at((0.05, 0.1, 1.6), (0, 0, 0), width=PX, height=PX, fov=50, background=(0.5, 0.5, 0.5))
    mask, surface = sp.render(truth, camera).alphas[0, ..., 0] > 0.5, Surface.of(asset)
    splats = asset
    for stripes in (0.1, 0.18, 0.1):
        edited = picture(rod(48, 120, stripes), camera)
        (view,) = edit_views(splats, [camera], [edited], [mask])
        lifted = edits_module.lift_local_views(
            splats, None, [view], "lift", features=False, surface=surface, originals=len(asset)
        )
        assert not len(lifted.replaced)  # no sheet
        splats = lifted.splats
    assert fills_view(splats, camera, mask, len(asset)) and not fills_view(splats, camera, mask)


def test_close_ups_are_sharper_and_other_views_no_worse(monkeypatch) -> None:
    """Than after the rounds of all pictures; and not where Gaussians stayed, as noise is no detail."""

    def camera(x: float, y: float) -> Camera:
        return look_at((x, y, 1.15), (0, 0, 0), width=PX, height=PX, fov=50, background=(0.5, 0.5, 0.5))

    asset, truth, cameras = rod(12, 26), rod(48, 120, 0.1), [camera(0.3, 0.1), camera(-0.3, -0.1)]
    masks = [sp.render(truth, one).alphas[0, ..., 0] > 0.5 for one in cameras]
    views = edit_views(asset, cameras, [picture(truth, one) for one in cameras], masks)
    noise = np.random.default_rng(5).uniform(-0.2, 0.2, (PX, PX, 1)).astype(np.float32)
    noisy = [replace(view, edited=np.clip(view.before + noise, 0, 1)) for view in views]
    sharp, unmoved = (lift_wide(asset, pictures, LOCAL_DEFAULTS).splats for pictures in (views, noisy))
    monkeypatch.setattr(wide_edit, "sharpened", lambda splats, *rest: splats.sh)
    soft, same = (lift_wide(asset, pictures, LOCAL_DEFAULTS).splats for pictures in (views, noisy))
    assert rows_sha256(unmoved) == rows_sha256(same)
    beside = [camera(0, -0.6), camera(0, 0.5)]
    for at, gain in ((cameras, 0.6), (beside, 0.2)):
        before, after = (
            np.mean([psnr(picture(splats, one), picture(truth, one)) for one in at]) for splats in (soft, sharp)
        )
        assert after > before + gain


def test_close_ups_of_loose_gaussians_cost_other_sides_little(monkeypatch) -> None:
    """Whole rounds towards the close-up gain it a little more, and lose 0.31 dB from aside."""

    def camera(y: float, z: float) -> Camera:
        return look_at((0.3 * (z > 1), y, z), (0, 0, 0), width=PX, height=PX, fov=50, background=(0.5, 0.5, 0.5))

    even, truth = rod(12, 26), rod(48, 120, 0.1)
    means = even.means + np.random.default_rng(0).normal(0, 0.03, even.means.shape)
    thin = np.full(len(even), 0.3, np.float32)
    asset = replace(even, means=means.astype(np.float32), scales=2 * even.scales, opacities=thin)
    close, aside = camera(0.1, 1.15), [camera(-1.1, 0.4), camera(1.1, 0.4)]
    views = edit_views(asset, [close], [picture(truth, close)], [sp.render(truth, close).alphas[0, ..., 0] > 0.5])
    sharp = lift_wide(asset, views, LOCAL_DEFAULTS).splats
    monkeypatch.setattr(wide_edit, "sharpened", lambda splats, *rest: splats.sh)
    soft = lift_wide(asset, views, LOCAL_DEFAULTS).splats
    gains = [
        psnr(picture(sharp, one), picture(truth, one)) - psnr(picture(soft, one), picture(truth, one))
        for one in (close, *aside)
    ]
    assert gains[0] > 0.5 and np.mean(gains[1:]) > -0.22


def test_a_view_beside_the_asset_is_named(asset, views) -> None:
    away = look_at((0, 0, 3), (9, 0, 3), width=PX, height=PX, fov=40)
    nothing = edit_views(asset, [away], [np.zeros((PX, PX, 3), np.float32)], [np.ones((PX, PX), bool)])[0]
    with pytest.raises(ValueError, match="second: no Gaussian contributes"):
        lift_wide(asset, [views[0], replace(nothing, name="second")], LOCAL_DEFAULTS)
