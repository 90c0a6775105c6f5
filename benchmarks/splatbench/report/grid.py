"""A protocol's table as HTML: means with intervals, and what they cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

from splatbench.report.names import Layout, Names
from splatbench.report.summary import MEASURED, Estimate, SummaryRow
from splatbench.report.svg import symbol
from splatbench.report.tables import seconds
from splatbench.tables import Column

COSTS = {
    "setup_seconds": "Set-up, s",
    "edit_seconds": "Edit, s",
    "peak_mib": "Peak, MiB",
    "rows": "Rows",
    "rows_equal": "Rows kept, %",
}
"""Field of SummaryRow -> what stands above it."""
WIDE = 12
"""Columns; more are set smaller."""


def grid(rows: Sequence[SummaryRow], table: Layout, names: Names) -> str:
    """A <table>, one <tbody> per block."""
    taken = {"rows_equal"} if any(column.key == "equal" for column in table.columns) else set()
    costs = [f for f in COSTS if f not in taken and any(getattr(row, f) is not None for row in rows)]
    head = _head(table.columns, costs)
    width = 1 + len(table.columns) + len(costs)
    bodies = []
    for block in dict.fromkeys(row.block for row in rows):
        within = [row for row in rows if row.block == block]
        best = {column.key: best_of(within, column, names) for column in table.columns}
        lines = [_row(row, table.columns, costs, best, names) for row in within]
        title = f"{table.split_by} {block}" if table.split_by and block else ""
        bodies.append(_body(lines, title, width))
    kind = "results wide" if width > WIDE else "results"
    return "\n".join([f'<table class="{kind}">', head, *bodies, "</table>"])


def best_of(rows: Sequence[SummaryRow], column: Column, names: Names) -> set[str]:
    """Methods whose mean is the best of these rows. Upper bounds, and methods that did not answer every case, do not
    compete; nobody is best alone."""
    if not column.better:
        return set()
    told = {
        row.method: row.figures[column.key].mean
        for row in rows
        if column.key in row.figures and row.cases == row.asked and row.method not in names.unmarked
    }
    if len(told) < 2:
        return set()
    wanted = (max if column.better == "higher" else min)(told.values())
    return {method for method, mean in told.items() if mean == wanted}


def number(value: float, digits: int) -> str:
    """For people."""
    return "∞" if math.isinf(value) else f"{value:,.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _head(columns: Sequence[Column], costs: Sequence[str]) -> str:
    groups = [escape(column.group) for column in columns]
    if not any(groups):
        groups = ["Measured"] * len(groups)
    spans = _runs(groups) + ([("Cost", len(costs))] if costs else [])
    top = ['<tr><th rowspan="2" scope="col" class="name">Method</th>']
    top += [f'<th colspan="{count}" scope="colgroup">{text}</th>' for text, count in spans]
    low = ["<tr>"]
    last = None
    for column, group in zip(columns, groups, strict=True):
        arrow = {"higher": " ↑", "lower": " ↓"}.get(column.better, "")
        low.append(_sortable(column.label + arrow, column.better == "lower", group != last))
        last = group
    low += [_sortable(COSTS[field], field not in ("rows_equal",), k == 0) for k, field in enumerate(costs)]
    return "\n".join(["<thead>", "".join([*top, "</tr>"]), "".join([*low, "</tr>"]), "</thead>"])


def _row(
    row: SummaryRow,
    columns: Sequence[Column],
    costs: Sequence[str],
    best: dict[str, set[str]],
    names: Names,
) -> str:
    mark = symbol(names.style(row.method), row.method in names.unmarked)
    few = f' <span class="few">{row.cases} of {row.asked} cases</span>' if 0 < row.cases < row.asked else ""
    key = escape(row.method, quote=True)
    cells = [f'<th scope="row" class="name">{mark}<span>{escape(names.labels[row.method])}{few}</span></th>']
    if row.state != MEASURED:
        cells.append(f'<td class="state" colspan="{len(columns) + len(costs)}">{escape(row.state)}</td>')
    else:
        last = None
        for column in columns:
            first = column.group != last
            last = column.group
            cells.append(_figure(row.figures.get(column.key), column, row.method in best[column.key], first))
        cells += [_cost(row, field, k == 0) for k, field in enumerate(costs)]
    return f'<tr data-m="{key}">' + "".join(cells) + "</tr>"


def _figure(found: Estimate | None, column: Column, best: bool, first: bool) -> str:
    kind = "num" + (" best" if best else "") + (" first" if first else "")
    if found is None:
        return f'<td class="{kind}" data-v="">n/a</td>'
    text = number(found.mean, column.digits)
    if best:
        text = f'<b>{text}</b><span class="unseen"> best</span>'
    if found.low is not None and found.high is not None:
        digits = min(column.digits, 3) if found.high - found.low > 0.0015 else column.digits
        low, high = (number(end, digits) for end in (found.low, found.high))
        if low != high:
            dash = "–" if found.low >= 0 else " – "
            text += f'<span class="interval">{low}{dash}{high}</span>'
    return f'<td class="{kind}" data-v="{found.mean!r}">{text}</td>'


def _cost(row: SummaryRow, field: str, first: bool) -> str:
    value = getattr(row, field)
    kind = "num first" if first else "num"
    if value is None:
        return f'<td class="{kind}" data-v="">–</td>'
    if field == "rows_equal":
        # never rounded up to all of them
        percent = 100 * value
        text = "100" if value == 1 else f"{math.floor(percent * 100) / 100:.2f}"
    else:
        text = f"{round(value):,}" if field in ("rows", "peak_mib") else escape(seconds(value))
    return f'<td class="{kind}" data-v="{float(value)!r}">{text}</td>'


def _body(lines: Sequence[str], title: str, width: int) -> str:
    block = (
        f'<tr class="block"><th colspan="{width}" scope="rowgroup"><span>{escape(title)}</span></th></tr>'
        if title
        else ""
    )
    return "\n".join([f"<tbody>{block}", *lines, "</tbody>"])


def _sortable(text: str, rising: bool, first: bool) -> str:
    """A column's head; its button sorts the best to the top first. Without a script it is plain text."""
    kind = ' class="first"' if first else ""
    return f'<th scope="col"{kind} data-rising="{int(rising)}">{escape(text)}</th>'


def _runs(groups: Sequence[str]) -> list[tuple[str, int]]:
    found: list[tuple[str, int]] = []
    for group in groups:
        if found and found[-1][0] == group:
            found[-1] = (group, found[-1][1] + 1)
        else:
            found.append((group, 1))
    return found
