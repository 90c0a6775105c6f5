"""Charts as SVG: two axes, points with intervals, lines, level lines, labels beside what they name. Text stays text.

`draw` gives an element for an HTML page, which brings the style; `document` makes a file that stands alone. Colour and
shape of a series are classes (m0, m1, ...), so that the page decides them for light and dark grounds. Knows no records.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape

from splatbench.report import labels
from splatbench.report.labels import Box, Point, text_width
from splatbench.report.scales import Scale, fitted, linear_ticks, log_ticks, tick_text

COLORS = (
    ("#0064a8", "#62b0ee"),
    ("#c94a00", "#ff9159"),
    ("#007f65", "#41cba6"),
    ("#b3478a", "#ec95c8"),
    ("#8f6b00", "#dcb741"),
    ("#5a5fd0", "#a9adff"),
    ("#4a4a50", "#d2d2d8"),
)
"""(on light, on dark); after Okabe and Ito 2008, readable on each ground. Shapes tell apart what colours may not."""
SHAPES = ("M-5,0a5,5 0 1,0 10,0a5,5 0 1,0 -10,0z", "M-4.5,-4.5h9v9h-9z", "M0,-5.8L5.6,4.4H-5.6z", "M0,-6L6,0L0,6L-6,0z")
SHAPES += ("M-5,-2h3v-3h4v3h3v4h-3v3h-4v-3h-3z",)
"""Circle, square, triangle, diamond, plus: paths about the origin. Their number and that of the colours have no common
divisor, so that the first 35 series all differ."""
TEXT, SMALL = 12.0, 10.0
"""Pixels."""
RADIUS = 6.0
FEW = 5
"""Series and levels that are named beside their points; more are named in a legend."""
FAR = 1.5
"""Ranges of the points within which a level still has its line."""
ARROWS = {True: "\N{UPWARDS ARROW}", False: "\N{DOWNWARDS ARROW}"}
SMALL_SCREEN = 500


@dataclass(frozen=True)
class Mark:
    """A point."""

    x: float
    y: float
    low: float | None = None
    """Of the interval in y."""
    high: float | None = None
    tip: str = ""
    """Shown when the point is pointed at."""
    note: str = ""
    """Small text beside it, where there is room."""


@dataclass(frozen=True)
class Series:
    label: str
    style: int
    """Its colour and shape, one of 35."""
    marks: tuple[Mark, ...]
    joined: bool = False
    """By a line."""
    hollow: bool = False
    key: str = ""
    """What the page calls it (data-m)."""


@dataclass(frozen=True)
class Level:
    """A line across the chart."""

    label: str
    y: float
    style: int = 6
    tip: str = ""
    key: str = ""


@dataclass(frozen=True)
class Axis:
    label: str
    log: bool = False
    ticks: tuple[tuple[float, str], ...] = ()
    """(value, text), instead of round values."""


@dataclass(frozen=True)
class Chart:
    title: str
    x: Axis
    y: Axis
    series: tuple[Series, ...]
    levels: tuple[Level, ...] = ()
    at_ends: bool = False
    """Labels right of the chart, at the ends of lines; else beside the points."""


def draw(chart: Chart, width: int) -> str:
    """An <svg> element of this many pixels' width, without a style. Raises ValueError for a chart without a point."""
    chart = _kept(chart)
    values = [v for s in chart.series for m in s.marks for v in (m.y, m.low, m.high) if v is not None]
    beyond = _beyond(chart.levels, values)
    chart = replace(chart, levels=tuple(level for level in chart.levels if level not in beyond))
    named = [*chart.levels, *chart.series]
    # small screens: labels have less width, so that they get more height
    height = round(min(width * 0.58, 400.0) if width >= SMALL_SCREEN else min(280.0 + 10.0 * len(named), 480.0))
    right = 14.0
    beside = _legend(chart, width) if len(named) > FEW and not chart.at_ends else ()
    if chart.at_ends:
        right = 20.0 + min(max(text_width(s.label, TEXT) for s in named), width * 0.34)
        height = max(height, round(len(named) * (TEXT + 3) + 90))
    elif beside and width >= SMALL_SCREEN:
        right = 34.0 + max(text_width(line, TEXT) for _, lines in beside for line in lines)
        height = max(height, round(_legend_height(beside) + 70))
    plot = height
    if beside and width < SMALL_SCREEN:
        height = round(plot + _legend_height(beside) + 6)
    values += [level.y for level in chart.levels]
    top, bottom = 26.0, plot - 44.0
    y = fitted(values, bottom, top, chart.y.log)
    y_ticks = _ticks(chart.y, y, 7)
    left = 12.0 + max((text_width(text, TEXT) for _, text in y_ticks), default=20.0)
    across = [m.x for s in chart.series for m in s.marks] + [value for value, _ in chart.x.ticks]
    x = fitted(across or [0.0, 1.0], left, width - right, chart.x.log)
    frame = (left, top, width - right, bottom)
    body = _grid(chart, x, y, y_ticks, frame)
    body += [_level(level, y(level.y), frame) for level in chart.levels]
    body += [_line(s, x, y) for s in chart.series if s.joined and len(s.marks) > 1]
    ends = [(level.key, text, frame[1 if higher else 3]) for level, (text, higher) in beyond.items()]
    body += _end_labels(chart, x, y, frame, width, ends) if chart.at_ends else []
    body += _near_labels(chart, x, y, frame, ends, not beside) if not chart.at_ends else []
    if beside:
        body += _legend_at(beside, *((width - right + 14, top + 4) if width >= SMALL_SCREEN else (left, plot + 8.0)))
    body += [_marks(s, x, y) for s in chart.series]  # above the labels, whose halo would hide them
    said = escape(chart.title, quote=True)
    head = f'<svg class="chart" viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img"'
    return "\n".join([f'{head} aria-label="{said}">', *body, "</svg>"])


def document(svg: str) -> str:
    """A file of what `draw` gave, in the colours of light and dark grounds as the viewer prefers."""
    style = STYLE + ":root{--ink:#1b1b1f;--quiet:#67676f;--line:#d9d8d4;--ground:#fbfaf8}" + colors(0)
    style += "@media (prefers-color-scheme:dark){:root{--ink:#ececf0;--quiet:#a3a3ad;--line:#3a3b42;--ground:#17181b}"
    style += colors(1) + "}.chart{background:var(--ground);font-family:system-ui,sans-serif}"
    head, rest = svg.split(">", 1)
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{style}</style>{rest}\n'


def colors(ground: int) -> str:
    """CSS: the colour --c of every style, on light (0) or dark (1) ground."""
    return "".join(f".m{k}{{--c:{COLORS[k % len(COLORS)][ground]}}}" for k in range(len(COLORS) * len(SHAPES)))


def symbol(style: int, hollow: bool = False) -> str:
    """The mark of a style as a small picture, for tables; decoration only."""
    kind = f"symbol m{style % (len(COLORS) * len(SHAPES))}" + (" hollow" if hollow else "")
    return (
        f'<svg class="{kind}" viewBox="-8 -8 16 16" width="14" height="14" aria-hidden="true">'
        f'<path class="mark" d="{SHAPES[style % len(SHAPES)]}"/></svg>'
    )


STYLE = (
    ".chart text{fill:var(--ink);font-size:12px}.chart .tick,.chart .axis{fill:var(--quiet)}"
    ".chart .label,.chart .note{paint-order:stroke;stroke:var(--ground);stroke-width:3px;stroke-linejoin:round}"
    ".chart .note{fill:var(--quiet);font-size:10px}.chart .grid{stroke:var(--line);stroke-width:1;fill:none}"
    ".chart .line{stroke:var(--c);stroke-width:2;fill:none;stroke-linejoin:round}"
    ".chart .level{stroke:var(--c);stroke-width:1.5;stroke-dasharray:5 4}"
    ".chart .whisker{stroke:var(--c);stroke-width:1.5;opacity:.65}.chart .leader{stroke:var(--quiet);stroke-width:.8}"
    ".mark{fill:var(--c);stroke:var(--ground);stroke-width:1}"
    ".hollow .mark{fill:var(--ground);stroke:var(--c);stroke-width:2}.chart .hit{fill:transparent;stroke:none}"
)


def _kept(chart: Chart) -> Chart:
    """Without marks that no axis can show."""
    series = []
    for s in chart.series:
        marks = tuple(m for m in s.marks if _shown(m.x, chart.x.log) and _shown(m.y, chart.y.log))
        if marks:
            series.append(Series(s.label, s.style, marks, s.joined, s.hollow, s.key))
    levels = tuple(level for level in chart.levels if _shown(level.y, chart.y.log))
    if not series and not levels:
        raise ValueError(f"chart {chart.title!r}: expected at least one point with finite values, got none")
    return Chart(chart.title, chart.x, chart.y, tuple(series), levels, chart.at_ends)


def _beyond(levels: Sequence[Level], values: Sequence[float]) -> dict[Level, tuple[str, bool]]:
    """Levels so far from all points that an axis with both would show neither: (what is said instead, whether they are
    higher)."""
    finite = [v for v in values if math.isfinite(v)]
    if not finite:
        return {}
    low, high = min(finite), max(finite)
    far = FAR * (high - low)
    found = {level: level.y > high for level in levels if far and (level.y > high + far or level.y < low - far)}
    return {level: (f"{level.label}: {level.y:.4g} {ARROWS[up]}", up) for level, up in found.items()}


def _shown(value: float, log: bool) -> bool:
    return math.isfinite(value) and (value > 0 or not log)


def _ticks(axis: Axis, scale: Scale, most: int) -> Sequence[tuple[float, str]]:
    if axis.ticks:
        return axis.ticks
    found = (log_ticks if scale.log else linear_ticks)(scale.low, scale.high, most)
    return [(value, tick_text(value)) for value in found]


def _grid(chart: Chart, x: Scale, y: Scale, y_ticks: Sequence[tuple[float, str]], frame: Box) -> list[str]:
    left, top, right, bottom = frame
    path = "".join(f"M{left:.1f},{y(v):.1f}H{right:.1f}" for v, _ in y_ticks)
    body = [f'<path class="grid" d="{path}M{left:.1f},{bottom:.1f}H{right:.1f}"/>']
    body += [_text("tick", left - 6, y(v) + 4, text, "end") for v, text in y_ticks]
    last = -math.inf
    for value, text in _ticks(chart.x, x, max(3, round((right - left) / 70))):
        half = text_width(text, TEXT) / 2
        body.append(f'<path class="grid" d="M{x(value):.1f},{bottom:.1f}v5"/>')
        if x(value) - half >= last + 4:  # a tick too near its neighbour goes without its text
            body.append(_text("tick", x(value), bottom + 19, text, "middle"))
            last = x(value) + half
    body.append(_text("axis", 2, 14, chart.y.label, "start"))
    body.append(_text("axis", (left + right) / 2, bottom + 38, chart.x.label, "middle"))
    return body


def _level(level: Level, y: float, frame: Box) -> str:
    tip = f"<title>{escape(level.tip)}</title>" if level.tip else ""
    line = f'<path class="level" d="M{frame[0]:.1f},{y:.1f}H{frame[2]:.1f}"/>'
    return f'<g class="m{level.style}" data-m="{escape(level.key, quote=True)}">{tip}{line}</g>'


def _line(series: Series, x: Scale, y: Scale) -> str:
    path = "L".join(f"{x(m.x):.1f},{y(m.y):.1f}" for m in series.marks)
    return f'<path class="line m{series.style}" data-m="{escape(series.key, quote=True)}" d="M{path}"/>'


def _marks(series: Series, x: Scale, y: Scale) -> str:
    kind = f"m{series.style}" + (" hollow" if series.hollow else "") + (" joined" if series.joined else "")
    parts = [f'<g class="{kind}" data-m="{escape(series.key, quote=True)}">']
    for m in series.marks:
        parts.append("<g>" + (f"<title>{escape(m.tip)}</title>" if m.tip else ""))
        if m.low is not None and m.high is not None and math.isfinite(m.low + m.high):
            parts.append(f'<path class="whisker" d="M{x(m.x):.1f},{y(m.low):.1f}V{y(m.high):.1f}"/>')
        spot = f'transform="translate({x(m.x):.1f},{y(m.y):.1f})"'
        parts.append(f'<path class="mark" {spot} d="{SHAPES[series.style % len(SHAPES)]}"/>')
        parts.append(f'<circle class="hit" {spot} r="11"/></g>')
    return "".join([*parts, "</g>"])


def _end_labels(
    chart: Chart, x: Scale, y: Scale, frame: Box, width: int, beyond: Sequence[tuple[str, str, float]]
) -> list[str]:
    """beyond: (key, text, height) of what lies above or below the chart."""
    ends = [(frame[2], height, text, key) for key, text, height in beyond]
    ends += [(frame[2], y(level.y), level.label, level.key) for level in chart.levels]
    ends += [(x(s.marks[-1].x) + RADIUS + 1, y(s.marks[-1].y), s.label, s.key) for s in chart.series]
    places = labels.spread([end[1] for end in ends], TEXT + 3, frame[1], frame[3])
    body, start = [], frame[2] + 16
    for (from_x, from_y, said, key), place in zip(ends, places, strict=True):
        text = labels.shortened(said, TEXT, width - start - 2)
        body.append(_leader((from_x, from_y), (start - 3, place)))
        body.append(_text("label", start, place + 4, text, "start", key))
    return body


def _near_labels(
    chart: Chart, x: Scale, y: Scale, frame: Box, beyond: Sequence[tuple[str, str, float]], named: bool
) -> list[str]:
    """beyond: as in `_end_labels`; named: also what series and levels are called, which is else in a legend."""
    marks, lines = [], [((frame[0], y(v.y)), (frame[2], y(v.y))) for v in chart.levels]
    across = [*beyond, *((level.key, level.label, y(level.y)) for level in chart.levels if named)]
    wanted = [(_along(frame, height, text_width(text, TEXT)), text, TEXT, key) for key, text, height in across]
    notes: list[tuple[list[Point], str, float, str]] = []
    for s in chart.series:
        at = [(x(m.x), y(m.y)) for m in s.marks]
        marks += [(px - RADIUS, py - RADIUS, px + RADIUS, py + RADIUS) for px, py in at]
        lines += [
            ((x(m.x), y(m.low)), (x(m.x), y(m.high))) for m in s.marks if m.low is not None and m.high is not None
        ]
        if s.joined:
            lines += list(zip(at, at[1:], strict=False))
        wanted += [(at[::-1], s.label, TEXT, s.key)] if named else []
        notes += [([spot], m.note, SMALL, s.key) for spot, m in zip(at, s.marks, strict=True) if m.note]
    wanted = [
        (spots, labels.shortened(text, size, (frame[2] - frame[0]) * 0.6), size, key)
        for spots, text, size, key in [*wanted, *notes]
    ]
    sizes = [(text_width(text, size), size + 1) for _, text, size, _ in wanted]
    boxes = labels.place([spots for spots, *_ in wanted], sizes, frame, marks, lines, RADIUS + 2)
    body = []
    for (spots, text, size, key), box in zip(wanted, boxes, strict=True):
        if box is None:
            continue
        away, spot, edge = min((math.dist(spot, edge := labels.nearest(spot, box)), spot, edge) for spot in spots)
        if size == SMALL and away > 14:  # a number far from its point says nothing
            continue
        if away > 18:
            body.append(_leader(spot, edge))
        body.append(_text("label" if size == TEXT else "note", box[0], box[3] - 2.5, text, "start", key))
    return body


Entry = tuple[Series | Level, list[str]]
"""Of a legend: what, and its name in lines."""


def _legend(chart: Chart, width: int) -> list[Entry]:
    """Series and levels from the highest to the lowest."""
    most = width * 0.34 if width >= SMALL_SCREEN else width - 76.0
    height = {item: item.y if isinstance(item, Level) else item.marks[-1].y for item in (*chart.series, *chart.levels)}
    order = sorted(height, key=lambda item: -height[item])
    return [(item, labels.wrapped(item.label, TEXT, most)) for item in order]


def _legend_height(entries: Sequence[Entry]) -> float:
    return sum(len(lines) * (TEXT + 2) + 4 for _, lines in entries)


def _legend_at(entries: Sequence[Entry], left: float, top: float) -> list[str]:
    body = []
    for item, lines in entries:
        middle = top + TEXT / 2 + 1
        if isinstance(item, Level):
            body.append(f'<path class="level m{item.style}" d="M{left:.1f},{middle:.1f}h14"/>')
        else:
            kind = f"m{item.style}" + (" hollow" if item.hollow else "")
            shape = SHAPES[item.style % len(SHAPES)]
            spot = f'transform="translate({left + 7:.1f},{middle:.1f})"'
            body.append(f'<g class="{kind}"><path class="mark" {spot} d="{shape}"/></g>')
        for line in lines:
            body.append(_text("label", left + 20, top + TEXT - 1, line, "start", item.key))
            top += TEXT + 2
        top += 4
    return body


def _along(frame: Box, height: float, width: float) -> list[Point]:
    """Places for a text about a level, from the right to the left."""
    first, last = frame[2] - 4 - width / 2, frame[0] + 4 + width / 2
    count = max(round((first - last) / 40), 1) + 1
    return [(first + (last - first) * k / (count - 1), height) for k in range(count)]


def _leader(a: Point, b: Point) -> str:
    return f'<path class="leader" d="M{a[0]:.1f},{a[1]:.1f}L{b[0]:.1f},{b[1]:.1f}"/>'


def _text(kind: str, x: float, y: float, text: str, anchor: str, key: str = "") -> str:
    named = f' data-m="{escape(key, quote=True)}"' if key else ""
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{named}>{escape(text)}</text>'
