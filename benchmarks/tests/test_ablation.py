"""The ablation table: its list of samples, its figures, and rows that change one setting of the same weights."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splatbench.cases import Budget, Case, Setup
from splatbench.methods import EditResult, EditTask, ablations, ttt
from splatbench.methods.ablations import AS_TRAINED, Change, altered
from splatbench.methods.lift import painted
from splatbench.tables import ablation as ablate

from splatpainter.lift.options import LocalOptions
from splatpainter.models import weights
from splatpainter.models.image_tokens import tokenize
from splatpainter.models.model import SplatPainterModel
from splatpainter.nn import fast_weights
from splatpainter.nn.fast_weights import FastWeights
from splatpainter.painter import EditSettings, Painter
from splattrain.data.shards import INDEX
from splattrain.judge import judged_samples, refine_task
from splattrain.training_data import DataSettings, ResourceFolders
from tests.support.model_scenes import grid_of, pictures, shell, with_refine
from tests.support.painter_scenes import ASSET_BASE, LIFT, built
from tests.support.train_scenes import LIFT as TRAINED
from tests.support.train_scenes import RECIPE

TABLE = ablate.TABLE
SETUP = Setup(objects=2, size=32, rows=200, base_views=2, novel_views=2, seed=4)
ROWS = {method.name: method for method in ablations.METHODS}


@pytest.fixture(autouse=True)
def few_surfels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ablate, "MIN_SURFELS", 800)


@cache
def made(index: int) -> Case:
    return TABLE.make(TABLE.keys(SETUP)[index], SETUP)


@cache
def first_samples() -> list[Any]:
    """The first two that `train judge` would look at, with this data, seed, mixture and sizes."""
    recipe = ablate._data_settings(SETUP, ResourceFolders()).recipe
    settings = DataSettings(ablate.PROCEDURAL, recipe, SETUP.seed, 0.1, ResourceFolders())
    return [judged.sample for judged in judged_samples(settings, ablate.KIND_WEIGHTS, 2, ablate.RELIT_VIEWS)]


def test_the_list_begins_with_every_part_of_the_mixture() -> None:
    order = [key.settings["kind"] for key in TABLE.keys(replace(SETUP, objects=6))]
    assert len(order) == 12 and order[:3] == ["relight", "stroke", "zoom"]
    assert [key.settings["kind"] for key in TABLE.keys(SETUP)] == order[:4]  # more objects only append
    assert len({key.label for key in TABLE.keys(replace(SETUP, objects=6))}) == 12
    # Of 12 in proportion to shares that add up to 12.5, each kind gets its share to within one.
    assert sum(ablate.KIND_WEIGHTS.values()) == 12.5
    assert all(abs(order.count(kind) - share) < 1 for kind, share in ablate.KIND_WEIGHTS.items())


def test_cases_are_the_samples_that_training_is_judged_on() -> None:
    for index, sample in enumerate(first_samples()):
        case = made(index)
        assert case.name == sample.name and case.steps[0].kind == sample.kind and case.steps[0].mode == sample.mode
        assert np.array_equal(case.asset.means, sample.asset.means)
        assert np.array_equal(case.steps[0].edited.colors, sample.edited.colors.numpy())
        assert np.array_equal(case.steps[0].masks, sample.masks) and np.array_equal(case.near, sample.near)
        assert np.array_equal(case.after.colors, sample.novel_after.colors.numpy())
    assert len(made(0).steps[0].edited) == ablate.RELIT_VIEWS and made(0).facts["mode"] == "global"


def split_lift(task: EditTask) -> EditResult:
    """The lift as networks know it, without sheets."""
    return painted(Painter(settings=EditSettings(local_options=LocalOptions(resurface=False))), "lift", task)


@pytest.mark.parametrize("index", [0, 1])
def test_figures_are_those_of_the_judge(index: int) -> None:
    """Of the asset as it is, and of the lift: train/stages/refine.py measures both beside the network."""
    case, sample = made(index), first_samples()[index]
    torch.manual_seed(0)
    numbers = (
        refine_task(replace(RECIPE, samples=RECIPE.samples), SplatPainterModel(TRAINED), None).judge(sample).numbers
    )
    lifted = split_lift(EditTask("ablate", case.asset, case.base, case.steps[0]))
    for name, splats in (("nothing", case.asset), ("lift", lifted.splats)):
        figures = TABLE.score(case, [EditResult(splats, 0, 0)], None)
        assert figures["psnr"] == pytest.approx(numbers[name], abs=2e-3)
        assert figures["ssim"] == pytest.approx(numbers[f"{name} SSIM"], abs=1e-3)
        assert figures["lpips"] is None


def test_the_sheet_shows_the_view_with_most_of_the_edit() -> None:
    case = made(1)
    tiles = TABLE.pictures(case, [EditResult(case.asset, 0, 0)])
    change = np.abs(case.after.colors - case.before.colors).max(-1) > 0.02
    most = int(np.argmax(np.where(case.near, change.sum((1, 2)), -1)))
    assert list(tiles) == ["result", "truth"]
    np.testing.assert_allclose(tiles["truth"][change[most]], case.after.colors[most][change[most]])


def test_bad_data_is_a_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected procedural:N, or a folder"):
        TABLE.keys(replace(SETUP, data=tmp_path / "nowhere"))
    (tmp_path / INDEX).write_text("{}")
    with pytest.raises(ValueError, match="these are shards"):
        TABLE.keys(replace(SETUP, data=tmp_path))


def test_an_edit_that_no_novel_view_shows_is_no_case(monkeypatch: pytest.MonkeyPatch) -> None:
    sample = first_samples()[1]
    hidden = replace(sample, novel_after=sample.novel_before)
    monkeypatch.setattr(ablate, "_of_kind", lambda stream, kind: {1: hidden})
    with pytest.raises(ValueError, match=r"no novel view shows the edit \(stroke\)"):
        TABLE.make(TABLE.keys(SETUP)[1], SETUP)


def wide_awake(config: Any = LIFT) -> SplatPainterModel:
    """A model whose Stage II says something, as if trained."""
    model = built(config, awake=0.01)
    for name, weight in model.refiner.named_parameters():
        if name.rsplit(".", 1)[-1] not in ("w0", "w1", "w2"):
            torch.nn.init.normal_(weight, std=0.15)
    return model


def adapted(model: SplatPainterModel, **more: Any) -> list[torch.Tensor]:
    """The fast weights after an edit."""
    groups = model.groups(grid_of(shell(), model.config))
    state = model.refiner.adapt(model.initial_state(), tokenize(pictures(), groups, model.config.refine), **more)
    return [w for block in state.blocks for w in block]


def close(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.allclose(x, y, rtol=1e-4, atol=1e-5) for x, y in zip(a, b, strict=True))


@torch.no_grad()
def test_edit_strength_is_the_one_that_a_call_may_ask_for() -> None:
    model = wide_awake()
    for strength in (0.5, 2.0):
        changed = adapted(altered(model, Change({"edit_strength": strength})))
        assert close(changed, adapted(model, strength=strength)) and not close(changed, adapted(model))
    first = [w for block in model.initial_state().blocks for w in block]  # type: ignore[union-attr]
    assert close(adapted(altered(model, Change({"edit_strength": 0.0}))), first)


@torch.no_grad()
def test_five_inner_steps_are_five_updates_from_the_same_tokens() -> None:
    model = wide_awake()
    five = altered(model, Change({"inner_steps": 5}))
    layers: list[Any] = [m.refiner.blocks[0].mixer.ttt for m in (model, five)]  # type: ignore[union-attr]
    tokens = torch.randn(40, model.config.compress.dim, generator=torch.Generator().manual_seed(1))
    state: FastWeights = layers[0].initial_state()
    for _ in range(5):
        state = layers[0].update(state, tokens)
    assert close(list(state), list(layers[1].update(layers[1].initial_state(), tokens)))


@torch.no_grad()
def test_loss_and_orthogonalisation_reach_the_update() -> None:
    """The update written out: a plain step along `ascent`, whose gradients tests/nn/test_fast_weights.py proves."""
    model = altered(wide_awake(), Change({"inner_loss": "dot", "newton_schulz_steps": 0}))
    ttt: Any = model.refiner.blocks[0].mixer.ttt  # type: ignore[union-attr]
    tokens = torch.randn(40, model.config.compress.dim, generator=torch.Generator().manual_seed(1))
    k, v = torch.nn.functional.silu(ttt.kv(tokens)).chunk(2, 1)
    k = k / k.norm(dim=1, keepdim=True)
    rates = torch.nn.functional.softplus(ttt.rates(tokens) + np.log(np.expm1(0.01)))
    start = [w[0] for w in ttt.initial_state()]
    way = fast_weights.ascent(FastWeights(*start), k, v, rates, "dot")
    moved = [w + d for w, d in zip(start, way, strict=True)]
    expected = [w * s.norm(dim=0) / w.norm(dim=0) for w, s in zip(moved, start, strict=True)]
    if torch.allclose(v.norm(dim=1), torch.ones(len(v)), atol=1e-3):
        pytest.fail("values are not to be of unit length")
    assert close(expected, [w[0] for w in ttt.update(ttt.initial_state(), tokens)])


def test_weights_are_shared_and_the_model_stays_as_it_was() -> None:
    model = wide_awake()
    changed = altered(model, Change({"mask_tokens": False}, ("refiner.lift.weight",)))
    original, other = model.state_dict(), changed.state_dict()
    assert original.keys() == other.keys() and not changed.training
    for name, tensor in original.items():
        assert (tensor.data_ptr() == other[name].data_ptr()) == (name != "refiner.lift.weight"), name
    assert not other["refiner.lift.weight"].any() and original["refiner.lift.weight"].any()
    groups = model.groups(grid_of(shell(), model.config))
    tokens = tokenize(pictures(2), groups, changed.config.refine)
    assert len(tokens.pixels) == 2 * (32 // model.config.refine.patch) ** 2  # all of them, edited or not


@torch.no_grad()
def test_zeroed_inputs_have_no_effect() -> None:
    model = wide_awake()
    latents = torch.randn(5, model.config.compress.dim)
    columns = model.state_dict()["refiner.lift.weight"].shape[1]
    features = [torch.rand(5, columns), torch.rand(5, columns)]
    drifts = [torch.rand(5, 7), torch.rand(5, 7)]
    deaf = altered(model, Change(zeroed=("refiner.lift.weight",)))
    heard = [m.refiner.prepare(latents, f, drifts[0]) for m in (model, deaf) for f in features]
    assert not torch.equal(heard[0], heard[1]) and torch.equal(heard[2], heard[3])
    still = altered(model, Change(zeroed=("refiner.drift.weight",)))
    heard = [m.refiner.prepare(latents, features[0], d) for m in (model, still) for d in drifts]
    assert not torch.equal(heard[0], heard[1]) and torch.equal(heard[2], heard[3])


def test_rows_that_teach_can_be_left_out_and_sizes_cannot_change() -> None:
    model = wide_awake(with_refine(LIFT, row_tokens=64))
    changed = altered(model, Change({"row_tokens": 0}))
    assert changed.state_dict().keys() < model.state_dict().keys() and changed.config.refine.row_tokens == 0
    with pytest.raises(ValueError, match="as this setting needs it; train with it"):
        altered(model, Change({"fast_hidden": 16}))
    with pytest.raises(ValueError, match="train with it"):
        altered(changed, Change({"row_tokens": 64}))


def test_a_setting_that_is_the_weights_own_is_not_run_twice(tmp_path: Path) -> None:
    built(LIFT).save(tmp_path / "lift")
    built(ASSET_BASE).save(tmp_path / "own")
    repeated = {
        name: {m.name for m in ablations.METHODS if m.missing(Budget(weights={"compact": str(tmp_path / name)}))}
        for name in ("lift", "own")
    }
    usual = {"same-inner-steps-1", "same-inner-l2", "same-newton-schulz-5", "same-strength-1", "same-no-row-tokens"}
    usual |= {"same-no-predictor", "same-no-detail"}
    assert repeated["lift"] == usual and repeated["own"] == usual - {"same-no-detail"} | {"same-no-drift"}
    budget = Budget(weights={"compact": str(tmp_path / "lift")})
    assert ROWS["same-strength-1"].missing(budget) == AS_TRAINED
    versions = {m.version(budget) for m in ablations.METHODS}
    assert len(versions) == len(ablations.METHODS)
    assert ROWS["same-strength-2"].missing(Budget(weights={"compact": str(tmp_path)})).startswith("no weights: ")
    # Of the shipped weights Stage II makes none of the edits; of preset "rows" all global ones.
    runs = {
        preset: {m.name for m in ablations.METHODS if not m.missing(Budget(weights={"compact": str(folder)}))}
        for preset in ("compact", "rows")
        if (folder := weights.find(preset))
    }
    assert (
        runs["compact"] == {"same-no-predictor", "same-as-trained"}
        and {"same-strength-0", "same-inner-steps-5"} < runs["rows"]
    )


def test_a_row_runs_end_to_end_and_differs_from_the_weights_own_settings(tmp_path: Path) -> None:
    wide_awake().save(tmp_path, dtype="float32")
    budget, case = Budget(weights={"compact": str(tmp_path)}), made(0)
    task = EditTask("ablate", case.asset, case.base, case.steps[0])
    plain, still = ttt.METHODS[0].edit(task, budget), ROWS["same-strength-0"].edit(task, budget)
    assert not np.array_equal(plain.splats.means, still.splats.means) and still.keeps_gaussians
    assert len(still.splats) == len(plain.splats)


def test_every_name_is_there_once_and_in_the_table() -> None:
    assert len(ROWS) == len(ablations.METHODS)
    assert all(method.protocols == ("ablate",) for method in ablations.METHODS)
