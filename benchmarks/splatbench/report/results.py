"""A run as one Markdown file with plots and contact sheets beside it: docs/RESULTS.md.

Text comes from records and from the file that is to stand above them; equal records give equal bytes, but for the
pictures' encoder.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from splatbench.report import runs, svg
from splatbench.report.names import Layout, Named, Names
from splatbench.report.page import machines, notes
from splatbench.report.plots import charts
from splatbench.report.sheets import write_contact_sheet
from splatbench.report.summary import summarize
from splatbench.report.tables import grid, markdown
from splatpainter.io import files

WIDTH = 720
"""Pixels of plots."""


def write_results(
    folders: Sequence[Path],
    out: Path,
    about: str = "",
    tables: Mapping[str, Layout] | None = None,
    methods: Mapping[str, Named] | None = None,
) -> Path:
    """`out` (a .md file) with plots and sheets in a folder of its name beside it. about: Markdown that stands first.
    tables, methods: as write_page has them. Raises ValueError where no folder has a record."""
    if methods is None:
        from splatbench.methods import all_methods

        methods = all_methods()
    beside = out.with_suffix("")
    beside = beside.with_name(beside.name.lower())
    found = {folder: runs.read(folder) for folder in folders}
    found = {folder: run for folder, run in found.items() if run.records}
    if not found:
        raise ValueError("report: expected records of `splatpainter bench`, found none")
    beside.mkdir(parents=True, exist_ok=True)
    told = [f"- {machine}" for machine in machines([r for run in found.values() for r in run.records])]
    parts = [about.strip(), "Measured on:", "\n".join(told)]
    for folder, run in found.items():
        table = _layout(folder, tables)
        names = Names.of(methods, (r.method for r in run.records))
        parts += _section(folder, run, table, names, beside, {folder.name: table}, methods)
    with files.writing(out) as file:
        file.write(("\n\n".join(part for part in parts if part) + "\n").encode())
    return out


def _section(
    folder: Path,
    run: runs.Run,
    table: Layout,
    names: Names,
    beside: Path,
    tables: Mapping[str, Layout],
    methods: Mapping[str, Named],
) -> list[str]:
    name = folder.name
    rows = summarize(run.records, table.split_by, names.order)
    cases, objects = len({r.label for r in run.records}), len({r.name for r in run.records})
    parts = [f"## {table.title}", f"`splatpainter bench {name}`: {objects} objects, {cases} cases."]
    parts.append(markdown(grid(name, table.columns, rows, names, table.split_by)))
    stale = set(beside.glob(f"{name}-*.svg"))
    for chart in charts(run.records, table, names):
        file = beside / f"{name}-{_slug(chart.title)}.svg"
        with files.writing(file) as stream:
            stream.write(svg.document(svg.draw(chart, WIDTH)).encode())
        parts.append(f"![{chart.title}]({beside.name}/{file.name})\n\n*{chart.title}*")
        stale.discard(file)
    for file in stale:  # of an earlier run
        file.unlink()
    sheet = write_contact_sheet(folder, beside / f"{name}.webp", tables[name], methods)
    if sheet is not None:
        parts.append(f"![Input, answers with their errors, and truth of some cases]({beside.name}/{sheet.name})")
    said = run.notes if run.notes is not None else notes(rows, table, names)
    if said:
        listed = "\n".join(f"- {note}" for note in said)
        parts.append(f"<details><summary>Notes</summary>\n\n{listed}\n\n</details>")
    return parts


def _layout(folder: Path, tables: Mapping[str, Layout] | None) -> Layout:
    if tables is not None:
        return tables[folder.name]
    from splatbench import tables as protocols

    return protocols.table(folder.name)


def _slug(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:60]
