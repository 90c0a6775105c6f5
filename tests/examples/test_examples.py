"""The numbered examples run, on a small asset, and each makes the file that it speaks of."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

import splatpainter as sp
from tests.support.cli_scenes import ball

EXAMPLES = sorted((Path(__file__).resolve().parents[2] / "examples").glob("0*.py"))


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("asset") / "ball.ply"
    sp.write(path, ball(4000))
    return path


def test_there_are_eight_and_the_page_lists_them() -> None:
    page = (EXAMPLES[0].parents[1] / "docs" / "guide" / "examples.md").read_text(encoding="utf-8")
    assert len(EXAMPLES) == 8
    for path in EXAMPLES:
        assert path.read_text(encoding="utf-8").strip() in page, f"{path.name}: python scripts/example_pages.py"


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(example: Path, asset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = asset.read_bytes()
    runpy.run_path(str(example))["main"](asset, tmp_path)
    assert capsys.readouterr().out.count("\n") >= 1
    assert [path for path in tmp_path.iterdir() if path.suffix == ".ply"]
    assert asset.read_bytes() == before, "an example writes beside its asset, not into it"
