"""One table as CSV, Markdown and LaTeX, in the paper's layout, with the paper's own figures in a group apart.

One line of the table per method and block; what did not run is said in words and never printed as a number. Best
figures are bold among rows that answered every case, methods that see the truth and "nothing" left out. page.py shows
the same Grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from splatbench.cases import Record
from splatbench.report import published
from splatbench.report.published import MARK
from splatbench.report.summary import MEASURED, Estimate, MethodNames, SummaryRow, best_methods
from splatpainter.io import files
from splatpainter.text_tables import cell_text, write_csv

NONE = "–"
ARROWS = {"higher": " ↑", "lower": " ↓", "": ""}
NOT_RUN = "not run"
MIN_SECONDS = 0.01
"""Shorter times are not told apart."""
COSTS = ("setup_seconds", "edit_seconds", "peak_mib", "rows", "rows_equal", "appended")
"""Fields of records and of rows that every table has besides its figures."""
_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--"}
_TEX |= {c: "\\" + c for c in "&%$#_{}"} | {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "<": "$<$", ">": "$>$"}


@dataclass(frozen=True)
class CaseFigure:
    """One line of results.csv: one metric of one method on one case."""

    protocol: str
    object: str
    case: str
    method: str
    metric: str
    """A column's key, "setup_seconds", "rows_equal", ..., or "error" and "missing", whose value is a sentence."""
    value: float | str | None


@dataclass(frozen=True)
class MeanFigure:
    """One line of summary.csv."""

    protocol: str
    block: str
    method: str
    metric: str
    mean: float | None
    low: float | None
    high: float | None
    cases: int
    objects: int
    state: str


@dataclass(frozen=True)
class Head:
    """Heading above a column."""

    group: str
    label: str
    published: bool = False
    better: str = ""
    """"higher", "lower" or "" (neither)."""


@dataclass(frozen=True)
class Cell:
    text: str = NONE
    interval: str = ""
    value: float | None = None
    """What rows are sorted by."""
    best: bool = False
    """Whether it is the best of its block."""


@dataclass(frozen=True)
class TableRow:
    """One row of the table."""

    label: str
    state: str
    """Why there are no figures; "": there are."""
    cells: tuple[Cell, ...]
    """One per column."""
    method: str = ""
    """Name; "" for a row that only the paper has."""


@dataclass(frozen=True)
class Grid:
    """A table as text, before it is Markdown, LaTeX or HTML."""

    heads: tuple[Head, ...]
    blocks: tuple[tuple[str, tuple[TableRow, ...]], ...]
    """(name, "" where the table is not split; its rows)."""


def case_figures(records: Iterable[Record]) -> list[CaseFigure]:
    """Every number of every record, in full; of a record without figures, its error or why it is missing."""
    lines = []
    for r in records:
        values: dict[str, float | str | None]
        if r.has_figures:
            values = {**r.figures, **{name: getattr(r, name) for name in COSTS}}
            values |= {f"numbers.{name}": value for name, value in r.numbers.items()}
        else:
            values = {"missing": r.missing} if r.missing else {"error": r.error}
        lines += [CaseFigure(r.protocol, r.name, r.label, r.method, metric, value) for metric, value in values.items()]
    return lines


def mean_figures(protocol: str, rows: Iterable[SummaryRow]) -> list[MeanFigure]:
    """Rows in long form; one line with its state for a row that has no figures."""
    lines = []
    for row in rows:
        start = protocol, row.block, row.method
        for key, one in row.figures.items():
            lines.append(MeanFigure(*start, key, one.mean, one.low, one.high, one.cases, one.objects, row.state))
        for name in COSTS if row.state == MEASURED else ():
            value = getattr(row, name)
            if value is not None:
                lines.append(MeanFigure(*start, name, float(value), None, None, row.cases, row.objects, row.state))
        if row.state != MEASURED:
            lines.append(MeanFigure(*start, "", None, None, None, 0, 0, row.state))
    return lines


def grid(protocol: str, columns: Sequence, rows: Sequence[SummaryRow], names: MethodNames, split_by: str = "") -> Grid:
    """The table. columns: of tables.Column; rows: of `summarize`, block by block."""
    paper = published.rows(protocol)
    paper_keys = list(dict.fromkeys(key for row in paper for key in row.figures))
    timed = any(row.seconds for row in paper)
    heads = [Head(c.group, c.label + ARROWS[c.better], better=c.better) for c in columns]
    costs = {"Seconds (set-up + edit)": _seconds, "Peak MiB": _memory, "Gaussians": _gaussians, "Kept %": _equal}
    if any(c.key == "equal" for c in columns):  # the table says it itself
        del costs["Kept %"]
    heads += [Head("", label, better="higher" if label == "Kept %" else "lower") for label in costs]
    heads += [Head(MARK, f"{group} {label}".strip(), True) for group, label in paper_keys]
    heads += [Head(MARK, "Seconds", True)] if timed else []
    blocks = []
    for block in dict.fromkeys(row.block for row in rows):
        within = [row for row in rows if row.block == block]
        methods = [row.method for row in within]
        views = int(block) if split_by == "views" and block.isdecimal() else None
        matched = published.published_rows(protocol, methods, views)
        best = {c.key: best_methods(within, c, names) for c in columns}
        lines = []
        for row in within:
            cells = [_mean(row, c, row.method in best[c.key]) for c in columns]
            cells += [cost(row) for cost in costs.values()]
            cells += _published(matched.get(row.method), paper_keys, timed)
            label = names.labels.get(row.method, row.method)
            if 0 < row.cases < row.all_cases:
                label += f" ({row.cases} of {row.all_cases})"
            lines.append(TableRow(label, "" if row.state == MEASURED else short(row.state), tuple(cells), row.method))
        for other in published.unmatched(protocol, methods, views):
            cells = [Cell()] * (len(columns) + len(costs)) + _published(other, paper_keys, timed)
            lines.append(TableRow(other.label, NOT_RUN, tuple(cells)))
        blocks.append((f"{split_by}: {block}" if split_by and block else "", tuple(lines)))
    return Grid(tuple(heads), tuple(blocks))


def markdown(table: Grid) -> str:
    """The table as Markdown, for people and for GitHub; published figures in italics, since Markdown has no grey."""
    heads = ["Method"] + [
        f"*{MARK}:* {h.label}" if h.published else f"{h.group} {h.label}".strip() for h in table.heads
    ]
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * len(table.heads)]
    for name, rows in table.blocks:
        if name:
            lines.append("| **" + cell_text(name) + "** |" + " |" * len(table.heads))
        for row in rows:
            cells = []
            for head, cell in zip(table.heads, row.cells, strict=True):
                text = f"**{cell.text}**" if cell.best else cell.text
                if head.published and text != NONE:
                    text = f"*{text}*"
                cells.append(f"{text} {cell.interval}".strip())
            if row.state:
                cells[0] = cell_text(row.state)
            lines.append("| " + " | ".join([cell_text(row.label), *cells]) + " |")
    return "\n".join(lines)


def latex(table: Grid, caption: str, label: str) -> str:
    r"""A table environment, as wide as the page; needs the packages booktabs, graphicx and xcolor."""
    heads = table.heads
    measured = sum(not h.published for h in heads)
    groups, spans, column = [], [], 2
    for group, width in head_groups(heads):
        title = _gray(tex(group)) if group == MARK else tex(group)
        groups.append(rf"\multicolumn{{{width}}}{{c}}{{{title}}}")
        spans += [rf"\cmidrule(lr){{{column}-{column + width - 1}}}"] if group else []
        column += width
    titles = [_gray(tex(h.label)) if h.published else tex(h.label) for h in heads]
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{tex(caption)}}}",
        rf"\label{{tab:{label}}}",
        r"\resizebox{\linewidth}{!}{%",
        r"\begin{tabular}{l" + "r" * len(heads) + "}",
        r"\toprule",
        " & ".join(["", *groups]) + r" \\",
        *(["".join(spans)] if spans else []),
        " & ".join(["Method", *titles]) + r" \\",
    ]
    for name, rows in table.blocks:
        lines.append(r"\midrule")
        if name:
            lines.append(rf"\multicolumn{{{len(heads) + 1}}}{{l}}{{\textit{{{tex(name)}}}}} \\")
        for row in rows:
            cells = []
            for head, cell in zip(heads, row.cells, strict=True):
                text = rf"\textbf{{{tex(cell.text)}}}" if cell.best else tex(cell.text)
                text = _gray(text) if head.published else text
                cells.append(text + (rf" {{\tiny {tex(cell.interval)}}}" if cell.interval else ""))
            if row.state:
                cells[:measured] = [rf"\multicolumn{{{measured}}}{{l}}{{\textit{{{tex(row.state)}}}}}"]
            lines.append(" & ".join([tex(row.label), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}}", r"\end{table}"]) + "\n"


def write_tables(
    folder: Path,
    title: str,
    table: Grid,
    figures: Sequence[CaseFigure],
    means: Sequence[MeanFigure],
    notes: Sequence[str],
) -> None:
    """results.csv, summary.csv, table.md and table.tex in a folder. notes: lines below the table."""
    write_csv(folder / "results.csv", figures, title)
    write_csv(folder / "summary.csv", means, title)
    bullets = "\n".join(f"- {' '.join(note.split())}" for note in notes)
    text = "\n\n".join([f"# {title}", markdown(table), *([bullets] if notes else [])]) + "\n"
    with files.writing(folder / "table.md") as file:
        file.write(text.encode())
    caption = f"{title}. Means and bootstrap 95 % intervals over objects; gray: {MARK}."
    with files.writing(folder / "table.tex") as file:
        comments = "".join(f"% {' '.join(note.split())}\n" for note in notes)
        file.write((latex(table, caption, folder.name) + comments).encode())


def short(state: str) -> str:
    """What stands in the table's cell: "not installed: pip ..." -> "not installed"; errors as far as fits."""
    if state.startswith("error: "):
        return state if len(state) <= 80 else state[:79].rstrip() + "…"
    return state.partition(":")[0]


def seconds(value: float) -> str:
    """Seconds for people: hundredths, tenths from 10 s on, whole ones from 100 s on."""
    if 0 < value < MIN_SECONDS:
        return f"< {MIN_SECONDS:g}"
    return f"{value:,.{2 if 0 < value < 9.995 else 1 if 0 < value < 99.95 else 0}f}"


def tex(text: str) -> str:
    """Text as LaTeX."""
    return "".join(_TEX.get(letter, letter) for letter in text)


def head_groups(heads: Sequence[Head]) -> list[tuple[str, int]]:
    """(group, number of columns) of each run of columns with the same group."""
    runs = []
    for group, same in groupby(heads, key=lambda head: head.group):
        runs.append((group, len(list(same))))
    return runs


def _mean(row: SummaryRow, column: Any, best: bool) -> Cell:
    figure: Estimate | None = row.figures.get(column.key)
    if figure is None:
        return Cell("n/a" if row.state == MEASURED else NONE)
    interval, digits = "", column.digits
    if figure.low is not None and figure.high is not None and math.isfinite(figure.mean):
        interval = f"[{figure.low:,.{digits}f}, {figure.high:,.{digits}f}]"
    return Cell(f"{figure.mean:,.{digits}f}", interval, figure.mean, best)


def _seconds(row: SummaryRow) -> Cell:
    """Seconds as the paper prints them; set-up is left out where there is none."""
    if row.edit_seconds is None:
        return Cell()
    text, setup = seconds(row.edit_seconds), row.setup_seconds or 0.0
    return Cell(f"{seconds(setup)} + {text}" if setup >= MIN_SECONDS else text, value=setup + row.edit_seconds)


def _memory(row: SummaryRow) -> Cell:
    return Cell() if row.peak_mib is None else Cell(f"{row.peak_mib:,.0f}", value=row.peak_mib)


def _gaussians(row: SummaryRow) -> Cell:
    return Cell() if row.rows is None else Cell(f"{row.rows:,}", value=float(row.rows))


def _equal(row: SummaryRow) -> Cell:
    """Percent of the Gaussians; never rounded up to all."""
    if row.rows_equal is None:
        return Cell()
    text = "100" if row.rows_equal == 1 else f"{math.floor(row.rows_equal * 1e4) / 100:.2f}"
    return Cell(text, value=row.rows_equal)


def _published(row: published.Published | None, keys: Sequence[tuple[str, str]], timed: bool) -> list[Cell]:
    """The paper's figures, with the digits that it prints."""
    if row is None:
        return [Cell()] * (len(keys) + timed)
    values = [(label, row.figures[group, label]) for group, label in keys]
    cells = [Cell(f"{value:.2f}" if label == "PSNR" else f"{value:.4f}") for label, value in values]
    return cells + ([Cell(row.seconds or NONE)] if timed else [])


def _gray(text: str) -> str:
    return rf"\textcolor{{gray}}{{{text}}}"
