"""`splatpainter bench` where its distribution is installed, and where it is not."""

from __future__ import annotations

import importlib.metadata

import pytest

from splatpainter.commands import DISTRIBUTIONS, ENTRY_POINTS, SUMMARIES
from tests.support.cli_scenes import run


@pytest.fixture()
def without_benches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: importlib.metadata.EntryPoints())


@pytest.mark.parametrize("words", [["bench"], ["bench", "refine", "--quick"], ["help", "bench"]])
def test_without_its_distribution_there_is_one_line(
    words: list[str], without_benches: None, capfd: pytest.CaptureFixture[str]
) -> None:
    result = run(capfd, *words)
    assert (result.code, result.out) == (2, "")
    assert result.err == f"splatpainter bench: not installed; it comes with {DISTRIBUTIONS['bench']}\n"


def test_help_lists_it_all_the_same(without_benches: None, capfd: pytest.CaptureFixture[str]) -> None:
    result = run(capfd, "--help")
    assert result.code == 0
    assert f"  bench     {SUMMARIES['bench']} (separate: splatpainter-bench)\n" in result.out
    assert result.out.count("(separate") == len(DISTRIBUTIONS)


def test_its_distribution_brings_the_command(capfd: pytest.CaptureFixture[str]) -> None:
    points = {point.name: point.value for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    assert points["bench"] == "splatbench.command" and set(points) == set(DISTRIBUTIONS)
    result = run(capfd, "bench")
    assert result.code == 0 and "splatpainter bench speed --quick" in result.out
