"""The paint of the benches: bold text, soft brush strokes, discs, in colours that show. Knows no splats.

It stays as it is, so that figures of the lift compare over time; sources/layers.py has richer brushes.

A layer is [H, W, 4] float32: display colour 0..1 and coverage 0..1, not multiplied by it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatpainter.sources.layers import face, filled

SUPERSAMPLING = 4
"""Text is drawn at this many times the size per axis and averaged."""
PALETTE = ((0.76, 0.09, 0.13), (0.09, 0.26, 0.72), (0.98, 0.82, 0.12), (0.94, 0.95, 0.93), (0.05, 0.45, 0.25))
"""Crimson, ultramarine, yellow, white, green: paint that is not the colour of what it is put on."""


def color_against(image: np.ndarray, coverage: np.ndarray, excluded: tuple[float, ...] | None = None) -> tuple:
    """The colour of the palette that shows best on a [H, W, 3] image where coverage [H, W] is above a half (on the
    worst tenth of it), other than `excluded`."""
    under = image[coverage > 0.5]
    under = under if len(under) else np.full((1, 3), 0.5)

    def contrast(color: tuple[float, ...]) -> float:
        return float(np.quantile(((under - np.array(color)) ** 2).sum(-1), 0.1))

    return max((color for color in PALETTE if color != excluded), key=contrast)


def text_layer(
    text: str,
    shape: tuple[int, int],
    center: tuple[float, float],
    height: float,
    color: tuple[float, ...] = PALETTE[0],
    font: Path | None = None,
) -> np.ndarray:
    """Bold antialiased text. shape: (H, W) of the layer; center: x, y of the text's middle, pixels; height: of its
    capitals, pixels. font: a TrueType or OpenType file, by default Pillow's own scalable font.
    Raises ValueError when the font cannot be read."""
    from PIL import Image, ImageDraw

    scale = SUPERSAMPLING
    letters = face(font, height * scale)
    canvas = Image.new("L", (shape[1] * scale, shape[0] * scale))
    position = (center[0] * scale, center[1] * scale)
    bold = round(0.04 * height * scale)  # the built-in font has one weight
    ImageDraw.Draw(canvas).text(position, text, 255, letters, anchor="mm", stroke_width=bold, stroke_fill=255)
    coverage = canvas.resize((shape[1], shape[0]), Image.Resampling.BOX)
    return filled(np.asarray(coverage, np.float32) / 255, color)


def stroke_layer(
    shape: tuple[int, int], points: np.ndarray, width: float, softness: float, color: tuple[float, ...] = PALETTE[0]
) -> np.ndarray:
    """A round brush dragged along points [K, 2] (x, y, pixels): opaque in the middle, falling to nothing over the outer
    `softness` pixels of its `width`. One point makes a disc."""
    ends = np.asarray(points, np.float32)
    y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) + 0.5 for n in shape), indexing="ij")
    nearest = np.full(shape, np.inf, np.float32)
    for a, b in zip(ends, ends[1:] if len(ends) > 1 else ends, strict=False):
        along = b - a
        length = float(along @ along)
        t = np.clip(((x - a[0]) * along[0] + (y - a[1]) * along[1]) / length, 0, 1) if length else 0.0
        nearest = np.minimum(nearest, (x - a[0] - t * along[0]) ** 2 + (y - a[1] - t * along[1]) ** 2)
    fall = np.clip((width / 2 - np.sqrt(nearest)) / max(softness, 1e-3), 0, 1)
    return filled(fall * fall * (3 - 2 * fall), color)


def wave(shape: tuple[int, int], height: float) -> np.ndarray:
    """[24, 2] points of a brush stroke across the middle three fifths of a picture. height: of its middle, 0..1 of the
    picture from the top."""
    t = np.linspace(0, 1, 24)
    return np.stack([(0.2 + 0.6 * t) * shape[1], (height + 0.045 * np.sin(2 * np.pi * t)) * shape[0]], 1)
