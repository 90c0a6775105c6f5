"""scripts/ship_weights.py: a run's weights as the packages hold them."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from splatpainter.models import checkpoint, weights
from splatpainter.models.config import PredictConfig
from splatpainter.models.local_network import LocalNetwork
from splatpainter.models.model import SplatPainterModel
from splattrain import recipes
from splattrain.data.held_out import HeldOut
from tests.models.test_edit_propagation import CARRYING
from tests.models.test_local_network import CONFIG as LOCAL_CONFIG

MODEL = replace(
    CARRYING,
    preset="anything",
    refine=replace(CARRYING.refine, latents=False),
    predict=PredictConfig(features=8, hidden=16, alone=True),
)


@pytest.fixture
def script() -> ModuleType:
    path = Path(__file__).parents[2] / "scripts/ship_weights.py"
    spec = importlib.util.spec_from_file_location("ship_weights", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules["ship_weights"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def trained(folder: Path, seed: int = 0, predictor_seed: int = 0) -> SplatPainterModel:
    torch.manual_seed(seed)
    made = SplatPainterModel(MODEL)
    torch.manual_seed(predictor_seed)
    assert made.predictor is not None
    torch.nn.init.normal_(made.predictor.expected.weight)
    for parameter in made.predictor.own.parameters():
        torch.nn.init.normal_(parameter)
    for part in (made.predictor.company, made.predictor.evidence, made.predictor.together, made.predictor.describe):
        for parameter in part.parameters():
            torch.nn.init.normal_(parameter)
    made.save(folder, notes={"stage": "rows", "step": 3})
    (folder.parent / "log.csv").write_text("step,loss,skipped\n1,-1.0,\n2,-3.0,\n")
    return made


def test_a_model_becomes_two_presets_that_share_their_tensors(script: ModuleType, tmp_path: Path) -> None:
    made, core, networks = trained(tmp_path / "run/model"), tmp_path / "core", tmp_path / "networks"
    assert script.ship(tmp_path / "run/model", core, networks) == ["compact", "rows"]
    # With the core lies what global edits need; the rest, once, with the networks.
    arrays = checkpoint.load_arrays(core / "compact", "predictor.")
    assert made.predictor is not None and set(arrays) == set(made.predictor.state_dict())
    assert len(list((networks / "compact").iterdir())) == 1 and not (networks / "rows").exists()
    for shard in (networks / "compact").iterdir():
        shutil.copy(shard, core / "compact")
    compact, rows = (SplatPainterModel.load(core / name, name) for name in ("compact", "rows"))
    assert compact.config.predictor_only and rows.config.carries and rows.predictor is None
    for name, tensor in rows.state_dict().items():
        assert torch.equal(tensor, made.state_dict()[name].half().float())
        assert torch.equal(tensor, compact.state_dict()[name])
    assert rows.notes["loss"] == {"first": -2.0, "last": -2.0} and rows.notes["step"] == 3


def test_what_was_judged_of_a_predictor_stays_with_it_alone(script: ModuleType, tmp_path: Path) -> None:
    core, networks = tmp_path / "core", tmp_path / "networks"
    trained(tmp_path / "one/model")
    script.ship(tmp_path / "one/model", core, networks)
    checkpoint.add_notes(core / "compact", {"gain": {"global": 0.1}, "judged": {"rows": []}})
    trained(tmp_path / "two/model", seed=1)
    script.ship(tmp_path / "two/model", core, networks)
    assert checkpoint.notes(core / "compact")["gain"] == {"global": 0.1}
    assert len(list((networks / "compact").iterdir())) == 1, "the old one is gone"
    trained(tmp_path / "three/model", predictor_seed=1)
    script.ship(tmp_path / "three/model", core, networks)
    assert "gain" not in checkpoint.notes(core / "compact")


def test_a_local_network_is_a_preset_and_other_weights_do_not_ship(script: ModuleType, tmp_path: Path) -> None:
    LocalNetwork(LOCAL_CONFIG).save(tmp_path / "local/model")
    assert script.ship(tmp_path / "local/model", tmp_path / "core", tmp_path / "networks") == ["local"]
    assert (tmp_path / "core/local/model.json").is_file() and list((tmp_path / "networks/local").iterdir())
    SplatPainterModel(CARRYING).save(tmp_path / "whole/model")
    with pytest.raises(ValueError, match="expected a predictor and a Stage II"):
        script.ship(tmp_path / "whole/model", tmp_path / "core", tmp_path / "networks")


@pytest.mark.parametrize(("preset", "recipe"), [("compact", "compact"), ("rows", "compact"), ("local", "paint")])
def test_what_ships_was_made_by_its_recipe_in_one_go(preset: str, recipe: str) -> None:
    """`splatpainter train rows --recipe ...` on the data of the model card makes it again."""
    notes = checkpoint.notes(weights.PACKAGED / preset)
    made = recipes.parse(json.dumps(notes["recipe"]), "rows")
    expected = recipes.load(recipe, "rows")
    assert replace(made, validate_every=expected.validate_every) == expected
    assert notes["step"] == expected.steps and "lengths" not in notes
    assert notes["held_out"] == HeldOut().note()
    assert [past["stage"] for past in notes.get("history", [])] == (["predict"] if preset != "local" else [])


def test_the_predictor_that_ships_was_made_by_its_recipe() -> None:
    (past,) = checkpoint.notes(weights.PACKAGED / "compact")["history"]
    expected = replace(recipes.load("compact", "predict"), seed=12)  # as docs/TRAINING.md says
    assert past["step"] == expected.steps and past["recipe"]["seed"] == expected.seed
    noted = {key: value for key, value in past["recipe"].items() if key != "samples"}
    assert noted and {key: expected.to_dict()[key] for key in noted} == noted
    kinds = {kind: weight for kind, weight in past["recipe"]["samples"]["kinds"].items() if weight}
    assert kinds == {kind: weight for kind, weight in expected.samples.kinds.items() if weight}
