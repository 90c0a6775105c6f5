"""Charts as SVG: two axes, points with intervals, lines, level lines, labels beside what they name. Text stays text.

`draw` gives an element for an HTML page, which brings the style; `document` makes a file that stands alone. Colour and
shape of a series are classes (m0, m1, ...), so that the page decides them for light and dark grounds. Knows no records.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from splatpainter.evaluate.paper.report import labels
from splatpainter.evaluate.paper.report.labels import Box, Point, text_width
from splatpainter.evaluate.paper.report.scales import Scale, fitted, linear_ticks, log_ticks, tick_text

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
    named = [*chart.levels, *chart.series]
    # small screens: labels have less width, so that they get more height
    height = round(min(width * 0.58, 400.0) if width >= SMALL_SCREEN else min(280.0 + 10.0 * len(named), 480.0))
    right = 14.0
    if chart.at_ends:
        right = 20.0 + min(max(text_width(s.label, TEXT) for s in named), width * 0.34)
        height = max(height, round(len(named) * (TEXT + 3) + 90))
    values = [v for s in chart.series for m in s.marks for v in (m.y, m.low, m.high) if v is not None]
    values += [level.y for level in chart.levels]
    top, bottom = 26.0, height - 44.0
    y = fitted(values, bottom, top, chart.y.log)
    y_ticks = _ticks(chart.y, y, 7)
    left = 12.0 + max((text_width(text, TEXT) for _, text in y_ticks), default=20.0)
    across = [m.x for s in chart.series for m in s.marks] + [value for value, _ in chart.x.ticks]
    x = fitted(across or [0.0, 1.0], left, width - right, chart.x.log)
    frame = (left, top, width - right, bottom)
    body = _grid(chart, x, y, y_ticks, frame)
    body += [_level(level, y(level.y), frame) for level in chart.levels]
    body += [_line(s, x, y) for s in chart.series if s.joined and len(s.marks) > 1]
    body += _end_labels(chart, x, y, frame, width) if chart.at_ends else _near_labels(chart, x, y, frame)
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


def _end_labels(chart: Chart, x: Scale, y: Scale, frame: Box, width: int) -> list[str]:
    ends: list[tuple[float, float, Series | Level]] = [(frame[2], y(level.y), level) for level in chart.levels]
    ends += [(x(s.marks[-1].x), y(s.marks[-1].y), s) for s in chart.series]
    places = labels.spread([end[1] for end in ends], TEXT + 3, frame[1], frame[3])
    body, start = [], frame[2] + 16
    for (from_x, from_y, item), place in zip(ends, places, strict=True):
        text = labels.shortened(item.label, TEXT, width - start - 2)
        begin = from_x + RADIUS + 1 if isinstance(item, Series) else from_x
        body.append(_leader((begin, from_y), (start - 3, place)))
        body.append(_text("label", start, place + 4, text, "start", item.key))
    return body


def _near_labels(chart: Chart, x: Scale, y: Scale, frame: Box) -> list[str]:
    marks, lines = [], [((frame[0], y(v.y)), (frame[2], y(v.y))) for v in chart.levels]
    wanted: list[tuple[Point, str, float, str]] = [
        ((frame[2] - 4 - text_width(level.label, TEXT) / 2, y(level.y)), level.label, TEXT, level.key)
        for level in chart.levels
    ]
    notes: list[tuple[Point, str, float, str]] = []
    for s in chart.series:
        at = [(x(m.x), y(m.y)) for m in s.marks]
        marks += [(px - RADIUS, py - RADIUS, px + RADIUS, py + RADIUS) for px, py in at]
        lines += [
            ((x(m.x), y(m.low)), (x(m.x), y(m.high))) for m in s.marks if m.low is not None and m.high is not None
        ]
        if s.joined:
            lines += list(zip(at, at[1:], strict=False))
        wanted.append((at[-1], s.label, TEXT, s.key))
        notes += [(spot, m.note, SMALL, s.key) for spot, m in zip(at, s.marks, strict=True) if m.note]
    wanted = [
        (spot, labels.shortened(text, size, (frame[2] - frame[0]) * 0.6), size, key)
        for spot, text, size, key in [*wanted, *notes]
    ]
    sizes = [(text_width(text, size), size + 1) for _, text, size, _ in wanted]
    boxes = labels.place([spot for spot, *_ in wanted], sizes, frame, marks, lines, RADIUS + 2)
    body = []
    for (spot, text, size, key), box in zip(wanted, boxes, strict=True):
        if box is None:
            continue
        edge = labels.nearest(spot, box)
        away = math.dist(spot, edge)
        if size == SMALL and away > 14:  # a number far from its point says nothing
            continue
        if away > 18:
            body.append(_leader(spot, edge))
        body.append(_text("label" if size == TEXT else "note", box[0], box[3] - 2.5, text, "start", key))
    return body


def _leader(a: Point, b: Point) -> str:
    return f'<path class="leader" d="M{a[0]:.1f},{a[1]:.1f}L{b[0]:.1f},{b[1]:.1f}"/>'


def _text(kind: str, x: float, y: float, text: str, anchor: str, key: str = "") -> str:
    named = f' data-m="{escape(key, quote=True)}"' if key else ""
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{named}>{escape(text)}</text>'
