"""Records as CSV, Markdown and LaTeX: figures by hand, and what must never be printed as a number."""

from __future__ import annotations

import csv
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from splatbench.cases import Budget, Record
from splatbench.methods import EditResult, EditTask, Method
from splatbench.report import published, tables
from splatbench.report.published import EDITED_REGION, OUTSIDE_REGION
from splatbench.report.summary import MethodNames, summarize
from splatbench.tables import Column

COLUMNS = (Column("psnr", "PSNR", "On the object", "higher"), Column("lpips", "LPIPS", "On the object", "lower", 4))


def record(method: str, name: str, psnr: float | None, views: int = 1, **rest) -> Record:
    template = Record(
        protocol="relight",
        method=method,
        label=f"{name}-{views}",
        name=name,
        fingerprint="f",
        figures={"psnr": psnr, "lpips": None},
        setup_seconds=1.5,
        edit_seconds=0.25,
        peak_mib=100.4,
        rows=1000,
        rows_equal=0.99999,
        appended=3,
        numbers={"rounds": 4.0},
        facts={"views": views},
    )
    return replace(template, **rest)


RECORDS = (
    record("ttt", "a", 20.0),
    record("ttt", "b", 23.0),
    record("3dgs", "a", 25.5),
    record("3dgs", "b", None, error="it burst | into\npieces", figures={}),
    record("lift", "a", 21.0),
    record("lift", "b", 21.5, setup_seconds=0.0, rows_equal=1.0),
    record("bound", "a", 30.0, rows_equal=None),
    record("bound", "b", 31.0, rows_equal=None),
    record("voxhammer", "a", None, missing="not installed: a_path & 50%", figures={}),
    record("voxhammer", "b", None, missing="not installed: a_path & 50%", figures={}),
    record("ttt", "a", 26.0, 2),
)


def edit(work: EditTask, budget: Budget) -> EditResult:
    raise AssertionError


LABELS = {"lift": "Lift", "ttt": "Ours & theirs", "3dgs": "3DGS", "bound": "Bound", "voxhammer": "VoxHammer"}
METHODS = {name: Method(name, label, edit, (), sees_truth=name == "bound") for name, label in LABELS.items()}


@pytest.fixture()
def grid() -> tables.Grid:
    rows = summarize(RECORDS, "views", tuple(METHODS))
    return tables.grid("relight", COLUMNS, rows, MethodNames.of(METHODS, LABELS), "views")


def cells(text: str, label: str, nth: int = 0) -> list[str]:
    lines = [line for line in text.splitlines() if line.startswith(f"| {label}")]
    return [cell.strip() for cell in lines[nth].split("|")[1:-1]]


def test_markdown(grid: tables.Grid) -> None:
    text = tables.markdown(grid)
    heads = [cell.strip() for cell in text.splitlines()[0].split("|")[1:-1]]
    assert heads[:3] == ["Method", "On the object PSNR ↑", "On the object LPIPS ↓"]
    assert heads[3:7] == ["Seconds (set-up + edit)", "Peak MiB", "Gaussians", "Kept %"]
    assert heads[7] == "*as published, other data:* PSNR"
    ours = cells(text, "Ours & theirs")
    # Two objects: the bootstrap draws (20, 20), (20, 23), (23, 23), so that its ends are the two.
    assert ours[1] == "**21.50** [20.00, 23.00]" and ours[2] == "n/a"
    assert ours[3:7] == ["1.50 + 0.25", "100", "1,000", "99.99"], "never rounded up to all rows"
    assert ours[7:] == ["*24.56*", "*0.8986*", "*0.0721*", "*1.54 + 0.08*"]
    lift = cells(text, "Lift")
    assert (lift[1], lift[3], lift[6]) == ("21.25 [21.00, 21.50]", "0.75 + 0.25", "99.99")
    assert cells(text, "Bound")[1] == "30.50 [30.00, 31.00]", "what sees the truth is not the best"
    few = cells(text, "3DGS")
    assert few[0] == "3DGS (1 of 2)" and few[1] == "25.50", "neither is a row that lacks cases"
    absent = cells(text, "VoxHammer")
    assert absent[1:7] == ["not installed"] + ["–"] * 5
    assert "| **views: 2** |" in text
    two = cells(text, "Ours & theirs", 1)
    assert two[1] == "26.00" and two[7] == "*24.71*", "alone, there is no best; its interval needs two objects"
    assert cells(text, "RelitLRM")[1:3] == ["not run", "–"] and cells(text, "RelitLRM")[7] == "*21.68*"


def test_latex(grid: tables.Grid, tmp_path: Path) -> None:
    text = tables.latex(grid, "A caption & more", "relight")
    assert r"\toprule" in text and r"\textbf{21.50} {\tiny [20.00, 23.00]}" in text
    assert r"\textcolor{gray}{24.56}" in text and r"\multicolumn{6}{l}{\textit{not installed}}" in text
    assert r"Ours \& theirs" in text and r"\multicolumn{4}{c}{\textcolor{gray}{as published, other data}}" in text
    body = text[text.index(r"\begin{tabular}") : text.index(r"\end{tabular}")]
    widths = {_width(line) for line in body.splitlines() if line.endswith(r"\\")}
    assert widths == {1 + len(grid.heads)}, "every line has as many columns as the head"
    assert text.count("{") == text.count("}")
    assert tables.tex("a_b & 50% <x> ~ ^ \\ – #") == (
        r"a\_b \& 50\% $<$x$>$ \textasciitilde{} \textasciicircum{} \textbackslash{} -- \#"
    )
    if shutil.which("pdflatex"):
        source = (
            r"\documentclass{article}\usepackage{booktabs,graphicx,xcolor}\begin{document}" + text + r"\end{document}"
        )
        (tmp_path / "t.tex").write_text(source)
        done = subprocess.run(["pdflatex", "-interaction=batchmode", "t.tex"], cwd=tmp_path, capture_output=True)
        assert done.returncode == 0


def test_csv_has_one_line_per_object_method_and_metric(grid: tables.Grid, tmp_path: Path) -> None:
    rows = summarize(RECORDS, "views", tuple(METHODS))
    figures, means_of_rows = tables.case_figures(RECORDS), tables.mean_figures("relight", rows)
    tables.write_tables(tmp_path, "A title", grid, figures, means_of_rows, ["one note", "of two\nlines"])
    with open(tmp_path / "results.csv", newline="") as file:
        assert file.readline() == "# A title\n"
        lines = list(csv.DictReader(file))
    assert list(lines[0]) == ["protocol", "object", "case", "method", "metric", "value"]
    values = {(line["case"], line["method"], line["metric"]): line["value"] for line in lines}
    assert len(values) == len(lines)
    assert values["b-1", "ttt", "psnr"] == "23.0" and values["b-1", "ttt", "lpips"] == ""
    assert values["a-1", "lift", "numbers.rounds"] == "4.0" and values["a-1", "lift", "rows"] == "1000"
    assert values["b-1", "3dgs", "error"] == "it burst | into\npieces"
    assert [line["metric"] for line in lines if line["method"] == "voxhammer"] == ["missing", "missing"]
    with open(tmp_path / "summary.csv", newline="") as file:
        file.readline()
        means = {(m["block"], m["method"], m["metric"]): m for m in csv.DictReader(file)}
    assert (means["1", "bound", "psnr"]["mean"], means["1", "bound", "psnr"]["objects"]) == ("30.5", "2")
    assert means["1", "voxhammer", ""]["mean"] == "" and "not installed" in means["1", "voxhammer", ""]["state"]
    assert (tmp_path / "table.md").read_text().endswith("- one note\n- of two lines\n")
    assert "% of two lines\n" in (tmp_path / "table.tex").read_text()


def test_seconds_for_people() -> None:
    texts = {0.0: "0", 0.00002: "< 0.01", 0.0149: "0.01", 1.5: "1.50", 9.994: "9.99", 9.996: "10.0", 99.96: "100"}
    assert {value: tables.seconds(value) for value in texts} == texts and tables.seconds(1234.5) == "1,234"


def test_states_in_cells() -> None:
    assert tables.short("not installed: pip install x") == "not installed"
    assert tables.short("needs a CUDA GPU") == "needs a CUDA GPU"
    long = tables.short("error: " + "x" * 200)
    assert len(long) == 80 and long.endswith("…")


def _width(line: str) -> int:
    """Columns that a line of a LaTeX table fills."""
    import re

    parts = re.split(r"(?<!\\)&", line)
    spans = [re.search(r"\\multicolumn\{(\d+)\}", part) for part in parts]
    return sum(int(span[1]) if span else 1 for span in spans)


# ---- the paper's own figures, against numbers copied from its tables by hand


def published_figures(protocol: str, label: str, group: str = "") -> tuple[float, ...]:
    (row,) = [row for row in published.rows(protocol) if row.label == label]
    return tuple(row.figures[group, name] for name in ("PSNR", "SSIM", "LPIPS"))


@pytest.mark.parametrize(
    ("protocol", "label", "group", "copied"),
    [
        ("refine", "GenDen", "", (17.32, 0.5378, 0.5979)),
        ("refine", "SRGS", "", (21.01, 0.6759, 0.3540)),
        ("refine", "Ours (stage II)", "", (21.07, 0.5780, 0.3673)),
        ("relight", "3DGS", "", (21.32, 0.8613, 0.1225)),
        ("relight", "Ours (2 views)", "", (24.71, 0.8991, 0.0719)),
        ("creative", "VineDresser3D", EDITED_REGION, (11.99, 0.6092, 0.3506)),
        ("creative", "VineDresser3D", OUTSIDE_REGION, (15.79, 0.7437, 0.2678)),
        ("creative", "Ours", OUTSIDE_REGION, (33.02, 0.9560, 0.0310)),
        ("compress", "VoxelAtt", "", (30.65, 0.9193, 0.0804)),
        ("compress", "Pre-Compression (GS-LRM)", "", (34.19, 0.9283, 0.0249)),
    ],
)
def test_figures_are_the_papers(protocol: str, label: str, group: str, copied: tuple[float, ...]) -> None:
    assert published_figures(protocol, label, group) == copied


def test_seconds_are_the_papers() -> None:
    seconds = {(row.protocol, row.label): row.seconds for row in published.ROWS}
    assert seconds["refine", "GS-LRM"] == "0.92" and seconds["refine", "SRGS"] == "495"
    assert seconds["refine", "Ours (stage II)"] == "1.54 + 0.64"
    assert seconds["relight", "RelitLRM"] == "22.1" and seconds["relight", "Ours (1 view)"] == "1.54 + 0.08"
    assert seconds["creative", "Ours"] == seconds["compress", "VoxelAtt"] == ""


def test_every_row_of_the_four_tables_is_there() -> None:
    counts = {name: len(published.rows(name)) for name in ("refine", "relight", "creative", "compress", "sequence")}
    assert counts == {"refine": 6, "relight": 6, "creative": 3, "compress": 4, "sequence": 0}
    assert {len(row.figures) for row in published.rows("creative")} == {6}
    # The column sums, added up by hand.
    assert sum(row.figures["", "PSNR"] for row in published.rows("refine")) == pytest.approx(121.04)
    assert sum(row.figures["", "PSNR"] for row in published.rows("relight")) == pytest.approx(141.35)
    assert sum(row.figures["", "PSNR"] for row in published.rows("compress")) == pytest.approx(132.70)


def test_rows_stand_beside_the_method_that_they_are() -> None:
    one = published.published_rows("relight", ["ttt", "3dgs"], 1)
    assert {method: row.label for method, row in one.items()} == {"ttt": "Ours (1 view)", "3dgs": "3DGS"}
    both = published.published_rows("relight", ["3dgs", "3dgs-colors"], 2)
    assert list(both) == ["3dgs-colors"], "the closest, and once"
    left = [row.label for row in published.unmatched("relight", ["ttt", "3dgs"], 4)]
    assert left == ["RelitLRM", "GS-LRM + CrossAtt"]
    assert list(published.published_rows("relight", ["predictor", "ttt-global"], 1)) == ["ttt-global"], "no predictor"
    assert published.published_rows("relight", ["ttt"], 3) == {}
