"""The matrix as text, as a page of the docs, and the contact sheet of pictures."""

from __future__ import annotations

import datetime
import io
from collections.abc import Mapping, Sequence

import numpy as np
from asset import TRIALS
from compare import Cell, turned

SHEET_TRIALS = (
    "arrow.ply",
    "arrow.v2.spz",
    "arrow.v3.spz",
    "arrow.v4.spz",
    "marked.v4.spz",
    "rub.v3.spz",
    "rub.v4.spz",
    "arrow.glb",
)
THUMBNAIL = 100
"""Pixels."""
UNKNOWN = ("is not a format of it", "no splats", "unsupported input", "unrecognized", "no plugin", "unknown file")
"""Words of an error of a program that does not claim to read a format."""

Cells = Mapping[str, Mapping[str, Cell]]


def words(cell: Cell, ply: Cell) -> str:
    """One cell of the table."""
    if cell.error:
        return "-" if any(word in cell.error.lower() for word in UNKNOWN) else "refused"
    stands = turned(cell, ply)
    return "; ".join([stands, *cell.differences])


def table(cells: Cells) -> str:
    """Markdown: a line for each file, a column for each program."""
    names = list(cells)
    lines = ["| file | " + " | ".join(names) + " |", "| --- |" + " --- |" * len(names)]
    for trial in TRIALS:
        row = [words(cells[name][trial.name], cells[name].get("arrow.ply", Cell())) for name in names]
        lines.append(f"| {trial.says} | " + " | ".join(row) + " |")
    return "\n".join(lines)


def refusals(cells: Cells) -> list[str]:
    """What programs said of files of formats that they claim to read."""
    out = []
    for name, column in cells.items():
        for trial in TRIALS:
            cell = column[trial.name]
            if cell.error and words(cell, Cell()) == "refused":
                out.append(f"- {name}, {trial.says}: {cell.error}")
    return out


def page(cells: Cells, reasons: Mapping[str, str], picture: str, drawn: Sequence[str]) -> str:
    """docs/interop.md. picture: name of the contact sheet, "" for none; drawn: the programs in it."""
    today = datetime.date.today().isoformat()
    parts = [
        "# Our files in other programs\n",
        "Made by `python scripts/interop --docs docs/interop.md`, which installs the newest packages, writes a small "
        "asset\n(an arm up, one to the right, one to the front, SH of degree 3) in every format, and reads it in each "
        f"program.\nThis run: {today}.\n",
        "*same*: the asset stands as the program's own reading of the PLY does, and all numbers that the program "
        "tells\n(positions, shapes, opacities, colours, SH) are those that we read in the file, up to rounding; what "
        "is not is\nnamed, with the largest difference. *upside down*: half a turn about x. *turned about z*: glTF's "
        "y-up axes, as the\nformat has them. *-*: the program does not claim to read the format.\n",
        table(cells) + "\n",
    ]
    if said := refusals(cells):
        parts.append("Refused files, in the programs' own words:\n\n" + "\n".join(said) + "\n")
    if picture:
        named = {trial.name: trial.says for trial in TRIALS}
        columns = "; ".join(named[name] for name in SHEET_TRIALS)
        text = (
            f"![The asset in viewers for the web]({picture}.webp)",
            "",
            f"The viewers for the web from top to bottom ({', '.join(drawn)}),",
            f"each with the camera at the same place of its world. Columns: {columns}.",
            "Captures are y down, so that a viewer with y up shows PLY files on their heads until it is told to turn",
            "them: what matters is that an SPZ file stands as the PLY beside it. Black: not drawn.",
            "",
        )
        parts.append("\n".join(text))
    parts.append("Not tried:\n\n" + "\n".join(f"- {name}: {reason}" for name, reason in reasons.items()) + "\n")
    return "\n".join(parts)


def sheet(pictures: Mapping[str, Mapping[str, bytes]]) -> bytes | None:
    """WebP of the viewers' pictures, one row each; None where there are none."""
    from PIL import Image

    if not pictures:
        return None
    out = np.zeros((THUMBNAIL * len(pictures), THUMBNAIL * len(SHEET_TRIALS), 3), np.uint8)
    for row, drawn in enumerate(pictures.values()):
        for column, name in enumerate(SHEET_TRIALS):
            if name in drawn:
                image = Image.open(io.BytesIO(drawn[name])).convert("RGB").resize((THUMBNAIL, THUMBNAIL))
                y, x = THUMBNAIL * row, THUMBNAIL * column
                out[y : y + THUMBNAIL, x : x + THUMBNAIL] = np.asarray(image)
    file = io.BytesIO()
    Image.fromarray(out).save(file, "WEBP", quality=80)
    return file.getvalue()
