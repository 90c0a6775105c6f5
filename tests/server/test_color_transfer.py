"""Adjustment layers by a LUT, the colours of a picture and one new colour: over the socket, in projects and in layers'
files; and what is wrong with them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatpainter.color import base_color
from splatpainter.grading import color_match
from splatpainter.grading.color_match import ColorMatch, Recolor
from splatpainter.grading.color_transfer import transfer_sh
from splatpainter.grading.cube_lut import CubeLut, parse_cube
from splatpainter.operations.grade import grade, read_look
from splatpainter.pictures.picture_reader import Picture
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.session import Session
from tests.support.studio_scenes import Live, live, make_studio

INVERTED = "LUT_3D_SIZE 2\n" + "\n".join(f"{1 - r} {1 - g} {1 - b}" for b in (0, 1) for g in (0, 1) for r in (0, 1))


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Live]:
    with live(make_studio(tmp_path)) as served:
        yield served


def base(sh: np.ndarray) -> np.ndarray:
    return np.clip(base_color(sh), 0, 1)


def test_each_kind_is_previewed_committed_and_the_same_as_on_the_command_line(
    studio: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(color_match, "MATCHING", replace(color_match.MATCHING, views=3))
    original = studio.studio.session.original
    red = np.zeros((8, 8, 3), np.float32) + np.array([0.8, 0.2, 0.1], np.float32)
    red[::2] *= 0.7
    table = studio.send(INVERTED.encode(), "inverted.cube")
    picture = studio.send(png_bytes(red), "red.png")
    pixels = np.round(red * 255).astype(np.float32) / 255
    cases = [
        ({"kind": "lut", "file": table}, parse_cube(INVERTED, "inverted.cube"), "inverted.cube"),
        ({"kind": "match", "file": picture, "strength": 0.5}, ColorMatch(Picture(pixels, None)), "red.png"),
        ({"kind": "recolor", "color": "#2040a0"}, Recolor((32 / 255, 64 / 255, 160 / 255)), "#2040a0"),
    ]
    with studio.greeted() as browser:
        for transfer, look, name in cases:
            answer = browser.do("look.preview", transfer=transfer)
            assert answer["gaussians"] == len(original) and browser.mirror.previews
            made = browser.do("look.commit", transfer=transfer, name=name)["layer"]
            assert made["parameters"]["name"] == name and made["kind"] == "look"
            expected = grade(original, look, strength=transfer.get("strength", 1.0)).splats
            assert np.allclose(studio.studio.session.splats.sh, expected.sh, atol=1e-5)
            path = tmp_path / f"{transfer['kind']}.splatlayer"
            studio.studio.session.files.export_layer(made["id"], path)
            again = grade(original, read_look(path)).splats
            assert np.allclose(again.sh, expected.sh, atol=1e-5)
            browser.do("undo")
        browser.do("redo")
    session = studio.studio.session
    assert session.verify() == []


def test_a_lut_outlives_the_studio_and_keeps_to_what_is_selected(studio: Live, tmp_path: Path) -> None:
    session = studio.studio.session
    weights = (session.splats.means[:, 0] > 0).astype(np.float32)
    studio.studio.selection.choose(weights)
    studio.post("look.commit", transfer={"kind": "lut", "file": studio.send(INVERTED.encode(), "inverted.cube")})
    sh = session.splats.sh
    inverted = np.abs(base(sh) - (1 - base(session.original.sh))).max(1) < 0.01
    same = (sh == session.original.sh).all((1, 2))
    assert inverted[weights > 0].all() and same[weights == 0].all()
    session.files.save_copy(tmp_path / "copy.splatproj")
    with Session.load(tmp_path / "copy.splatproj") as loaded:
        assert np.array_equal(loaded.splats.sh, sh) and loaded.verify(repaint=True) == []


def test_what_is_wrong_is_said_in_one_line(studio: Live) -> None:
    picture = studio.send(png_bytes(np.zeros((4, 4, 3), np.float32)))
    broken = studio.send(b"LUT_3D_SIZE 2\n0 0 0\n", "broken.cube")
    for transfer, words in (
        ({"kind": "lut", "file": picture}, "expected a lut, got a picture"),
        ({"kind": "lut", "file": broken}, "broken.cube: expected 8 entries"),
        ({"kind": "lut"}, "expected a file"),
        ({"kind": "match", "file": broken}, "expected a picture, got a lut"),
        ({"kind": "recolor"}, "expected a colour"),
        ({"kind": "recolor", "color": "blue"}, "color"),
    ):
        answer = studio.http.post("/api/do/look.commit", json={"transfer": transfer})
        assert answer.status_code == 400 and words in answer.json()["error"]["message"], answer.text
    both = studio.http.post(
        "/api/do/look.commit", json={"transfer": {"kind": "recolor", "color": "#000000"}, "look": {}}
    )
    assert "either sliders or colours" in both.text
    assert studio.post("look.preview")["gaussians"] == 0  # ends a preview
    assert list(studio.studio.session.layers) == []


def test_parameters_and_tables_of_strangers_are_judged() -> None:
    sh = np.zeros((3, 1, 3), np.float32)
    good = {"look": "match", "matrix": np.eye(3).tolist(), "start": [0, 0, 0], "end": [0.1, 0, 0], "strength": 1.0}
    assert transfer_sh(sh, good).shape == sh.shape
    for change in (
        {"matrix": [[1, 2], [3, 4]]},
        {"start": ["a", 0, 0]},
        {"end": [True, 0, 0]},
        {"end": [float("nan"), 0, 0]},
        {"strength": 2},
        {"strength": None},
        {"space": "cie"},
        {"look": "recolor", "target": [0, 0, 1], "mean": 0},
        {"look": "lut", "table": "0" * 64},
        {"look": "lut", "table": b"no picture"},
    ):
        with pytest.raises(ValueError, match="^(look|LUT): expected"):
            transfer_sh(sh, {**good, **change})
    lut = parse_cube("LUT_1D_SIZE 2\nLUT_3D_SIZE 2\nLUT_3D_INPUT_RANGE -1 2\n0 0 0\n1 2 1\n" + "0.5 0 1\n" * 8, "two")
    again = CubeLut.from_png(lut.to_png(), "two")
    colors = np.random.default_rng(0).uniform(size=(50, 3)).astype(np.float32)
    assert np.array_equal(again(colors), lut(colors)) and again.cube_domain == lut.cube_domain
