"""The paper's own table as HTML, in grey below the measured one: beside it, wide tables would be cut off."""

from __future__ import annotations

from collections.abc import Collection
from html import escape

from splatbench import published
from splatbench.published import Published
from splatbench.report.names import Names
from splatbench.report.svg import symbol


def paper_grid(protocol: str, methods: Collection[str], names: Names) -> str:
    """A <table> of the paper's figures, or "" where it has none for this protocol. methods: those of the measured
    table, whose marks stand beside the paper's rows of the same systems."""
    rows = published.rows(protocol)
    if not rows:
        return ""
    keys = list(dict.fromkeys(key for row in rows for key in row.figures))
    timed = any(row.seconds for row in rows)
    heads = [f"{label}, {group[:1].lower()}{group[1:]}" if group else label for group, label in keys]
    heads += ["Set-up + edit, s"] if timed else []
    head = "".join(f'<th scope="col">{escape(text)}</th>' for text in heads)
    lines = [
        '<table class="results paper">',
        f'<thead><tr><th scope="col" class="name">The paper\'s own figures ({escape(published.MARK)})</th>{head}</tr>',
        "</thead><tbody>",
    ]
    for row in rows:
        method = next((name for name in row.methods if name in methods), None)
        mark = symbol(names.style(method), method in names.unmarked) if method else ""
        named = f' data-m="{escape(method, quote=True)}"' if method else ""
        cells = [_cell(row, key) for key in keys]
        cells += [f'<td class="num">{escape(row.seconds)}</td>'] if timed else []
        name = f'<th scope="row" class="name">{mark}<span>{escape(row.label)}</span></th>'
        lines.append(f"<tr{named}>{name}{''.join(cells)}</tr>")
    return "\n".join([*lines, "</tbody></table>"])


def _cell(row: Published, key: tuple[str, str]) -> str:
    value = row.figures.get(key)
    return f'<td class="num">{"" if value is None else f"{value:.{4 if abs(value) < 1 else 2}f}"}</td>'
