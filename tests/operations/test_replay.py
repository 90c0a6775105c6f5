"""A project's layers as an operation: the same bytes as the session's own export, wherever there are operations."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.operations.operation import operation_of
from splatpainter.painter import Painter
from tests.support.batch_jobs import CAMERA
from tests.support.cli_scenes import Capture, ball, listing, run, saved

PROJECT = Path("brand.splatproj")


def stripe(splats: sp.Splats) -> sp.Edit:
    picture = sp.render(splats, CAMERA).colors[0].copy()
    picture[40:50, 40:56] = (0.1, 0.6, 0.2)
    mask = np.zeros(picture.shape[:2], bool)
    mask[40:50, 40:56] = True
    return sp.Edit(picture, CAMERA, mask)


def add_layers(session: sp.Session) -> None:
    session.layers.add("paint", [stripe(session.splats)], name="stripe")
    session.layers.add("look", look="grade", settings={"exposure": -0.5}, name="darker")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """ball.ply with a project of two layers, expected.ply as it exports them, and other.ply, which stands there too."""
    monkeypatch.chdir(tmp_path)
    saved(tmp_path / "ball.ply", ball(900))
    saved(tmp_path / "other.ply", ball(700))
    with sp.Session("ball.ply", PROJECT, painter=Painter()) as session:
        add_layers(session)
        session.files.export("expected.ply")
    return tmp_path


def test_the_same_bytes_from_every_place_that_has_operations(folder: Path, capfd: Capture) -> None:
    done = run(capfd, "edit", "ball.ply", "replay", PROJECT, "--out", "words.ply", "--json")
    assert done.code == 0, done.err
    assert done.json["receipt"]["mode"] == "session" and done.json["receipt"]["note"] == "layers: stripe, darker"
    operation = sp.ReplayLayers(PROJECT)
    sp.apply_to_file(
        Path("ball.ply"), [operation_of(json.loads(json.dumps(operation.record())), "x")], Path("json.ply")
    )
    sp.write("memory.ply", sp.edit(sp.read("ball.ply"), [operation]).splats)
    for name in ("layers", "replay"):
        step = "{project: brand.splatproj}"
        (folder / f"{name}.yaml").write_text(f"assets: [ball.ply]\nout: {name}\nedits: [{{{name}: {step}}}]\n")
        assert run(capfd, "batch", f"{name}.yaml").code == 0
    for name in ("words.ply", "json.ply", "memory.ply", "layers/ball.ply", "replay/ball.ply"):
        assert (folder / name).read_bytes() == (folder / "expected.ply").read_bytes(), name
    assert run(capfd, "verify", "ball.ply", "words.ply").code == 0


def test_in_a_list_there_is_one_receipt(folder: Path, capfd: Capture) -> None:
    words = ["grade", "--saturation", "-0.4", "replay", PROJECT, "--only", "stripe", "grade", "--hue", "30"]
    done = run(capfd, "edit", "other.ply", *words, "--out", "list.ply", "--json")
    assert done.code == 0, done.err
    assert [entry["kind"] for entry in done.json["receipt"]["operations"]] == ["grade", "replay", "grade"]
    assert run(capfd, "verify", "other.ply", "list.ply").code == 0
    # By hand: what a layer of a session makes of the graded asset.
    graded = sp.edit(sp.read("other.ply"), [sp.Grade(saturation=-0.4)]).splats
    with sp.Session("ball.ply", painter=Painter()) as session:
        pictured = stripe(session.splats)
    with sp.Session(graded, painter=Painter()) as session:
        session.layers.add("paint", [pictured])
        sp.write("expected.ply", sp.edit(session.splats, [sp.Grade(hue=30)]).splats, overwrite=True)
    result, expected = sp.read("list.ply"), sp.read("expected.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(result, name), getattr(expected, name), name)
    assert len(result) > 700


def test_on_its_own_asset_nothing_is_painted_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("painted anew")

    monkeypatch.setattr(Painter, "apply", refuse)
    made = sp.edit(sp.read("ball.ply"), [sp.ReplayLayers(PROJECT)])
    assert made.receipt is not None and len(made.receipt.touched)
    # The same file with its axes turned is another asset to its layers.
    with pytest.raises(AssertionError, match="painted anew"):
        sp.edit(sp.read("ball.ply", axes="rub"), [sp.ReplayLayers(PROJECT)])


@pytest.mark.parametrize(
    "words, line",
    [
        ([PROJECT, "--only", "logo"], "expected visible layers, got none called logo"),
        ([PROJECT, "--layers-of", "rug"], "expected asset to be one of 'ball.ply', got 'rug'"),
        (["ball.ply"], "ball.ply"),
        ([], "expected PROJECT.splatproj, the project with the layers"),
    ],
)
def test_what_cannot_be_replayed_is_one_line_and_writes_nothing(
    words: list, line: str, folder: Path, capfd: Capture
) -> None:
    before = listing(folder)
    done = run(capfd, "edit", "other.ply", "replay", *words, "--out", "out.ply")
    assert line in done.error and listing(folder) == before


@pytest.mark.parametrize("name", ["noted.ply", "noted.compressed.ply"])
@pytest.mark.parametrize("is_original", [True, False], ids=["its project", "a project of another"])
def test_what_a_file_holds_beside_its_gaussians_stays(
    folder: Path, capfd: Capture, name: str, is_original: bool
) -> None:
    sp.write(name, sp.read("other.ply"))
    data = Path(name).read_bytes()
    Path(name).write_bytes(data.replace(b"element", b"comment scanned in the museum\nelement", 1))
    project = PROJECT
    if is_original:
        project = Path("noted.splatproj")
        with sp.Session(name, project, painter=Painter()) as session:
            session.layers.add("paint", [stripe(session.splats)], name="stripe")
    done = run(capfd, "edit", name, "replay", project, "--only", "stripe", "--out", f"new-{name}", "--json")
    assert done.code == 0, done.err
    assert b"comment scanned in the museum\n" in Path(f"new-{name}").read_bytes()[:400]
    verified = run(capfd, "verify", name, f"new-{name}", "--json")
    assert verified.code == 0 and verified.json["same"] > 500, verified.json
    if is_original:
        done = run(capfd, "edit", name, "replay", project, "--out", f"all-{name}", "--json")
        assert done.code == 0, done.err
