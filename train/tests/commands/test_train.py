"""`splatpainter train`: one tiny run through the command line, its files, and every way to say it wrongly."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from splatpainter.cli import main
from splatpainter.models.model import SplatPainterModel
from splattrain import recipes
from splattrain.recipes import ENTRY_POINTS
from tests.support.train_scenes import LIFT, RECIPE, SAMPLES, SMALL

WORDS = ["--data", "procedural:2", "--device", "cpu", "--samples.surfels", "800"]


@pytest.fixture(scope="module")
def recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tests' recipe as a file, with validation."""
    path = tmp_path_factory.mktemp("recipe") / "tiny.json"
    data = RECIPE.to_dict() | {"validate_every": 1, "validation_samples": 1, "steps": 2, "batch": 1}
    del data["stage"]  # for every stage
    path.write_text(json.dumps(data))
    return path


def run(*words: object) -> int:
    return main(["train", *map(str, words)])


def test_three_stages_one_after_the_other(
    tmp_path: Path, recipe: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SPLATPAINTER_PERCEPTUAL", raising=False)
    plain = ["--samples.kinds.plain", "1", "--samples.kinds.stroke", "0", "--samples.kinds.regrade", "0"]
    plain += ["--session-steps", "1"]
    lrm, refine = tmp_path / "lrm", tmp_path / "refine"
    assert run("lrm", "--recipe", recipe, *WORDS, *plain, "--out", lrm, "--perceptual", 0.5) == 0
    output = capsys.readouterr()
    assert "step 1 of 2 (session steps)" in output.out and "--resume" in output.out
    assert "the perceptual term is dropped" in output.err and "validation reconstruction: asset" in output.err
    assert run("refine", "--recipe", recipe, *WORDS, "--out", refine, "--from", lrm / "model", "--json") == 0
    output = capsys.readouterr()
    record = json.loads(output.out)
    assert record["step"] == 2 and record["ended"] == "done" and record["validation"]["all"]["lift"] > 0
    assert "lrm as trained by stage lrm" in output.err
    names = {p.relative_to(refine).as_posix() for p in refine.rglob("*") if p.is_file()}
    assert {"recipe.json", "log.csv", "validation.csv", "model/model.json", "state/model.json"} <= names
    assert {f"sheets/step_000000{k}.png" for k in (0, 1, 2)} <= names and any("tfevents" in name for name in names)
    first, last = SplatPainterModel.load(lrm / "model"), SplatPainterModel.load(refine / "model")
    assert torch.equal(first.lrm.head.weight, last.lrm.head.weight) and last.config == LIFT
    assert last.notes["stage"] == "refine" and last.notes["recipe"]["samples"]["surfels"] == 800
    assert recipes.parse((refine / "recipe.json").read_text(), "refine").samples.size == SAMPLES.size
    # It is over: going on does nothing, beginning again is refused.
    assert run("refine", "--recipe", recipe, *WORDS, "--out", refine, "--resume") == 0
    assert "step 2 of 2 (done)" in capsys.readouterr().out
    assert run("refine", "--recipe", recipe, *WORDS, "--out", refine) == 2
    assert "holds a run already" in capsys.readouterr().err
    # Weights of another model are named.
    other = [*WORDS, "--model.compress.hidden", "48", "--out", tmp_path / "other", "--from", refine / "model"]
    assert run("refine", "--recipe", recipe, *other) == 2
    assert "weights of another model: compress.hidden 40 there, 48 here" in capsys.readouterr().err
    # Another Stage II: how to go on is said.
    raw = [*WORDS, "--model.refine.inputs", "raw" if LIFT.refine.inputs != "raw" else "normalised"]
    assert run("refine", "--recipe", recipe, *raw, "--out", tmp_path / "raw", "--from", refine / "model") == 2
    hint = f"go on with --model.refine.inputs {LIFT.refine.inputs}, or train a new Stage II on its encoder"
    assert hint in capsys.readouterr().err
    # It starts from the same Stage I, and from nothing later.
    anew = [*WORDS, "--model.refine.blocks", "3", "--out", tmp_path / "anew", "--session-steps", "1"]
    anew += ["--from", refine / "model"]
    assert run("refine", "--recipe", recipe, *anew, "--from-stage", "densify") == 2
    assert "expected --from-stage to be one up to refine, got densify" in capsys.readouterr().err
    assert run("refine", "--recipe", recipe, *anew, "--from-stage", "compress") == 0
    assert "lrm, compressor as trained by stage refine" in capsys.readouterr().err
    stage_one = SplatPainterModel.load(tmp_path / "anew" / "model").compressor.state_dict()
    assert all(torch.equal(stage_one[name], value) for name, value in last.compressor.state_dict().items())
    # Of an LRM, only the LRM must be the same.
    assert run("compress", "--recipe", recipe, *other[:-1], lrm / "model", "--session-steps", "1") == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["refind"], "expected one of lrm, compress, predict, rows, refine, densify, judge, got 'refind'"),
        (["refine"], "--data is missing"),
        (["refine", "--data", "procedural:x"], "expected procedural:N with a number"),
        (["refine", "--data", "nowhere"], "expected procedural:N, or a folder"),
        (["refine", "--recipe", "huge"], "--recipe huge: expected one of compact, paint, paper"),
        (["refine", "--data", "procedural:2", "--stpes", "3"], "unknown option --stpes; perhaps you meant --steps"),
        (["refine", "--data", "procedural:2", "--steps", "0"], "expected steps of at least 1"),
        (["refine", "--data", "procedural:2", "--from", "nowhere"], "nowhere: no weights there"),
        (["refine", "--recipe", "paper", "--data", "procedural:2"], "'copy' models start from their Stage I"),
        (["refine", "--data", "procedural:2", "--device", "cupboard"], "expected a device"),
        (["refine", "--data", "procedural:2", "--stage", "lrm"], "--stage lrm"),
    ],
)
def test_wrong_words_are_one_line(
    tmp_path: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [] if len(words) < 2 or "--data" not in words else ["--out", str(tmp_path / "run"), "--validate-every", "0"]
    assert run(*words, *out) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert message in lines[-1] and lines[-1].startswith("splatpainter")
    assert not list(tmp_path.rglob("*.json"))


def test_a_stage_of_another_distribution_says_what_brings_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.metadata.entry_points

    def without_stages(**select: str) -> Sequence[importlib.metadata.EntryPoint]:
        return [] if select["group"] == ENTRY_POINTS else list(find(**select))  # the command comes by one, too  # pyright: ignore[reportReturnType]

    monkeypatch.setattr(importlib.metadata, "entry_points", without_stages)
    assert run("densify", "--data", "procedural:2") == 2
    line = "splatpainter train densify: not installed; it comes with the distribution splatpainter-bench"
    assert line in capsys.readouterr().err


def test_help_shows_the_recipes_own_values(capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 0 and "stages:" in capsys.readouterr().out
    assert run("refine", "--recipe", "paper", "--help") == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "Optimiser steps; the learning rate's cosine ends there. (default: 200000)" in output
    assert "--model.refine.base" in output and SMALL.preset not in output
