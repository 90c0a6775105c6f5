"""`splatpainter refine`: detail that a picture source adds arrives, from all views together; what is refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.io import read
from splatpainter.metrics import psnr
from tests.support.cli_scenes import Capture, ball, listing, run, saved

SHARPEN = """
import sys
import numpy as np
from PIL import Image
picture = Image.open(sys.argv[1]).convert("RGB")
large = picture.resize((2 * picture.width, 2 * picture.height), Image.Resampling.BICUBIC)
pixels = np.asarray(large, float)
stripes = 40 * (-1.0) ** (np.arange(pixels.shape[1]) // 2)[None, :, None]
Image.fromarray((pixels + stripes).clip(0, 255).astype(np.uint8)).save(sys.argv[2])
"""


@pytest.fixture()
def asset(tmp_path: Path) -> Path:
    return saved(tmp_path / "ball.ply", ball(1200))


def views(asset: Path, capfd: Capture) -> list[Path]:
    folder = asset.parent / "views"
    assert run(capfd, "render", asset, "--views", "2", "--size", "96", "--out", folder).code == 0
    return [folder / "view_000.json", folder / "view_001.json"]


def test_the_detail_of_a_source_arrives_and_is_proved(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    program, out = tmp_path / "sharpen.py", tmp_path / "fine.ply"
    program.write_text(SHARPEN)
    option = f"run={sys.executable} {program} {{image}} {{out}} {{scale}}"
    words = ["--source", "command", "--source-option", option, "--out", out, "--json"]
    cameras = views(asset, capfd)
    done = run(capfd, "refine", asset, "--view", *cameras, *words)
    assert done.code == 0, done
    receipt = done.json["receipt"]
    assert receipt["source"]["name"] == "command" and len(receipt["views"]) == 2 and receipt["appended_rows"] > 100
    scores = [(view["psnr_before"], view["psnr_after"]) for view in receipt["views"]]
    assert all(after > before + 1.5 for before, after in scores), scores
    assert run(capfd, "verify", asset, out).code == 0
    camera = sp.Camera.from_json(cameras[0].read_text())
    before, after = (sp.render(read(path), camera).colors[0] for path in (asset, out))
    assert psnr(after, before) > 30  # at the old size the asset is what it was


def test_without_a_model_it_is_lanczos(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    done = run(capfd, "refine", asset, "--view", views(asset, capfd)[0], "--out", tmp_path / "fine.spz")
    assert done.code == 0 and "Lanczos and sharpening, 192 x 192" in done.out and "verified" in done.out
    names = json.loads((tmp_path / "fine.spz.receipt.json").read_text())
    assert names["source"]["name"] == "upscale" and names["method"] == "lift"
    assert np.isfinite(read(tmp_path / "fine.spz").means).all()


def test_what_cannot_be_done_is_said_and_nothing_written(asset: Path, tmp_path: Path, capfd: Capture) -> None:
    camera, out = views(asset, capfd)[0], tmp_path / "fine.ply"
    (tmp_path / "model.pth").write_bytes(b"x")
    before = listing(tmp_path)
    for words, reason in (
        ([], "expected 1 to 16 cameras (--view CAM.json ...), got none"),
        (["--view", camera, "--upscale", tmp_path / "model.pth"], "is a pickle"),
        (["--view", camera, "--upscale", tmp_path / "none.safetensors"], "no such file"),
        (["--view", camera, "--source", "gemini", "--upscale", "m.safetensors"], "not of gemini"),
        (["--view", camera, "--source", "nobody"], "nobody"),
        (["--view", camera, "--scale", "1"], "an enlargement of 1"),
        (["--view", tmp_path / "none.json"], "none.json"),
    ):
        done = run(capfd, "refine", asset, *words, "--out", out)
        assert done.code == 2 and reason in done.err and done.err.count("\n") == 1, done
        assert listing(tmp_path) == before
