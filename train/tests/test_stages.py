"""The stages: what they train, what untrained ones say, and that they learn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from splatpainter.models.config import ModelConfig
from splatpainter.models.encode import encode_asset
from splatpainter.nn.precision import autocast
from splatpainter.rendering import render
from splatpainter.splats import SH_C0
from splatpainter.voxels.grid import voxelize
from splattrain.build import make_task
from splattrain.data.lit_scenes import PosedViews
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.samples import Sample, SampleRecipe, SampleStream
from splattrain.recipes import Recipe
from splattrain.stages.refine import RefineTask, holding
from splattrain.stages.task import Task
from tests.support.model_scenes import with_compress
from tests.support.train_scenes import LIFT, RECIPE, SAMPLES, SMALL, FixedSamples, loop, model, stream

PLAIN = SampleRecipe({"plain": 1.0}, size=32, rows=200, surfels=2000, base_views=2, novel_views=2, steps_per_object=1)
COPY = replace(SMALL, representation="copy", lrm=replace(SMALL.lrm, geometry=False), preset="tiny-copy")
"""The paper's way: geometry is guessed from pictures, and the LRM's Gaussians are thinned out."""


def samples_of(kind: str, count: int = 1) -> list[Sample]:
    samples = [stream()[i] for i in range(12) if stream()[i].kind == kind]
    return samples[:count]


def task_of(recipe: Recipe, config: ModelConfig | None = None) -> Any:
    return make_task(recipe, model(config or recipe.model), None, lambda line: None)


def trained(task: Task) -> set[str]:
    return {name.split(".")[1] for name, p in task.named_parameters() if p.requires_grad}


def gradients(task: Task, sample: Sample, seed: int = 0) -> dict[str, torch.Tensor]:
    task.zero_grad()
    task.train()
    task(sample, seed)["loss"].backward()
    assert not task.problem
    return {name: p.grad.clone() for name, p in task.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("kind", ["stroke", "regrade"])
def test_untrained_refinement_is_the_lift(kind: str, precision: str) -> None:
    score = task_of(RECIPE).eval().judge(samples_of(kind)[0])
    assert score.numbers["gain"] == 0 and score.numbers["ours"] == score.numbers["lift"]
    assert score.numbers["lift"] != score.numbers["nothing"]
    assert [label.split()[0] for label, _ in score.strip] == ["edited", "nothing", "lift", "ours", "truth"]


@pytest.mark.parametrize("kind", ["stroke", "regrade"])
def test_validation_says_what_adaptation_is_worth(kind: str) -> None:
    task = task_of(RECIPE)
    fixed = task.eval().judge(samples_of(kind)[0]).numbers
    assert fixed["adapts"] == 0 and fixed["strength 0"] == fixed["another edit"] == fixed["ours"]
    torch.nn.init.normal_(task.model.head.linear.weight, std=0.1)
    awake = task.judge(samples_of(kind)[0]).numbers
    assert awake["adapts"] == awake["ours"] - awake["strength 0"] != 0
    assert awake["another edit"] not in (awake["ours"], awake["strength 0"])


@pytest.mark.parametrize("kind", ["stroke", "regrade"])
def test_untrained_refinement_on_own_gaussians_is_nothing(kind: str) -> None:
    score = task_of(RECIPE, SMALL).eval().judge(samples_of(kind)[0])
    assert score.numbers["ours"] == score.numbers["nothing"] != score.numbers["lift"]


def test_refinement_trains_stage_two_and_the_head_alone(precision: str) -> None:
    task = task_of(RECIPE)
    assert trained(task) == {"refiner", "head"}
    for kind in ("stroke", "regrade"):
        gradient = gradients(task, samples_of(kind)[0])
        assert float(gradient["model.head.linear.weight"].abs().max()) > 0
    # Behind the head, which is zero at first, gradients arrive as soon as it is not.
    torch.nn.init.normal_(task.model.head.linear.weight, std=0.01)
    gradient = gradients(task, samples_of("regrade")[0])
    assert all(float(gradient[f"model.refiner.blocks.0.mixer.ttt.{w}"].abs().max()) > 0 for w in ("w0", "w1", "w2"))
    wide = task_of(replace(RECIPE, train_encoder="compress"))
    assert trained(wide) == {"refiner", "head", "compressor"}
    torch.nn.init.normal_(wide.model.head.linear.weight, std=0.01)
    gradient = gradients(wide, samples_of("stroke")[0])
    assert float(gradient["model.compressor.attribute.weight"].abs().max()) > 0


def test_all_gaussians_or_some_have_the_same_picture_and_on_average_the_same_gradient() -> None:
    sample, name = samples_of("regrade")[0], "model.head.linear.weight"
    every = replace(RECIPE, gradient_rows=0, loss_views=2, sequence=0.0)
    some = replace(every, gradient_rows=60)
    torch.manual_seed(1)
    head = 0.02 * torch.randn_like(model().head.linear.weight)
    gradient, losses = {}, {}
    for key, recipe, seeds in (("every", every, [5]), ("some", some, [5])):
        task = task_of(recipe)
        with torch.no_grad():
            task.model.head.linear.weight.copy_(head)
        gradient[key] = torch.stack([gradients(task, sample, seed)[name] for seed in seeds]).mean(0)
        losses[key] = [float(task(sample, seed)["loss"].detach()) for seed in seeds]
    np.testing.assert_allclose(losses["some"], losses["every"], rtol=1e-5)
    # Averaged over choices of the Gaussians, with all else equal: only those choices are random here.
    task, total = task_of(some), torch.zeros_like(head)
    with torch.no_grad():
        task.model.head.linear.weight.copy_(head)
    prepared = task._remembered(sample)
    views = task._edits(sample, prepared)
    start = task._start(sample, prepared, views)
    cameras, target = task._target(sample, prepared, views, np.random.default_rng(5))
    start = task._visible(start, cameras)
    for seed in range(24):
        from splattrain.stages.task import draw

        task.zero_grad()
        edited = task._refined(prepared, start, views, 0, np.random.default_rng(100 + seed))
        task.loss(draw(edited, cameras, task.device)[0], target)["loss"].backward()
        total += task.model.head.linear.weight.grad / 24
    share = float((total * gradient["every"]).sum() / (gradient["every"] ** 2).sum())
    cosine = float((total * gradient["every"]).sum() / total.norm() / gradient["every"].norm())
    assert 0.85 < share < 1.15 and cosine > 0.95


def test_a_part_of_the_voxels_has_the_latents_of_the_whole(precision: str) -> None:
    asset, net = samples_of("stroke")[0].asset, model()
    grid = voxelize(asset, net.config.compress.resolution)
    with autocast("cpu", precision):
        complete = encode_asset(net, asset, grid)
    task = task_of(replace(RECIPE, train_encoder="compress"))
    ids = np.array([3, 50, 51, 120])
    with task.arithmetic():
        part = task._encoded(task._prepare(asset), ids)
    with torch.no_grad():
        same = complete.latents.values[complete.latent_ids[ids]]
    assert len(part.latents.groups) < len(complete.latents.groups)
    torch.testing.assert_close(part.latents.values[part.latent_ids[ids]], same, rtol=1e-4, atol=1e-5)
    groups = holding(net.groups(grid), ids, len(asset))
    assert set(ids) <= set(groups.order.tolist()) and groups.starts[-1] == len(groups.order)


def test_a_sample_that_cannot_be_used_is_a_loss_of_zero_on_every_weight() -> None:
    task = task_of(RECIPE)
    for broken in (
        "mesh.glb: no faces",
        replace(samples_of("stroke")[0], masks=np.zeros_like(samples_of("stroke")[0].masks)),
    ):
        task.zero_grad()
        parts = task(broken, 0)
        parts["loss"].backward()
        assert float(parts["loss"].detach()) == 0 and task.problem
        assert all((p.grad is not None) == p.requires_grad for p in task.parameters())
        assert all(float(p.grad.abs().max()) == 0 for p in task.parameters() if p.grad is not None)


def test_bad_samples_are_counted_and_change_no_weight(tmp_path: Path) -> None:
    class Broken:
        def __getitem__(self, i: int) -> Sample:
            if i < 2:
                raise ValueError("mesh.glb: no faces")
            return stream()[i]

    messages: list[str] = []
    run = loop(replace(RECIPE, batch=1, steps=3), tmp_path, samples=Broken(), report=messages.append)
    before = [p.detach().clone() for p in run.task.parameters()]
    run.step()
    assert all(torch.equal(a, b) for a, b in zip(before, run.task.parameters(), strict=True))
    result = run()
    assert result.failed == 2 and result.step == 3 and any("mesh.glb: no faces" in line for line in messages)
    assert any(not torch.equal(a, b) for a, b in zip(before, run.task.parameters(), strict=True))


def test_a_step_that_is_not_finite_is_skipped_and_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = loop(replace(RECIPE, batch=1), tmp_path)
    honest = RefineTask.losses

    def poisoned(self: RefineTask, sample: Sample, seed: int) -> dict[str, torch.Tensor]:
        parts = honest(self, sample, seed)
        return {k: v * float("nan") for k, v in parts.items()} if self.step == 1 else parts

    monkeypatch.setattr(RefineTask, "losses", poisoned)
    result = run()
    assert result.skipped == 1 and result.step == 6
    assert all(bool(torch.isfinite(p).all()) for p in run.task.parameters())
    assert "not finite" in (tmp_path / "log.csv").read_text().splitlines()[2]


def test_a_toy_run_halves_its_loss_and_comes_nearer_to_the_truth(tmp_path: Path) -> None:
    """Stage II that reads pictures, on the two edits that it is trained on: novel views of the whole asset."""
    supply = FixedSamples(SampleStream(ProceduralSource(2, seed=3), replace(SAMPLES, kinds={"regrade": 1.0}), seed=1))

    class Two:
        def __getitem__(self, i: int) -> Sample:
            return supply[i % 2]

    recipe = replace(RECIPE, model=SMALL, steps=30, batch=1, learning_rate=6e-3, warmup=5, gradient_rows=0)
    recipe = replace(recipe, sequence=0.0)
    run = loop(recipe, tmp_path, samples=Two())
    losses = [run.step()["loss"] for _ in range(recipe.steps)]
    first, last = np.mean(losses[:6]), np.mean(losses[-8:])
    assert last < 0.5 * first, (first, last)
    for sample in (supply[0], supply[1]):
        numbers = run.task.eval().judge(sample).numbers
        assert numbers["ours"] > numbers["nothing"] + 3, numbers  # it had 6.2 and 4.7 dB
        assert numbers["ours"] > numbers["lift"] + 2, numbers  # 3.3 and 4.2


@pytest.mark.parametrize("stage", ["lrm", "compress"])
@pytest.mark.parametrize("config", [SMALL, COPY], ids=["native", "copy"])
def test_the_first_stages_learn(tmp_path: Path, stage: Any, config: ModelConfig) -> None:
    supply = FixedSamples(SampleStream(ProceduralSource(2, seed=3), PLAIN, seed=1))

    class One:
        def __getitem__(self, i: int) -> Sample:
            return supply[0]

    recipe = replace(
        RECIPE, stage=stage, model=config, samples=PLAIN, steps=10, batch=1, pull_steps=3, learning_rate=4e-3
    )
    run = loop(recipe, tmp_path, samples=One())
    assert trained(run.task) <= {"lrm"} if stage == "lrm" else "lrm" not in trained(run.task)
    rows = [run.step() for _ in range(recipe.steps)]
    losses = [row["loss"] for row in rows if row.get("pulled") is None]
    pulled = [row["pulled"] for row in rows if "pulled" in row]
    assert len(pulled) == (3 if stage == "lrm" and config is COPY else 0)
    assert not pulled or pulled[-1] < pulled[0]
    assert np.mean(losses[-4:]) < 0.95 * np.mean(losses[:4])
    score = run.task.eval().judge(supply[1])
    assert np.isfinite(score.numbers["ours"])


def test_validation_of_the_lrm_says_what_its_pictures_are_worth() -> None:
    """Half red, half blue: grey pictures, and those of other cameras, lose that; of a red asset these hardly do."""
    plain = SampleStream(ProceduralSource(2, seed=3), PLAIN, seed=1)[0]
    task = task_of(replace(RECIPE, stage="lrm", samples=PLAIN), SMALL).eval()

    def judged(left: tuple[float, ...], right: tuple[float, ...]) -> dict[str, float]:
        asset, cameras = plain.asset.numpy(), plain.novel_before.cameras
        colors = np.where(asset.means[:, :1] < np.median(asset.means[:, 0]), left, right)
        sh = np.zeros_like(asset.sh)
        sh[:, 0] = (colors - 0.5) / SH_C0
        asset = replace(asset, sh=sh)
        truth = PosedViews(cameras, torch.from_numpy(render(asset, list(cameras)).colors))
        return task.judge(replace(plain, asset=asset, novel_before=truth)).numbers

    painted = judged((0.95, 0.05, 0.05), (0.05, 0.05, 0.95))
    assert painted["adapts"] == painted["ours"] - painted["strength 0"] > 1
    assert painted["another edit"] < painted["ours"] - 0.5
    assert 0 < painted["between Gaussians"] <= 1
    red = judged((0.95, 0.05, 0.05), (0.95, 0.05, 0.05))
    assert red["ours"] - red["another edit"] < 0.5 * (painted["ours"] - painted["another edit"])


def test_compress_of_copy_sees_the_lrm_frozen() -> None:
    task = task_of(replace(RECIPE, stage="compress", model=with_compress(COPY, min_opacity=0.05)))
    assert trained(task) == {"compressor", "head"}
    assert LIFT.refine.base == "lift"


@pytest.mark.parametrize("kind", ["stroke", "regrade"])
def test_refinement_of_the_papers_copy_leaves_the_decoder_alone(kind: str, precision: str) -> None:
    task = task_of(RECIPE, COPY)
    assert trained(task) == {"refiner"}
    torch.nn.init.normal_(task.model.head.linear.weight, std=0.02)  # as after Stage I
    sample = samples_of(kind)[0]
    gradient = gradients(task, sample)
    assert max(float(g.abs().max()) for g in gradient.values()) > 0
    prepared = task._remembered(sample)
    assert len(prepared.splats) == len(prepared.encoded.gaussians) != len(sample.asset)
    assert np.isfinite(task.eval().judge(sample).numbers["ours"])
    with pytest.raises(ValueError, match="train_encoder nothing"):
        task_of(replace(RECIPE, train_encoder="compress"), COPY)


@pytest.mark.parametrize("steps", [3, 10**6])
def test_a_run_that_used_no_sample_fails_and_saves_nothing(
    tmp_path: Path, steps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        def __getitem__(self, i: int) -> Sample:
            raise ValueError(f"mesh{i}.glb: no faces")

    monkeypatch.setattr("splattrain.loop.MAX_USELESS_STEPS", 5)
    recipe = replace(RECIPE, steps=steps, save_minutes=1e-9)
    last = 2 * min(steps, 5) - 1
    with pytest.raises(ValueError, match=f"none of the {last + 1} samples .* nothing was trained .* no faces"):
        loop(recipe, tmp_path, samples=Broken())()
    assert not (tmp_path / "model").exists() and not (tmp_path / "state").exists()
