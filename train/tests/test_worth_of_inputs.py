"""Validation and tables of every stage say what a network makes of what it is told: without it, with another edit's in
its place, and how much of it differs between Gaussians."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from splatpainter.cli import main
from splatpainter.models.config import ModelConfig, PredictConfig
from splatpainter.models.model import SplatPainterModel
from splattrain import judge
from splattrain.data.object_sources import ProceduralSource
from splattrain.data.samples import SampleStream
from splattrain.recipes import Recipe, Stage
from splattrain.stages.gaussian_edit_task import GaussianEditOptions, GaussianEditTask
from tests.support.train_scenes import LIFT, RECIPE, SMALL, loop
from train.tests.test_gaussian_edit_task import MODEL as ON_ROWS
from train.tests.test_gaussian_edit_task import stream as edits
from train.tests.test_judge import COPY, PLAIN, ROWS, spoken, weights
from train.tests.test_stages import samples_of, task_of

WORTH = ("strength 0", "adapts", "another edit", "between Gaussians")
ALONE = replace(ROWS, predict=PredictConfig(features=8, hidden=16, alone=True))


def awake(config: ModelConfig) -> SplatPainterModel:
    """A model all of whose answers say something."""
    net = spoken(config)
    if net.predictor is not None:
        torch.nn.init.normal_(net.predictor.expected.weight, std=0.2)
    return net


def checked(numbers: dict[str, float]) -> None:
    assert set(WORTH) <= set(numbers), numbers
    assert numbers["adapts"] == numbers["ours"] - numbers["strength 0"] != 0
    assert numbers["another edit"] not in (numbers["ours"], numbers["strength 0"])
    assert 0 < numbers["between Gaussians"] <= 1


@pytest.mark.parametrize(
    ("config", "kind"),
    [
        (LIFT, "stroke"),
        (SMALL, "stroke"),
        (LIFT, "regrade"),
        (COPY, "stroke"),
        (ROWS, "regrade"),
        (ALONE, "regrade"),
    ],
    ids=["lift", "own", "global", "copy", "rows", "predictor"],
)
def test_of_stage_two(config: ModelConfig, kind: str) -> None:
    task = judge.refine_task(replace(RECIPE, model=config), awake(config), None).eval()
    checked(task.judge(samples_of(kind)[0]).numbers)


def test_of_stage_two_the_share_is_of_what_it_reads() -> None:
    """Gaussians that are told the same have none of it between them."""
    task: Any = task_of(RECIPE).eval()
    sample = samples_of("stroke")[0]
    before = task.judge(sample).numbers["between Gaussians"]
    with torch.no_grad():  # all latents alike, and nothing else is told
        for name in ("lift", "drift", "facts"):
            if hasattr(task.model.refiner, name):
                getattr(task.model.refiner, name).weight.zero_()
        encoded = task._remembered(sample).encoded
        encoded.latents.values[:] = encoded.latents.values[:1]
    assert task.judge(sample).numbers["between Gaussians"] < 1e-6 < before


@pytest.mark.parametrize(("stage", "config"), [("lrm", SMALL), ("compress", COPY), ("compress", SMALL)])
def test_of_the_stages_before(stage: Stage, config: ModelConfig) -> None:
    sample = SampleStream(ProceduralSource(2, seed=3), replace(PLAIN, size=32, rows=200), seed=1)[0]
    task = task_of(replace(RECIPE, stage=stage, samples=PLAIN, model=config), config).eval()
    checked(task.judge(sample).numbers)


def test_of_rows_whatever_carries() -> None:
    config = replace(ON_ROWS, predict=PredictConfig(features=8, hidden=16))
    for carrier in ("stage2", "predictor"):
        task = GaussianEditTask(awake(config), GaussianEditOptions(carrier, cached=False)).eval()
        checked(task.judge(edits()[0]).numbers)


def test_they_are_columns_of_validation_and_of_train_judge(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = loop(RECIPE, tmp_path / "run", held_out=tuple(samples_of("stroke")))
    run.validate()
    with open(tmp_path / "run/validation.csv", newline="") as file:
        columns = csv.DictReader(file).fieldnames or []
    assert {f"all {name}" for name in WORTH} <= set(columns)
    for stage, config in (("lrm", LIFT), ("compress", COPY)):
        recipe: Recipe = replace(RECIPE, stage=stage, model=config, samples=PLAIN)
        folder, out = weights(tmp_path / stage / "model", recipe), tmp_path / stage / "out"
        words = ["judge", folder, "--data", "procedural:3", "--device", "cpu", "--samples", 2, "--out", out]
        assert main(["train", *map(str, words), "--json"]) == 0
        for row in json.loads(capsys.readouterr().out)["rows"]:
            assert None not in (row["strength_zero"], row["another_edit"], row["between_gaussians"])
        assert "strength 0 dB" in (out / "judged.md").read_text()
