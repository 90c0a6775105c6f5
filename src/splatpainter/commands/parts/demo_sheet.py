"""The demo's overview picture and turntable. Pictures in, bytes out; knows no asset."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from splatpainter.image_files import to_uint8
from splatpainter.system.quick_dataclass import dataclass

PAPER, INK, CAPTION_COLOR = (246, 244, 239), (38, 42, 46), (120, 122, 122)
CROP = (0.0, 0.14, 1.0, 0.94)
"""Left, top, right, bottom of the part shown: the sky above the still life is empty."""
FRAME_MILLISECONDS = 90
"""Of the animation."""


@dataclass(frozen=True)
class Panel:
    """One picture of the overview."""

    pixels: np.ndarray
    """[H, W, 3] display colours 0..1, square."""
    title: str
    """A few words."""
    line: str
    """A few more, smaller."""
    inset: np.ndarray | None = None
    """[H, W, 3] a small picture in the upper left corner."""


def overview(panels: Sequence[Panel], columns: int = 3, width: int = 1600) -> np.ndarray:
    """[H, width, 3] uint8: the panels in rows, each with its captions below."""
    from PIL import Image, ImageDraw, ImageFont

    # All sizes follow from the width, so that the sheet looks alike at any.
    gap = width // 64
    cell = (width - gap * (columns + 1)) // columns
    high = round(cell * (CROP[3] - CROP[1]))
    big, small = ImageFont.load_default(width / 68), ImageFont.load_default(width / 90)
    caption = round(width / 22)
    rows = -(-len(panels) // columns)
    sheet = Image.new("RGB", (width, gap + rows * (high + caption + gap)), PAPER)
    draw = ImageDraw.Draw(sheet)
    for k, panel in enumerate(panels):
        x, y = gap + k % columns * (cell + gap), gap + k // columns * (high + caption + gap)
        # The same part of every panel, so that they can be compared.
        side = panel.pixels.shape[0]
        box = (side * CROP[0], side * CROP[1], side * CROP[2], side * CROP[3])
        picture = Image.fromarray(to_uint8(panel.pixels))
        sheet.paste(picture.resize((cell, high), Image.Resampling.LANCZOS, box), (x, y))
        # What the edit was made from stands in the corner of what it led to.
        if panel.inset is not None:
            w, h = round(0.24 * cell), round(0.24 * high)
            draw.rectangle([x + 9, y + 9, x + 14 + w, y + 14 + h], fill=PAPER)
            inset = Image.fromarray(to_uint8(panel.inset))
            sheet.paste(inset.resize((w, h), Image.Resampling.LANCZOS, box), (x + 12, y + 12))
        draw.text((x, y + high + 0.16 * caption), panel.title, fill=INK, font=big)
        draw.text((x, y + high + 0.60 * caption), panel.line, fill=CAPTION_COLOR, font=small)
    return np.asarray(sheet)


def animation(frames: Sequence[np.ndarray]) -> tuple[bytes, str]:
    """(file, ending) of a looping animation of [H, W, 3] display colours 0..1: WebP, or GIF where this Pillow has no
    WebP."""
    from PIL import Image, features

    pictures = [Image.fromarray(to_uint8(frame)) for frame in frames]
    out = io.BytesIO()
    rest = {"save_all": True, "append_images": pictures[1:], "duration": FRAME_MILLISECONDS, "loop": 0}
    # WebP is smaller and has all colours; not every Pillow can write it.
    if features.check("webp"):
        pictures[0].save(out, "WEBP", quality=82, method=4, **rest)
        return out.getvalue(), ".webp"
    pictures[0].save(out, "GIF", **rest)
    return out.getvalue(), ".gif"
