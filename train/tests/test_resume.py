"""A run that stops and goes on is the run that never stopped; what must not go on is refused."""

from __future__ import annotations

import csv
import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from splatpainter.models import checkpoint
from splatpainter.models.model import SplatPainterModel
from splattrain.build import make_task
from splattrain.distributed import Group
from splattrain.loop import Limits, Loop
from tests.support.model_scenes import with_refine
from tests.support.systems import posix_only
from tests.support.train_scenes import LIFT, RECIPE, loop, stream


def rows(out: Path) -> list[dict[str, str]]:
    with open(out / "log.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def weights(out: Path) -> dict[str, torch.Tensor]:
    return checkpoint.load(out / "state").tensors


def test_six_steps_are_three_and_three(tmp_path: Path) -> None:
    uninterrupted, parts = tmp_path / "whole", tmp_path / "parts"
    assert loop(RECIPE, uninterrupted)().ended == "done"
    first = loop(RECIPE, parts)(Limits(steps=3))
    assert (first.step, first.ended) == (3, "session steps")
    assert loop(RECIPE, parts, resume=True)().step == 6
    assert rows(uninterrupted) == rows(parts)  # losses as repr: equal text, equal bits
    assert len({row["loss"] for row in rows(uninterrupted)}) == 6
    one, other = weights(uninterrupted), weights(parts)
    assert one.keys() == other.keys()
    for name in one:
        assert torch.equal(one[name], other[name]), name
    assert any(name.startswith("second/") for name in one)


def test_the_saved_model_is_the_average_and_loads(tmp_path: Path) -> None:
    made = loop(RECIPE, tmp_path)
    made()
    model = SplatPainterModel.load(tmp_path / "model")
    assert model.config == LIFT and model.notes["stage"] == "refine" and model.notes["step"] == 6
    for name, value in made.run.average.values.items():
        stored = dict(model.named_parameters())[name.removeprefix("model.")]
        assert torch.equal(stored, value.half().float()), name
    frozen = made.task.model.lrm.patches.weight
    assert torch.equal(model.lrm.patches.weight, frozen.half().float())
    assert max(f.stat().st_size for f in tmp_path.rglob("*.safetensors")) <= checkpoint.MAX_SHARD_BYTES


def test_rows_beyond_the_state_are_dropped(tmp_path: Path) -> None:
    loop(RECIPE, tmp_path)(Limits(steps=2))
    with open(tmp_path / "log.csv", "a") as file:  # a run that was killed after its last save
        file.write("3,0.5\n4,0.5\n")
    loop(RECIPE, tmp_path, resume=True)(Limits(steps=1))
    assert [row["step"] for row in rows(tmp_path)] == ["1", "2", "3"]
    assert rows(tmp_path)[2]["loss"] != "0.5"


@posix_only
@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_a_signal_ends_after_the_step_and_saves(tmp_path: Path, name: str) -> None:
    class Signalling:
        def __getitem__(self, i: int) -> Any:
            if i == 2:
                os.kill(os.getpid(), getattr(signal, name))
            return stream()[i]

    before = signal.getsignal(getattr(signal, name))
    result = loop(replace(RECIPE, batch=1), tmp_path, samples=Signalling())()
    assert result.ended == name and 0 < result.step < 6
    assert checkpoint.load(tmp_path / "state").notes["progress"]["step"] == result.step
    assert signal.getsignal(getattr(signal, name)) is before


def test_another_recipe_is_refused_by_name(tmp_path: Path) -> None:
    loop(RECIPE, tmp_path)(Limits(steps=1))
    before = {f: f.read_bytes() for f in (tmp_path / "state").iterdir()}
    with pytest.raises(ValueError, match=r"another recipe: learning_rate 0.003 there, 0.1 now"):
        loop(replace(RECIPE, learning_rate=0.1), tmp_path, resume=True)
    other = replace(RECIPE, model=with_refine(LIFT, blocks=1))
    with pytest.raises(ValueError, match=r"model.refine.blocks 2 there, 1 now"):
        loop(other, tmp_path, resume=True)
    assert {f: f.read_bytes() for f in (tmp_path / "state").iterdir()} == before
    # How it runs may change.
    assert "lengths" not in checkpoint.load(tmp_path / "model").notes
    assert loop(replace(RECIPE, steps=2, report_every=7), tmp_path, resume=True)().step == 2
    # The rate fell for another number of steps at first, which the recipe alone does not say.
    assert checkpoint.load(tmp_path / "model").notes["lengths"] == [[0, RECIPE.steps], [1, 2]]


def test_damage_is_named(tmp_path: Path) -> None:
    loop(RECIPE, tmp_path)(Limits(steps=1))
    shard = next((tmp_path / "state").glob("*.safetensors"))
    shard.write_bytes(shard.read_bytes()[:-1])
    with pytest.raises(ValueError, match="damaged"):
        loop(RECIPE, tmp_path, resume=True)
    with pytest.raises(ValueError, match="no weights there"):
        loop(RECIPE, tmp_path / "nowhere", resume=True)


def test_a_compact_state_is_small_and_nearly_exact(tmp_path: Path) -> None:
    plain = loop(RECIPE, tmp_path / "plain")
    plain(Limits(steps=3))
    packed = loop(RECIPE, tmp_path / "packed", compact=True)
    packed(Limits(steps=3))
    size = {d: sum(f.stat().st_size for f in (tmp_path / d / "state").iterdir()) for d in ("plain", "packed")}
    assert size["packed"] < 0.5 * size["plain"]
    again = loop(RECIPE, tmp_path / "packed", resume=True)
    for (name, a), (_, b) in zip(plain.task.named_parameters(), again.task.named_parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-6, msg=name)
        if name in plain.run.average.values and a in plain.run.optimizer.state:
            assert int(again.run.optimizer.state[b]["step"]) == 3
    # Frozen weights are not in it: others are refused.
    torch.manual_seed(5)
    task = make_task(RECIPE, SplatPainterModel(LIFT), None, lambda line: None)
    with pytest.raises(ValueError, match="frozen weights are not these"):
        Loop(task, RECIPE, stream(), (), tmp_path / "packed", Group(), resume=True)
    assert again().step == 6


def test_the_state_is_whole_after_a_kill_while_saving(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loop(RECIPE, tmp_path)(Limits(steps=2))
    running = loop(RECIPE, tmp_path, resume=True)
    written = []

    def cut(path: Path) -> Any:
        if written:
            raise KeyboardInterrupt  # as good as a kill: nothing after it runs
        written.append(path)
        return writing(path)

    writing = checkpoint.writing
    monkeypatch.setattr(checkpoint, "writing", cut)
    with pytest.raises(KeyboardInterrupt):
        running(Limits(steps=1))
    monkeypatch.undo()
    assert json.loads((tmp_path / "state" / "model.json").read_text())["notes"]["progress"]["step"] == 2
    assert loop(RECIPE, tmp_path, resume=True)().step == 6
