"""A table's rows as CSV, Markdown and LaTeX, in the paper's layout, with the paper's own figures in a group apart.

One line of the table per method and block; what did not run is said in words and never printed as a number. Best
figures are bold among rows that answered every case, upper bounds and "nothing" left out. Knows no files but those it
writes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatbench import published
from splatbench.published import MARK
from splatbench.records import Record
from splatbench.report.names import Names
from splatbench.report.summary import MEASURED, Estimate, SummaryRow
from splatpainter.io import files
from splatpainter.text_tables import shown, write_csv

NONE = "–"
ARROWS = {"higher": " ↑", "lower": " ↓", "": ""}
NOT_RUN = "not run"
SHORTEST = 0.01
"""Seconds; less is not told apart."""
_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "–": "--"}
_TEX |= {c: "\\" + c for c in "&%$#_{}"} | {"↑": r"$\uparrow$", "↓": r"$\downarrow$", "<": "$<$", ">": "$>$"}


@dataclass(frozen=True)
class Figure:
    """One line of results.csv: one metric of one method on one case."""

    protocol: str
    object: str
    case: str
    method: str
    metric: str
    """A column's key, "setup_seconds", "rows_equal", ..., or "error" and "missing", whose value is a sentence."""
    value: float | str | None


@dataclass(frozen=True)
class Mean:
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
    """Above a column."""

    group: str
    label: str
    published: bool = False


@dataclass(frozen=True)
class Line:
    """One row of the table."""

    label: str
    state: str
    """Why there are no figures; "": there are."""
    cells: tuple[tuple[str, str], ...]
    """(figure, its interval or "") per column."""
    best: frozenset[int] = frozenset()
    """Columns in which it is the best of its block."""


@dataclass(frozen=True)
class Grid:
    """A table as text, before it is Markdown or LaTeX."""

    heads: tuple[Head, ...]
    blocks: tuple[tuple[str, tuple[Line, ...]], ...]
    """(name, "" where the table is not split; its rows)."""


def figures(records: Iterable[Record]) -> list[Figure]:
    """Every number of every record, in full; of a record without figures, its error or why it is missing."""
    found = []
    for r in records:
        told: dict[str, float | str | None]
        if r.whole:
            own = ("setup_seconds", "edit_seconds", "peak_mib", "rows", "rows_equal", "appended")
            told = {**r.figures, **{name: getattr(r, name) for name in own}}
            told |= {f"numbers.{name}": value for name, value in r.numbers.items()}
        else:
            told = {"missing": r.missing} if r.missing else {"error": r.error}
        found += [Figure(r.protocol, r.name, r.label, r.method, metric, value) for metric, value in told.items()]
    return found


def means(protocol: str, rows: Iterable[SummaryRow]) -> list[Mean]:
    """Rows in long form; one line with its state for a row that has no figures."""
    found = []
    for row in rows:
        start = protocol, row.block, row.method
        for key, one in row.figures.items():
            found.append(Mean(*start, key, one.mean, one.low, one.high, one.cases, one.objects, row.state))
        own = ("setup_seconds", "edit_seconds", "peak_mib", "rows", "rows_equal", "appended")
        for name in own if row.state == MEASURED else ():
            value = getattr(row, name)
            if value is not None:
                found.append(Mean(*start, name, float(value), None, None, row.cases, row.objects, row.state))
        if row.state != MEASURED:
            found.append(Mean(*start, "", None, None, None, 0, 0, row.state))
    return found


def grid(protocol: str, columns: Sequence, rows: Sequence[SummaryRow], names: Names, split_by: str = "") -> Grid:
    """The table. columns: of protocols.Column; rows: of `summarize`, block by block."""
    paper = published.rows(protocol)
    theirs = list(dict.fromkeys(key for row in paper for key in row.figures))
    timed = any(row.seconds for row in paper)
    heads = [Head(c.group, c.label + ARROWS[c.better]) for c in columns]
    costs = {"Seconds (set-up + edit)": _seconds, "Peak MiB": _memory, "Rows": _rows, "Rows kept %": _kept}
    if any(c.key == "equal" for c in columns):  # the table says it itself
        del costs["Rows kept %"]
    heads += [Head("", label) for label in costs]
    heads += [Head(MARK, f"{group} {label}".strip(), True) for group, label in theirs]
    heads += [Head(MARK, "Seconds", True)] if timed else []
    blocks = []
    for block in dict.fromkeys(row.block for row in rows):
        own = [row for row in rows if row.block == block]
        views = int(block) if split_by == "views" and block.isdecimal() else None
        beside = published.beside(protocol, [row.method for row in own], views)
        best = {k: _best(own, c.key, c.better, names) for k, c in enumerate(columns)}
        lines = []
        for row in own:
            cells = [_estimate(row.figures.get(c.key), c.digits, row.state) for c in columns]
            cells += [(cost(row), "") for cost in costs.values()]
            cells += _paper(beside.get(row.method), theirs, timed)
            label = names.labels.get(row.method, row.method)
            if 0 < row.cases < row.asked:
                label += f" ({row.cases} of {row.asked})"
            marked = frozenset(k for k, methods in best.items() if row.method in methods)
            lines.append(Line(label, "" if row.state == MEASURED else short(row.state), tuple(cells), marked))
        blank = (NONE, "")
        for other in published.others(protocol, [row.method for row in own], views):
            cells = [blank] * (len(columns) + len(costs)) + _paper(other, theirs, timed)
            lines.append(Line(other.label, NOT_RUN, tuple(cells)))
        blocks.append((f"{split_by}: {block}" if split_by and block else "", tuple(lines)))
    return Grid(tuple(heads), tuple(blocks))


def markdown(table: Grid) -> str:
    """For people and for GitHub; published figures in italics, since Markdown has no grey."""
    heads = ["Method"] + [
        f"*{MARK}:* {h.label}" if h.published else f"{h.group} {h.label}".strip() for h in table.heads
    ]
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * len(table.heads)]
    for name, rows in table.blocks:
        if name:
            lines.append("| **" + _plain(name) + "** |" + " |" * len(table.heads))
        for row in rows:
            cells = []
            for k, (text, interval) in enumerate(row.cells):
                text = f"**{text}**" if k in row.best else text
                if table.heads[k].published and text != NONE:
                    text = f"*{text}*"
                cells.append(f"{text} {interval}".strip())
            if row.state:
                cells[0] = _plain(row.state)
            lines.append("| " + " | ".join([_plain(row.label), *cells]) + " |")
    return "\n".join(lines)


def latex(table: Grid, caption: str, label: str) -> str:
    r"""A table environment, as wide as the page; needs the packages booktabs, graphicx and xcolor."""
    heads = table.heads
    ours = sum(not h.published for h in heads)
    groups, spans, place = [], [], 2
    while place < len(heads) + 2:
        group = heads[place - 2].group
        width = next((k for k, h in enumerate(heads[place - 2 :]) if h.group != group), len(heads) - place + 2)
        text = tex(group) if place - 2 < ours else rf"\textcolor{{gray}}{{{tex(group)}}}"
        groups.append(rf"\multicolumn{{{width}}}{{c}}{{{text if group else ''}}}")
        spans += [rf"\cmidrule(lr){{{place}-{place + width - 1}}}"] if group else []
        place += width
    titles = [_grey(tex(h.label)) if h.published else tex(h.label) for h in heads]
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
            for k, (text, interval) in enumerate(row.cells):
                cell = rf"\textbf{{{tex(text)}}}" if k in row.best else tex(text)
                cell = _grey(cell) if heads[k].published else cell
                cells.append(cell + (rf" {{\tiny {tex(interval)}}}" if interval else ""))
            if row.state:
                cells[:ours] = [rf"\multicolumn{{{ours}}}{{l}}{{\textit{{{tex(row.state)}}}}}"]
            lines.append(" & ".join([tex(row.label), *cells]) + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}}", r"\end{table}"]) + "\n"


def write(folder: Path, title: str, table: Grid, told: Sequence[Figure], summed: Sequence[Mean], notes: Sequence[str]):
    """results.csv, summary.csv, table.md and table.tex in a folder. notes: lines below the table."""
    write_csv(folder / "results.csv", told, title)
    write_csv(folder / "summary.csv", summed, title)
    text = "\n\n".join([f"# {title}", markdown(table), *([_bullets(notes)] if notes else [])]) + "\n"
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
    """For people: hundredths, tenths from 10 s on, whole ones from 100 s on."""
    if 0 < value < SHORTEST:
        return f"< {SHORTEST:g}"
    return f"{value:,.{2 if 0 < value < 9.995 else 1 if 0 < value < 99.95 else 0}f}"


def tex(text: str) -> str:
    """Text as LaTeX."""
    return "".join(_TEX.get(letter, letter) for letter in text)


def _best(rows: Sequence[SummaryRow], key: str, better: str, names: Names) -> set[str]:
    """Methods with the best mean; none where fewer than two can be compared."""
    known = {
        row.method: row.figures[key].mean
        for row in rows
        if key in row.figures and row.cases == row.asked and row.method not in names.unmarked
    }
    if not better or len(known) < 2:
        return set()
    top = max(known.values()) if better == "higher" else min(known.values())
    return {method for method, value in known.items() if value == top}


def _estimate(one: Estimate | None, digits: int, state: str) -> tuple[str, str]:
    if one is None:
        return ("n/a" if state == MEASURED else NONE), ""
    interval = ""
    if one.low is not None and one.high is not None and math.isfinite(one.mean):
        interval = f"[{one.low:,.{digits}f}, {one.high:,.{digits}f}]"
    return f"{one.mean:,.{digits}f}", interval


def _seconds(row: SummaryRow) -> str:
    """As the paper prints them; set-up is left out where there is none."""
    if row.edit_seconds is None:
        return NONE
    edit = seconds(row.edit_seconds)
    return f"{seconds(row.setup_seconds)} + {edit}" if row.setup_seconds and row.setup_seconds >= SHORTEST else edit


def _memory(row: SummaryRow) -> str:
    return NONE if row.peak_mib is None else f"{row.peak_mib:,.0f}"


def _rows(row: SummaryRow) -> str:
    return NONE if row.rows is None else f"{row.rows:,}"


def _kept(row: SummaryRow) -> str:
    """Percent; never rounded up to all."""
    if row.rows_equal is None:
        return NONE
    return "100" if row.rows_equal == 1 else f"{math.floor(row.rows_equal * 1e4) / 100:.2f}"


def _paper(row: published.Published | None, keys: Sequence[tuple[str, str]], timed: bool) -> list[tuple[str, str]]:
    if row is None:
        return [(NONE, "")] * (len(keys) + timed)
    cells = [(_as_printed(label, row.figures[group, label]), "") for group, label in keys]
    return cells + ([(row.seconds or NONE, "")] if timed else [])


def _as_printed(label: str, value: float) -> str:
    return f"{value:.2f}" if label == "PSNR" else f"{value:.4f}"


def _plain(text: str) -> str:
    return shown(text)


def _grey(text: str) -> str:
    return rf"\textcolor{{gray}}{{{text}}}"


def _bullets(notes: Sequence[str]) -> str:
    return "\n".join(f"- {' '.join(note.split())}" for note in notes)
