"""Pictures of a run: which cases are shown, what stands beside what, and a contact sheet of them.

Shown are the easiest, the middle and the hardest case by what all methods reach on average, so that no method picks its
own examples.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbench.cases import Record
from splatbench.report.summary import (
    MethodLabel,
    MethodNames,
    TableLayout,
    block_of,
    blocks,
    method_names,
    read_run,
    table_layout,
)
from splatbench.tables import Column
from splatpainter.contact_sheet import Strip, error_map, sheet, write_sheet


@dataclass(frozen=True)
class SheetSizes:
    """How contact sheets are laid out. Source: taste, on a page of this width."""

    cell_px: int = 232
    """Edge of a picture."""
    across: int = 7
    """Pictures in a line; more go on below."""
    letters_px: int = 14
    """Height of letters of labels on a page `page_px` wide."""
    page_px: int = 900
    """Width of such a page: a document's column."""
    white_error: float = 0.25
    """Error that is white in error maps."""
    margin: float = 0.06
    """Of the window that is shown of a picture: what is around the object, as a share of the picture's edge."""


SHEET_SIZES = SheetSizes()


@dataclass(frozen=True)
class Tile:
    """One picture of a row."""

    label: str
    path: Path
    method: str = ""
    """"" for what is no method's: the input, the asset before, the truth."""
    figure: float | None = None
    """Figure of this answer, in the row's column."""
    answer: bool = False
    """It is to be compared with the truth."""
    is_input: bool = False
    """Seen by another camera than the others."""


@dataclass(frozen=True)
class PictureRow:
    """One case: its input, every method's answer, the truth."""

    title: str
    """Which case it is, in words."""
    rank: str
    """"easiest", "middle" or "hardest", or "" where all cases are shown."""
    tiles: tuple[Tile, ...]
    truth: Path | None
    column: Column
    """Column of the tiles' figures."""


def picture_rows(folder: Path, records: Sequence[Record], names: MethodNames, table: TableLayout) -> list[PictureRow]:
    """Rows for OUT/TABLE: three cases, or two of each block, or one of each of more than three blocks; cases without
    any picture are left out. Cases are ranked by the first column that their block has figures for."""
    parts = blocks(records, table.split_by)
    rows = []
    for block in parts:
        within = [r for r in records if block_of(r, table.split_by) == block]
        measured = (c for c in table.columns if any(r.figures.get(c.key) is not None for r in within))
        column = next(measured, table.columns[0])
        for case, rank in ranked(within, column.key, {1: 3, 2: 2, 3: 2}.get(len(parts), 1)):
            answers = {r.method: r for r in within if r.label == case and r.has_figures}
            name = next((r.name for r in answers.values()), case)
            title = [name, f"{table.split_by} {block}" if table.split_by and block else "", rank and f"{rank} case"]
            tiles = _tiles(folder, case, answers, names, column)
            truth = next((tile.path for tile in tiles if tile.path.name == "truth.png" and not tile.method), None)
            if tiles:
                rows.append(PictureRow(", ".join(filter(None, title)), rank, tuple(tiles), truth, column))
    return rows


def ranked(records: Iterable[Record], key: str, count: int) -> list[tuple[str, str]]:
    """(case, rank) of at most `count` cases, from the one with the highest mean of `key` over methods to that with the
    lowest; ties and cases without figures by label. count: 1 (the middle one), 2 or 3."""
    figures: dict[str, list[float]] = {}
    for r in records:
        figure = r.figures.get(key)
        figures.setdefault(r.label, []).extend([figure] if figure is not None and not math.isnan(figure) else [])
    mean = {label: float(np.mean(values)) if values else -math.inf for label, values in figures.items()}
    order = sorted(mean, key=lambda label: (-mean[label], label))
    if len(order) <= count:
        return [(label, "") for label in order]
    index = {"easiest": 0, "middle": len(order) // 2, "hardest": -1}
    ranks = {1: ("middle",), 2: ("easiest", "hardest"), 3: tuple(index)}[count]
    return [(order[index[rank]], rank) for rank in ranks]


def read_picture(path: Path) -> np.ndarray:
    """[H, W, 3] float32 0..1. Raises ValueError for a file that is no picture."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"), np.float32) / 255
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected a picture ({error})") from None


def error_of(tile: Tile, truth: np.ndarray | None) -> np.ndarray | None:
    """[H, W, 3] error map of an answer; None where there is nothing of its size to compare with."""
    if truth is None or not tile.answer:
        return None
    picture = read_picture(tile.path)
    return error_map(picture, truth, SHEET_SIZES.white_error) if picture.shape == truth.shape else None


def write_contact_sheet(
    folder: Path,
    out: Path,
    tables: Mapping[str, TableLayout] | None = None,
    methods: Mapping[str, MethodLabel] | None = None,
) -> Path | None:
    """The sheet of OUT/TABLE as a picture (.png, .webp or .jpg) at `out`: input edit, every method with its error
    beneath, truth; for a few cases. None where there is nothing to show.

    tables, methods: by name; None: those of this package. Raises ValueError for records that cannot be read, or for a
    folder that is no table's.
    """
    table, run = table_layout(folder, tables), read_run(folder)
    records = run.records
    rows = picture_rows(folder, records, method_names(records, methods, run.labels), table)
    if not rows:
        return None
    title = f"{table.title}. Errors: largest channel, white at {SHEET_SIZES.white_error:g} and more."
    out.parent.mkdir(parents=True, exist_ok=True)
    strips = [strip for row in rows for strip in _strips(row)]
    # Letters are to be read where the page is narrower than the sheet.
    width = max(len(strip.cells) for strip in strips) * SHEET_SIZES.cell_px
    letters = -(-SHEET_SIZES.letters_px * max(width, SHEET_SIZES.page_px) // SHEET_SIZES.page_px)
    write_sheet(out, sheet(strips, SHEET_SIZES.cell_px, title, letters, 2))
    return out


def _strips(row: PictureRow) -> Iterator[Strip]:
    """One line of answers and one of errors for every SHEET_SIZES.across tiles; as even as can be, so that no line is
    nearly empty. Of pictures the window is shown in which the object is; of those as large as the truth that of the
    truth."""
    truth = read_picture(row.truth) if row.truth else None

    def cut(picture: np.ndarray, alone: bool = False) -> np.ndarray:
        # The input has a camera of its own, and so a window.
        if alone or truth is None or picture.shape != truth.shape:
            return picture[object_window(picture)]
        return picture[object_window(truth)]

    lines = -(-len(row.tiles) // SHEET_SIZES.across)
    ends = [round(k * len(row.tiles) / lines) for k in range(lines + 1)]
    figures = f"   before names: {row.column.label}{f', {row.column.group}' if row.column.group else ''}"
    for k, (start, stop) in enumerate(zip(ends, ends[1:], strict=False)):
        tiles = row.tiles[start:stop]
        pictures = [read_picture(tile.path) for tile in tiles]
        windows = [cut(p, tile.is_input) for tile, p in zip(tiles, pictures, strict=True)]
        cells = tuple((_label(tile, row.column.digits), p) for tile, p in zip(tiles, windows, strict=True))
        yield Strip(row.title + (" (continued)" if k else figures), cells)
        errors = [error_of(tile, truth) for tile in tiles]
        if any(error is not None for error in errors):
            blank = np.broadcast_to(np.float32(250 / 255), (1, 8, 3))
            yield Strip("", tuple(("", blank if error is None else cut(error)) for error in errors))


def object_window(picture: np.ndarray) -> tuple[slice, slice]:
    """(rows, columns) of a picture [H, W, 3] in which it differs from its corner, with a margin; all where nothing
    does."""
    differs = (np.abs(picture - picture[0, 0]) > 1.5 / 255).any(-1)
    if not differs.any():
        differs[:] = True
    edge = round(SHEET_SIZES.margin * max(differs.shape))
    sides = []
    for axis in (1, 0):
        inside = np.flatnonzero(differs.any(axis))
        sides.append(slice(max(int(inside[0]) - edge, 0), int(inside[-1]) + 1 + edge))
    return sides[0], sides[1]


def _label(tile: Tile, digits: int) -> str:
    """The figure first: what is too long is cut off at its end."""
    return tile.label if tile.figure is None else f"{tile.figure:.{digits}f}  {tile.label}"


def _tiles(folder: Path, case: str, answers: dict[str, Record], names: MethodNames, column: Column) -> list[Tile]:
    """Tiles of the pictures that exist."""
    inputs = _inside(folder / "cases", case)
    tiles = [Tile("Input", inputs / "input.png", is_input=True)]
    if "nothing" not in answers:  # whose answer it is
        tiles.append(Tile("Asset before", inputs / "before.png", answer=True))
    for name in names.order:
        if name in answers and (answered := _inside(folder / "records", name)) != folder / "records":
            path = _inside(answered, f"{case}.png")
            tiles.append(Tile(names.labels[name], path, name, answers[name].figures.get(column.key), True))
    tiles.append(Tile("Truth", inputs / "truth.png"))
    return [tile for tile in tiles if tile.path.is_file()]


def _inside(folder: Path, name: str) -> Path:
    """folder / name, or the folder itself where the name is no plain name: records are read from files."""
    return folder / name if name not in ("", ".", "..") and Path(name).name == name else folder
