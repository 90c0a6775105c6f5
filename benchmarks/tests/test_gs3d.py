"""3DGS optimisation as rows of the tables: which views it gets, which pixels of them count, and that it edits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatbench.cases import Budget, EditStep, PosedImages
from splatbench.methods import EditTask
from splatbench.methods.gs3d import METHODS, Settings, edit, local_views, reached, views_of_asset

from splatpainter.cameras import Camera, look_at
from splatpainter.rendering import render
from splatpainter.rendering.pixel_shares import share_of
from splatpainter.splats import Splats
from tests.support.lift_scenes import bits, db, disk, front, sheet

SIZE = 48
GREEN = np.array([0.1, 0.8, 0.2], np.float32)


def asset() -> Splats:
    """An opaque sheet, and another one behind it that faces away."""
    return sheet(24, opacity=0.97).append(sheet(12, z=-0.8, opacity=0.97))


def beside(x: float) -> Camera:
    return look_at((x, 0.2, 2.9), (0, 0, 0), width=SIZE, height=SIZE, fov=42, background=(0.5, 0.5, 0.5))


def drawn(splats: Splats, cameras: list[Camera]) -> PosedImages:
    return PosedImages(tuple(cameras), np.clip(render(splats, cameras).colors, 0, 1))


def dab(splats: Splats, x: float, color: np.ndarray = GREEN, kind: str = "stroke") -> EditStep:
    mask = disk(front(SIZE), x, 24, 5)
    colors = drawn(splats, [front(SIZE)]).colors.copy()
    colors[0, mask] = color
    return EditStep("local", kind, PosedImages((front(SIZE),), colors), mask[None])


def work(step: EditStep | None = None, scene: Splats | None = None, state: object = None) -> EditTask:
    scene = scene or asset()
    return EditTask("creative", scene, drawn(asset(), [front(SIZE), beside(1.5)]), step or dab(scene, 17), state=state)


def test_pictures_of_the_old_look_count_only_beside_the_edit() -> None:
    this = work()
    mask = this.step.masks[0]
    views = local_views(this, (), views_of_asset(this, 6))
    base, edited = views[0], views[-1]
    assert base.mask is not None and base.mask.shape == (SIZE, SIZE)
    assert not base.mask[mask].any(), "the same camera: no painted pixel keeps its old look"
    assert (base.mask == 1).mean() > 0.6 and base.mask.max() == 1
    assert edited.mask is None and np.array_equal(edited.color, this.step.edited.colors[0])
    assert len(views) == 2 + 6 + round(0.25 * 8 / 0.75), "a quarter of the steps see the edit"
    away = [view for view in views[2:8] if view.camera.position[2] < -1]
    assert away and all(view.mask is None or view.mask.mean() > 0.97 for view in away), "from behind it hardly shows"


def test_close_ups_contradict_the_assets_own_views_only() -> None:
    this = work(dab(asset(), 17, kind="zoom"))
    views = local_views(this, (), views_of_asset(this, 6))
    assert all(view.mask is None for view in views[:2]) and any(view.mask is not None for view in views[2:8])


def test_earlier_edits_stay_but_for_what_a_later_one_covers() -> None:
    scene = asset()
    first, second = dab(scene, 17), dab(scene, 24, np.array([0.9, 0.1, 0.1], np.float32))
    this = work(second, state=(first,))
    views = local_views(this, (first,), None)
    base, earlier = views[0], views[2]
    assert base.mask is not None and not base.mask[first.masks[0] | second.masks[0]].any()
    assert np.array_equal(earlier.color, first.edited.colors[0]) and earlier.mask is not None
    assert not earlier.mask[second.masks[0]].any() and earlier.mask[first.masks[0]].mean() > 0.2


@pytest.mark.parametrize("settings", [Settings(), Settings(8)], ids=["3dgs", "with views of the asset"])
def test_it_edits_and_keeps_the_rest(settings: Settings) -> None:
    this = work()
    before, mask = this.base.colors[0], this.step.masks[0]
    done = edit(settings, this, Budget(steps=120))
    after = render(done.splats, front(SIZE)).colors[0]
    assert db(after, this.step.edited.colors[0], mask) > db(before, this.step.edited.colors[0], mask) + 4
    assert not done.keeps_gaussians and done.numbers["steps"] == 120 and done.curve == ()
    assert done.state == (this.step,) and done.edit_seconds > 0
    novel = beside(-1.0)
    far = share_of(this.asset, novel, reached(this.asset, [this.step])) < 0.01
    far_db = db(render(done.splats, novel).colors[0], render(this.asset, novel).colors[0], far)
    assert far_db > 24


def test_sh_and_opacity_alone_leave_the_geometry_bit_for_bit() -> None:
    scene = asset()
    relit = np.clip(drawn(scene, [front(SIZE)]).colors * [1.2, 0.9, 0.6], 0, 1).astype(np.float32)
    step = EditStep("global", "relight", PosedImages((front(SIZE),), relit), np.ones((1, SIZE, SIZE), bool))
    done = edit(Settings(appearance=True), replace(work(step), protocol="relight"), Budget(steps=40))
    assert done.keeps_gaussians and len(done.splats) == len(scene)
    for name in ("means", "quats", "scales"):
        assert np.array_equal(bits(getattr(done.splats, name)), bits(getattr(scene, name))), name
    old, new = (db(render(splats, front(SIZE)).colors[0], relit[0]) for splats in (scene, done.splats))
    assert new > old + 2
    with pytest.raises(ValueError, match="3dgs-8: views of the asset show it without the edit"):
        edit(Settings(8), work(step), Budget(steps=2))


def test_the_curve_ends_where_the_method_does() -> None:
    done = edit(Settings(), work(), Budget(steps=30, curve=True))
    assert [steps for _, steps, _ in done.curve] == [10, 30]
    seconds = [when for when, _, _ in done.curve]
    assert 0 < seconds[0] < seconds[1] <= done.edit_seconds
    assert np.array_equal(done.curve[-1][2].sh, done.splats.sh)


def test_the_asset_is_not_written_to_and_equal_budgets_give_equal_rows() -> None:
    this = work()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        getattr(this.asset, name).flags.writeable = False
    first, second = (edit(Settings(2), this, Budget(steps=5, seed=3)).splats for _ in range(2))
    assert np.array_equal(first.means, second.means) and np.array_equal(first.sh, second.sh)


def test_the_rows_of_the_tables() -> None:
    rows = {method.name: method for method in METHODS}
    assert list(rows) == ["3dgs", "3dgs-48", "3dgs-colors"]
    assert rows["3dgs-colors"].protocols == ("relight",) and "creative" in rows["3dgs-48"].protocols
    assert len({method.version(Budget()) for method in METHODS}) >= 2
    assert not any(method.sees_truth or method.missing(Budget()) for method in METHODS)
