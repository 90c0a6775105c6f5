"""Which figure stands against which: quality against seconds, against the number of views or edits, and row counts.

Every function gives a Chart (svg.py), or None where the records have nothing for it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from splatbench.records import Record
from splatbench.report import curves
from splatbench.report.names import Layout, Names
from splatbench.report.summary import SummaryRow, block_of, blocks, leading, summarize
from splatbench.report.svg import Axis, Chart, Level, Mark, Series
from splatbench.report.tables import seconds
from splatbench.tables import Column

INSTANT = 1e-4
"""Seconds; what takes less is a line across the plot, for a log axis has no place for it."""
LEAST = 2
"""Methods in a plot: one alone is in the table already."""
STAGES = (("from the LRM", ("gaussians_before", "lrm_gaussians")), ("after Stage I", ("gaussians_kept",)))
"""(stage, keys of Record.numbers that have its row count)."""
RESULT = "in the edited asset"
STEMS = {
    "psnr": "PSNR after each step",
    "fresh": "PSNR of each edit right after it was made",
    "end": "PSNR of each edit after the last one",
}
"""Stem of a figure's key -> what its chart shows."""
NUMBERED = re.compile(r"(?P<stem>.+?)_(?P<place>\d+)$")


def charts(records: Sequence[Record], table: Layout, names: Names) -> list[Chart]:
    """All that a protocol's records have something for, in the order of reading."""
    found: list[Chart | None] = []
    parts = blocks(records, table.split_by)
    counted = len(parts) > 1 and all(_number(part) is not None for part in parts)
    for part in parts[-1:] if counted else parts:
        within = f"{table.split_by} {part}" if part else ""
        own = [r for r in records if block_of(r, table.split_by) == part]
        rows = summarize(own, "", names.order)
        for column in leading(table.columns, rows):
            found.append(against_seconds(rows, own, column, names, within))
        found += numbered(rows, table.columns, names, within)
        found.append(row_counts(rows, names, within))
    if counted:
        rows = summarize(records, table.split_by, names.order)
        found += [against_blocks(rows, column, table.split_by, names) for column in leading(table.columns, rows)]
    return [chart for chart in found if chart is not None]


def against_seconds(
    rows: Sequence[SummaryRow], records: Sequence[Record], column: Column, names: Names, within: str = ""
) -> Chart | None:
    """One point per method at the median seconds of its edits (of the set-up, where that is all it does); methods with
    Record.curve as lines through their steps. rows: one block's. None for fewer than two points to compare."""
    series, levels, timed = [], [], set()
    for row in rows:
        found = row.figures.get(column.key)
        if found is None or not math.isfinite(found.mean):
            continue
        label, style = names.labels[row.method], names.style(row.method)
        tip = _tip(label, row, column)
        spent = {"edits": row.edit_seconds, "set-up": row.setup_seconds}
        what = next((name for name, value in spent.items() if value is not None and value >= INSTANT), None)
        if what is None:
            levels.append(Level(label, found.mean, style, tip, row.method))
            continue
        timed.add(what)
        end = Mark(spent[what] or 0.0, found.mean, found.low, found.high, tip)
        way = [m for m in curve(records, row.method, column, label) if abs(math.log(m.x / end.x)) > 0.05]
        marks = tuple(sorted((*way, end), key=lambda mark: mark.x))
        series.append(Series(label, style, marks, len(marks) > 1, row.method in names.unmarked, row.method))
    if len(series) < LEAST:
        return None
    axis = f"seconds of {timed.pop()}" if len(timed) == 1 else "seconds of edits, or of set-up where there are none"
    axis += " (small numbers: steps)" if any(m.note for s in series for m in s.marks) else ""
    title = f"{_named(column)} against seconds{_where(_place(column), within)}"
    return Chart(title, Axis(axis, log=True), _axis(column), tuple(series), tuple(levels))


def curve(records: Sequence[Record], method: str, column: Column, label: str) -> list[Mark]:
    """What a method had on its way, as marks."""
    marks = []
    for point in curves.points(records, method, column.key):
        if point.seconds >= INSTANT:
            tip = f"{label} after {point.steps:g} steps: {column.label} {point.mean:.{column.digits}f}"
            tip += f", {seconds(point.seconds)} s"
            marks.append(Mark(point.seconds, point.mean, tip=tip, note=f"{point.steps:g}"))
    return marks


def against_blocks(rows: Sequence[SummaryRow], column: Column, split_by: str, names: Names) -> Chart | None:
    """One line per method over blocks that are numbers, e.g. of edited views. rows: of all blocks."""
    series = []
    for method in names.order:
        marks = []
        for row in rows:
            found, at = row.figures.get(column.key), _number(row.block)
            if row.method == method and found is not None and at is not None:
                tip = f"{_tip(names.labels[method], row, column)}, {split_by} {row.block}"
                marks.append(Mark(at, found.mean, found.low, found.high, tip))
        if marks:
            hollow = method in names.unmarked
            series.append(Series(names.labels[method], names.style(method), tuple(marks), True, hollow, method))
    if len(series) < LEAST or max(len(s.marks) for s in series) < 2:
        return None
    title = f"{_named(column)} against number of {split_by}{_where(_place(column))}"
    return Chart(title, _counts(series, f"number of {split_by}"), _axis(column), _apart(series), at_ends=True)


def numbered(rows: Sequence[SummaryRow], columns: Sequence[Column], names: Names, within: str = "") -> list[Chart]:
    """Figures beyond the table whose keys end in a number ("psnr_1", "psnr_2", ...), one chart per stem of STEMS."""
    tabled = {column.key for column in columns}
    stems: dict[str, dict[str, list[Mark]]] = {}
    for row in rows:
        for key, found in row.figures.items():
            if key not in tabled and (match := NUMBERED.match(key)) and match["stem"] in STEMS:
                place = float(match["place"])
                tip = f"{names.labels[row.method]}: {found.mean:.2f} dB, step {place:g}"
                mark = Mark(place, found.mean, found.low, found.high, tip)
                stems.setdefault(match["stem"], {}).setdefault(row.method, []).append(mark)
    found_charts = []
    for stem, by_method in stems.items():
        series = [
            Series(
                names.labels[method],
                names.style(method),
                tuple(sorted(marks, key=lambda m: m.x)),
                True,
                method in names.unmarked,
                method,
            )
            for method, marks in by_method.items()
        ]
        if len(series) >= LEAST and max(len(s.marks) for s in series) > 1:
            title = f"{STEMS[stem]}{_where(within)}"
            found_charts.append(Chart(title, _counts(series, "step"), Axis("PSNR ↑"), _apart(series), at_ends=True))
    return found_charts


def row_counts(rows: Sequence[SummaryRow], names: Names, within: str = "") -> Chart | None:
    """Rows at each stage, for methods that tell them (Record.numbers), and in the edited asset."""
    series = []
    for row in rows:
        label = names.labels[row.method]
        counts = [next((row.numbers[key] for key in keys if key in row.numbers), None) for _, keys in STAGES]
        counts.append(None if row.rows is None else float(row.rows))
        if sum(count is not None for count in counts) < 2:
            continue
        marks = []
        for at, (stage, count) in enumerate(zip((*(name for name, _ in STAGES), RESULT), counts, strict=True)):
            if count:
                marks.append(Mark(float(at), count, tip=f"{label}: {count:,.0f} rows {stage}"))
        series.append(Series(label, names.style(row.method), tuple(marks), True, key=row.method))
    if len(series) < LEAST:
        return None
    axis = Axis("", ticks=tuple((float(k), text) for k, text in enumerate((*(name for name, _ in STAGES), RESULT))))
    return Chart(
        f"Rows at each stage{_where(within)}", axis, Axis("rows (Gaussians)", log=True), _apart(series), at_ends=True
    )


def _named(column: Column) -> str:
    """Its measure; where the label only says when or where, the group ends in the measure: "PSNR, after the last"."""
    group, _, measure = column.group.rpartition(", ")
    return f"{measure}, {column.label}" if group and column.label[:1].islower() else column.label


def _place(column: Column) -> str:
    """Its group, without the measure that `_named` has."""
    return column.group if _named(column) == column.label else column.group.rpartition(", ")[0]


def _axis(column: Column) -> Axis:
    arrow = {"higher": " \N{UPWARDS ARROW}", "lower": " \N{DOWNWARDS ARROW}"}.get(column.better, "")
    return Axis(f"{_named(column).partition(',')[0]}{arrow}")


def _where(*parts: str) -> str:
    """In brackets, those that say something."""
    told = [part[:1].lower() + part[1:] for part in parts if part]
    return f" ({', '.join(told)})" if told else ""


def _tip(label: str, row: SummaryRow, column: Column) -> str:
    found = row.figures[column.key]
    spread = "" if found.low is None else f" ({found.low:.{column.digits}f} to {found.high:.{column.digits}f})"
    edits = "" if row.edit_seconds is None else f", {seconds(row.edit_seconds)} s of edits"
    setup = f" + {seconds(row.setup_seconds)} s once" if row.setup_seconds else ""
    return f"{label}: {column.label} {found.mean:.{column.digits}f}{spread}{edits}{setup}"


def _counts(series: Sequence[Series], label: str) -> Axis:
    """An axis with a tick at every count that occurs."""
    return Axis(label, ticks=tuple((at, f"{at:g}") for at in sorted({m.x for s in series for m in s.marks})))


def _apart(series: Sequence[Series]) -> tuple[Series, ...]:
    """Moved sideways a little, so that intervals at the same count stand beside each other."""
    places = sorted({m.x for s in series for m in s.marks})
    step = min((b - a for a, b in zip(places, places[1:], strict=False)), default=1.0) * 0.25 / max(len(series), 1)
    moved = []
    for k, s in enumerate(series):
        by = (k - (len(series) - 1) / 2) * step
        marks = tuple(Mark(m.x + by, m.y, m.low, m.high, m.tip, m.note) for m in s.marks)
        moved.append(Series(s.label, s.style, marks, s.joined, s.hollow, s.key))
    return tuple(moved)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
