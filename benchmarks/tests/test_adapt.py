"""The bench of carriers: once from start to end with tiny networks, and its arithmetic by hand."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from splatbench import adapt, adapt_carriers
from splatbench.adapt import SHIPPED, SHIPPED_STAGE2, AdaptBench, EditScore, means, relative, remarks
from splatbench.adapt_carriers import MESA, TRAINED, carrier_training

from splatpainter.models import weights
from splatpainter.models.config import PredictConfig
from splatpainter.models.model import SplatPainterModel
from splattrain.data import gaussian_edits, lit_assets
from splattrain.recipes import Recipe
from tests.models.test_edit_propagation import CARRYING
from train.tests.test_gaussian_edit_task import RECIPE

TINY_RECIPE: Recipe = replace(RECIPE, model=replace(CARRYING, predict=PredictConfig(features=8, hidden=16)))


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A checkpoint with a tiny encoder; recipes, lights and fits as small."""
    monkeypatch.setattr(adapt_carriers, "recipe", lambda: TINY_RECIPE)
    monkeypatch.setattr(adapt_carriers, "SLICE_SECONDS", 0.05)
    monkeypatch.setattr(lit_assets, "FIT_STEPS", 4)
    monkeypatch.setattr(gaussian_edits, "LIGHT_COUNT", 6)
    monkeypatch.setattr(adapt, "STOPS", (0.5, 1.0))
    monkeypatch.setattr(adapt, "MIN_UNSEEN", 8)
    monkeypatch.setattr(weights, "find", lambda preset, *more: tmp_path / "encoder")
    monkeypatch.setenv("SPLATPAINTER_CACHE", str(tmp_path / "cache"))
    torch.manual_seed(0)
    SplatPainterModel(TINY_RECIPE.model).save(tmp_path / "encoder", dtype="float32")
    yield tmp_path


def test_carriers_differ_in_their_memory_alone(tiny: Path) -> None:
    made = {name: carrier_training(name, tiny / "encoder") for name in TRAINED}
    stage2 = [one.task.model for name, one in made.items() if name != MESA]
    for one in stage2[1:]:
        plain = replace(one.config.refine, mixer="ttt", inner_steps=1, newton_schulz_steps=5)
        assert plain == stage2[1].config.refine
        assert torch.equal(one.compressor.token.weight, stage2[0].compressor.token.weight)
    assert {one.task.options.carrier for one in made.values()} == {"predictor", "stage2"}


def test_from_start_to_end(tiny: Path) -> None:
    chosen = (MESA, "TTT, Muon, 1 step")
    config = AdaptBench(
        seconds=0.2, objects=1, training_objects=1, encoder=tiny / "encoder", carriers=chosen, out=tiny / "out"
    )
    rows = adapt.run(config)
    names = [row.carrier for row in rows]
    assert names[:2] == ["nothing", "ridge on fixed features"] and set(chosen) < set(names)
    assert {SHIPPED, SHIPPED_STAGE2, f"{SHIPPED_STAGE2}: another edit"} < set(names)
    assert f"{chosen[1]}: strength 0" in names and f"{MESA}: strength 0" not in names
    spent = {row.carrier: row.cpu_seconds for row in rows if row.cpu_seconds is not None}
    assert set(spent) == set(chosen) and all(0.2 <= seconds < 1.5 for seconds in spent.values())
    assert all(row.relight is not None and 5 < row.relight < 60 for row in rows)
    with open(tiny / "out" / "curve.csv", newline="") as file:
        points = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert [point["carrier"] for point in points] == 3 * list(chosen)
    assert "<svg" in (tiny / "out" / "curve.svg").read_text()
    assert "adapting is worth" in (tiny / "out" / "adapt.md").read_text()
    saved = SplatPainterModel.load(tiny / "out" / "weights" / "ttt-muon-1-step")
    assert saved.notes["stage"] == "rows" and saved.config.refine.answers == "teachers"
    # Trained carriers are not trained again, and say the same.
    again = adapt.run(config)
    assert [row.relight for row in again] == pytest.approx([row.relight for row in rows], abs=0.05)


def test_means_are_by_asset_and_views() -> None:
    scores = [
        EditScore("a", k, f"object {k % 2}", asset, kind, views, float(psnr), None)  # type: ignore[arg-type]
        for k, (asset, kind, views, psnr) in enumerate(
            [
                ("coarse", "relight", 1, 20),
                ("coarse", "relight", 1, 22),
                ("fitted", "relight", 4, 30),
                ("coarse", "recolor", 1, 11),
            ]
        )
    ]
    (row,) = means(scores, {"a": 1.25})  # type: ignore[arg-type]
    assert (row.coarse_1, row.coarse_2, row.fitted_4, row.recolor, row.relight) == (21, None, 30, 11, 24)
    assert row.cpu_seconds == 1.2 and row.low is not None and row.high is not None and row.low <= 24 <= row.high


def test_adaptation_is_the_difference() -> None:
    name = "TTT, Muon, 1 step"
    scores = [EditScore(name, 0, "o", "coarse", "relight", 1, 24.0, None)]
    scores += [EditScore(f"{name}: strength 0", 0, "o", "coarse", "relight", 1, 22.5, 0.4)]
    (line,) = remarks(scores, [])
    assert "adapting is worth +1.50 dB against strength 0" in line and "40%" in line
    assert relative(torch.tensor([[3.0, 4.0]]), torch.tensor([[0.0, 4.0]])) == pytest.approx(0.75)
    assert np.isfinite(relative(torch.zeros(1, 3), torch.zeros(1, 3)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"seconds": 0.0}, "expected --seconds above 0"),
        ({"carriers": ("magic",)}, "expected --carriers of"),
        ({"carriers": ()}, "at least one of --carriers"),
    ],
)
def test_wrong_options_are_one_line(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        adapt.run(AdaptBench(**settings))
