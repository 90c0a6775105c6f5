"""Which objects no training sees, and that a checkpoint of another split is refused wherever it would be judged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from splatpainter.cli import main
from splatpainter.models import checkpoint, weights
from splattrain import recipes
from splattrain.data.held_out import HeldOut
from splattrain.data.object_sources import HELD_OUT_SHARE, split
from splattrain.recipes import STAGES
from splattrain.training_data import DataSettings, ResourceFolders
from tests.support.train_scenes import RECIPE, SAMPLES, model

NAMES = [f"thing{k}" for k in range(200)]
TRAINED, APART = split(NAMES)


def noted(rule: HeldOut, *before: HeldOut) -> dict[str, Any]:
    return {
        "stage": "refine",
        "held_out": rule.note(),
        "history": [{"stage": "lrm", "held_out": r.note()} for r in before],
    }


def test_all_recipes_hold_out_what_benches_measure() -> None:
    for path in recipes.FOLDER.glob("*.json"):
        name, _, stage = path.stem.rpartition("-")
        assert stage in STAGES and recipes.load(name, stage).validation_share == HELD_OUT_SHARE, path
    for name in ("compact", "rows"):
        folder = weights.find(name)
        assert folder is not None and HeldOut().leak(checkpoint.notes(folder)) == ""


@pytest.mark.parametrize(
    ("rule", "notes", "problem"),
    [
        (HeldOut(), noted(HeldOut()), ""),
        (HeldOut(0.02), noted(HeldOut(0.1)), ""),  # what is held out here was held out there too
        (HeldOut(), noted(HeldOut(0.02)), "stage refine held out a share of 0.02, here 0.1 is held out"),
        (HeldOut(), noted(HeldOut(), HeldOut(0.02)), "stage lrm held out a share of 0.02"),
        (HeldOut(), {"recipe": {"validation_share": 0.02}}, "held out a share of 0.02"),  # before notes said it
        (HeldOut(), {}, ""),
        (HeldOut(names=("a", "b")), noted(HeldOut(names=("b", "a"))), ""),
        (HeldOut(names=("a", "c")), noted(HeldOut(names=("a", "b"))), "held out a list of 2 objects, here 2 others"),
        (HeldOut(), noted(HeldOut(names=("a", "b"))), "held out a list of 2 objects, here a share of 0.1"),
        (HeldOut(names=tuple(APART)), noted(HeldOut()), ""),
        (HeldOut(names=(TRAINED[0], *APART)), noted(HeldOut()), f"1 of the {len(APART) + 1} names were trained on"),
        (HeldOut(names=("a",)), noted(HeldOut(0.0)), "1 of the 1 names were trained on"),
    ],
)
def test_a_leak_is_seen_in_the_notes(rule: HeldOut, notes: dict[str, Any], problem: str) -> None:
    answer = rule.leak(notes)
    assert problem in answer and bool(answer) == bool(problem)


def test_a_list_of_names_splits_a_folder(tmp_path: Path) -> None:
    folder, file = tmp_path / "meshes", tmp_path / "names.txt"
    folder.mkdir()
    for k in range(6):
        (folder / f"m{k}.obj").write_text("v 0 0 0\n")
    file.write_text("# the paper's\n\nm4\nm1\n")
    settings = DataSettings(str(folder), SAMPLES, 0, 0.1, ResourceFolders(), names=HeldOut.of_file(file).names)
    source = settings.stream(validation=True).source
    assert [source.name(i) for i in range(len(source))] == ["m1", "m4"] and settings.counts() == (4, 2)
    with pytest.raises(ValueError, match=r"1 of the 1 objects of --names are not there, such as 'm9'"):
        replace(settings, names=("m9",)).stream()
    with pytest.raises(ValueError, match="procedural objects have no list"):
        replace(settings, data="procedural:3").stream()


@pytest.mark.parametrize(
    ("text", "message"), [("", "holds no name"), ("# a\n", "holds no name"), ("a\nb\na\n", "'a' stands there twice")]
)
def test_lists_that_are_none(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "names.txt"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        HeldOut.of_file(file)
    with pytest.raises(ValueError, match="no such file"):
        HeldOut.of_file(tmp_path / "none.txt")


def test_another_split_is_refused_by_train_and_judge(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "model"
    notes = {"stage": "refine", "recipe": RECIPE.to_dict(), "held_out": {"share": 0.02}}
    model().save(folder, notes=notes)
    out = ["--out", str(tmp_path / "out"), "--data", "procedural:2", "--device", "cpu"]
    assert main(["train", "refine", *out, "--from", str(folder)]) == 2
    line = "stage refine held out a share of 0.02, here 0.1 is held out"
    assert line in capsys.readouterr().err
    assert main(["train", "judge", str(folder), *out]) == 2
    assert line in capsys.readouterr().err and not (tmp_path / "out").exists()
