"""The pictures of a run: which cases are shown, and what stands beside what. Reads files, draws nothing.

Shown are the easiest, the middle and the hardest case by what all methods reach on average, so that no method picks its
own examples.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbench.records import Record
from splatbench.report.names import Layout, Names
from splatbench.report.summary import block_of, blocks
from splatbench.tables import Column


@dataclass(frozen=True)
class Tile:
    """One picture of a row."""

    label: str
    path: Path
    method: str = ""
    """"" for what is no method's: the input, the asset before, the truth."""
    figure: float | None = None
    """Of this answer, in the row's column."""
    answer: bool = False
    """It is to be compared with the truth."""


@dataclass(frozen=True)
class PictureRow:
    """One case: its input, every method's answer, the truth."""

    case: str
    """Its label."""
    name: str
    """Of the object."""
    block: str
    why: str
    """It is shown: "easiest", "middle" or "hardest", or "" where all cases are."""
    tiles: tuple[Tile, ...]
    truth: Path | None
    column: Column
    """Of the tiles' figures."""


def picture_rows(folder: Path, records: Sequence[Record], names: Names, table: Layout) -> list[PictureRow]:
    """Rows for OUT/PROTOCOL: three cases, or two of each block, or one of each of more than three blocks; cases without
    any picture are left out. Cases are ranked by the first column that their block has figures for."""
    found = blocks(records, table.split_by)
    rows = []
    for block in found:
        within = [r for r in records if block_of(r, table.split_by) == block]
        told = (c for c in table.columns if any(r.figures.get(c.key) is not None for r in within))
        column = next(told, table.columns[0])
        for case, why in ranked(within, column.key, {1: 3, 2: 2, 3: 2}.get(len(found), 1)):
            answers = {r.method: r for r in within if r.label == case and r.whole}
            if row := _row(folder, case, block, why, answers, names, column):
                rows.append(row)
    return rows


def ranked(records: Iterable[Record], key: str, most: int) -> list[tuple[str, str]]:
    """(case, why) of at most `most` cases, from the one with the highest mean of `key` over methods to that with the
    lowest; ties and cases without figures by label. most: 1 (the middle one), 2 or 3."""
    told: dict[str, list[float]] = {}
    for r in records:
        figure = r.figures.get(key)
        told.setdefault(r.label, []).extend([figure] if figure is not None and not math.isnan(figure) else [])
    mean = {label: float(np.mean(figures)) if figures else -math.inf for label, figures in told.items()}
    order = sorted(mean, key=lambda label: (-mean[label], label))
    if len(order) <= most:
        return [(label, "") for label in order]
    places = {"easiest": 0, "middle": len(order) // 2, "hardest": -1}
    chosen = {1: ("middle",), 2: ("easiest", "hardest"), 3: tuple(places)}[most]
    return [(order[places[why]], why) for why in chosen]


def read(path: Path) -> np.ndarray:
    """[H, W, 3] float32 0..1. Raises ValueError for a file that is no picture."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"), np.float32) / 255
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected a picture ({error})") from None


def _row(
    folder: Path, case: str, block: str, why: str, answers: dict[str, Record], names: Names, column: Column
) -> PictureRow | None:
    asked = _inside(folder / "cases", case)
    tiles = [Tile("Input edit", asked / "input.png")]
    if "nothing" not in answers:  # whose answer it is
        tiles.append(Tile("Asset before", asked / "before.png", answer=True))
    for name in names.order:
        if name in answers and (home := _inside(folder / "records", name)) != folder / "records":
            path = _inside(home, f"{case}.png")
            tiles.append(Tile(names.labels[name], path, name, answers[name].figures.get(column.key), True))
    truth = asked / "truth.png"
    tiles.append(Tile("Truth", truth))
    tiles = [tile for tile in tiles if tile.path.is_file()]
    if not tiles:
        return None
    object_name = next((r.name for r in answers.values()), case)
    return PictureRow(case, object_name, block, why, tuple(tiles), truth if truth.is_file() else None, column)


def _inside(folder: Path, name: str) -> Path:
    """folder / name, or the folder itself where the name is no plain name: records are read from files."""
    return folder / name if name not in ("", ".", "..") and Path(name).name == name else folder
