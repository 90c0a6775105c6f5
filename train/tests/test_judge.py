"""Judging trained models: which samples, which statistics, what is written, and what the painter makes of it."""

from __future__ import annotations

import csv
import importlib.util
import json
import math
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import tyro

from splatpainter.cli import main
from splatpainter.models import checkpoint
from splatpainter.models import weights as shipped
from splatpainter.models.config import ModelConfig, PredictConfig
from splatpainter.models.model import SplatPainterModel
from splatpainter.painter import Painter
from splattrain import judge, state
from splattrain.judge import apportioned, first_views, judged_samples
from splattrain.recipes import Recipe
from splattrain.training_data import DataSettings, ResourceFolders
from tests.support.train_scenes import LIFT, RECIPE, SAMPLES, SMALL, model

KINDS = {"stroke": 1.0, "relight": 2.0}
JUDGED = replace(RECIPE, samples=replace(SAMPLES, surfels=800, kinds=KINDS))
PLAIN = replace(SAMPLES, surfels=800, kinds={"plain": 1.0})
ROWS = replace(
    LIFT,
    refine=replace(
        LIFT.refine, inputs="normalised", answers="teachers", picture_tokens=False, row_tokens=64, base="own"
    ),
)
"""A Stage II as `train rows` makes it."""
DATA_SETTINGS = DataSettings("procedural:3", JUDGED.samples, 0, 0.1, ResourceFolders())
COPY = replace(SMALL, representation="copy", preset="tiny-copy")


@pytest.fixture(scope="module")
def held() -> list[Any]:
    """Three trials: two relit objects and one with a stroke."""
    return list(judged_samples(DATA_SETTINGS, KINDS, 3, 4))


def spoken(config: ModelConfig = LIFT) -> SplatPainterModel:
    """A model that changes something."""
    net = model(config)
    torch.manual_seed(5)
    with torch.no_grad():
        net.head.linear.weight.normal_(std=0.02)
    return net.eval()


def weights(folder: Path, recipe: Recipe, **notes: Any) -> Path:
    """A checkpoint as a run of this recipe leaves it."""
    notes_of = {"stage": recipe.stage, "step": 6, "seconds": 7200.0, "recipe": recipe.to_dict(), **notes}
    spoken(recipe.model).save(folder, notes=notes_of)
    return folder


def model_card(*words: object) -> str:
    """What scripts/model_card.py prints."""
    path = Path(__file__).parents[2] / "scripts/model_card.py"
    spec = importlib.util.spec_from_file_location("model_card", path)
    assert spec is not None and spec.loader is not None
    script = sys.modules["model_card"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script.main(tyro.cli(script.Options, args=list(map(str, words))))


def run(*words: object) -> int:
    return main(["train", *map(str, words)])


def test_kinds_come_in_proportion_at_every_length() -> None:
    order = apportioned({"relight": 3.0, "stroke": 2.0, "zoom": 1.0}, 60)
    assert Counter(order) == {"relight": 30, "stroke": 20, "zoom": 10}
    assert order[:12] == apportioned({"relight": 3.0, "stroke": 2.0, "zoom": 1.0}, 12)
    assert all(abs(order[:n].count("relight") - n / 2) <= 1 for n in range(61))


def test_trials_are_the_same_every_time_and_never_of_training_objects(held: list[Any]) -> None:
    assert [judged.kind for judged in held] == ["relight", "stroke", "relight"]
    longer: Any = judged_samples(DATA_SETTINGS, KINDS, 4, 4)
    for judged in held:
        other = next(longer)
        assert torch.equal(other.sample.novel_after.colors, judged.sample.novel_after.colors)
        assert other.sample.asset.sha256 == judged.sample.asset.sha256
    training = DATA_SETTINGS.stream().source
    names = {training.name(i) for i in range(len(training))}
    assert not names & {judged.sample.name for judged in held}
    assert [len(t.sample.edited) for t in held if t.kind == "relight"] == [4, 4]
    with pytest.raises(ValueError, match="no object of it is held out"):
        next(judged_samples(replace(DATA_SETTINGS, share=0.0), KINDS, 1, 4))


def test_shards_serve_as_well_with_the_views_that_they_have(tmp_path: Path) -> None:
    small = ["--size", "32", "--rows", "200", "--surfels", "600", "--samples", "3", "--kinds", "stroke", "relight"]
    assert main(["data", "render", "procedural:2", "--out", str(tmp_path), *small]) == 0
    settings: Any = replace(DATA_SETTINGS, data=str(tmp_path), share=0.6)  # one of the two objects
    results: list[Any] = list(judged_samples(settings, {**KINDS, "zoom": 1.0}, 3, 4))  # no zooms there
    assert [t.kind for t in results] == ["relight", "stroke", "relight"] == [t.sample.kind for t in results]
    held = {settings.stream(validation=True)[i].name for i in range(6)}
    assert held >= {t.sample.name for t in results} and not held & {settings.stream()[i].name for i in range(6)}


def test_fewer_views_of_the_same_edit_are_among_the_more(held: list[Any]) -> None:
    sample = held[0].sample
    cameras = [first_views(sample, n).edited.cameras for n in (1, 2, 4)]
    assert cameras[2] == sample.edited.cameras and cameras[1] == (cameras[2][0], cameras[2][2])
    assert cameras[0] == cameras[1][:1]
    two = first_views(sample, 2)
    assert torch.equal(two.edited.colors, sample.edited.colors[[0, 2]])
    assert np.array_equal(two.masks, sample.masks[[0, 2]]) and two.novel_after is sample.novel_after


def test_intervals_cover_the_mean_as_the_normal_law_says_and_draw_whole_objects() -> None:
    values = np.random.default_rng(1).normal(2.0, 0.5, 80).tolist()
    names = [f"object {k}" for k in range(80)]
    low, high = judge.interval(values, names) or (0.0, 0.0)
    half = 1.96 * np.std(values) / math.sqrt(80)
    assert abs(low - (np.mean(values) - half)) < 0.15 * half and abs(high - (np.mean(values) + half)) < 0.15 * half
    # Twice the samples of the same objects are no more evidence.
    assert judge.interval(values * 2, names * 2) == pytest.approx((low, high), abs=1e-12)
    assert judge.interval(values, ["one"] * 80) is None


def test_rows_are_means_of_the_tasks_own_verdicts(held: list[Any]) -> None:
    task = judge.refine_task(JUDGED, spoken(), None)
    sample_scores = [f for f in judge.judge_edits(task, held, (4, 1, 1)) if isinstance(f, judge.SampleScore)]
    assert [(f.kind, f.views) for f in sample_scores] == [("relight", 1), ("relight", 4), ("stroke", None)] + [
        ("relight", 1),
        ("relight", 4),
    ]
    rows = {(row.kind, row.views): row for row in judge.edit_rows(sample_scores)}
    assert list(rows) == [("stroke", None), ("relight", 1), ("relight", 4), ("local", None), ("global", None)]
    fresh, relit = judge.refine_task(JUDGED, spoken(), None).eval(), [held[0].sample, held[2].sample]
    scores = {n: [fresh.judge(first_views(sample, n)).numbers for sample in relit] for n in (1, 4)}
    for n in (1, 4):
        row = rows["relight", n]
        assert row.gain == pytest.approx(np.mean([v["ours"] - v["lift"] for v in scores[n]]))
        assert row.lift_ssim == pytest.approx(np.mean([v["lift SSIM"] for v in scores[n]]))
        assert (row.samples, row.objects, row.ours_lpips) == (2, 2, None) and abs(row.gain) > 1e-3
        assert row.gain_low is not None and row.gain_high is not None and row.gain_low <= row.gain <= row.gain_high
    # A sample counts once in its mode, however many numbers of views it was judged with.
    assert rows["global", None].samples == 2
    assert rows["global", None].gain == pytest.approx(np.mean([rows["relight", n].gain for n in (1, 4)]))
    assert rows["global", None].gain_low is not None and rows["local", None].gain_low is None  # one object
    assert judge.gains(list(rows.values())) == {
        "local": rows["stroke", None].gain,
        "global": rows["global", None].gain_low,
    }


def test_goals_say_reached_and_missed() -> None:
    blank = dict.fromkeys(f"{n}_{m}" for n in ("nothing", "lift", "ours") for m in ("ssim", "lpips"))
    rest: dict[str, Any] = {"samples": 3, "objects": 2, "nothing": 10.0, "lift": 20.0, **blank}
    rest |= {"gain_low": -0.1, "gain_high": 2.0}
    rows = [
        judge.EditRow(kind="relight", views=1, ours=21.0, gain=1.0, **rest),
        judge.EditRow(kind="relight", views=2, ours=20.9, gain=0.9, **rest),
        judge.EditRow(kind="local", views=None, ours=19.9, gain=-0.1, **rest),
    ]
    notes_of = judge.goals(rows)
    assert [line.rsplit(": ", 1)[1] for line in notes_of] == ["missed", "reached", "missed", "missed"]
    assert "relighting from 1 view: goal +1.0 dB over the lift, measured +1.00 dB" in notes_of[1]
    assert judge.weak_kinds(rows) == ([], ["relight from 1 view", "relight from 2 views"])
    assert judge.from_json(json.loads(json.dumps(judge.as_json(rows)))) == rows
    copied = judge.CopyRow(judge.COPY, 2, 2, "the LRM before compression", 25.0, 24.6, -0.4, None, None)
    assert judge.goals([copied]) == ["Stage I within 0.3 dB of the LRM: -0.40 dB: missed"]


def test_the_command_writes_tables_notes_and_card(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SPLATPAINTER_PERCEPTUAL", raising=False)
    past = {"stage": "lrm", "step": 94, "seconds": 3600.0, "recipe": {"batch": 1}}
    folder, out = weights(tmp_path / "run/model", JUDGED, history=[past]), tmp_path / "judged"
    (tmp_path / "run/log.csv").write_text("step,loss,skipped\n1,0.5,\n2,nan,not finite\n3,0.25,\n")
    with pytest.raises(ValueError, match="have not been judged"):
        model_card(folder)
    words = ["judge", folder, "--data", "procedural:3", "--device", "cpu", "--samples", 2, "--views", 1, 2]
    assert run(*words, "--out", out, "--write-notes", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    with open(out / "judged.csv", newline="") as file:
        table = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert [row["kind"] + row["views"] for row in table] == ["stroke", "relight1", "relight2", "local", "global"]
    assert (out / "judged.png").stat().st_size > 1000 and "| relight | 2 |" in (out / "judged.md").read_text()
    # The weights and other notes are as they were, and the painter goes by the gain.
    held = checkpoint.load(folder)
    assert held.notes["gain"] == record["gain"] and held.notes["step"] == 6
    assert all(torch.equal(held.tensors[k], v.half()) for k, v in spoken().state_dict().items())
    painter = Painter(model=SplatPainterModel.load(folder))
    for mode, gain in record["gain"].items():
        assert painter.choose("auto", mode)[0] == ("ttt" if gain > 0 else "corrected" if mode == "local" else "lift")
        row = table[3 if mode == "local" else 4]
        assert float(row["gain_low"] or row["gain"]) == pytest.approx(gain)
    output = model_card(folder, "--hardware", "an abacus")
    for part in ("# Model card: tiny", "Gaussian LRM | 94 | 1.00", "Stage II | 6 | 2.00", "an abacus; 3.0 hours"):
        assert part in output
    assert "| 0.375 | 0.375 |" in output and "are procedural" in output and "| relight | 2 | 1 | 1 |" in output


def test_the_committed_card_is_what_the_script_writes_of_the_shipped_weights() -> None:
    """Run `python scripts/model_card.py > docs/MODEL_CARD.md` where this fails."""
    card = (Path(__file__).parents[2] / "docs/MODEL_CARD.md").read_text(encoding="utf-8")
    assert model_card() == card
    # Its figures are those beside the weights.
    notes = checkpoint.notes(shipped.PACKAGED / "local")["validation"]["all"]
    assert f"| the lift | {notes['edited lift']:.2f} | {notes['novel lift']:.2f} |" in card


def test_a_stage_two_of_global_edits_is_judged_by_those(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = weights(tmp_path / "model", replace(JUDGED, stage="rows", model=ROWS))
    words = ["judge", folder, "--data", "procedural:3", "--device", "cpu", "--out", tmp_path / "out"]
    assert run(*words, "--samples", 1, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert {row["kind"] for row in record["rows"]} == {"relight", "global"} and set(record["gain"]) == {"global"}
    assert run(*words, "--kinds", "stroke") == 2
    assert "for weights that make global edits alone, got 'stroke'" in capsys.readouterr().err


def test_a_carried_edit_is_judged_beside_no_adaptation_and_another_edit(held: list[Any]) -> None:
    """In pictures: what the memory is worth there."""
    sample = next(trial.sample for trial in held if trial.kind == "relight")
    recipe = replace(JUDGED, model=ROWS)
    awake = judge.refine_task(recipe, spoken(ROWS), None).eval().judge(sample).numbers
    assert awake["adapts"] == awake["ours"] - awake["strength 0"] != 0
    assert awake["another edit"] not in (awake["ours"], awake["strength 0"])
    asleep = spoken(replace(ROWS, refine=replace(ROWS.refine, edit_strength=0.0)))
    still = judge.refine_task(recipe, asleep, None).eval().judge(sample).numbers
    assert still["adapts"] == 0 and still["ours"] == still["another edit"] == awake["strength 0"]


def test_a_carried_edit_is_judged_in_the_arithmetic_that_edits_have(
    held: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    sample = next(trial.sample for trial in held if trial.kind == "relight")
    task = judge.refine_task(replace(JUDGED, model=ROWS), spoken(ROWS), None).eval()
    numbers = []
    for precision in ("float32", "bfloat16"):
        monkeypatch.setenv("SPLATPAINTER_PRECISION", precision)
        numbers.append(task.judge(sample).numbers)
    for name in ("ours", "strength 0", "another edit"):
        assert 0 < abs(numbers[0][name] - numbers[1][name]) < 0.5, name


def test_a_predictor_that_stands_alone_is_judged_on_the_lift(held: list[Any]) -> None:
    """Untrained it leaves the lift as it is, whatever Stage II would start from."""
    config = replace(ROWS, predict=PredictConfig(features=8, hidden=16, alone=True))
    task = judge.refine_task(replace(JUDGED, model=config), spoken(config), None)
    relit = next(judged.sample for judged in held if judged.kind == "relight")
    numbers = task.judge(relit).numbers
    assert numbers["ours"] == pytest.approx(numbers["lift"], abs=1e-4) and numbers["gain"] == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize(("stage", "config"), [("lrm", LIFT), ("compress", COPY), ("compress", LIFT)])
def test_earlier_stages_are_judged_by_what_they_reproduce(
    tmp_path: Path, stage: Any, config: ModelConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = weights(tmp_path / "model", replace(RECIPE, stage=stage, model=config, samples=PLAIN))
    words = ["judge", folder, "--data", "procedural:3", "--device", "cpu", "--samples", 2, "--out", tmp_path / "out"]
    assert run(*words, "--json") == 0
    rows = {row["what"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    native = stage == "compress" and config is LIFT
    assert set(rows) == ({judge.LRM, judge.COPY} if config is COPY else {judge.LRM})
    assert ("read-out" in (tmp_path / "out/judged.md").read_text()) == native
    if config is COPY:
        copied = rows[judge.COPY]
        assert copied["reference_psnr"] == pytest.approx(rows[judge.LRM]["ours"])
        assert copied["difference"] == pytest.approx(copied["ours"] - copied["reference_psnr"])


def test_stages_remember_those_before_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "tiny.json").write_text(json.dumps(RECIPE.to_dict() | {"stage": "compress"}))
    common = ["--data", "procedural:2", "--device", "cpu", "--samples.surfels", 800, "--samples.kinds.plain", 1]
    plain = [*common, "--samples.kinds.stroke", 0, "--samples.kinds.regrade", 0]
    before = weights(tmp_path / "lrm/model", replace(RECIPE, stage="lrm"), history=[{"stage": "lrm", "step": 1}])
    first = ["compress", "--recipe", tmp_path / "tiny.json", *plain, "--out", tmp_path / "run"]
    assert run(*first, "--from", before, "--session-steps", 1) == 0
    assert run(*first, "--resume", "--session-steps", 1) == 0  # without --from
    capsys.readouterr()
    folder = tmp_path / "run/model"
    notes = checkpoint.load(folder).notes
    assert [past["step"] for past in notes["history"]] == [1, 6] and notes["step"] == 2
    assert [r["step"] for r in state.history(folder, notes)] == [1, 6, 2]
    assert set(state.history(folder, notes)[-1]["loss"]) == {"first", "last"}
    # Stage I's read-out is found beside its weights.
    judged = ["judge", folder, "--data", "procedural:3", "--device", "cpu", "--samples", 2, "--out", tmp_path / "out"]
    assert run(*judged, "--json") == 0
    assert {row["what"] for row in json.loads(capsys.readouterr().out)["rows"]} == {judge.LRM, judge.HIDDEN}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "--data is missing"),
        (["--data", "nowhere"], "expected procedural:N, or a folder"),
        (["--data", "procedural:2", "--kinds", "plain"], "for stage refine, got 'plain'"),
        (["--data", "procedural:2", "--kinds", "stroke", "--write-notes"], "leave --kinds out"),
        (["--data", "procedural:2", "--samples", "0"], "--samples of at least 1"),
        (["--data", "procedural:2", "--views", "0"], "--views of 1 to 16"),
        (["--data", "procedural:2", "--recipe", "nowhere.json"], "--recipe nowhere.json"),
    ],
)
def test_wrong_words_are_one_line(
    tmp_path: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = weights(tmp_path / "model", JUDGED)
    assert run("judge", folder, "--out", tmp_path / "out", *words) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
    checkpoint.save(folder, LIFT, spoken().state_dict(), notes={})
    assert run("judge", folder, "--out", tmp_path / "out", "--data", "procedural:2") == 2
    assert "hold no recipe" in capsys.readouterr().err
