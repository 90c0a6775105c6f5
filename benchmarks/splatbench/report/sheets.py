"""A contact sheet per table: input edit, every method with its error beneath, truth; for a few cases."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from splatbench.report import pictures, runs
from splatbench.report.labels import shortened
from splatbench.report.names import Layout, Named, Names
from splatbench.report.pictures import PictureRow, Tile
from splatpainter.contact_sheet import GAP, Strip, error_map, sheet, write_sheet

CELL = 208
"""Pixels of a picture's edge."""
ACROSS = 8
"""Pictures in a line; more go on below."""
WHITE = 0.25
"""Error that is white in error maps."""


def write_contact_sheet(
    folder: Path, out: Path, table: Layout | None = None, methods: Mapping[str, Named] | None = None
) -> Path | None:
    """The sheet of OUT/PROTOCOL as a picture (.png, .webp or .jpg) at `out`; None where there is nothing to show.

    table, methods: None: those of this package. Raises ValueError for records that cannot be read, or for a folder that
    is no protocol's.
    """
    if table is None:
        from splatbench import tables as protocols

        if folder.name not in protocols.NAMES:
            raise ValueError(f"{folder}: expected the folder of one of {', '.join(protocols.NAMES)}")
        table = protocols.table(folder.name)
    if methods is None:
        from splatbench.methods import all_methods

        methods = all_methods()
    found = runs.read(folder).records
    names = Names.of(methods, (r.method for r in found))
    strips: list[Strip] = []
    for row in pictures.picture_rows(folder, found, names, table):
        strips += _strips(row, table.split_by)
    if not strips:
        return None
    title = f"{table.title}. Errors: largest channel, white at {WHITE:g} and more."
    out.parent.mkdir(parents=True, exist_ok=True)
    write_sheet(out, sheet(strips, CELL, title))
    return out


def caption(row: PictureRow, split_by: str) -> str:
    """Which case it is, in words."""
    parts = [row.name, f"{split_by} {row.block}" if split_by and row.block else "", row.why and f"{row.why} case"]
    return ", ".join(part for part in parts if part)


def error_of(tile: Tile, truth: np.ndarray | None) -> np.ndarray | None:
    """[H, W, 3] error map of an answer; None where there is nothing of its size to compare with."""
    if truth is None or not tile.answer:
        return None
    shown = pictures.read(tile.path)
    return error_map(shown, truth, WHITE) if shown.shape == truth.shape else None


def _strips(row: PictureRow, split_by: str) -> Iterable[Strip]:
    """One line of answers and one of errors for every ACROSS tiles; as even as can be, so that no line is nearly
    empty."""
    truth = pictures.read(row.truth) if row.truth else None
    lines = -(-len(row.tiles) // ACROSS)
    ends = [round(k * len(row.tiles) / lines) for k in range(lines + 1)]
    for k, (start, stop) in enumerate(zip(ends, ends[1:], strict=False)):
        tiles = row.tiles[start:stop]
        said = f"   beside names: {row.column.label}{f', {row.column.group}' if row.column.group else ''}"
        cells = tuple((_label(tile, row.column.digits), pictures.read(tile.path)) for tile in tiles)
        yield Strip(caption(row, split_by) + (" (continued)" if k else said), cells)
        errors = [error_of(tile, truth) for tile in tiles]
        if any(error is not None for error in errors):
            blank = np.broadcast_to(np.float32(250 / 255), (8, 8, 3))
            yield Strip("", tuple(("", blank) if error is None else ("error", error) for error in errors))


def _label(tile: Tile, digits: int) -> str:
    size = max(CELL // 18, 9)
    figure = "" if tile.figure is None else f"  {tile.figure:.{digits}f}"
    return shortened(tile.label, size, CELL - GAP - len(figure) * size * 0.6) + figure
