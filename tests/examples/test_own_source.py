"""The example package of a picture source: short, installed by pip, and used through its entry point in a process of
its own."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.fake_services import pixels, png

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "examples" / "own_source"
RECIPE = ROOT / "docs" / "recipes" / "own_source.md"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that it is installed into, from a copy: pip leaves build folders beside what it installs."""
    folder = tmp_path_factory.mktemp("own_source")
    source = shutil.copytree(
        EXAMPLE, folder / "source", ignore=shutil.ignore_patterns("__pycache__", "build", "*.egg-*")
    )
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
    words = ["--no-deps", "--no-build-isolation", "--no-index", "--target", str(folder / "site"), str(source)]
    done = subprocess.run([*pip, *words], capture_output=True, encoding="utf-8", errors="replace")
    assert done.returncode == 0, done.stderr
    return folder / "site"


def splatpainter(installed: Path, *words: object) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(installed), str(ROOT / "src")])
    return subprocess.run(
        [sys.executable, "-m", "splatpainter", *map(str, words)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        encoding="utf-8",
    )


def test_it_is_as_short_as_the_guide_says() -> None:
    assert len((EXAMPLE / "splatpainter_sepia.py").read_text("utf-8").splitlines()) <= 34


def test_the_recipe_is_the_example() -> None:
    blocks = dict(re.findall(r"^```(\w+)\n(.*?)^```$", RECIPE.read_text("utf-8"), re.M | re.S))
    assert blocks["toml"] == (EXAMPLE / "pyproject.toml").read_text("utf-8")
    assert blocks["python"] == (EXAMPLE / "splatpainter_sepia.py").read_text("utf-8")
    assert [line.split()[:4] for line in blocks["sh"].splitlines()] == [
        ["pip", "install", "examples/own_source"],
        ["splatpainter", "source", "list", "sepia"],
        ["splatpainter", "source", "try", "sepia"],
    ]


def test_a_source_of_another_package(installed: Path, tmp_path: Path) -> None:
    listed = splatpainter(installed, "source", "list", "sepia", "--json")
    assert listed.returncode == 0, listed.stderr
    (record,) = json.loads(listed.stdout)["sources"]
    assert (record["summary"], record["distribution"]) == ("the view as an old photograph", "splatpainter-sepia")
    assert record["ready"] and record["options"][0]["environment"] == ["SPLATPAINTER_SEPIA_AMOUNT"]
    picture, out = tmp_path / "view.png", tmp_path / "old.png"
    picture.write_bytes(png(8, 8, (0, 128, 255)))
    tried = splatpainter(installed, "source", "try", "sepia", picture, "--source-option", "amount=0.5", "--out", out)
    assert tried.returncode == 0, tried.stderr
    grey = (0.7152 * 128 + 0.0722 * 255) * np.array([1.08, 0.92, 0.68])
    expected = 0.5 * np.array([0, 128, 255]) + 0.5 * grey
    assert np.abs(pixels(out.read_bytes()).astype(float) - expected).max() <= 1
