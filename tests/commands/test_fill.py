"""`splatpainter fill`: a part removed and filled, a hole circled, a source; proved; and what is refused."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import look_at
from splatpainter.io import read
from tests.holes.test_body import ground, sphere
from tests.support.cli_scenes import Capture, ball, listing, rows_of, run, saved

SPHERE = "sphere=0,0,-1,0.45"


@pytest.fixture()
def asset(tmp_path: Path) -> Path:
    return saved(tmp_path / "ball.ply", ball(1500))


def test_a_part_is_removed_and_filled_and_verify_agrees(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "filled.ply"
    done = run(capfd, "fill", asset, "--where", SPHERE, "--out", out)
    assert done.code == 0 and "filled 1 hole with" in done.out and "removed (opacity 0)" in done.out, done
    before, after = rows_of(asset), rows_of(out)
    receipt = json.loads((tmp_path / "filled.ply.receipt.json").read_text())
    changed = (before != after[: len(before)]).any(1)
    assert changed.sum() == receipt["removed_rows"] == receipt["touched_rows"] > 20
    assert receipt["appended_rows"] == len(after) - len(before) > 20 and receipt["mode"] == "fill"
    assert run(capfd, "verify", asset, out).code == 0


def test_a_mask_around_a_thing_leaves_the_neighbour_that_touches_it(tmp_path: Path, capfd: Capture) -> None:
    one = sphere(0.5, (0.7, 0.7, 0.7))
    other = replace(one, means=one.means + np.array([1, 0, 0], np.float32))
    pair = saved(tmp_path / "pair.ply", ground((0.35, 0.2, 0.1)).append(one).append(other))
    camera = look_at((0, 1.5, 6), (0, 0.5, 0), (0, 1, 0), width=192, height=192, fov=30)
    (tmp_path / "cam.json").write_text(camera.to_json())
    splats = read(pair)
    of_one = np.arange(len(splats) - 2 * len(one), len(splats) - len(one))
    (x, y), radius = camera.project(np.array([[0, 0.5, 0]]))[0][0], 0.53 * camera.fx / 6.1
    rows, columns = np.mgrid[:192, :192] + 0.5
    Image.fromarray((np.hypot(columns - x, rows - y) < radius).astype(np.uint8) * 255).save(tmp_path / "around.png")
    words = ["--where", f"mask={tmp_path / 'around.png'}@{tmp_path / 'cam.json'}", "--out", tmp_path / "alone.ply"]
    done = run(capfd, "fill", pair, *words)
    assert done.code == 0, done
    gone = read(tmp_path / "alone.ply").opacities[: len(splats)] < 1e-3
    assert gone[of_one].mean() > 0.95 and gone[of_one[-1] + 1 :].mean() < 0.03 and gone[: of_one[0]].mean() < 0.01


def test_a_hole_is_circled_and_a_source_colours_it(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    splats = read(asset)
    gone = ((splats.means - np.array([0, 0, -1])) ** 2).sum(1) < 0.4**2
    chipped = saved(tmp_path / "chipped.ply", ball(1500).take(np.flatnonzero(~gone)))
    camera = look_at((0, 0, -3), (0, 0, 0), (0, -1, 0), width=96, height=96, fov=45)
    (tmp_path / "cam.json").write_text(camera.to_json())
    y, x = np.mgrid[:96, :96] - 47.5
    Image.fromarray((np.hypot(x, y) < 27).astype(np.uint8) * 255).save(tmp_path / "circle.png")
    words = ["--around", f"mask={tmp_path / 'circle.png'}@{tmp_path / 'cam.json'}", "--out", tmp_path / "closed.ply"]
    done = run(capfd, "fill", chipped, *words, "--json")
    assert done.code == 0 and done.json["verified"] and done.json["receipt"]["touched_rows"] == 0, done
    closed = read(tmp_path / "closed.ply")
    assert np.abs(np.linalg.norm(closed.means[len(read(chipped)) :], axis=1) - 1).max() < 0.06
    script = tmp_path / "redder.py"
    script.write_text(
        "import sys\nfrom PIL import Image\nimage = Image.open(sys.argv[1]).convert('RGB')\nw, h = image.size\n"
        "image.paste((200, 60, 60), (w * 2 // 5, h * 2 // 5, w * 3 // 5, h * 3 // 5))\nimage.save(sys.argv[2])\n"
    )
    option = f"run={sys.executable} {script} {{image}} {{out}}"
    more = ["--source", "command", "--source-option", option, "--source-strictness", "loose", "--overwrite"]
    done = run(capfd, "fill", chipped, *words, *more, "--json")
    assert done.code == 0 and done.json["receipt"]["source"]["name"] == "command", done
    first = len(read(chipped))
    red, plain = read(tmp_path / "closed.ply").sh[first:, 0], closed.sh[first:, 0]
    assert (red[:, 0] - red[:, 1]).max() > (plain[:, 0] - plain[:, 1]).max() + 0.8


def test_what_cannot_be_filled_is_one_line_and_writes_nothing(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    before = listing(tmp_path)
    out = tmp_path / "out.ply"
    cases = [
        (["--out", out], "--where (what to remove) or --around"),
        (["--where", SPHERE, "--around", SPHERE, "--out", out], "got both"),
        (["--where", "sphere=9,9,9,0.1", "--out", out], "reach"),
        (["--where", "x=-9..9", "--out", out], "nothing is left there"),
        (["--around", SPHERE, "--out", out], "there is no hole"),
        (["--where", SPHERE, "--prompt", "moss", "--out", out], "give --source NAME too"),
        (["--where", SPHERE, "--out", asset], "ball.ply"),
    ]
    for words, expected in cases:
        assert expected in run(capfd, "fill", asset, *words).error
    assert listing(tmp_path) == before
