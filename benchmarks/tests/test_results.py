"""RESULTS.md: what it holds, and that its pictures are there."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from splatbench.report.page import write_markdown

from benchmarks.tests.support.runs import METHODS, FakeTable, plain_run, record, write


def test_holds_tables_plots_and_sheets_that_are_there(tmp_path: Path) -> None:
    folder = plain_run(tmp_path / "refine")
    out = write_markdown([folder], tmp_path / "docs" / "RESULTS.md", "# Results\n\nFive objects.", _tables(), METHODS)
    text = out.read_text()
    assert text.startswith("# Results\n\nFive objects.\n\nMeasured on:\n\n- two cores\n")
    assert "## Made up (Tab. 1)" in text and "3 objects, 3 cases" in text
    rows = [line for line in text.splitlines() if line.startswith("| VoxHammer")]
    assert len(rows) == 1 and "not installed" in rows[0] and not re.search(r"\d", rows[0].split("|")[2])
    links = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(links) >= 2 and all((out.parent / link).is_file() for link in links)
    for link in links:
        if link.endswith(".svg"):
            assert ET.parse(out.parent / link).getroot().tag.endswith("svg")
    assert text.count("\n\n*PSNR against seconds*\n") == 1, "a caption: pictures do not show their titles"
    (out.parent / "results" / "refine-of-an-earlier-run.svg").write_text("<svg/>")
    again = write_markdown([folder], tmp_path / "docs" / "RESULTS.md", "# Results\n\nFive objects.", _tables(), METHODS)
    assert again.read_text() == text
    assert not (out.parent / "results" / "refine-of-an-earlier-run.svg").exists()


def test_folders_without_records_are_left_out_and_none_at_all_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^report: expected records of .* in .*relight, found none$"):
        write_markdown([tmp_path / "relight"], tmp_path / "RESULTS.md", "", _tables(), METHODS)
    folder = write(tmp_path / "refine", [record("lift", "ant", 20.0)])
    (tmp_path / "relight").mkdir()
    out = write_markdown([tmp_path / "relight", folder], tmp_path / "R.md", "", _tables(), METHODS)
    assert out.read_text().count("## ") == 1


def _tables() -> dict[str, FakeTable]:
    return {"refine": FakeTable(), "relight": FakeTable()}
