"""`splatpainter grade`: every kind of look on a file, proved; and what it refuses, with nothing written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter.grading.color_grading import GradeSettings, grade_sh
from splatpainter.io import read
from splatpainter.painter import Painter
from tests.support.cli_scenes import Capture, ball, listing, rows_of, run, saved


@pytest.fixture()
def asset(tmp_path: Path) -> Path:
    return saved(tmp_path / "ball.ply", ball(1200))


def test_untouched_gaussians_keep_their_bytes_and_verify_agrees(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "warm.ply"
    done = run(capfd, "grade", asset, "--exposure", "0.5", "--where", "hue=340..20", "--out", out)
    assert done.code == 0 and "exposure 0.5" in done.out and "where hue=340..20" in done.out
    same = (rows_of(asset) == rows_of(out)).all(1)
    cap = ball(1200).means[:, 1] < -0.8
    np.testing.assert_array_equal(~same, cap)
    receipt = json.loads((tmp_path / "warm.ply.receipt.json").read_text())
    assert receipt["touched_rows"] == cap.sum() and receipt["mode"] == "grade" and receipt["appended_rows"] == 0
    assert run(capfd, "verify", asset, out).code == 0
    assert run(capfd, "verify", asset, out, "--receipt", out.with_name("other.json")).code == 2


def test_sliders_are_the_adjustment_layer_of_the_studio(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    words = ["--temperature", "0.5", "--contrast", "-0.3", "--hue", "40"]
    assert run(capfd, "grade", asset, *words, "--out", tmp_path / "a.ply").code == 0
    look = GradeSettings.from_dict(
        {"temperature": 0.5, "contrast": -0.3, "hues": [{"hue": 0.0, "width": 1e6, "shift": 40.0}]}
    )
    (tmp_path / "look.json").write_text(json.dumps(look.to_dict()))
    assert run(capfd, "grade", asset, "--look", tmp_path / "look.json", "--out", tmp_path / "b.ply").code == 0
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    expected = grade_sh(read(asset).sh, look.to_dict())
    np.testing.assert_allclose(read(tmp_path / "a.ply").sh, expected, atol=1e-6)


def test_every_other_look_grades(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    (tmp_path / "n.cube").write_text("LUT_1D_SIZE 2\n1 1 1\n0 0 0\n")
    Image.new("RGB", (8, 8), (200, 120, 60)).save(tmp_path / "dusk.png")
    looks = {
        "lut": (["--lut", tmp_path / "n.cube"], "LUT n.cube"),
        "match": (["--match", tmp_path / "dusk.png", "--strength", "0.5"], "colours of dusk.png; strength 0.5"),
        "recolor": (["--recolor", "#2040a0"], "colour #2040a0"),
    }
    for name, (words, note) in looks.items():
        done = run(capfd, "grade", asset, *words, "--out", tmp_path / f"{name}.spz", "--json")
        assert done.code == 0 and done.json["verified"], done
        assert done.json["receipt"]["note"].startswith(note)


@pytest.mark.parametrize(
    "words, line",
    [
        ([], "expected sliders or one look (--exposure, --temperature, "),
        (["--exposure", "1", "--recolor", "#ffffff"], "got --recolor and sliders"),
        (["--lut", "no.cube"], "no.cube: no such file"),
        (["--look", "ball.ply"], "ball.ply: a look is not JSON"),
        (["--match", "ball.ply"], "ball.ply"),
        (["--recolor", "blue"], "expected --recolor like #2040a0, got 'blue'"),
        (["--exposure", "99"], "expected --exposure from -10 to 10, got 99.0"),
        (["--exposure", "nan"], "expected --exposure from -10 to 10, got nan"),
        (["--exposure", "1", "--where", "hue=red"], "--where hue: expected A..B, ..B or A.., got 'red'"),
        (["--exposure", "1", "--where", "x=9.."], "reaches none of 1200 Gaussians"),
        (["--exposure", "1", "--strength", "0"], "expected --strength above 0, up to 1, got 0.0"),
    ],
)
def test_what_cannot_be_graded_is_one_line_and_writes_nothing(
    words: list[str], line: str, asset: Path, tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = listing(tmp_path)
    done = run(capfd, "grade", "ball.ply", *words, "--out", "out.ply")
    assert line in done.error and listing(tmp_path) == before


def test_a_look_file_names_what_is_wrong_in_it(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    (tmp_path / "look.json").write_text('{"exposure": "much"}')
    done = run(capfd, "grade", asset, "--look", tmp_path / "look.json", "--out", tmp_path / "out.ply")
    assert done.error.endswith("look.json: expected float as 'exposure', got 'much'")


def test_a_layer_of_the_studio_is_a_look(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    settings = {"exposure": 0.4, "curve": [[0.3, 0.4]], "hues": [{"hue": 0.0, "shift": 40.0}]}
    with sp.Session(asset, painter=Painter()) as session:
        layer = session.layers.add("look", look="grade", settings=settings)
        session.files.export_layer(layer.id, tmp_path / "a.splatlayer")
        session.files.export(tmp_path / "session.ply")
        session.layers.set(layer.id, blend="color")
        session.files.export_layer(layer.id, tmp_path / "b.splatlayer")
        gain = session.layers.add("look", look="gain", settings={"gain": [2, 1, 1]})
        session.files.export_layer(gain.id, tmp_path / "c.splatlayer")
    assert run(capfd, "grade", asset, "--look", tmp_path / "a.splatlayer", "--out", tmp_path / "o.ply").code == 0
    assert (tmp_path / "o.ply").read_bytes() == (tmp_path / "session.ply").read_bytes()
    for name, line in (
        ("b", "expected a layer of blend normal, got color"),
        ("c", "expected an adjustment layer with"),
    ):
        done = run(capfd, "grade", asset, "--look", tmp_path / f"{name}.splatlayer", "--out", tmp_path / "p.ply")
        assert line in done.error


def test_the_asset_and_its_inputs_are_never_overwritten(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    assert "is the input itself" in run(capfd, "grade", asset, "--exposure", 1, "--out", asset).error
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    words = ["--match", tmp_path / "a.png", "--out", tmp_path / "o.ply", "--receipt", tmp_path / "a.png", "--overwrite"]
    assert "is an input" in run(capfd, "grade", asset, *words).error
