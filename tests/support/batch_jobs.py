"""A folder with small assets, pictures and a JOBS.yaml, for the tests of `splatpainter batch`; imported by workers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from splatpainter.cameras import look_at
from splatpainter.image_files import write_png
from splatpainter.rendering import render
from splatpainter.splats import Splats
from tests.support.cli_scenes import BOX, ball, paint, saved

CAMERA = look_at((0, 0, -3.5), (0, 0, 0), (0, -1, 0), width=96, height=96)


def colored_ball(count: int, seed: int) -> Splats:
    splats = ball(count)
    sh = splats.sh.copy()
    sh[:, 0] += np.random.default_rng(seed).normal(0, 0.1, (len(splats), 3)).astype(np.float32)
    return replace(splats, sh=sh)


def write_assets(folder: Path, count: int = 2) -> list[Path]:
    """shoes/shoe0.ply, ..., painted pictures views/shoe0.png, ..., label.png and cam.json."""
    (folder / "shoes").mkdir()
    (folder / "views").mkdir()
    (folder / "cam.json").write_text(CAMERA.to_json())
    Image.new("RGBA", (24, 12), (200, 30, 40, 255)).save(folder / "label.png")
    assets = []
    for k in range(count):
        splats = colored_ball(600, k)
        assets.append(saved(folder / "shoes" / f"shoe{k}.ply", splats))
        picture = folder / "views" / f"shoe{k}.png"
        write_png(picture, render(splats, CAMERA).colors[0], CAMERA)
        paint(picture, picture, BOX)
    return assets


def jobs_file(folder: Path, text: str) -> Path:
    path = folder / "jobs.yaml"
    path.write_text(text, encoding="utf-8")
    return path
