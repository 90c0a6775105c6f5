"""Picture rows as HTML, and the pictures themselves beside the page: input, every method with its error, truth."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from splatbench.report import pictures
from splatbench.report.grid import number
from splatbench.report.names import Names
from splatbench.report.pictures import PictureRow, Tile
from splatbench.report.sheets import WHITE, caption, error_of
from splatbench.report.svg import symbol
from splatpainter.cameras import to_uint8
from splatpainter.io import files

QUALITY = 92
"""Of WebP. Figures are always of the pictures as they were rendered."""


@dataclass(frozen=True)
class Stored:
    """A picture beside the page."""

    address: str
    """Relative to the page."""
    width: int
    height: int


class Store:
    """The folder of one protocol's pictures, filled as the page is written."""

    def __init__(self, page: Path, protocol: str) -> None:
        self.page = page
        self.folder = page / "pictures" / _plain(protocol)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.names: set[str] = set()

    def add(self, name: str, picture: np.ndarray) -> Stored:
        """picture: [H, W, 3] float 0..1."""
        from PIL import Image

        plain, count = _plain(name), 1
        while plain.lower() in self.names:  # names that differ only in what files may not hold
            count += 1
            plain = f"{_plain(name)}-{count}"
        self.names.add(plain.lower())
        data = io.BytesIO()
        Image.fromarray(to_uint8(picture)).save(data, "WEBP", quality=QUALITY, method=5)
        path = self.folder / f"{plain}.webp"
        if not path.is_file() or path.read_bytes() != data.getvalue():
            with files.writing(path) as file:
                file.write(data.getvalue())
        return Stored(path.relative_to(self.page).as_posix(), picture.shape[1], picture.shape[0])

    def prune(self) -> None:
        """Remove what an earlier page put here and this one does not show."""
        for path in self.folder.glob("*.webp"):
            if path.stem.lower() not in self.names:
                path.unlink()


def gallery(rows: Sequence[PictureRow], store: Store, names: Names, split_by: str, anchor: str) -> str:
    """The rows of a protocol, or "" where there are none. anchor: the section's id."""
    if not rows:
        return ""
    whys = list(dict.fromkeys(row.why for row in rows if row.why))
    columns = list(dict.fromkeys(row.column for row in rows))
    what = f"{columns[0].label}{f', {columns[0].group[:1].lower()}{columns[0].group[1:]}' if columns[0].group else ''}"
    how = f"Beside names: {what if len(columns) == 1 else 'the first figure of the table that the case has'}. "
    if whys:
        how += f"Shown: {', '.join(whys)} case by its mean over methods. "
    switch = "".join(
        f'<label><input type="radio" name="{anchor}-shown" value="{value}"{on}>{text}</label>'
        for value, text, on in (("result", "Results", " checked"), ("error", "Errors", ""))
    )
    parts = [
        '<div class="gallery"><div class="gallery-head"><h3>Pictures</h3>',
        f'<fieldset class="segments"><legend class="unseen">What is shown</legend>{switch}</fieldset>',
        f"<p>{escape(how)}Open a picture to compare two of a row; errors are the largest difference of a "
        f"channel from the truth, white at {WHITE:g} and more.</p></div>",
    ]
    parts += [_row(row, store, names, split_by) for row in rows]
    return "\n".join([*parts, "</div>"])


def _row(row: PictureRow, store: Store, names: Names, split_by: str) -> str:
    title = caption(row, split_by)
    truth = pictures.read(row.truth) if row.truth else None
    tiles = [_tile(row, tile, truth, store, names) for tile in row.tiles]
    head = f'<div class="case" data-title="{escape(title, quote=True)}">'
    head += f'<div class="case-head"><h4>{escape(title)}</h4></div><ul class="tiles">'
    return "\n".join([head, *tiles, "</ul></div>"])


def _tile(row: PictureRow, tile: Tile, truth: np.ndarray | None, store: Store, names: Names) -> str:
    stem = f"{row.case}--{tile.method or tile.label}"
    image = store.add(stem, pictures.read(tile.path))
    said = f"{tile.label}, {row.name}"
    shown = [_image(image, "result", said)]
    if (error := error_of(tile, truth)) is not None:
        shown.append(_image(store.add(f"{stem}--error", error), "error", f"Error of {said}"))
    mark = symbol(names.style(tile.method), tile.method in names.unmarked) if tile.method else ""
    figure = "" if tile.figure is None else f" <b>{number(tile.figure, row.column.digits)}</b>"
    kind = ' class="no-error"' if len(shown) == 1 else ""
    named = f' data-m="{escape(tile.method, quote=True)}"' if tile.method else ""
    return (
        f'<li{kind}{named}><a href="{image.address}" data-label="{escape(tile.label, quote=True)}">{"".join(shown)}</a>'
        f"<p>{mark}<span>{escape(tile.label)}{figure}</span></p></li>"
    )


def _image(image: Stored, kind: str, said: str) -> str:
    size = f'width="{image.width}" height="{image.height}"'
    return f'<img class="{kind}" src="{image.address}" {size} alt="{escape(said, quote=True)}" loading="lazy">'


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")[:120] or "picture"
