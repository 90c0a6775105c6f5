"""The studio's bench: its patches against the paint they are cut from, its growth and verdicts against numbers written
out, and the whole once on a tiny asset. Nothing asserts a speed."""

from __future__ import annotations

import base64
import csv
import os
from pathlib import Path

import numpy as np
import pytest
from splatbench import scenes, studio
from splatbench.studio import Measurement, StrokePatch, StudioBench

from splatpainter.cli import main
from splatpainter.io import write
from tests.support.studio_scenes import ball


def pixels(patch: StrokePatch) -> np.ndarray:
    return np.frombuffer(base64.b64decode(patch.rgba), np.uint8).reshape(patch.height, patch.width, 4)


def test_a_line_is_judged_by_its_median() -> None:
    assert studio.line("x", [1.0, 9.0, 2.0], target=2.0) == Measurement("x", None, "ms", 2.0, 9.0, 2.0, True, 3)
    assert studio.line("x", [1.0, 9.0, 2.1], target=2.0).met is False
    assert studio.line("x", [1.0], "MiB").met is None
    assert studio.line("x", [float("nan")], target=2.0).met is None


def test_a_view_of_another_size_shows_the_same() -> None:
    home = {"width": 800, "height": 800, "fx": 1000.0, "fy": 1000.0, "cx": 400.0, "cy": 400.0, "version": 1}
    small = studio.view(home, 200)
    assert small == {"width": 200, "height": 200, "fx": 250.0, "fy": 250.0, "cx": 100.0, "cy": 100.0, "version": 1}


def test_patches_put_together_are_the_stroke() -> None:
    size = 256
    canvas = np.zeros((size, size, 4), np.uint8)
    patches = studio.stroke_patches(size, 0.5)
    for patch in patches:  # as the server does it
        canvas[patch.y : patch.y + patch.height, patch.x : patch.x + patch.width] = pixels(patch)
    first, last = 0.3 * size, 0.3 * size + (studio.STROKE_BATCHES - 1) * size / 32
    points = np.array([(first, size / 2), (last, size / 2)])
    stroke = scenes.stroke_layer((size, size), points, studio.DAB_WIDTH * size, size / 128, scenes.PALETTE[0])
    covered = np.abs(canvas[..., 3] / 255 - stroke[..., 3])
    # A batch holds all paint in its rectangle so far; the rim of the one before, outside of it, is not drawn again.
    assert np.quantile(covered, 0.99) < 0.01 and covered.max() < 0.6
    assert all(patch.width < 2 * studio.DAB_WIDTH * size for patch in patches)


def test_text_lies_within_its_patch() -> None:
    patch = studio.text_patch(256, 0.5)
    alpha = pixels(patch)[..., 3]
    assert alpha[0].any() and alpha[-1].any() and alpha[:, 0].any() and alpha[:, -1].any()
    assert abs(patch.x + patch.width / 2 - 128) < 6 and abs(patch.y + patch.height / 2 - 128) < 6


@pytest.mark.parametrize(("words", "message"), [(["--rows", "5"], "--rows"), (["--sizes", "9"], "--sizes")])
def test_senseless_settings_are_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "studio", *words]) == 2
    line = capsys.readouterr().err
    assert message in line and line.count("\n") == 1


def test_a_studio_that_does_not_start_says_why(tmp_path: Path) -> None:
    with (
        pytest.raises(RuntimeError, match="did not start.*no such file"),
        studio.serving(tmp_path / "missing.ply", tmp_path),
    ):
        pass


def test_the_whole_bench(tmp_path: Path) -> None:
    write(tmp_path / "ball.ply", ball(500))
    lines = studio.run(StudioBench(tmp_path, tmp_path / "ball.ply", rows=600, edits=8, clients=2, quick=True))
    named = {one.what: one for one in lines}
    for what, target in (
        ("start: to the first picture", 5000),
        ("preview of a stroke", 100),
        ("dab committed", 800),
        ("text committed", 800),
        ("slider previewed", 300),
    ):
        assert named[what].target == target and 0 < named[what].median <= named[what].worst
        assert named[what].met == (named[what].median <= target)
    steps = [named[f"start: to the {step}"].median for step in ("address", "page", "rows", "first picture")]
    assert steps == sorted(steps)
    assert named["preview of a stroke"].repeats == 2 * studio.STROKE_BATCHES
    # A frame of the slider's rows: a header, indices, halves of 3 base colours and 3 codes of most of 600 rows.
    row = (4 + 6 + 3 * 4) / 1024
    assert 300 * row < named["slider previewed: rows sent"].median <= 600 * row + 1
    assert named["load: 2 clients x 5 edits, one edit"].repeats == 10
    if os.path.exists("/proc/self/status"):
        assert 50 < named["memory: after 8 edits and undos"].median <= named["memory: largest"].median + 1
    with open(tmp_path / "studio.csv") as file:
        assert file.readline().startswith("# ")
        rows = list(csv.DictReader(file))
    assert [row["what"] for row in rows] == [one.what for one in lines]
    assert "target is met" in (tmp_path / "studio.md").read_text()
