"""Charts: quality against seconds, against the number of views or steps, and counts of Gaussians at each stage.

`charts` says what there is to show; `draw` makes an SVG of it with matplotlib. Equal charts give equal bytes. Its
colours are CSS variables with a value for light and one for dark grounds, as the viewer prefers.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from splatbench.cases import Record
from splatbench.report.summary import (
    MethodNames,
    SummaryRow,
    TableLayout,
    as_number,
    block_of,
    blocks,
    curve_points,
    leading,
    summarize,
)
from splatbench.report.tables import ARROWS
from splatbench.tables import Column

COLORS = (
    ("#0064a8", "#62b0ee"),
    ("#c94a00", "#ff9159"),
    ("#007f65", "#41cba6"),
    ("#b3478a", "#ec95c8"),
    ("#8f6b00", "#dcb741"),
    ("#5a5fd0", "#a9adff"),
    ("#4a4a50", "#d2d2d8"),
)
"""(on light, on dark); after Okabe and Ito 2008, readable on each ground. Markers tell apart what colours may not."""
MARKERS = {
    "o": "M-5,0a5,5 0 1,0 10,0a5,5 0 1,0 -10,0z",
    "s": "M-4.5,-4.5h9v9h-9z",
    "^": "M0,-5.8L5.6,4.4H-5.6z",
    "D": "M0,-6L6,0L0,6L-6,0z",
    "P": "M-5,-2h3v-3h4v3h3v4h-3v3h-4v-3h-3z",
}
"""matplotlib's marker -> the same as an SVG path about the origin. 5 markers and 7 colours: the first 35 methods all
differ."""
INK, QUIET, LINE, GROUND = (
    ("#1b1b1f", "#ececf0"),
    ("#67676f", "#a3a3ad"),
    ("#d9d8d4", "#3a3b42"),
    ("#fbfaf8", "#17181b"),
)
"""(on light, on dark), as page.css has them."""
SETTINGS: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "splatpainter",
    "font.size": 12,
    "axes.spines.left": False,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.edgecolor": LINE[0],
    "axes.labelcolor": QUIET[0],
    "axes.unicode_minus": True,
    "xtick.color": QUIET[0],
    "ytick.color": QUIET[0],
    "ytick.left": False,
    "text.color": INK[0],
    "figure.facecolor": GROUND[0],
    "axes.facecolor": GROUND[0],
}
NARROW_PX = 500
"""Below this width the legend stands under the plot."""
FAR_RANGES = 1.5
"""Ranges of the points within which a level still has its line."""
MIN_SECONDS = 1e-4
"""What takes less is a line across the plot: a log axis has no position for it."""
MIN_METHODS = 2
"""Fewest methods in a plot: one alone is in the table already."""
MIN_CURVE_STEP = 0.05
"""Least step, in log seconds; points of a curve that are nearer to its end are left out."""
STAGES = (("from the LRM", ("gaussians_before", "lrm_gaussians")), ("after Stage I", ("gaussians_kept",)))
"""(stage, keys of Record.numbers that have its count of Gaussians)."""
RESULT = "in the edited asset"
STEMS = {
    "psnr": "PSNR after each step",
    "fresh": "PSNR of each edit right after it was made",
    "end": "PSNR of each edit after the last one",
}
"""Stem of a figure's key -> what its chart shows."""
NUMBERED = re.compile(r"(?P<stem>.+?)_(?P<step>\d+)$")


@dataclass(frozen=True)
class Point:
    x: float
    y: float
    low: float | None = None
    """Lower end of the interval in y."""
    high: float | None = None
    note: str = ""
    """Small text above it."""


@dataclass(frozen=True)
class Series:
    label: str
    style: int
    """Number of its colour and marker."""
    points: tuple[Point, ...]
    joined: bool = False
    """Whether the points are joined by a line."""
    hollow: bool = False


@dataclass(frozen=True)
class HorizontalLine:
    """A line across the chart."""

    label: str
    y: float
    style: int = 6


@dataclass(frozen=True)
class Plot:
    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    levels: tuple[HorizontalLine, ...] = ()
    log_x: bool = False
    log_y: bool = False
    x_ticks: tuple[tuple[float, str], ...] = ()
    """(value, text), instead of round values."""


# ---- what is shown


def charts(records: Sequence[Record], table: TableLayout, names: MethodNames) -> list[Plot]:
    """All that a table's records have something for, in the order of reading."""
    drawn: list[Plot | None] = []
    parts = blocks(records, table.split_by)
    counted = len(parts) > 1 and all(as_number(part) is not None for part in parts)
    for part in parts[-1:] if counted else parts:
        block = f"{table.split_by} {part}" if part else ""
        within = [r for r in records if block_of(r, table.split_by) == part]
        rows = summarize(within, "", names.order)
        for column in leading(table.columns, rows):
            drawn.append(against_seconds(rows, within, column, names, block))
        drawn += numbered(rows, table.columns, names, block)
        drawn.append(gaussian_counts(rows, names, block))
    if counted:
        rows = summarize(records, table.split_by, names.order)
        drawn += [against_blocks(rows, column, table.split_by, names) for column in leading(table.columns, rows)]
    return [chart for chart in drawn if chart is not None]


def against_seconds(
    rows: Sequence[SummaryRow], records: Sequence[Record], column: Column, names: MethodNames, block: str = ""
) -> Plot | None:
    """One point per method at the median seconds of its edits (of the set-up, where that is all it does); methods with
    Record.curve as lines through their steps. rows: one block's. None for fewer than two points to compare."""
    series, levels, timed = [], [], set()
    for row in rows:
        figure = row.figures.get(column.key)
        if figure is None or not math.isfinite(figure.mean):
            continue
        label, style = names.labels[row.method], names.style(row.method)
        spent = {"edits": row.edit_seconds, "set-up": row.setup_seconds}
        what = next((name for name, value in spent.items() if value is not None and value >= MIN_SECONDS), None)
        if what is None:
            levels.append(HorizontalLine(label, figure.mean, style))
            continue
        timed.add(what)
        end = Point(spent[what] or 0.0, figure.mean, figure.low, figure.high)
        way = [
            Point(p.seconds, p.mean, note=f"{p.steps:g}")
            for p in curve_points(records, row.method, column.key)
            if p.seconds >= MIN_SECONDS and abs(math.log(p.seconds / end.x)) > MIN_CURVE_STEP
        ]
        points = tuple(sorted((*way, end), key=lambda point: point.x))
        series.append(Series(label, style, points, len(points) > 1, row.method in names.unranked))
    if len(series) < MIN_METHODS:
        return None
    axis = f"seconds of {timed.pop()}" if len(timed) == 1 else "seconds of edits, or of set-up where there are none"
    axis += " (small numbers: steps)" if any(p.note for s in series for p in s.points) else ""
    measure, group = _measure(column)
    title = f"{measure} against seconds{_in_brackets(group, block)}"
    return Plot(title, axis, _y_label(column), tuple(series), tuple(levels), log_x=True)


def against_blocks(rows: Sequence[SummaryRow], column: Column, split_by: str, names: MethodNames) -> Plot | None:
    """One line per method over blocks that are numbers, e.g. of edited views. rows: of all blocks."""
    points: dict[str, list[Point]] = {}
    for row in rows:
        figure, x = row.figures.get(column.key), as_number(row.block)
        if figure is not None and x is not None:
            points.setdefault(row.method, []).append(Point(x, figure.mean, figure.low, figure.high))
    series = [_series(method, points[method], names) for method in names.order if method in points]
    if len(series) < MIN_METHODS or max(len(s.points) for s in series) < 2:
        return None
    measure, group = _measure(column)
    title = f"{measure} against number of {split_by}{_in_brackets(group)}"
    return Plot(title, f"number of {split_by}", _y_label(column), _spread(series), x_ticks=_counts(series))


def numbered(rows: Sequence[SummaryRow], columns: Sequence[Column], names: MethodNames, block: str = "") -> list[Plot]:
    """Figures beyond the table whose keys end in a number ("psnr_1", "psnr_2", ...), one chart per stem of STEMS."""
    keys = {column.key for column in columns}
    stems: dict[str, dict[str, list[Point]]] = {}
    for row in rows:
        for key, figure in row.figures.items():
            if key not in keys and (match := NUMBERED.match(key)) and match["stem"] in STEMS:
                point = Point(float(match["step"]), figure.mean, figure.low, figure.high)
                stems.setdefault(match["stem"], {}).setdefault(row.method, []).append(point)
    drawn = []
    for stem, by_method in stems.items():
        series = [_series(method, points, names) for method, points in by_method.items()]
        if len(series) >= MIN_METHODS and max(len(s.points) for s in series) > 1:
            title, ticks = f"{STEMS[stem]}{_in_brackets(block)}", _counts(series)
            drawn.append(Plot(title, "step", "PSNR ↑", _spread(series), x_ticks=ticks))
    return drawn


def gaussian_counts(rows: Sequence[SummaryRow], names: MethodNames, block: str = "") -> Plot | None:
    """Counts at each stage, for methods that give them (Record.numbers), and in the edited asset."""
    series = []
    for row in rows:
        counts = [next((row.numbers[key] for key in keys if key in row.numbers), None) for _, keys in STAGES]
        counts.append(None if row.rows is None else float(row.rows))
        if sum(count is not None for count in counts) >= 2:
            points = [Point(float(stage), count) for stage, count in enumerate(counts) if count]
            series.append(Series(names.labels[row.method], names.style(row.method), tuple(points), True))
    if len(series) < MIN_METHODS:
        return None
    ticks = tuple((float(k), text) for k, text in enumerate((*(name for name, _ in STAGES), RESULT)))
    title = f"Gaussians at each stage{_in_brackets(block)}"
    return Plot(title, "", "Gaussians", _spread(series), log_y=True, x_ticks=ticks)


def _series(method: str, points: Sequence[Point], names: MethodNames) -> Series:
    ordered = tuple(sorted(points, key=lambda point: point.x))
    return Series(names.labels[method], names.style(method), ordered, True, method in names.unranked)


def _measure(column: Column) -> tuple[str, str]:
    """(measure, what it is of). Where the label only says when or where, the group ends in the measure: "PSNR, after
    the last"."""
    group, _, measure = column.group.rpartition(", ")
    if group and column.label[:1].islower():
        return f"{measure}, {column.label}", group
    return column.label, column.group


def _y_label(column: Column) -> str:
    return _measure(column)[0].partition(",")[0] + ARROWS[column.better]


def _in_brackets(*parts: str) -> str:
    """The parts that are not empty, in brackets."""
    given = [part[:1].lower() + part[1:] for part in parts if part]
    return f" ({', '.join(given)})" if given else ""


def _counts(series: Sequence[Series]) -> tuple[tuple[float, str], ...]:
    """A tick at every count that occurs."""
    return tuple((x, f"{x:g}") for x in sorted({p.x for s in series for p in s.points}))


def _spread(series: Sequence[Series]) -> tuple[Series, ...]:
    """Moved sideways a little, so that intervals at the same count stand beside each other."""
    values = sorted({p.x for s in series for p in s.points})
    step = min((b - a for a, b in zip(values, values[1:], strict=False)), default=1.0) * 0.25 / max(len(series), 1)
    moved = []
    for k, s in enumerate(series):
        shift = (k - (len(series) - 1) / 2) * step
        moved.append(replace(s, points=tuple(replace(p, x=p.x + shift) for p in s.points)))
    return tuple(moved)


# ---- how it is drawn


def draw(chart: Plot, width: int) -> str:
    """An SVG file of this many pixels' width; its legend names series and levels from the highest down. Raises
    ValueError for a chart without a point."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    chart = _drawable(chart)
    levels: dict[Any, str] = {level: _far(level, chart) for level in chart.levels}
    entries: list[tuple[float, Line2D]] = []
    narrow = width < NARROW_PX
    labels = {item: _label(item.label + levels.get(item, ""), narrow) for item in (*chart.series, *levels)}
    legend = sum(15 * len(label.splitlines()) + 6 for label in labels.values())  # pixels
    height = 260 + legend if narrow else max(round(min(width * 0.58, 400.0)), legend + 20)
    with rc_context(SETTINGS):
        figure = Figure(figsize=(width / 72, height / 72), dpi=72, layout="constrained")
        axes = figure.add_subplot()
        axes.grid(axis="y", color=LINE[0], linewidth=1)
        axes.set_axisbelow(True)
        for level, far in levels.items():
            line = {"color": _color(level.style), "linewidth": 1.5, "linestyle": (0, (5, 4))}
            if not far:
                axes.axhline(level.y, **line)
            entries.append((level.y, Line2D([], [], label=labels[level], **line)))
        for s in chart.series:
            look = {"color": _color(s.style), "marker": [*MARKERS][s.style % len(MARKERS)], "markersize": 10}
            look |= {"markerfacecolor": GROUND[0] if s.hollow else _color(s.style)}
            look |= {"markeredgecolor": _color(s.style) if s.hollow else GROUND[0]}
            look |= {"markeredgewidth": 2 if s.hollow else 1, "linewidth": 2, "linestyle": "-" if s.joined else "none"}
            ends = [p for p in s.points if p.low is not None and p.high is not None and math.isfinite(p.low + p.high)]
            for p in ends:
                axes.vlines(p.x, p.low or 0.0, p.high or 0.0, color=_color(s.style), alpha=0.4 if s.joined else 0.65)
            axes.plot([p.x for p in s.points], [p.y for p in s.points], **look)
            for p in s.points:
                small = {"ha": "center", "fontsize": 10, "color": QUIET[0]}
                axes.annotate(p.note, (p.x, p.y), (0, 8), textcoords="offset points", **small)
            entries.append((s.points[-1].y, Line2D([], [], label=labels[s], **look)))
        _scale(axes, chart)
        axes.set_xlabel(chart.x_label)
        axes.set_title(chart.y_label, loc="left", fontsize=12, color=QUIET[0])
        handles = [line for _, line in sorted(entries, key=lambda entry: -entry[0])]
        position = "outside lower left" if narrow else "outside right upper"
        figure.legend(handles=handles, loc=position, frameon=False, fontsize=12, handlelength=1.8, borderpad=0.2)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Title": chart.title})
    return _with_variables(text.getvalue())


def _drawable(chart: Plot) -> Plot:
    """Without points that no axis can show."""

    def fits(value: float, log: bool) -> bool:
        return math.isfinite(value) and (value > 0 or not log)

    series = []
    for s in chart.series:
        points = tuple(p for p in s.points if fits(p.x, chart.log_x) and fits(p.y, chart.log_y))
        series += [replace(s, points=points)] if points else []
    levels = tuple(level for level in chart.levels if fits(level.y, chart.log_y))
    if not series and not levels:
        raise ValueError(f"chart {chart.title!r}: expected at least one point with finite values, got none")
    return replace(chart, series=tuple(series), levels=levels)


def _far(level: HorizontalLine, chart: Plot) -> str:
    """What the legend says of a level so far from all points that an axis with both would show neither; "": it is
    not."""
    values = [v for s in chart.series for p in s.points for v in (p.y, p.low, p.high) if v is not None]
    values = [v for v in values if math.isfinite(v)]
    margin = FAR_RANGES * (max(values) - min(values)) if values else 0.0
    if not margin or min(values) - margin <= level.y <= max(values) + margin:
        return ""
    return f": {level.y:.4g}{ARROWS['higher' if level.y > max(values) else 'lower']}"


def _scale(axes, chart: Plot) -> None:
    """Axes with ticks at round values, or at those that the chart has."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    axes.margins(0.06)
    axes.yaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))
    for axis, log in ((axes.xaxis, chart.log_x), (axes.yaxis, chart.log_y)):
        if log:
            (axes.set_xscale if axis is axes.xaxis else axes.set_yscale)("log")
            low, high = axis.get_view_interval()
            decades = math.log10(high / low)
            subs = range(1, 10) if decades < 0.7 else (1, 2, 5) if decades < 3 else (1,)
            axis.set_major_locator(LogLocator(subs=tuple(map(float, subs)), numticks=20))
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}" if value >= 1 else f"{value:g}"))
    if chart.x_ticks:
        axes.set_xticks([value for value, _ in chart.x_ticks], [text for _, text in chart.x_ticks])


def _color(style: int) -> str:
    return COLORS[style % len(COLORS)][0]


def _label(text: str, narrow: bool) -> str:
    """The label in lines that leave the plot its share."""
    return textwrap.fill(text, 46 if narrow else 30)


def _with_variables(svg: str) -> str:
    """Colours of the light ground become variables that know both grounds."""
    pairs = {"ink": INK, "quiet": QUIET, "line": LINE, "ground": GROUND} | {f"c{k}": p for k, p in enumerate(COLORS)}
    for name, (light, _) in pairs.items():
        svg = svg.replace(light, f"var(--{name}, {light})")
    light, dark = ("".join(f"--{name}:{pair[k]};" for name, pair in pairs.items()) for k in (0, 1))
    style = f"<style>svg{{{light}}}text{{font-family:system-ui,sans-serif!important}}"
    style += f"@media(prefers-color-scheme:dark){{svg{{{dark}}}}}</style>"
    svg = re.sub(r' (width|height)="([\d.]+)pt"', r' \1="\2"', svg, count=2)
    return svg.replace("<metadata>", f"{style}<metadata>", 1)
