"""The row of feed-forward densification: where it finds weights, what it replaces, and what it says without them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from splatbench.cases import Budget, EditStep, PosedImages
from splatbench.densification.densifier import Densifier
from splatbench.densification.densify_config import COMPACT
from splatbench.methods import EditTask, genden

from splatpainter.cameras import Camera, orbit
from splatpainter.metrics import psnr
from splatpainter.models.model import SplatPainterModel
from splatpainter.rendering import render
from splatpainter.splats import ATTRIBUTES, Splats
from tests.support.model_scenes import TINY

SMALL = replace(COMPACT, most=40, widths=(16, 24), heads=2, window=16, frequencies=2)
ROW = genden.METHODS[0]


def wall(count: int = 12) -> Splats:
    """Grey Gaussians on a square, facing the cameras below."""
    u, v = np.meshgrid(*[np.linspace(-1, 1, count)] * 2)
    means = np.stack([u, v, 0 * u], -1).reshape(-1, 3)
    size = np.tile(np.array([0.1, 0.1, 0.02]), (len(means), 1))
    quats = np.tile([1.0, 0, 0, 0], (len(means), 1))
    means, size, quats = (np.ascontiguousarray(x, np.float32) for x in (means, size, quats))
    return Splats(means, quats, size, np.full(len(means), 0.8, np.float32), np.zeros((len(means), 4, 3), np.float32))


def cameras(count: int, size: int = 40) -> tuple[Camera, ...]:
    ring = orbit((0, 0, 0), 4.0, 4 * count, width=size, height=size)
    near = sorted(ring, key=lambda camera: -abs(camera.forward[2]))
    return tuple(near[:count])


def half_dark(splats: Splats, views: tuple[Camera, ...], left: bool) -> PosedImages:
    """The wall's renders with Gaussians of one half much darker."""
    dark = splats.sh.copy()
    dark[splats.means[:, 0] < 0 if left else splats.means[:, 0] >= 0, 0] = -1.2
    return pictures(replace(splats, sh=dark), views)


def pictures(splats: Splats, views: tuple[Camera, ...]) -> PosedImages:
    return PosedImages(views, render(splats, list(views)).colors.clip(0, 1).astype(np.float32))


def step(edited: PosedImages) -> EditStep:
    return EditStep("local", "zoom", edited, np.ones(edited.colors.shape[:3], bool))


def work(left: bool = True) -> EditTask:
    asset = wall()
    return EditTask("refine", asset, pictures(asset, cameras(3)), step(half_dark(asset, cameras(1, 56), left)))


@pytest.fixture
def budget(tmp_path: Path) -> Budget:
    torch.manual_seed(0)
    Densifier(SMALL).save(tmp_path / "w", {"step": 7})
    return Budget(weights={"genden": str(tmp_path / "w")})


def test_gaussians_that_the_edit_changes_are_replaced_and_the_others_stay(budget: Budget) -> None:
    task = work()
    done = ROW.edit(task, budget)
    asset, out = task.asset, done.splats
    # 40 rows: 8 stay whole, 64 children of which 12 stay whole (52 go on), 208 grandchildren.
    assert done.numbers == {"rows": 144 - 40 + 228, "rows_replaced": 40, "rows_generated": 228}
    assert not done.keeps_gaussians and done.setup_seconds == 0 and done.edit_seconds > 0
    assert done.note == "4 views; 40 of 144 Gaussians replaced by 228; 7 training steps"
    survivors = out.take(np.arange(104))
    means = {tuple(mean) for mean in asset.means.tolist()}
    assert {tuple(mean) for mean in survivors.means.tolist()} < means
    # Only the half that the close-up shows darker is pulled at: whatever went is on the left, or at its border.
    removed = np.array(sorted(means - {tuple(mean) for mean in survivors.means.tolist()}))
    assert len(removed) == 40 and removed[:, 0].max() < 0.3
    assert all(np.isfinite(getattr(out, name)).all() for name in ATTRIBUTES)
    before, after = (render(s, list(task.base.cameras)).colors.astype(np.float64).clip(0, 1) for s in (asset, out))
    assert psnr(after[0], before[0]) > 25  # untrained: near the asset


def test_a_second_step_knows_the_first_and_starts_from_the_same_asset(budget: Budget) -> None:
    first = ROW.edit(work(), budget)
    right = half_dark(wall(), cameras(1, 56), left=False)
    second = ROW.edit(EditTask("refine", first.splats, work().base, step(right), state=first.state), budget)
    both = PosedImages(
        work().step.edited.cameras + right.cameras, np.concatenate([work().step.edited.colors, right.colors])
    )
    at_once = ROW.edit(replace(work(), step=step(both)), budget)
    assert second.note.startswith("5 views; 40 of 144 Gaussians")
    for name in ATTRIBUTES:
        assert np.array_equal(getattr(second.splats, name), getattr(at_once.splats, name))


def test_without_weights_it_says_how_to_get_them(
    budget: Budget, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ROW.missing(budget) == "" and ROW.name == "genden" and ROW.protocols == ("refine",)
    monkeypatch.setattr("splatbench.methods.weights.BENCH_WEIGHTS", tmp_path / "none")
    monkeypatch.delenv("SPLATPAINTER_WEIGHTS", raising=False)
    line = ROW.missing(Budget())
    assert line.startswith("no weights: train with `splatpainter train densify") and "--weights genden=" in line
    assert ROW.version(Budget()) == "1-none"
    with pytest.raises(ValueError, match="no weights: train with"):
        ROW.edit(work(), Budget())
    SplatPainterModel(TINY).save(tmp_path / "other")
    wrong = Budget(weights={"genden": str(tmp_path / "other")})
    assert "expected format 'splatpainter densifier', got 'splatpainter model'" in ROW.missing(wrong)
    empty = ROW.missing(Budget(weights={"genden": str(tmp_path / "nowhere")}))
    assert "expected a folder with model.json" in empty and str(tmp_path) not in empty


def test_other_weights_are_another_version(budget: Budget, tmp_path: Path) -> None:
    before = ROW.version(budget)
    assert ROW.version(budget) == before
    torch.manual_seed(1)
    Densifier(SMALL).save(tmp_path / "w")
    assert ROW.version(budget) != before


def test_packaged_weights_are_of_a_densifier() -> None:
    assert ROW.missing(Budget()) == ""
    done = ROW.edit(work(), Budget())
    assert done.numbers["rows_generated"] > done.numbers["rows_replaced"] > 16
    assert all(np.isfinite(getattr(done.splats, name)).all() for name in ATTRIBUTES)
