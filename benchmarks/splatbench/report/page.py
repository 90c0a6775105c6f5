"""One static HTML page of all tables, plots and pictures of a run. Needs no network; every text from files is escaped.

OUT/index.html holds style and script, OUT/pictures/PROTOCOL/ the pictures. Equal records give equal bytes.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from splatbench.notes import LOAD, SIDE_BY_SIDE
from splatbench.records import Record
from splatbench.report import runs, svg
from splatbench.report.gallery import Store, gallery
from splatbench.report.grid import grid
from splatbench.report.names import Layout, Named, Names
from splatbench.report.page_script import SCRIPT
from splatbench.report.page_style import STYLE
from splatbench.report.paper_grid import paper_grid
from splatbench.report.pictures import picture_rows
from splatbench.report.plots import charts
from splatbench.report.summary import SummaryRow, summarize
from splatpainter.io import files

WIDE, NARROW = 720, 372
"""Pixels of plots, on large and on small screens: text keeps its size."""


@dataclass(frozen=True)
class Part:
    """One protocol's share of the page."""

    name: str
    folder: Path
    table: Layout
    run: runs.Run

    @property
    def records(self) -> tuple[Record, ...]:
        return self.run.records


def write_page(
    folders: Sequence[Path],
    out: Path,
    tables: Mapping[str, Layout] | None = None,
    methods: Mapping[str, Named] | None = None,
    title: str = "SplatPainter: the paper's tables",
) -> Path:
    """OUT/index.html of the protocols whose results lie in `folders` (each OUT/PROTOCOL, as the runner leaves them).

    tables: by protocol; methods: by name, in order; None: those of this package. Folders without a record are left out.
    Raises ValueError where no folder has a record, where a record cannot be read, and for a folder that is no
    protocol's.
    """
    parts = [part for folder in folders if (part := _part(folder, tables)).records]
    if not parts:
        told = ", ".join(str(folder) for folder in folders) or "no folder"
        raise ValueError(f"report: expected records of `splatpainter bench` in {told}, found none")
    if methods is None:
        from splatbench.methods import all_methods

        methods = all_methods()
    names = Names.of(methods, (r.method for part in parts for r in part.records))
    sections = [_section(part, names, out) for part in parts]
    out.mkdir(parents=True, exist_ok=True)
    with files.writing(out / "index.html") as file:
        file.write(_document(title, machines([r for p in parts for r in p.records]), parts, sections).encode())
    return out / "index.html"


def notes(rows: Sequence[SummaryRow], table: Layout, names: Names) -> list[str]:
    """What a reader must know beside the figures, where the runner has not said it: what failed, what is not installed,
    what was not measured."""
    told: dict[str, None] = {}
    for row in rows:
        where = f", {table.split_by} {row.block}" if table.split_by and row.block else ""
        for said, count in row.errors:
            told[f"{names.labels[row.method]}{where}: {said} ({count} of {row.asked} cases)"] = None
    for row in rows:
        for note in row.notes[:3]:
            told[f"{names.labels[row.method]}: {note}"] = None
        if len(row.notes) > 3:
            told[f"{names.labels[row.method]}: {len(row.notes) - 3} further notes in its records"] = None
    for column in table.columns:
        if not any(column.key in row.figures for row in rows):
            told[f"{column.label}{f' ({column.group.lower()})' if column.group else ''}: not measured"] = None
    return list(told)


def _part(folder: Path, tables: Mapping[str, Layout] | None) -> Part:
    name = folder.name
    if tables is None:
        from splatbench import tables as protocols

        if name not in protocols.NAMES:
            raise ValueError(f"{folder}: expected the folder of one of {', '.join(protocols.NAMES)}")
        return Part(name, folder, protocols.table(name), runs.read(folder))
    if name not in tables:
        raise ValueError(f"{folder}: expected the folder of one of {', '.join(tables)}")
    return Part(name, folder, tables[name], runs.read(folder))


def _section(part: Part, names: Names, out: Path) -> str:
    table = part.table
    rows = summarize(part.records, table.split_by, names.order)
    anchor = escape(part.name, quote=True)
    cases, objects = len({r.label for r in part.records}), len({r.name for r in part.records})
    body = [
        f'<section id="{anchor}"><h2>{escape(table.title)}</h2>',
        f'<p class="about">{_count(objects, "object")}, {_count(cases, "case")}. {_legend(rows)}</p>',
        f'<div class="scroller" tabindex="0" role="region" aria-label="Table: {escape(table.title, quote=True)}">',
        grid(rows, table, names),
        "</div>",
    ]
    if own := paper_grid(part.name, {row.method for row in rows}, names):
        body += [
            '<div class="scroller own" tabindex="0" role="region" aria-label="The paper\'s own table">',
            own,
            "</div>",
        ]
    if said := part.run.notes if part.run.notes is not None else notes(rows, table, names):
        body += ['<details class="notes"><summary>', f"{_count(len(said), 'note')}</summary><ul>"]
        body += [f"<li>{escape(note)}</li>" for note in said]
        body += ["</ul></details>"]
    if drawn := charts(part.records, table, names):
        body += ['<div class="plots">', *map(_figure, drawn), "</div>"]
    store = Store(out, part.name)
    shown = picture_rows(part.folder, part.records, names, table)
    body += [gallery(shown, store, names, table.split_by, anchor), "</section>"]
    store.prune()
    return "\n".join(body)


def _figure(chart: svg.Chart) -> str:
    wide, narrow = svg.draw(chart, WIDE), svg.draw(chart, NARROW)
    return (
        f'<figure><figcaption>{escape(chart.title)}</figcaption><div class="wide">{wide}</div>'
        f'<div class="narrow">{narrow}</div></figure>'
    )


def _legend(rows: Sequence[SummaryRow]) -> str:
    said = "Means over objects"
    if any(found.low is not None for row in rows for found in row.figures.values()):
        said += ", with 95 % bootstrap intervals below"
    return said + "; seconds are medians. Bold: the best of a block; upper bounds do not compete."


def machines(records: Sequence[Record]) -> list[str]:
    """Every machine that rows were measured on; more than one is said, for their seconds do not compare."""
    told = (r.machine for r in records if r.whole and r.machine)
    return list(dict.fromkeys(SIDE_BY_SIDE.sub("", LOAD.sub("", machine)) for machine in told))


def _document(title: str, machines: Sequence[str], parts: Sequence[Part], sections: Sequence[str]) -> str:
    style = STYLE + svg.STYLE
    links = "".join(f'<a href="#{escape(p.name, quote=True)}">{escape(p.name.capitalize())}</a>' for p in parts)
    told = "".join(f"<li>{escape(machine)}</li>" for machine in machines)
    warning = (
        "<p>Rows were measured on several machines: their seconds do not compare.</p>" if len(machines) > 1 else ""
    )
    policy = f"default-src 'none'; img-src 'self' file: data:; style-src '{_digest(style)}'; "
    policy += f"script-src '{_digest(SCRIPT)}'; base-uri 'none'; form-action 'none'"
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{escape(title)}</title>
<link rel="icon" href="data:,">
<style>{style}</style>
</head>
<body>
<a class="skip" href="#main">To the tables</a>
<header class="top">
<h1>{escape(title)}</h1>
<p class="about">Every method gets the same cases, cameras, metrics and machine. Figures of the paper (arXiv 2512.05354)
stand in grey; they were taken on other data and compare with no measured row.</p>
<ul class="machines" aria-label="Measured on">{told}</ul>{warning}
</header>
<nav aria-label="Tables">{links}</nav>
<main id="main">
{chr(10).join(sections)}
</main>
<script>{SCRIPT}</script>
</body>
</html>
"""


def _digest(text: str) -> str:
    """As a content security policy names it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
