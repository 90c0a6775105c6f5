"""Losses, optimiser, recipes, tables and data of training, each against numbers written out here."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatpainter.metrics import psnr
from splatpainter.models.config import PAPER, PRESETS
from splattrain import recipes
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.samples import SampleStream
from splattrain.loss import (
    PictureLoss,
    PictureTarget,
    global_target,
    local_target,
    masked_psnr,
    perceptual_or_not,
    scattered_depth,
    weighted_square,
)
from splattrain.optim import Average, Guard, adamw, decays, rate_at
from splattrain.prefetch import PrefetchedSamples, packed, unpacked
from splattrain.report import StepTable
from splattrain.training_data import DataSettings, Lanes, ResourceFolders, open_training_data
from tests.support.train_scenes import RECIPE, SAMPLES, stream


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random(shape, np.float32))


def test_a_local_target_is_the_truth_where_it_was_edited_and_the_asset_elsewhere() -> None:
    before = noise(2, 20, 20, 3)
    after = before.clone()
    after[0, 5:9, 5:9] = 1 - after[0, 5:9, 5:9].round()
    drawn = noise(2, 20, 20, 3, seed=1)
    target = local_target(after, before, drawn, keep=0.25)
    inside = torch.zeros(2, 20, 20, dtype=torch.bool)
    inside[0, 4:10, 4:10] = True  # with one pixel around
    assert torch.equal(target.focus, inside)
    assert torch.equal(target.colors, torch.where(inside[..., None], after, drawn))
    # 36 of 800 pixels; per view 18: an edited pixel counts 1 / 18.
    np.testing.assert_allclose(target.weights[inside].numpy(), 1 / 18, rtol=1e-6)
    np.testing.assert_allclose(target.weights[~inside].numpy(), 0.25 / 18, rtol=1e-6)
    rendered = noise(2, 20, 20, 3, seed=2)
    d = (rendered.double() - target.colors.double()) ** 2
    by_hand = (d[inside].mean(-1).sum() + 0.25 * d[~inside].mean(-1).sum()) / 18 / 2
    assert math.isclose(float(weighted_square(rendered, target)), float(by_hand), rel_tol=1e-5)


def test_a_global_target_counts_all_pixels_over_the_objects_area() -> None:
    truth, covered = noise(2, 8, 8, 3), torch.zeros(2, 8, 8, dtype=torch.bool)
    covered[:, 2:6, 2:6] = True
    target = global_target(truth, covered)
    rendered = noise(2, 8, 8, 3, seed=1)
    by_hand = float(((rendered - truth) ** 2).mean()) * 64 / 16
    assert math.isclose(float(weighted_square(rendered, target)), by_hand, rel_tol=1e-5)
    measured = masked_psnr(rendered, target)
    assert measured is not None
    a, b, m = (x.reshape(16, 8, *x.shape[3:]).numpy() for x in (rendered, truth, covered))
    assert math.isclose(measured, psnr(a, b, m), abs_tol=1e-4)
    assert masked_psnr(rendered, PictureTarget(truth, target.weights, torch.zeros_like(covered))) is None


def test_the_perceptual_term_is_dropped_with_one_line(tmp_path: Path) -> None:
    loss, why = perceptual_or_not(0.5, tmp_path)
    assert loss.network is None and why and "perceptual term is dropped" in why and "\n" not in why
    target = global_target(noise(1, 40, 40, 3), torch.ones(1, 40, 40, dtype=torch.bool))
    parts = loss(noise(1, 40, 40, 3, seed=3), target)
    assert set(parts) == {"squared", "loss"}


def test_in_decibels_samples_count_by_their_ratio() -> None:
    target = global_target(noise(1, 8, 8, 3), torch.ones(1, 8, 8, dtype=torch.bool))
    gradients = []
    for error in (0.3, 0.15):  # far above what counts as nothing
        rendered = (target.colors + error).requires_grad_()
        parts = PictureLoss(None, 0.0, decibels=True)(rendered, target)
        assert math.isclose(float(parts["loss"].detach()), math.log(error**2 + 2e-4), rel_tol=1e-4)
        parts["loss"].backward()
        assert rendered.grad is not None
        gradients.append(float((rendered.grad * error).sum()))
    assert math.isclose(*gradients, rel_tol=0.01) and math.isclose(gradients[0], 2, rel_tol=0.01)


def test_the_perceptual_term_is_lpips_of_the_chosen_views(shared: Path) -> None:
    loss = PictureLoss.load(0.5, shared / "perceptual")
    assert loss.network is not None
    target = global_target(noise(2, 40, 40, 3), torch.ones(2, 40, 40, dtype=torch.bool))
    rendered = noise(2, 40, 40, 3, seed=3).requires_grad_()
    parts = loss(rendered, target, [1])
    a, b = (x[1:].permute(0, 3, 1, 2) for x in (rendered.detach(), target.colors))
    # All pixels weigh alike here, so that the mask means nothing.
    assert math.isclose(float(parts["perceptual"].detach()), float(loss.network(a, b).mean()), rel_tol=1e-4)
    total = float(parts["squared"].detach()) + 0.5 * float(parts["perceptual"].detach())
    assert math.isclose(float(parts["loss"].detach()), total, rel_tol=1e-6)
    parts["perceptual"].backward()
    assert rendered.grad is not None
    assert float(rendered.grad[1].abs().max()) > 0 and float(rendered.grad[0].abs().max()) == 0


def test_scattered_depths_are_at_rest_with_the_wanted_spread() -> None:
    depths = torch.from_numpy(np.random.default_rng(0).normal(3, 0.5, (2, 400)).astype(np.float32))
    depths = (depths - depths.mean(1, keepdim=True)) / depths.std(1, keepdim=True) * 0.5
    assert float(scattered_depth(depths.flatten(), 2)) < 1e-10
    assert float(scattered_depth(2 * depths.flatten(), 2)) > 0.2


def test_the_rate_rises_and_falls() -> None:
    rates = [rate_at(step, 1.0, 4, 104, 0.1) for step in range(110)]
    assert rates[:4] == [0.25, 0.5, 0.75, 1.0] and rates[4] == 1.0
    assert math.isclose(rates[54], 0.1 + 0.9 * 0.5) and math.isclose(rates[104], 0.1) and rates[109] == rates[104]


def test_norms_biases_and_fast_weights_do_not_decay() -> None:
    module = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.LayerNorm(4))
    assert [n for n, p in module.named_parameters() if decays(n, p)] == ["0.weight"]
    assert not decays("blocks.0.mixer.ttt.w1", torch.zeros(1, 4, 4))
    module[1].requires_grad_(False)
    groups = adamw(module.named_parameters(), 1e-3, 0.05).param_groups
    assert [(g["weight_decay"], len(g["params"]), g["betas"]) for g in groups] == [
        (0.05, 1, (0.9, 0.95)),
        (0.0, 1, (0.9, 0.95)),
    ]


def test_the_guard_refuses_what_is_not_finite_and_spikes() -> None:
    guard = Guard(spike=5.0)
    assert [guard.admit(1.0) for _ in range(25)] == [""] * 25
    assert guard.admit(float("nan")) == "not finite" and guard.admit(float("inf")) == "not finite"
    assert guard.admit(6.0) == "spike" and guard.admit(4.0) == ""
    assert (guard.seen, guard.skipped) == (26, 3)
    for _ in range(60):  # a level that has really risen is accepted
        guard.admit(50.0)
    assert guard.admit(50.0) == ""
    assert Guard(spike=0.0, typical=1.0, seen=99).admit(1e9) == ""


def test_the_average_is_a_running_mean_and_returns_what_it_borrowed() -> None:
    module = torch.nn.Linear(2, 1, bias=False)
    average = Average.of(module.named_parameters(), 0.9)
    expected = module.weight.detach().double().clone()
    for step in range(30):
        with torch.no_grad():
            module.weight.add_(0.1)
        average.update(module.named_parameters(), step)
        share = min(0.9, (1 + step) / (10 + step))
        expected = share * expected + (1 - share) * module.weight.detach().double()
    torch.testing.assert_close(average.values["weight"].double(), expected, rtol=1e-5, atol=1e-6)
    weights = module.weight.detach().clone()
    with average.used_by(module):
        assert torch.equal(module.weight, average.values["weight"]) and not torch.equal(module.weight, weights)
    assert torch.equal(module.weight, weights)


def test_every_recipe_in_the_package_loads_and_survives_json() -> None:
    assert {"compact", "paper"} <= set(recipes.names())
    for path in recipes.FOLDER.glob("*.json"):
        name, stage = path.stem.rsplit("-", 1)
        recipe = recipes.load(name, stage)  # type: ignore[arg-type]
        assert recipe.stage == stage and recipes.parse(recipe.to_json(), recipe.stage) == recipe
    paper = recipes.load("paper", "refine")
    assert (paper.steps, paper.learning_rate, paper.perceptual) == (200_000, 4e-5, 0.5)
    assert paper.model.compress == replace(PAPER.compress, checkpoint_activations=True)
    assert recipes.load("paper", "compress").steps == 80_000
    assert recipes.load("compact", "refine").model.refine.base == "lift"
    models = [recipes.load("compact", stage).model for stage in recipes.STAGES if stage not in recipes.DISTRIBUTIONS]
    assert models[0] == models[1] == models[2] and models[0].compress == PRESETS["compact"].compress


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "recipe is not JSON"),
        ("[]", "expected an object as recipe, found list"),
        ('{"stepz": 1}', "unknown key 'stepz'"),
        ('{"steps": "many"}', "expected int as 'steps', got 'many'"),
        ('{"steps": true}', "expected int as 'steps', got True"),
        ('{"steps": 0}', "expected steps of at least 1, got 0"),
        ('{"model": {"refine": {"blokcs": 2}}}', "unknown key 'model.refine.blokcs'"),
        ('{"model": 3}', "expected an object as 'model', got 3"),
        ('{"samples": {"kinds": {"strike": 1}}}', "expected kinds of"),
        ('{"samples": {"views": 1}}', "expected a list as 'samples.views'"),
        ('{"train_encoder": "some"}', "expected one of nothing, compress, all as 'train_encoder'"),
        ('{"stage": "lrm"}', "recipe of stage 'lrm', not of 'refine'"),
    ],
)
def test_a_wrong_recipe_is_one_line(text: str, message: str) -> None:
    with pytest.raises(ValueError, match="my.json: ") as caught:
        recipes.parse(text, "refine", "my.json")
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_table_keeps_what_was_done_and_grows_columns(tmp_path: Path) -> None:
    table = StepTable(tmp_path / "log.csv", 0)
    table.add(1, {"loss": 0.1 + 0.2})
    table.add(2, {"loss": 1.0, "other": None})
    table.add(3, {"loss": 2.0, "other": 5})
    again = StepTable(tmp_path / "log.csv", 2)
    again.add(3, {"other": 7})
    with open(tmp_path / "log.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["step"] for row in rows] == ["1", "2", "3"]
    assert float(rows[0]["loss"]) == 0.1 + 0.2 and rows[0]["other"] == rows[2]["loss"] == "" and rows[2]["other"] == "7"


def test_validation_objects_are_never_trained_on(tmp_path: Path) -> None:
    from splattrain.data.shards import INDEX

    folder = tmp_path / "meshes"
    folder.mkdir()
    for i in range(40):
        (folder / f"m{i}.obj").write_text("v 0 0 0\n")
    settings = DataSettings(str(folder), SAMPLES, 0, 0.2, ResourceFolders())
    train, held = settings.stream(), settings.stream(validation=True)
    names = [{s.source.name(i) for i in range(len(s.source))} for s in (train, held)]
    assert not names[0] & names[1] and len(names[0] | names[1]) == 40 and 2 <= len(names[1]) <= 16
    assert settings.counts() == (len(names[0]), len(names[1]))
    other = replace(settings, seed=9).stream()
    assert {other.source.name(i) for i in range(len(other.source))} == names[0]
    procedural = replace(settings, data="procedural:5")
    seeds = {s.source.seed for s in (procedural.stream(), procedural.stream(validation=True))}
    assert len(seeds) == 2 and not (tmp_path / INDEX).exists()
    for wrong, message in (
        ("procedural:0", "procedural:N"),
        (str(tmp_path / "no"), "expected procedural:N, or a folder"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(settings, data=wrong).stream()
    with pytest.raises(ValueError, match="no such folder"):
        replace(settings, resources=ResourceFolders(fonts=tmp_path / "fonts")).stream()


def test_validation_samples_are_fixed_and_lanes_are_the_stream() -> None:
    settings = DataSettings("procedural:2", replace(SAMPLES, surfels=800), 4, 0.1, ResourceFolders())
    one, two = (open_training_data(settings, batch=2, count=2) for _ in range(2))
    assert [s.name for s in one.validation] == [s.name for s in two.validation]
    assert all(
        torch.equal(a.edited.colors, b.edited.colors) for a, b in zip(one.validation, two.validation, strict=True)
    )
    plain = SampleStream(ProceduralSource(2, 4), settings.recipe, 4)
    lanes = Lanes(settings, 2)
    for i in (0, 2, 1, 5):
        assert torch.equal(lanes[i].novel_after.colors, plain[i].novel_after.colors)


class Numbers:
    """A stream for the workers: fails at 5."""

    def __getitem__(self, i: int) -> Any:
        if i == 5:
            raise ValueError("five is broken")
        return replace(stream()[0], name=f"number {i}")


def test_samples_made_ahead_are_the_same_in_the_same_order() -> None:
    ahead, threads = PrefetchedSamples(partial(Numbers), 1, 2), torch.get_num_threads()
    torch.set_num_threads(1)  # as its workers do, and made anew: sums by two have other bits
    try:
        order = [0, 2, 1, 3]
        ahead.expect(iter([*order, 5, 8]))
        assert [ahead[i].name for i in order] == [f"number {i}" for i in order]
        with pytest.raises(ValueError, match="five is broken"):
            _ = ahead[5]
        assert ahead[40].name == "number 40"  # not announced
        assert torch.equal(ahead[8].novel_after.colors, stream.__wrapped__()[0].novel_after.colors)
    finally:
        torch.set_num_threads(threads)
        ahead.close()


def test_packing_loses_nothing() -> None:
    sample = stream()[0]
    again = unpacked(packed(sample))
    assert isinstance(packed(sample).edited.colors, np.ndarray)
    assert torch.equal(again.edited.colors, sample.edited.colors) and again.asset is sample.asset
    assert dataclasses.fields(again) == dataclasses.fields(sample)


def test_the_recipe_of_the_tests_is_as_plain_as_json() -> None:
    assert json.loads(RECIPE.to_json()) == RECIPE.to_dict()
