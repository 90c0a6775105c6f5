"""Learning on rows: what is trained, what it may know, that it learns, and the command."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from splatpainter.cli import main
from splatpainter.models import checkpoint, weights
from splatpainter.models.config import PredictConfig
from splatpainter.models.model import SplatPainterModel
from splattrain import recipes
from splattrain.build import make_task, start
from splattrain.data import gaussian_edits, lit_assets
from splattrain.data.gaussian_edits import GaussianEdit, GaussianEditStream
from splattrain.data.lit_assets import LitAssets
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.sample_recipes import SampleRecipe
from splattrain.recipes import Recipe
from splattrain.stages.gaussian_edit_task import (
    GaussianEditOptions,
    GaussianEditTask,
    fixed_ridge,
    judged,
    unseen,
)
from tests.models.test_edit_propagation import CARRYING
from tests.support.train_scenes import LIFT, SMALL, loop, model

MODEL = replace(CARRYING, predict=PredictConfig(features=8, hidden=16))
SAMPLES = SampleRecipe({"relight": 1.0, "recolor": 1.0}, size=32, rows=200, surfels=2000, steps_per_object=1)
RECIPE = Recipe(
    stage="rows",
    model=MODEL,
    samples=SAMPLES,
    steps=40,
    batch=1,
    learning_rate=1e-2,
    warmup=2,
    average=0.8,
    validate_every=0,
    teachers=60,
    readers=60,
)


@pytest.fixture(autouse=True, scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lit_assets, "FIT_STEPS", 4)
        patch.setattr(gaussian_edits, "LIGHT_COUNT", 6)
        patch.setenv("SPLATPAINTER_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@cache
def stream() -> GaussianEditStream:
    return GaussianEditStream(
        LitAssets(ProceduralSource(1, seed=3), SAMPLES), {"relight": 1.0}, ("coarse",), samples_per_object=1
    )


def task(carrier: str = "stage2") -> GaussianEditTask:
    return GaussianEditTask(model(MODEL), GaussianEditOptions(carrier, 60, 60, cached=False))  # type: ignore[arg-type]


def trained(made: GaussianEditTask) -> set[str]:
    return {name.split(".")[1] for name, p in made.named_parameters() if p.requires_grad}


def test_one_carrier_is_trained() -> None:
    assert trained(task()) == {"refiner", "head"} and trained(task("predictor")) == {"predictor"}
    for config, message in ((LIFT, "only shown Gaussians teach"), (replace(MODEL, decoder="absolute"), "residual")):
        with pytest.raises(ValueError, match=message):
            GaussianEditTask(model(config))
    with pytest.raises(ValueError, match="expected a model with a predictor"):
        GaussianEditTask(model(SMALL), GaussianEditOptions("predictor"))


@pytest.mark.parametrize("carrier", ["stage2", "predictor"])
def test_what_no_picture_shows_is_not_told(carrier: str) -> None:
    made, sample = task(carrier), stream()[0]
    torch.nn.init.normal_(made.model.head.linear.weight, std=0.1)
    hidden = unseen(sample)
    other = sample.change.copy()
    other[hidden] = 3.0
    changed = GaussianEdit(sample.item, sample.kind, sample.views, other, sample.weight, sample.counts)
    with torch.no_grad():
        answers = [made.answer(edit) for edit in (sample, changed)]
    torch.testing.assert_close(*answers, atol=0, rtol=0)
    assert answers[0].shape == (len(judged(sample)), 3) and float(answers[0].abs().max()) > 0
    # The truth itself has no error, and nothing done has that of the change.
    truth = torch.from_numpy(sample.change[judged(sample)])
    assert made.decibels(sample, truth) > 60
    counts, change = sample.counts[judged(sample)], sample.change[judged(sample)]
    by_hand = -10 * math.log10(np.average((change**2).mean(1), weights=counts))
    assert math.isclose(made.decibels(sample, None), by_hand, rel_tol=1e-3)


def test_a_step_asks_gaussians_that_do_not_teach(monkeypatch: pytest.MonkeyPatch) -> None:
    made, sample, calls = task(), stream()[0], []
    honest = GaussianEditTask.predicted

    def watched(self: GaussianEditTask, edit: GaussianEdit, teachers: np.ndarray, readers: np.ndarray) -> torch.Tensor:
        calls.append((teachers, readers))
        return honest(self, edit, teachers, readers)

    monkeypatch.setattr(GaussianEditTask, "predicted", watched)
    for seed in range(3):
        made.losses(sample, seed)
    for teachers, readers in calls:
        assert sample.seen[teachers].all() and not set(teachers) & set(readers)
        assert len(set(readers) & set(unseen(sample))) == min(60, len(unseen(sample)))


def test_the_memory_of_another_edit_gives_another_answer() -> None:
    made, sample = task(), stream()[0]
    torch.nn.init.normal_(made.model.head.linear.weight, std=0.1)
    other = GaussianEdit(sample.item, sample.kind, sample.views, -sample.change, sample.weight, sample.counts)
    with torch.no_grad():
        answer, swapped = made.answer(sample), made.answer(sample, evidence=other)
        fixed = [made.answer(sample, 0.0, edit) for edit in (sample, other)]
    assert float((answer - swapped).abs().max()) > 1e-4
    torch.testing.assert_close(*fixed, atol=0, rtol=0)


class FewEdits:
    """Four edits, again and again."""

    def __getitem__(self, i: int) -> GaussianEdit:
        return stream()[i % 4]


def test_it_learns(tmp_path: Path) -> None:
    run = loop(RECIPE, tmp_path, samples=FewEdits(), held_out=(stream()[0],))
    before = run.validate()["all"]
    result = run()
    assert result.ended == "done" and result.failed == 0
    after = run.validate()["all"]
    assert math.isclose(before["ours"], before["nothing"], abs_tol=1e-4) and after["ours"] > before["ours"] + 1
    saved = SplatPainterModel.load(tmp_path / "model")
    assert saved.config == MODEL and saved.notes["stage"] == "rows"
    # Another Stage II starts from the same encoder; the same one goes on.
    lines: list[str] = []
    other = replace(RECIPE, model=replace(MODEL, refine=replace(MODEL.refine, blocks=1)))
    start(other, tmp_path / "model", lines.append)
    start(RECIPE, tmp_path / "model", lines.append)
    assert ["refiner" in line for line in lines] == [False, True]


def test_the_ridge_is_the_lifts() -> None:
    sample = stream()[1]
    made = task()
    assert fixed_ridge(sample).shape == (len(judged(sample)), 3)
    score = made.judge(sample)
    assert score.kind == f"relight {sample.views} coarse" and set(score.numbers) > {
        *("nothing", "lift", "strength 0", "adapts", "another edit", "between Gaussians")
    }
    assert score.numbers["adapts"] == score.numbers["ours"] - score.numbers["strength 0"]
    assert 0 < score.numbers["between Gaussians"] <= 1


def test_the_stage_is_a_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = RECIPE.to_dict() | {"steps": 2, "validate_every": 2, "validation_samples": 2}
    (tmp_path / "tiny.json").write_text(json.dumps(data))
    words = ["train", "rows", "--recipe", str(tmp_path / "tiny.json"), "--data", "procedural:1", "--device", "cpu"]
    assert main([*words, "--out", str(tmp_path / "run"), "--assets", str(tmp_path / "assets"), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["step"] == 2 and record["validation"]["all"]["nothing"] > 0
    assert list((tmp_path / "assets").glob("*.npz"))
    assert checkpoint.notes(tmp_path / "run" / "model")["recipe"]["teachers"] == 60
    (tmp_path / "nothing").mkdir()
    assert main([*words[:-4], "--data", str(tmp_path / "nothing"), "--out", str(tmp_path / "other")]) == 2
    assert "holds no mesh files" in capsys.readouterr().err


def test_training_goes_on_from_the_shipped_weights() -> None:
    lines: list[str] = []
    folder = Path(__file__).parents[2] / "benchmarks/splatbench/weights/latents"
    start(recipes.load("compact", "rows"), weights.PACKAGED / "compact", lines.append)
    start(recipes.load("compact", "refine"), folder, lines.append, "compress")
    assert ["refiner" in line for line in lines] == [True, False]
    with pytest.raises(ValueError, match="learnt without pictures .* --from-stage compress"):
        start(recipes.load("compact", "refine"), folder)


def test_stages_of_lrm_and_stage_one_want_a_model_that_has_them(tmp_path: Path) -> None:
    without = replace(MODEL, refine=replace(MODEL.refine, latents=False))
    for stage in ("lrm", "compress"):
        with pytest.raises(ValueError, match=f"train {stage}: expected a model with LRM and Stage I"):
            make_task(replace(RECIPE, stage=stage, model=without), model(without), None)
    with_none = SplatPainterModel(without)
    with_none.save(tmp_path / "without", notes={"stage": "rows"})
    with pytest.raises(ValueError, match="without LRM and Stage I, .* start from those of train compress"):
        start(RECIPE, tmp_path / "without")
    # One that has none takes neither from weights that do, and its history is that of what it took.
    stages = [{"stage": stage, "step": step} for step, stage in enumerate(("lrm", "compress", "predict"))]
    SplatPainterModel(MODEL).save(tmp_path, notes={"stage": "rows", "history": stages})
    made = start(replace(RECIPE, model=without), tmp_path, lambda line: None)
    assert made.encoders == () and [one["stage"] for one in made.notes["history"]] == ["predict"]
    everything = start(RECIPE, tmp_path, lambda line: None)
    assert [one["stage"] for one in everything.notes["history"]] == ["lrm", "compress", "predict", "rows"]
    encoder = start(RECIPE, tmp_path, lambda line: None, "compress")
    assert [one["stage"] for one in encoder.notes["history"]] == ["lrm", "compress", "predict"]


def test_train_refine_leaves_it_to_rows() -> None:
    made = make_task(replace(RECIPE, stage="refine"), model(MODEL), None, lambda line: None)
    with pytest.raises(ValueError, match="use train rows"):
        made.losses(SimpleNamespace(mode="global"), 0)  # type: ignore[arg-type]
