"""Assets whose Gaussians know their materials, and edits of them without pictures."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpainter.splats import SH_C0
from splatpainter.transforms import quat_to_matrix
from splattrain.data import gaussian_edits, lit_assets
from splattrain.data.gaussian_edits import GaussianEditStream
from splattrain.data.lit_assets import LitAsset, LitAssets, base_colors, turned
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.sample_recipes import SampleRecipe
from splattrain.data.viewpoints import UP_AXIS_ROTATIONS
from tests.lift.test_global import ball

SAMPLES = SampleRecipe(size=32, rows=200, surfels=2000)
KINDS = {"relight": 1.0, "recolor": 1.0, "regrade": 1.0}


@pytest.fixture(autouse=True, scope="module")
def small() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lit_assets, "FIT_STEPS", 6)
        patch.setattr(gaussian_edits, "LIGHT_COUNT", 6)
        yield


@cache
def assets() -> LitAssets:
    return LitAssets(ProceduralSource(2, seed=3), SAMPLES)


@cache
def stream() -> GaussianEditStream:
    return GaussianEditStream(assets(), KINDS, samples_per_object=2)


def same(one: LitAsset, other: LitAsset) -> bool:
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("normals", "transfer", "visible_px", "residual")]
    pairs += [(getattr(one.asset, name), getattr(other.asset, name)) for name in ("means", "quats", "sh", "opacities")]
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize("kind", ["coarse", "fitted"])
def test_an_asset_has_the_colours_of_its_materials_under_its_light(kind: lit_assets.AssetKind) -> None:
    item = assets()[0, kind]
    colors = item.colors(item.surfels, item.coefficients, item.exposure)
    np.testing.assert_allclose(colors, 0.5 + SH_C0 * item.asset.sh[:, 0], atol=1e-5)
    assert item.residual.any() == (kind == "fitted") and 100 < len(item.asset) <= 200
    np.testing.assert_allclose(np.linalg.norm(item.normals, axis=1), 1, atol=1e-3)
    assert item.visible_px.shape == (3, 4, len(item.asset)) and (item.visible_px >= 0).all()
    assert item.asset.drawable.all() and item.transfer.shape == (len(item.asset), 10)


def test_assets_are_made_once_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = LitAssets(ProceduralSource(2, seed=3), SAMPLES, folder=tmp_path)
    assert not first.has(1, "coarse")
    made = first[1, "coarse"]
    assert first.has(1, "coarse") and same(made, LitAssets(ProceduralSource(2, seed=3), SAMPLES)[1, "coarse"])
    monkeypatch.setattr(LitAssets, "_make", lambda *_: pytest.fail("made again"))
    again = LitAssets(ProceduralSource(2, seed=3), SAMPLES, folder=tmp_path)[1, "coarse"]
    assert same(made, again) and torch.equal(again.exposure, made.exposure)
    monkeypatch.undo()
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:400])  # damaged: made anew
    assert same(made, LitAssets(ProceduralSource(2, seed=3), SAMPLES, folder=tmp_path)[1, "coarse"])


def test_turning_an_asset_turns_its_shapes() -> None:
    splats, turn = ball(20), np.array(UP_AXIS_ROTATIONS[2])
    after = turned(splats, turn)
    shapes = [quat_to_matrix(s.quats) @ (s.scales[:, :, None] ** 2 * np.eye(3)) for s in (splats, after)]
    covariances = [a @ quat_to_matrix(s.quats).transpose(0, 2, 1) for a, s in zip(shapes, (splats, after), strict=True)]
    np.testing.assert_allclose(covariances[1], turn @ covariances[0] @ turn.T, atol=1e-7)
    np.testing.assert_allclose(after.means, splats.means @ turn.T, atol=1e-6)


def test_edits_are_the_same_in_any_order() -> None:
    made = [stream()[i] for i in range(12)]
    again = GaussianEditStream(assets(), KINDS, samples_per_object=2)
    for i in (7, 3, 11):
        edit = again[i]
        assert (edit.name, edit.kind, edit.views) == (made[i].name, made[i].kind, made[i].views)
        np.testing.assert_array_equal(edit.change, made[i].change)
    assert {edit.kind for edit in made} == set(KINDS) and {edit.item.kind for edit in made} == {"coarse", "fitted"}
    assert len({(edit.name, edit.item.kind) for edit in made}) == 4
    for edit in made:
        after = edit.colors + edit.change
        assert after.min() >= -1e-6 and after.max() <= 1 + 1e-6 and np.abs(edit.change).max() > 0.01
        assert edit.seen.any() and (edit.counts >= edit.weight - 1e-3).all()


def test_more_views_show_more() -> None:
    item, rng = assets()[0, "coarse"], np.random.default_rng
    one, two, four = (stream().edit(item, "relight", views, rng(4)) for views in (1, 2, 4))
    assert (one.seen <= two.seen).all() and (two.seen <= four.seen).all() and one.seen.sum() < four.seen.sum()
    np.testing.assert_array_equal(one.change, four.change)


def test_a_relighting_is_the_shading_under_another_light_and_a_recolouring_leaves_other_materials() -> None:
    item = assets()[0, "coarse"]
    edit = stream().edit(item, "relight", 1, np.random.default_rng(0))
    coefficients, exposures = stream()._lights
    lit = [
        np.clip(base_colors(item.surfels, c, e), 0, 1) - edit.colors
        for c, e in zip(coefficients, exposures, strict=True)
    ]
    assert min(float(np.abs(change - edit.change).max()) for change in lit) < 1e-5
    edit = stream().edit(item, "recolor", 1, np.random.default_rng(0))
    still = np.abs(edit.change).max(1) < 0.02
    assert 0.02 < still.mean() < 0.98 or not still.any()


def test_what_makes_no_sense_is_one_line() -> None:
    with pytest.raises(ValueError, match="expected kinds of relight, recolor, regrade"):
        GaussianEditStream(assets(), {"stroke": 1.0})
    with pytest.raises(IndexError):
        stream()[-1]
