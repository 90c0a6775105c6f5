"""`splatpainter edit --mode spread`: proved, with a picture of its confidence; a dry run writes nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.image_files import write_png
from splatpainter.io import write
from tests.support.cli_scenes import Capture, listing, run
from tests.support.spread_scenes import CAMERA, board, left_half, painted_picture


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    splats = board()
    write(tmp_path / "board.ply", splats)
    write_png(tmp_path / "green.png", painted_picture(splats), CAMERA)
    write_png(tmp_path / "mask.png", np.repeat(left_half()[..., None], 3, 2).astype(np.float32))
    return tmp_path


def edited(capfd: Capture, folder: Path, *more: object):
    files = (folder / "board.ply", folder / "green.png", "--mask", folder / "mask.png", "--out", folder / "out.ply")
    return run(capfd, "edit", *files, *more)


def test_a_material_is_spread_and_proved(capfd: Capture, folder: Path) -> None:
    sure = folder / "sure.png"
    ran = edited(capfd, folder, "--mode", "spread", "--spread-confidence", sure, "--json")
    assert ran.code == 0 and ran.json["receipt"]["mode"] == "spread" and ran.json["receipt"]["touched_rows"] > 600
    assert np.asarray(Image.open(sure)).shape == (72, 144, 3)
    assert run(capfd, "verify", folder / "board.ply", folder / "out.ply").code == 0
    fewer = edited(capfd, folder, "--mode", "spread", "--spread-threshold", "1", "--overwrite", "--json")
    assert fewer.json["receipt"]["touched_rows"] < ran.json["receipt"]["touched_rows"] / 1.5


def test_a_dry_run_writes_the_confidence_alone(capfd: Capture, folder: Path) -> None:
    before = set(listing(folder))
    ran = edited(capfd, folder, "--mode", "spread", "--dry-run", "--spread-confidence", folder / "sure.png")
    assert ran.code == 0 and "would change" in ran.out and set(listing(folder)) - before == {"sure.png"}


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--spread-threshold", "0.4"), "are for --mode spread"),
        (("--mode", "spread", "--spread-threshold", "1.2"), "expected --spread-threshold from 0 to 1, got 1.2"),
        (("--mode", "spread", "--method", "fit"), "mode spread is made by the lift alone"),
        (("--dry-run",), "--dry-run is for pictures that a source makes"),
    ],
)
def test_words_that_make_no_sense(capfd: Capture, folder: Path, words: tuple[str, ...], reason: str) -> None:
    ran = edited(capfd, folder, *words)
    assert ran.code == 2 and reason in ran.error
