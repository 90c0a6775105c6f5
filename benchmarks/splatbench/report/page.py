"""A run for people: one HTML page of all tables, plots and pictures, or a Markdown file with pictures beside it.

The page is a single file that needs no network: page.html.j2 with page.css and page.js in it, every picture as a data
URI. Text from records is escaped by Jinja2. Equal records give equal bytes.
"""

from __future__ import annotations

import base64
import hashlib
import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbench.notes import LOAD, SIDE_BY_SIDE
from splatbench.report.gallery import (
    SHEET_SIZES,
    PictureRow,
    error_of,
    picture_rows,
    read_picture,
    write_contact_sheet,
)
from splatbench.report.plots import COLORS, MARKERS, charts, draw
from splatbench.report.summary import (
    MethodLabel,
    MethodNames,
    StoredRun,
    SummaryRow,
    TableLayout,
    method_names,
    read_run,
    summarize,
    table_layout,
)
from splatbench.report.tables import Grid, grid, head_groups, markdown
from splatpainter.image_files import to_uint8
from splatpainter.io import files

TEMPLATES = Path(__file__).parent
WIDE_PX, NARROW_PX = 720, 372
"""Widths of plots on large and on small screens: text keeps its size."""
WEBP_QUALITY = 92
"""Figures are always of the pictures as they were rendered."""
NOTES_PER_METHOD = 3


@dataclass(frozen=True)
class ReportSection:
    """One table's share of a report."""

    name: str
    folder: Path
    table: TableLayout
    run: StoredRun
    names: MethodNames
    """Names of the whole report, so that a method has one mark on all of the page."""
    which: str = ""
    """Which of several runs of this table, by the name of its OUT; "" where there is one."""

    @property
    def key(self) -> str:
        """Its name in links and files."""
        return "-".join([self.name, *filter(None, [_slug(self.which)])])

    @property
    def title(self) -> str:
        return self.table.title + (f": {self.which.replace('-', ' ')}" if self.which else "")

    @property
    def count(self) -> str:
        """The table's size in words."""
        objects, cases = len({r.name for r in self.run.records}), len({r.label for r in self.run.records})
        return f"{objects} object{'s'[: objects != 1]}, {cases} case{'s'[: cases != 1]}"

    def rows(self) -> list[SummaryRow]:
        return summarize(self.run.records, self.table.split_by, self.names.order)

    def grid(self) -> Grid:
        return grid(self.name, self.table.columns, self.rows(), self.names, self.table.split_by)

    def notes(self) -> Sequence[str]:
        """Notes of the runner, where it has finished."""
        return notes(self.rows(), self.table, self.names) if self.run.notes is None else self.run.notes


def write_page(
    folders: Sequence[Path],
    out: Path,
    tables: Mapping[str, TableLayout] | None = None,
    methods: Mapping[str, MethodLabel] | None = None,
    title: str = "SplatPainter: the paper's tables",
) -> Path:
    """OUT/index.html of the tables whose results lie in `folders` (each OUT/TABLE, as the runner leaves them).

    tables, methods: by name, in order; None: those of this package. Folders without a record are left out. Raises
    ValueError where no folder has a record, where a record cannot be read, for a folder that is no table's, and for two
    runs of a table that cannot be told apart by the name of their OUT.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    sections = _sections(folders, tables, methods)
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"head_groups": head_groups, "markers": [*MARKERS.values()], "colors": len(COLORS)}
    css, script = ((TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    html = environment.get_template("page.html.j2").render(
        title=title,
        machines=machines(sections),
        sections=[_section_view(section) for section in sections],
        css=css,
        script=script,
        policy=f"default-src 'none'; img-src data:; style-src '{_digest(css)}'; script-src '{_digest(script)}'; "
        "base-uri 'none'; form-action 'none'",
    )
    out.mkdir(parents=True, exist_ok=True)
    with files.writing(out / "index.html") as file:
        file.write(html.encode())
    return out / "index.html"


def write_markdown(
    folders: Sequence[Path],
    out: Path,
    about: str = "",
    tables: Mapping[str, TableLayout] | None = None,
    methods: Mapping[str, MethodLabel] | None = None,
) -> Path:
    """`out` (a .md file, e.g. docs/RESULTS.md) with plots and contact sheets in a folder of its name beside it. about:
    Markdown that stands first. tables, methods, errors: as write_page has them."""
    sections = _sections(folders, tables, methods)
    beside = out.with_name(out.stem.lower())
    beside.mkdir(parents=True, exist_ok=True)
    parts = [about.strip(), "Measured on:", "\n".join(f"- {machine}" for machine in machines(sections))]
    stale = {path for name in {s.name for s in sections} for path in beside.glob(f"{name}[.-]*")}
    for section in sections:
        names = method_names(section.run.records, methods, section.run.labels)
        parts += [f"## {section.title}", f"`splatpainter bench {section.name}`: {section.count}."]
        parts.append(markdown(section.grid()))
        for chart in charts(section.run.records, section.table, names):
            path = beside / f"{section.key}-{_slug(chart.title)[:60]}.svg"
            with files.writing(path) as file:
                file.write(draw(chart, WIDE_PX).encode())
            parts.append(f"![{chart.title}]({beside.name}/{path.name})\n\n*{chart.title}*")
            stale.discard(path)
        sheet = write_contact_sheet(section.folder, beside / f"{section.key}.webp", tables, methods)
        if sheet is not None:
            stale.discard(sheet)
            parts.append(f"![Input, answers with their errors, and truth of some cases]({beside.name}/{sheet.name})")
        if section.notes():
            listed = "\n".join(f"- {note}" for note in section.notes())
            parts.append(f"<details><summary>Notes</summary>\n\n{listed}\n\n</details>")
    for path in stale:  # of an earlier run
        path.unlink()
    with files.writing(out) as file:
        file.write(("\n\n".join(part for part in parts if part) + "\n").encode())
    return out


def notes(rows: Sequence[SummaryRow], table: TableLayout, names: MethodNames) -> list[str]:
    """What a reader must know beside the figures, where the runner has not said it: what failed, what is not installed,
    what was not measured."""
    lines = []
    for row in rows:
        block = f", {table.split_by} {row.block}" if table.split_by and row.block else ""
        for reason, count in row.errors:
            lines.append(f"{names.labels[row.method]}{block}: {reason} ({count} of {row.all_cases} cases)")
    for row in rows:
        lines += [f"{names.labels[row.method]}: {note}" for note in row.notes[:NOTES_PER_METHOD]]
        if (further := len(row.notes) - NOTES_PER_METHOD) > 0:
            lines.append(f"{names.labels[row.method]}: {further} further notes in its records")
    for column in table.columns:
        if not any(column.key in row.figures for row in rows):
            lines.append(f"{column.label}{f' ({column.group.lower()})' if column.group else ''}: not measured")
    return list(dict.fromkeys(lines))


def machines(sections: Sequence[ReportSection]) -> list[str]:
    """Every machine that rows were measured on, without how busy it was."""
    lines = (r.machine for section in sections for r in section.run.records if r.has_figures and r.machine)
    return list(dict.fromkeys(SIDE_BY_SIDE.sub("", LOAD.sub("", line)) for line in lines))


def _sections(
    folders: Sequence[Path],
    tables: Mapping[str, TableLayout] | None,
    methods: Mapping[str, MethodLabel] | None,
) -> list[ReportSection]:
    runs = [(folder, table_layout(folder, tables), read_run(folder)) for folder in folders]
    runs = [(folder, table, run) for folder, table, run in runs if run.records]
    if not runs:
        listed = ", ".join(map(str, folders)) or "no folder"
        raise ValueError(f"report: expected records of `splatpainter bench` in {listed}, found none")
    records = [r for _, _, run in runs for r in run.records]
    several = {name for name, count in Counter(folder.name for folder, _, _ in runs).items() if count > 1}
    sections = []
    for folder, table, run in runs:
        which = folder.absolute().parent.name if folder.name in several else ""
        names = method_names(records, methods, run.labels)
        sections.append(ReportSection(folder.name, folder, table, run, names, which))
    keys = [section.key for section in sections]
    if len(set(keys)) < len(keys):
        raise ValueError(f"report: expected runs of a table in folders of different names, got {keys}")
    return sections


def _slug(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


# ---- what the template shows


def _section_view(section: ReportSection) -> dict[str, object]:
    rows = picture_rows(section.folder, section.run.records, section.names, section.table)
    intervals = any(figure.low is not None for row in section.rows() for figure in row.figures.values())
    return {
        "name": section.key,
        "title": section.title,
        "count": section.count,
        "intervals": intervals,
        "grid": section.grid(),
        "notes": section.notes(),
        "marks": {name: (section.names.style(name), name in section.names.unranked) for name in section.names.order},
        "charts": [
            {"title": chart.title, "wide": _svg_uri(draw(chart, WIDE_PX)), "narrow": _svg_uri(draw(chart, NARROW_PX))}
            for chart in charts(section.run.records, section.table, section.names)
        ],
        "cases": [_case_view(row) for row in rows],
        "figures": _displayed_figures(rows),
        "ranks": list(dict.fromkeys(row.rank for row in rows if row.rank)),
        "white_error": f"{SHEET_SIZES.white_error:g}",
    }


def _displayed_figures(rows: Sequence[PictureRow]) -> str:
    """Which figures stand beside names of pictures."""
    columns = list(dict.fromkeys(row.column for row in rows))
    if len(columns) != 1:
        return "the first figure of the table that the case has"
    group = columns[0].group
    return f"{columns[0].label}{f', {group[:1].lower()}{group[1:]}' if group else ''}"


def _case_view(row: PictureRow) -> dict[str, object]:
    truth = read_picture(row.truth) if row.truth else None
    tiles = []
    for tile in row.tiles:
        picture, error = read_picture(tile.path), error_of(tile, truth)
        tiles.append(
            {
                "label": tile.label,
                "method": tile.method,
                "figure": "" if tile.figure is None else f"{tile.figure:,.{row.column.digits}f}",
                "width": picture.shape[1],
                "height": picture.shape[0],
                "picture": _webp_uri(picture),
                "error": "" if error is None else _webp_uri(error),
            }
        )
    return {"title": row.title, "tiles": tiles}


def _webp_uri(picture: np.ndarray) -> str:
    """picture: [H, W, 3] float 0..1."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(to_uint8(picture)).save(data, "WEBP", quality=WEBP_QUALITY, method=5)
    return "data:image/webp;base64," + base64.b64encode(data.getvalue()).decode()


def _svg_uri(text: str) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(text.encode()).decode()


def _digest(text: str) -> str:
    """Digest as a content security policy names it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
