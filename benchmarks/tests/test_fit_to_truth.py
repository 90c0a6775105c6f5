"""Fits to true views: what they may move, what they may not, and how near the truth they come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatbench.cases import Budget, EditStep, PosedImages
from splatbench.methods import Curve, EditTask, fit_to_truth, is_curve_point

from splatpainter.cameras import Camera, look_at
from splatpainter.painter import Mode
from splatpainter.rendering import render
from splatpainter.splats import Splats
from tests.support.lift_scenes import SH_C0, back, bits, db, disk, front, sheet

BY_NAME = {method.name: method for method in fit_to_truth.METHODS}
SIZE = 48


def camera(x: float, y: float, z: float) -> Camera:
    return look_at((x, y, z), (0, 0, 0), width=SIZE, height=SIZE, fov=42, background=(0.5, 0.5, 0.5))


def pictures(truth: Splats, cameras: list[Camera]) -> PosedImages:
    return PosedImages(tuple(cameras), render(truth, cameras).colors)


def two_sheets() -> Splats:
    """One before the other, opaque: the front hides the back."""
    return sheet(26, opacity=0.98).append(sheet(16, z=-0.8, opacity=0.98))


def spotted(splats: Splats, color: tuple[float, float, float]) -> Splats:
    """The truth: Gaussians of the front sheet near its middle in one colour."""
    sh = splats.sh.copy()
    inside = (np.hypot(splats.means[:, 0], splats.means[:, 1]) < 0.45) & (splats.means[:, 2] > -0.4)
    sh[inside, 0] = (np.array(color) - 0.5) / SH_C0
    return replace(splats, sh=sh)


def given(mode: Mode, asset: Splats, truth: Splats) -> EditTask:
    view = front(SIZE)
    edited = pictures(truth, [view])
    masks = disk(view, SIZE / 2, SIZE / 2, 11)[None] if mode == "local" else np.ones((1, SIZE, SIZE), bool)
    around = pictures(truth, [camera(1, 0.3, 2.8), camera(-1, 0.2, 2.8), camera(0.2, -0.9, 2.9)])
    return EditTask("creative", asset, pictures(asset, [view]), EditStep(mode, "stroke", edited, masks), around)


def test_without_true_views_there_is_no_fit() -> None:
    asset = two_sheets()
    work = replace(given("local", asset, asset), true_views=None)
    for method in BY_NAME.values():
        assert method.sees_truth and method.missing(Budget()) == ""
        with pytest.raises(ValueError, match="no true edited views"):
            method.edit(work, Budget(steps=1))


def test_a_local_fit_moves_only_colours_and_opacities_of_rows_that_the_edit_reaches() -> None:
    asset = two_sheets()
    truth = spotted(asset, (0.9, 0.1, 0.1))
    work = given("local", asset, truth)
    sh = asset.sh.copy()
    done = BY_NAME["oracle-fit"].edit(work, Budget(steps=100))
    assert np.array_equal(asset.sh, sh)  # the case's own asset is not written to
    assert done.keeps_gaussians and len(done.splats) == len(asset)
    for name in ("means", "quats", "scales"):
        assert np.array_equal(bits(getattr(done.splats, name)), bits(getattr(asset, name)))
    moved = (bits(done.splats.sh) != bits(asset.sh)).reshape(len(asset), -1).any(1)
    assert moved.sum() > 50 and done.numbers["rows_reached"] >= moved.sum()
    assert not moved[26 * 26 :].any()  # the sheet behind is hidden
    far = np.hypot(asset.means[:, 0], asset.means[:, 1]) > 0.9  # the mask ends at about 0.53
    assert not moved[far].any() and np.array_equal(bits(done.splats.opacities[far]), bits(asset.opacities[far]))
    novel = camera(-0.5, 0.6, 2.9)
    before, after = (db(render(s, novel).colors[0], render(truth, novel).colors[0]) for s in (asset, done.splats))
    assert after > before + 1  # at 3DGS' rates a colour moves by 0.07 in 100 steps


def test_a_global_fit_moves_all_rows_that_the_true_views_show_and_learns_unseen_views() -> None:
    asset = two_sheets()
    truth = replace(asset, sh=asset.sh * 0.6 - 0.1)
    work = given("global", asset, truth)
    work = replace(work, true_views=pictures(truth, [*work.true_views.cameras, back(SIZE)]))  # type: ignore[union-attr]
    done = BY_NAME["oracle-fit"].edit(work, Budget(steps=150))
    assert np.array_equal(bits(done.splats.means), bits(asset.means)) and "rows_reached" not in done.numbers
    behind = slice(26 * 26, None)
    assert np.abs(done.splats.sh[behind] - asset.sh[behind]).max() > 0.02
    novel = camera(0.5, 0.5, -2.9)
    before, after = (db(render(s, novel).colors[0], render(truth, novel).colors[0]) for s in (asset, done.splats))
    assert after > before + 2
    assert done.numbers["views"] == 5 and done.numbers["steps"] == 150


def test_with_all_attributes_rows_move_and_come_and_go_and_show_what_coarse_rows_cannot() -> None:
    asset, truth = sheet(14), sheet(44)
    x, y = truth.means[:, 0], truth.means[:, 1]
    checks = (0.25 * np.sign(np.sin(14 * x) * np.sin(14 * y)) / SH_C0)[:, None]
    truth = replace(truth, sh=(truth.sh + checks[:, None]).astype(np.float32))
    work = given("local", asset, truth)
    done = BY_NAME["oracle-fit-all"].edit(work, Budget(steps=150, seed=1))
    assert not done.keeps_gaussians and len(done.splats) > len(asset)
    colors = BY_NAME["oracle-fit"].edit(work, Budget(steps=150, seed=1))
    view, target = camera(0.5, 0.4, 2.9), render(truth, camera(0.5, 0.4, 2.9)).colors[0]
    before, alike, finer = (db(render(s, view).colors[0], target) for s in (asset, colors.splats, done.splats))
    assert finer > alike + 0.5 and alike > before


def test_equal_seeds_give_equal_bits_and_a_curve_changes_nothing() -> None:
    asset = two_sheets()
    work = given("local", asset, spotted(asset, (0.1, 0.9, 0.1)))
    plain = BY_NAME["oracle-fit"].edit(work, Budget(steps=32, seed=3))
    watched = BY_NAME["oracle-fit"].edit(work, Budget(steps=32, seed=3, curve=True))
    assert np.array_equal(bits(plain.splats.sh), bits(watched.splats.sh)) and plain.curve == ()
    assert [steps for _, steps, _ in watched.curve] == [10, 30]
    times = [seconds for seconds, _, _ in watched.curve]
    assert times == sorted(times) and times[-1] <= watched.edit_seconds
    early, late = (splats.sh for _, _, splats in watched.curve)
    assert not np.array_equal(early, late) and not np.array_equal(late, watched.splats.sh)


def test_points_of_a_curve() -> None:
    assert [k for k in range(1, 40_000) if is_curve_point(k)] == [10, 30, 100, 300, 1000, 3000, 10_000, 30_000]
    assert Curve(False).watch is None
    curve, drawn = Curve(True), sheet(2)
    assert curve.watch is not None
    for step in range(1, 11):
        curve.watch(step, lambda: drawn)
    assert [(steps, splats) for _, steps, splats in curve.points] == [(10, drawn)]
