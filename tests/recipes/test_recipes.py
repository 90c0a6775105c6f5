"""The recipes of the documentation, command by command, on a small asset; what people do in between is done by code."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpainter.cameras import orbit_cameras
from splatpainter.splats import SH_C0, Splats
from tests.support.cli_scenes import Capture, ball, paint, run, saved

FOLDER = Path(__file__).parents[2] / "docs" / "recipes"
SIZE = 96
"""Pixels of every picture here; the pages say 800 or 400."""
SMALL_SIZE = 48
"""Of views that are enlarged."""
Step = Callable[[Path], None]


def regraded(folder: Path) -> None:
    for name in ("000", "001"):
        with Image.open(folder / "views" / f"view_{name}.png") as picture:
            pixels = np.asarray(picture.convert("RGB"), np.float32) * [0.3, 0.4, 0.7]
        Image.fromarray(pixels.astype(np.uint8)).save(folder / f"night_{name}.png")


def mask_drawn(folder: Path) -> None:
    pixels = np.zeros((SIZE, SIZE), np.uint8)
    pixels[40:56, 38:58] = 255
    Image.fromarray(pixels).save(folder / "logo.png")


STEPS: dict[str, dict[str, Step]] = {
    "graffiti.md": {
        "# open views/view_000.png": lambda f: void(
            paint(f / "views/view_000.png", f / "painted.png", (40, 44, 55, 53))
        ),
        "# paint views2/view_001.png": lambda f: void(
            paint(f / "views2/view_001.png", f / "views2/view_001.png", (44, 40, 52, 50), (20, 30, 160))
        ),
    },
    "night.md": {"# regrade": regraded},
    "recolour.md": {},
    "sharpen.md": {},
    "logo.md": {
        "# draw logo.png": mask_drawn,
        "# inpaint": lambda f: void(
            paint(f / "views/view_000.png", f / "clean.png", (38, 40, 57, 55), (170, 180, 190))
        ),
    },
}
"""Page -> beginning of a comment in its commands -> what a person does there."""
ELSEWHERE = {"own_source.md"}
"""Pages that other tests run: tests/examples/test_own_source.py."""
ASSETS = {
    "graffiti.md": "wall",
    "night.md": "house",
    "recolour.md": "shoes/runner",
    "logo.md": "bottle",
    "sharpen.md": "chair",
}


def specimen() -> Splats:
    """The ball with a dark spot in the middle of the first view of `render`."""
    splats = ball(1200)
    eye = orbit_cameras(splats, 1, size=SIZE)[0].position
    spot = np.linalg.norm(splats.means - eye / np.linalg.norm(eye), axis=1) < 0.2
    sh = splats.sh.copy()
    sh[spot, 0] = (np.array([0.2, 0.05, 0.3]) - 0.5) / SH_C0
    return replace(splats, sh=sh)


def void(_: object) -> None: ...


def blocks(page: Path) -> list[tuple[str, str]]:
    """(language, text) of the fenced blocks of a page."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)


def words_of(line: str, size: int) -> list[str]:
    """A command's words, its pictures small."""
    words = shlex.split(line, comments=True)
    return [str(size) if before == "--size" else word for before, word in zip(["", *words], words, strict=False)]


@pytest.mark.parametrize("name", STEPS)
def test_a_recipe_works_as_it_says(name: str, tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    (tmp_path / "shoes").mkdir()
    saved(tmp_path / f"{ASSETS[name]}.ply", specimen())
    steps, done, outputs = STEPS[name], set(), 0
    for language, text in blocks(FOLDER / name):
        if language in ("yaml", "python"):
            (file,) = re.findall(r"^# (\S+\.(?:yaml|py))$", text, re.M)
            (tmp_path / file).write_text(text, encoding="utf-8")
            continue
        assert language == "sh", f"{name}: a block of {language} that nobody runs"
        for line in text.strip().splitlines():
            step = next((start for start in steps if line.startswith(start)), None)
            if step is not None:
                steps[step](tmp_path)
                done.add(step)
                continue
            assert line.startswith("splatpainter "), f"{name}: no command, and no step that is known: {line}"
            words = words_of(line, SMALL_SIZE if name == "sharpen.md" else SIZE)[1:]
            result = run(capfd, *words)
            assert result.code == 0, f"{line}: {result.err or result.out}"
            if "--out" in words:
                assert Path(words[words.index("--out") + 1]).exists()
                outputs += 1
    assert done == set(steps) and outputs


def test_every_recipe_is_on_the_first_page_and_is_run() -> None:
    pages = {path.name for path in FOLDER.glob("*.md")} - {"index.md"}
    listed = set(re.findall(r"\]\((\w+\.md)\)", (FOLDER / "index.md").read_text(encoding="utf-8")))
    assert listed == pages == set(STEPS) | ELSEWHERE
