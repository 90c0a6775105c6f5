"""Names as long as file systems take: what is made for a while beside a file does not grow with its name."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from splatpainter import io
from splatpainter.image_files import write_png
from splatpainter.io.files import writing
from splatpainter.output_paths import receipt_of
from splatpainter.scene.merge import merge
from splatpainter.session import Session
from splatpainter.system.atomic import brief_name
from tests.support.cli_scenes import Capture, ball, run
from tests.support.io_assets import random_splats
from tests.support.io_packed import alone

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="paths of Windows end at 260 characters")


def of_length(length: int, ending: str, letter: str = "a") -> str:
    """A name of so many bytes; whole letters, then a's."""
    room = length - len(ending)
    count = room // len(letter.encode())
    return letter * count + "a" * (room - count * len(letter.encode())) + ending


@pytest.mark.parametrize("length", [99, 101, 143, 240, 243, 244, 249, 255])
@pytest.mark.parametrize("letter", ["a", "ß", "🦋"])
def test_every_name_that_a_folder_takes(length: int, letter: str, tmp_path: Path, capfd: Capture) -> None:
    io.write(tmp_path / "a.ply", random_splats(20, 0))
    for ending in (".ply", ".compressed.ply", ".spz"):
        target = tmp_path / of_length(length, ending, letter)
        done = run(capfd, "convert", tmp_path / "a.ply", target)
        assert done.code == 0 and len(io.read(target)) == 20, done
        assert run(capfd, "convert", tmp_path / "a.ply", target, "--overwrite").code == 0
    write_png(tmp_path / of_length(length, ".png", letter), np.zeros((2, 2, 3)))
    assert len(list(tmp_path.iterdir())) == 5


def test_temporary_names_are_short_and_differ(tmp_path: Path) -> None:
    twins = [of_length(250, f"{k}.compressed.ply") for k in range(2)]
    for keep in (False, True):
        brief = [brief_name(name, keep) for name in twins]
        assert brief[0] != brief[1] and max(map(len, brief)) < 40
        assert all(name.endswith(".compressed.ply") for name in brief) == keep
    assert brief_name("vase.ply") == "vase.ply"
    with writing(tmp_path / twins[0]) as file:
        file.write(b"x")
        (partial,) = os.listdir(tmp_path)
        assert len(partial) < 60 and partial.endswith(".part")


def test_receipts_of_long_names(tmp_path: Path, capfd: Capture) -> None:
    """Of edits, exports and merges: a shorter name where the ending finds no room, and `verify` finds it."""
    (tmp_path / "a").mkdir()
    io.write(tmp_path / "a.ply", ball(300))
    for k, length in enumerate((240, 255)):
        target = tmp_path / "a" / of_length(length, ".ply")
        words = ("grade", tmp_path / "a.ply", "--exposure", "0.5", "--out", target)
        done = run(capfd, *words)
        assert done.code == 0 and receipt_of(target).is_file(), done
        assert (receipt_of(target).name == f"{target.name}.receipt.json") == (length <= 242)
        done = run(capfd, "verify", tmp_path / "a.ply", target)
        assert done.code == 0 and "receipt: " in done.out, done
        assert len(list((tmp_path / "a").iterdir())) == 2 * (k + 1)
    with Session(alone(random_splats(20, 0)), tmp_path / "s.splatproj") as session:
        target = tmp_path / of_length(255, ".ply", "é")
        session.files.export(target)
    assert target.is_file() and receipt_of(target).is_file()
    target = tmp_path / of_length(255, ".glb")
    io.write(tmp_path / "b.ply", random_splats(30, 0, seed=1))
    merge([tmp_path / "a.ply", tmp_path / "b.ply"], target)
    assert target.is_file() and receipt_of(target).is_file()


def test_longer_names_are_refused_in_a_line_that_names_the_file(tmp_path: Path, capfd: Capture) -> None:
    io.write(tmp_path / "a.ply", random_splats(20, 0))
    name = of_length(256, ".ply")
    error = run(capfd, "convert", tmp_path / "a.ply", tmp_path / name).error
    assert name in error and "its name of 256 bytes is too long for its folder; shorten it" in error
    with pytest.raises(ValueError, match=r"expected a project's name of at most \d+ bytes, got 250"):
        Session(alone(random_splats(20, 0)), tmp_path / of_length(250, ".splatproj"))
    with Session(alone(random_splats(20, 0)), tmp_path / of_length(245, ".splatproj")) as session:
        assert len(session.splats) == 20
    assert len(list(tmp_path.iterdir())) == 2
