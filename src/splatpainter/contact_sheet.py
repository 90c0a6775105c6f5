"""Contact sheets: rows of captioned pictures on one page. Knows no splats."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.image_files import encode_png, to_uint8
from splatpainter.io import files
from splatpainter.system.quick_dataclass import dataclass

PAPER, INK, CAPTION_COLOR = (250, 250, 248), (20, 20, 22), (110, 110, 115)
GAP_PX = 6
"""Gap between pictures, pixels."""


@dataclass(frozen=True)
class Strip:
    """One row of a sheet."""

    caption: str
    """One line above the pictures."""
    cells: tuple[tuple[str, np.ndarray], ...]
    """(label, picture [H, W, 3], float 0..1 or uint8)."""


def sheet(
    strips: Sequence[Strip], cell: int, title: str = "", letters: int | None = None, label_lines: int = 1
) -> np.ndarray:
    """[H, W, 3] uint8: one strip below the other, every picture fitted into cell x cell pixels, a strip as high as the
    highest of its pictures. Strips without a caption, or without a label, stand closer below the one before. letters:
    size of those of labels, pixels (None: by the cell); label_lines: most lines of a label, the last of which ends
    where its cell does."""
    from PIL import Image, ImageDraw, ImageFont

    # Letters grow with the cells, and stay readable in small ones.
    small = letters or max(cell // 18, 9)
    large = round(1.15 * letters) if letters else max(cell // 14, 11)
    width = max(len(strip.cells) for strip in strips) * (cell + GAP_PX) + GAP_PX
    body, fine = ImageFont.load_default(large), ImageFont.load_default(small)
    head = _title_size(title, width - 2 * GAP_PX, small, round(large * 1.4))
    # All sizes first, as the page has to be made before anything is drawn on it.
    heights = [round(large * 1.7) if strip.caption else 0 for strip in strips]
    top = round(head * 1.8) if title else 0
    labels = [[_wrapped(name, fine, cell, label_lines) for name, _ in strip.cells] for strip in strips]
    above = [round(small * (1.2 * max(map(len, lines)) + 0.3)) if any(lines) else 0 for lines in labels]
    inner = [max(_fitted(np.asarray(picture), cell) for _, picture in strip.cells) for strip in strips]
    size = (width, top + sum(heights) + sum(inner) + sum(above) + len(strips) * GAP_PX + GAP_PX)
    page = Image.new("RGB", size, PAPER)
    pen = ImageDraw.Draw(page)
    if title:
        pen.text((GAP_PX, head // 3), title, INK, ImageFont.load_default(head))
    y = top
    for strip, lines, line, label, high in zip(strips, labels, heights, above, inner, strict=True):
        pen.text((GAP_PX, y + line // 5), _shortened(strip.caption, body, width - 2 * GAP_PX), INK, body)
        for column, (words, (_, picture)) in enumerate(zip(lines, strip.cells, strict=True)):
            x = GAP_PX + column * (cell + GAP_PX)
            for k, text in enumerate(words):
                pen.text((x, y + line + round(1.2 * k * small)), text, CAPTION_COLOR, fine)
            # Scaled down smoothly, up in whole squares: a small picture's pixels are meant to be seen.
            image = Image.fromarray(to_uint8(np.asarray(picture)))
            image.thumbnail((cell, cell), Image.Resampling.LANCZOS)
            if image.width < cell and image.height < cell:
                scale = cell / max(image.size)
                size = (max(1, round(scale * image.width)), max(1, round(scale * image.height)))
                image = image.resize(size, Image.Resampling.NEAREST)
            page.paste(image, (x, y + line + label))
        y += line + label + high + GAP_PX
    return np.asarray(page)


def _fitted(picture: np.ndarray, cell: int) -> int:
    """Pixels of height of a picture that was fitted into cell x cell."""
    height, width = picture.shape[:2]
    return min(cell, -(-cell * height // width))


def _wrapped(text: str, font: Any, width: int, most: int) -> list[str]:
    """At most `most` lines of the text, cut between words where that keeps them within `width` pixels."""
    lines: list[str] = []
    words = text.split()
    while words and len(lines) < most - 1:
        count = next((k for k in range(len(words), 1, -1) if font.getlength(" ".join(words[:k])) <= width), 1)
        lines.append(_shortened(" ".join(words[:count]), font, width))
        words = words[count:]
    return [*lines, _shortened(" ".join(words), font, width)] if words else lines


def _shortened(text: str, font: Any, width: int) -> str:
    """The text, or its beginning and an ellipsis, within `width` pixels."""
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text.rstrip() + "…"


def _title_size(title: str, width: int, smallest: int, largest: int) -> int:
    """The largest size of letters within smallest..largest pixels that fits the title into the width; else the
    smallest."""
    from PIL import ImageFont

    fits = (k for k in range(largest, smallest, -1) if ImageFont.load_default(k).getlength(title) <= width)
    return next(fits, smallest)


def error_map(image: np.ndarray, target: np.ndarray, white: float = 0.25) -> np.ndarray:
    """[H, W, 3] largest channel difference of two pictures [H, W, 3], black at 0 through red and yellow to white at
    `white`."""
    level = np.clip(np.abs(image - target).max(-1) / white, 0, 1)[..., None]
    return np.clip(3 * level - np.array([0.0, 1.0, 2.0]), 0, 1)


def write_sheet(path: Path, picture: np.ndarray) -> None:
    """[H, W, 3] uint8 as a PNG (or what the name says)."""
    from PIL import Image

    form = {".png": "PNG", ".webp": "WEBP", ".jpg": "JPEG"}.get(path.suffix.lower(), "PNG")
    with files.writing(path) as file:
        if form == "PNG":
            file.write(encode_png(picture))
        else:
            Image.fromarray(picture).save(file, form)
