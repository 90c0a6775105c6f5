"""`splatpainter compare`: the numbers are those of the pictures, and the pictures say what they show."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import splatpainter as sp
from splatpainter.cameras import Camera
from splatpainter.color import to_light
from splatpainter.splats import SH_C0
from tests.support.cli_scenes import Capture, ball, run, saved


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """The ball, and one of fewer rows that is brighter."""
    other = ball(2500)
    other.sh[:, 0] += 0.05 / SH_C0
    return saved(tmp_path / "one.ply"), saved(tmp_path / "other.ply", other)


@pytest.mark.parametrize("profile", ["inria", "playcanvas"])
def test_decibels_and_pictures(pair: tuple[Path, Path], profile: str, tmp_path: Path, capfd: Capture) -> None:
    out = tmp_path / "out"
    words = ["compare", *pair, "--out", out, "--views", 2, "--size", 170, "--profile", profile, "--amplify", 5]
    done = run(capfd, *words, "--json")
    assert (done.code, done.err) == (0, "")
    record = done.json
    assert json.loads((out / "compare.json").read_text()) == record
    assert (record["a"]["rows"], record["b"]["rows"], record["profile"]) == (3000, 2500, profile)
    assert record["difference_amplified"] == 5 and record["identical"] is False
    errors = []
    for view in record["views"]:
        camera = Camera.from_json(json.dumps(view["camera"]))
        a, b = (np.clip(sp.render(sp.read(path), camera, profile=profile).colors[0], 0, 1) for path in pair)  # type: ignore[arg-type]
        errors.append(((a.astype(float) - b) ** 2).mean())
        assert view["psnr"] == pytest.approx(-10 * math.log10(errors[-1]), abs=1e-3)
        assert view["psnr_covered"] < view["psnr"] and 0.5 < view["ssim"] < 1
        assert view["largest_difference"] == pytest.approx(np.abs(a - b).max(), abs=1e-6)
        assert 0.2 < view["differing"] < 0.9
        with Image.open(view["file"]) as image:
            pixels = np.asarray(image).astype(int)
        panels = [pixels[-170 - 12 : -12, 6 + k * 176 : 176 + k * 176] for k in range(3)]
        expected = [a, b, np.clip(5 * np.abs(a - b), 0, 1)]
        for stored, picture in zip(panels, expected, strict=True):
            assert np.abs(stored - picture * 255).max() <= 0.51
        assert (pixels[:20] < 80).any(), "a caption stands above"
    assert record["psnr"] == pytest.approx(-10 * math.log10(np.mean(errors)), abs=1e-3)
    assert sorted(path.name for path in out.iterdir()) == [
        "compare.json",
        "sheet.png",
        *(f"view_{k:03d}.png" for k in (0, 1)),
    ]
    with Image.open(record["sheet"]) as sheet:
        assert sheet.width > 3 * 360 and sheet.height > 2 * 360


def test_the_same_asset_is_identical_and_colour_spaces_are_compared_as_displayed(
    tmp_path: Path, capfd: Capture
) -> None:
    """A linear asset of the same displayed colours, opaque and without view dependence."""
    plain = ball(3000, degree=0)
    one = saved(tmp_path / "one.ply", plain)
    done = run(capfd, "compare", one, one, "--out", tmp_path / "same", "--views", 1, "--size", 64, "--json").json
    assert done["identical"] is True and done["psnr"] is None and done["views"][0]["ssim"] == 1
    text = run(capfd, "compare", one, one, "--out", tmp_path / "same", "--views", 1, "--size", 64, "--overwrite").out
    assert "view_000.png  identical" in text and "all 1 view: identical" in text
    light = to_light(0.5 + SH_C0 * plain.sh.astype(np.float64), "srgb")
    linear = replace(plain, sh=((light - 0.5) / SH_C0).astype(np.float32), color_space="linear")
    other = saved(tmp_path / "linear.glb", linear)
    assert sp.read(other).color_space == "linear"
    words = ["compare", one, other, "--out", tmp_path / "linear", "--views", 1, "--size", 64, "--json"]
    assert run(capfd, *words, "--background", "0.7,0.75,0.8").json["psnr"] > 25


def test_given_cameras_and_many_views(pair: tuple[Path, Path], tmp_path: Path, capfd: Capture) -> None:
    views = tmp_path / "views"
    assert run(capfd, "render", pair[0], "--out", views, "--views", 1, "--width", 96, "--height", 40).code == 0
    camera = ["--camera", views / "view_000.png", views / "view_000.json"]
    done = run(capfd, "compare", *pair, "--out", tmp_path / "out", *camera, "--json").json
    assert [(v["camera"]["width"], v["camera"]["height"]) for v in done["views"]] == [(96, 40)] * 2
    assert done["views"][0]["psnr"] == done["views"][1]["psnr"]
    words = ["compare", *pair, "--out", tmp_path / "many", "--views", 14, "--size", 24, "--json"]
    done = run(capfd, *words).json
    assert len(done["views"]) == 14 and done["worst_view"] in {Path(v["file"]).name for v in done["views"]}
    worst = min(done["views"], key=lambda view: view["psnr"])
    assert Path(worst["file"]).name == done["worst_view"]


@pytest.mark.parametrize(
    ("words", "pattern"),
    [
        (["--size", "9"], "--size from 16"),
        (["--size", "4096"], "--size from 16 to 2730"),
        (["--views", "0"], "--views from 1"),
        (["--amplify", "0"], "--amplify from 1"),
        (["--amplify", "nan"], "--amplify from 1"),
        (["--background", "red"], "--background"),
        (["--camera", "gone.json"], "gone.json: no such file"),
        (["--profile", "unreal"], "unreal"),
    ],
)
def test_wrong_options(pair: tuple[Path, Path], words: list[str], pattern: str, tmp_path: Path, capfd: Capture) -> None:
    line = run(capfd, "compare", *pair, "--out", tmp_path / "out", *words).error
    assert pattern in line and not (tmp_path / "out").exists()


def test_existing_files_and_inputs_are_not_written_over(
    pair: tuple[Path, Path], tmp_path: Path, capfd: Capture
) -> None:
    (tmp_path / "sheet.png").write_text("mine")
    words = ["compare", *pair, "--out", tmp_path, "--views", 1, "--size", 32]
    assert "sheet.png: already exists" in run(capfd, *words).error
    assert run(capfd, *words, "--overwrite").code == 0
    assert (
        "gone.ply: no such file" in run(capfd, "compare", pair[0], tmp_path / "gone.ply", "--out", tmp_path / "x").error
    )
