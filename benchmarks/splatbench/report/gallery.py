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

CELL_PX = 208
"""Edge of a picture in contact sheets."""
PICTURES_ACROSS = 8
"""Pictures in a line of a contact sheet; more go on below."""
WHITE_ERROR = 0.25
"""Error that is white in error maps."""


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
    return error_map(picture, truth, WHITE_ERROR) if picture.shape == truth.shape else None


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
    title = f"{table.title}. Errors: largest channel, white at {WHITE_ERROR:g} and more."
    out.parent.mkdir(parents=True, exist_ok=True)
    write_sheet(out, sheet([strip for row in rows for strip in _strips(row)], CELL_PX, title))
    return out


def _strips(row: PictureRow) -> Iterator[Strip]:
    """One line of answers and one of errors for every PICTURES_ACROSS tiles; as even as can be, so that no line is
    nearly empty."""
    truth = read_picture(row.truth) if row.truth else None
    lines = -(-len(row.tiles) // PICTURES_ACROSS)
    ends = [round(k * len(row.tiles) / lines) for k in range(lines + 1)]
    figures = f"   before names: {row.column.label}{f', {row.column.group}' if row.column.group else ''}"
    for k, (start, stop) in enumerate(zip(ends, ends[1:], strict=False)):
        tiles = row.tiles[start:stop]
        cells = tuple((_label(tile, row.column.digits), read_picture(tile.path)) for tile in tiles)
        yield Strip(row.title + (" (continued)" if k else figures), cells)
        errors = [error_of(tile, truth) for tile in tiles]
        if any(error is not None for error in errors):
            blank = np.broadcast_to(np.float32(250 / 255), (8, 8, 3))
            yield Strip("", tuple(("", blank) if error is None else ("error", error) for error in errors))


def _label(tile: Tile, digits: int) -> str:
    """The figure first: what is too long is cut off at its end."""
    return tile.label if tile.figure is None else f"{tile.figure:.{digits}f}  {tile.label}"


def _tiles(folder: Path, case: str, answers: dict[str, Record], names: MethodNames, column: Column) -> list[Tile]:
    """Tiles of the pictures that exist."""
    inputs = _inside(folder / "cases", case)
    tiles = [Tile("Input edit", inputs / "input.png")]
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
