"""`splatpainter edit --preset`: weights found, said, and refused in one line with nothing written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from splatpainter.io import read, write
from splatpainter.lift.options import LocalOptions
from splatpainter.models import checkpoint
from splatpainter.models.config import ModelConfig
from splatpainter.operations.operation import Tools
from splatpainter.operations.paint import Paint
from splatpainter.painter import Asset, EditSettings, Painter
from tests.support.cli_scenes import Capture, ball_and_painted_view, listing, paint, refused, rows_of, run
from tests.support.painter_scenes import ASSET_BASE, COPY, LIFT, built


@pytest.fixture
def view(tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A painted picture of ball.ply in a folder of its own; beside that, empty folders of weights and encodings."""
    monkeypatch.setenv("SPLATPAINTER_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("SPLATPAINTER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("splatpainter.models.weights.PACKAGED", tmp_path / "packaged")
    (tmp_path / "here").mkdir()
    return ball_and_painted_view(tmp_path / "here", capfd)


def save(folder: Path, config: ModelConfig, awake: float = 0.0) -> Path:
    built(config, awake=awake).save(folder, dtype="float32")
    return folder


def test_auto_takes_compact_once_its_weights_are_there(view: Path, tmp_path: Path, capfd: Capture) -> None:
    here = view.parent
    words = ["edit", here / "ball.ply", view]
    plain = run(capfd, *words, "--out", here / "lift.ply", "--json").json["receipt"]
    assert (plain["method"], plain["preset"]) == ("corrected", "lift") and "no trained weights" in plain["note"]
    save(tmp_path / "weights" / "compact", replace(LIFT, preset="compact"))
    done = run(capfd, *words, "--out", here / "ttt.ply", "--json").json
    receipt = done["receipt"]
    assert (receipt["method"], receipt["preset"]) == ("ttt", "compact") and done["verified"]
    assert "compact" in receipt["note"] and "encode" in receipt["seconds"]
    # Untrained, on the lift as networks know it, without sheets: the very file.
    painter = Painter(settings=EditSettings(local_options=LocalOptions(resurface=False)))
    write(
        here / "split.ply",
        Paint((view,), method="lift").apply(Asset(read(here / "ball.ply")), Tools(painter)).splats,
    )
    assert (here / "ttt.ply").read_bytes() == (here / "split.ply").read_bytes()
    assert list((tmp_path / "cache").glob("*.safetensors"))
    text = run(capfd, *words, "--out", here / "text.ply").out
    assert "method ttt with preset compact, mode local" in text and "note: weights of preset 'compact'" in text
    again = run(capfd, *words, "--out", here / "again.ply", "--preset", "lift").out
    assert "method lift, mode local" in again and "note: preset 'lift'" in again


@pytest.mark.parametrize("gain", [None, {"local": -0.33, "global": -0.2}], ids=["unjudged", "worse"])
def test_method_ttt_alone_takes_the_packaged_weights(
    view: Path, tmp_path: Path, capfd: Capture, gain: dict | None, precision: str
) -> None:
    folder = save(tmp_path / "packaged" / "compact", replace(LIFT, preset="compact"), awake=0.05)
    checkpoint.add_notes(folder, {"gain": gain} if gain else {})
    words = ["edit", view.parent / "ball.ply", view, "--method", "ttt"]
    done = run(capfd, *words, "--out", view.parent / "ttt.ply", "--json").json
    receipt = done["receipt"]
    assert (receipt["method"], receipt["preset"], receipt["precision"]) == ("ttt", "compact", precision)
    assert done["verified"] and "encode" in receipt["seconds"]
    output = run(capfd, *words, "--out", view.parent / "said.ply", "--precision", "float32", "--polish").out
    assert "method ttt with preset compact, mode local, in float32" in output and "note: polished" in output


def test_a_precision_that_there_is_not_is_refused(view: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPLATPAINTER_PRECISION", "fp8")
    line = "SPLATPAINTER_PRECISION: expected auto, float32 or bfloat16, got 'fp8'"
    assert line in refused(capfd, view.parent, view)


@pytest.mark.parametrize("mode", ["local", "global"])
def test_a_folder_of_weights_paints_and_the_file_proves_it(
    view: Path, tmp_path: Path, capfd: Capture, mode: str
) -> None:
    here, weights = view.parent, save(tmp_path / "mine", replace(ASSET_BASE, preset="mine"), awake=0.05)
    words = ["--preset", weights, "--mode", mode, "--polish", "--json"]
    done = run(capfd, "edit", here / "ball.ply", view, "--out", here / "out.ply", *words).json
    receipt = done["receipt"]
    assert done["verified"] and (receipt["method"], receipt["preset"]) == ("ttt", "mine")
    assert "polish" in receipt["note"] and receipt["touched_rows"] > 10
    assert (receipt["appended_rows"] > 0) == (mode == "local")
    before, after = rows_of(here / "ball.ply"), rows_of(here / "out.ply")
    same = (before == after[: len(before)]).all(1)
    assert int((~same).sum()) == receipt["touched_rows"]
    assert run(capfd, "verify", here / "ball.ply", here / "out.ply").code == 0


@pytest.mark.parametrize("preset", ["auto", "compact", "folder"])
def test_networks_that_make_no_local_edits_are_refused_before_they_are_read(
    view: Path, tmp_path: Path, capfd: Capture, preset: str
) -> None:
    settings = {"answers": "teachers", "picture_tokens": False, "row_tokens": 64, "detail": False}
    config = replace(LIFT, preset="compact", refine=replace(LIFT.refine, **settings))  # type: ignore[arg-type]
    folder = save(tmp_path / "weights" / "compact", config)
    for shard in folder.glob("weights-*"):
        shard.unlink()
    words = ["--preset", folder if preset == "folder" else preset, "--method", "ttt"]
    line = refused(capfd, view.parent, view, *words)
    assert "make global edits alone, and those of preset 'local' are not there" in line


@pytest.mark.parametrize("preset", ["auto", "local"])
def test_the_local_network_that_ships_paints_by_request_alone(
    view: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch, preset: str
) -> None:
    monkeypatch.setattr("splatpainter.models.weights.PACKAGED", checkpoint.PACKAGED)
    here = view.parent
    words = ["edit", here / "ball.ply", view, "--preset", preset, "--json", "--out"]
    by_default = run(capfd, *words, here / "auto.ply").json["receipt"]
    assert by_default["method"] == "corrected" and "preset 'local'" in by_default["note"]
    done = run(capfd, *words, here / "ttt.ply", "--method", "ttt").json
    receipt = done["receipt"]
    assert done["verified"] and (receipt["method"], receipt["preset"], receipt["mode"]) == ("ttt", "local", "local")
    assert "no better than the lift" in receipt["note"]
    assert (here / "auto.ply").read_bytes() != (here / "ttt.ply").read_bytes()


@pytest.mark.parametrize("preset", ["auto", "local"])
def test_without_their_distribution_networks_are_refused_in_a_line(
    view: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch, preset: str
) -> None:
    monkeypatch.setattr("splatpainter.models.weights.PACKAGED", checkpoint.PACKAGED)
    monkeypatch.setattr(checkpoint, "DISTRIBUTION_PACKAGE", "not_installed_here")
    line = refused(capfd, view.parent, view, "--preset", preset, "--method", "ttt")
    assert "the networks of 'local' are not installed" in line and "pip install 'splatpainter[networks]'" in line


def test_weights_that_cannot_be_used_are_refused(view: Path, tmp_path: Path, capfd: Capture) -> None:
    here = view.parent
    newer = save(tmp_path / "newer", ASSET_BASE)
    index = newer / "model.json"
    index.write_text(index.read_text().replace('"version": 1', '"version": 9'))
    save(tmp_path / "weights" / "paper", replace(ASSET_BASE, preset="compact"))
    copy = save(tmp_path / "copy", COPY)
    cases = [
        (["--preset", "compact"], "preset 'compact': no trained weights"),
        (
            ["--preset", "tiny"],
            "expected one of auto, lift, paper, compact, rows, local, or a folder of weights, got 'tiny'",
        ),
        (["--preset", "paper"], "these are of preset 'compact'"),
        (["--preset", newer], "newer SplatPainter"),
        (["--preset", here], "no weights there"),
        (["--preset", copy], "representation copy"),
        (["--preset", "lift", "--method", "ttt"], "trained weights"),
        (["--method", "ttt"], "trained weights"),
        (["--polish"], "--polish is for method ttt"),
    ]
    for words, pattern in cases:
        assert pattern in refused(capfd, here, view, *words), words


def test_pictures_that_networks_cannot_take_together_are_refused(view: Path, tmp_path: Path, capfd: Capture) -> None:
    here, weights = view.parent, save(tmp_path / "mine", ASSET_BASE)
    words = ["render", here / "ball.ply", "--out", here / "small", "--views", 1, "--size", 64]
    assert run(capfd, *words).code == 0
    small = paint(here / "small" / "view_000.png", here / "small.png", (26, 29, 36, 35))
    for pictures, pattern in (([view, small], "one size, got 64x64, 96x96"), ([view] * 17, "1 to 16 pictures")):
        before = listing(here)
        done = run(capfd, "edit", here / "ball.ply", *pictures, "--out", here / "out.ply", "--preset", weights)
        assert pattern in done.error and listing(here) == before
    air = paint(here / "views" / "view_000.png", here / "air.png", (0, 0, 1, 1))
    assert "no Gaussian" in refused(capfd, here, air, "--preset", weights)
    # The lift takes both sizes.
    both = ["edit", here / "ball.ply", view, small, "--out", here / "both.ply", "--preset", "lift"]
    assert run(capfd, *both).code == 0
