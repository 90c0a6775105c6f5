"""What is painted: a random stroke, word, sticker, photo patch, image noise or recolouring around a pixel of a view.

Each function designs one edit from a generator and returns a layer over the view (pictures/drawing.py); a recolouring
follows the object's colours and is one of points. Sizes are chosen so that an edit covers about the intended area.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatpainter.color import luminance
from splatpainter.pictures import drawing

Color = tuple[float, float, float]
WORDS = tuple(
    "hello|SALE|2026|love|No. 7|WOW|paint|OPEN|mama|FRAGILE|x|R&B|ok!|Zoe|up|KEEP OUT|tea|joy|#1|Berlin|rot|EAT|42|"
    "moon|Tom + Ida|NEW|?|hi|punk|Nr. 12 a".split("|")
)


@dataclass(frozen=True)
class EditResources:
    """Files that edits are made of; each list may be empty, then built-in shapes and the default font serve."""

    decals: tuple[Path, ...] = ()
    """Pictures with transparency."""
    fonts: tuple[Path, ...] = ()
    """TrueType or OpenType files."""
    textures: tuple[Path, ...] = ()
    """Photos."""


@dataclass(frozen=True)
class Canvas:
    """A view as its painter sees it."""

    colors: np.ndarray
    """[H, W, 3] the render, 0..1."""
    center: tuple[float, float]
    """x, y in pixels, of the edit."""
    extent: float
    """Pixels: edge of a square with the intended area."""

    @property
    def shape(self) -> tuple[int, int]:
        return self.colors.shape[0], self.colors.shape[1]

    @property
    def local_color(self) -> np.ndarray:
        """[3] mean around the center."""
        x, y = (round(v) for v in self.center)
        radius = max(round(self.extent / 3), 1)
        part = self.colors[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
        return part.reshape(-1, 3).mean(0) if part.size else np.full(3, 0.5)


def stroke(canvas: Canvas, resources: EditResources, rng: np.random.Generator) -> np.ndarray:
    """One to four brush strokes: lines, arcs, loops or hatching, with pressure that swells and fades."""
    color = contrasting_color(canvas.local_color, rng)
    count = int(rng.integers(1, 5))
    width = canvas.extent * rng.uniform(0.7, 1.4) / (1.5 + count)
    brush = drawing.Brush(width, rng.uniform(0.4, 1), rng.choice([1.0, 0.9, 0.7]), int(rng.choice([0, 0, 9, 15])))
    angle, hatch = rng.uniform(0, math.pi), rng.random() < 0.4
    out = np.zeros((*canvas.shape, 4), np.float32)
    for k in range(count):
        if hatch and count > 1:
            points = _line(canvas, angle + rng.normal(0, 0.06), (k - (count - 1) / 2) * width * 1.4)
        else:
            points = _scribble(canvas, rng)
        pressure = np.clip(np.sin(np.linspace(0.15, math.pi - 0.15, len(points))) ** 0.5 + rng.normal(0, 0.12), 0.15, 1)
        if rng.random() < 0.3:
            color = contrasting_color(canvas.local_color, rng)
        mark = drawing.draw_stroke(canvas.shape, points, pressure, brush, color, int(rng.integers(1 << 30)))
        out = drawing.stack_layers(out, mark)
    return out


def text(canvas: Canvas, resources: EditResources, rng: np.random.Generator) -> np.ndarray:
    """A word in a random font, turned, with or without a rim."""
    word = str(rng.choice(WORDS))
    word = word.upper() if rng.random() < 0.2 else word
    font = resources.fonts[rng.integers(len(resources.fonts))] if resources.fonts else None
    height = canvas.extent * min(0.8, 1.9 / (0.6 * len(word) + 0.4)) * rng.uniform(0.8, 1.1)
    color = contrasting_color(canvas.local_color, rng)
    outline = contrasting_color(np.array(color), rng) if rng.random() < 0.35 else None
    angle, weight = rng.normal(0, 14), 0.06 if font is None else rng.uniform(0, 0.05)
    return drawing.draw_text(canvas.shape, word, canvas.center, max(height, 5), color, font, angle, outline, weight)


def sticker(canvas: Canvas, resources: EditResources, rng: np.random.Generator) -> np.ndarray:
    """A decal, or a built-in shape where there are none."""
    stamp = _picture(resources.decals[rng.integers(len(resources.decals))]) if resources.decals else _shape(rng)
    size = canvas.extent * rng.uniform(1.0, 1.4)
    return drawing.draw_sticker(
        canvas.shape, stamp, canvas.center, size, rng.normal(0, 25), rng.choice([1.0, 1.0, 0.85])
    )


def photo(canvas: Canvas, resources: EditResources, rng: np.random.Generator) -> np.ndarray:
    """A part of a photo, or of a pattern, as a rectangle or an irregular patch with a soft rim."""
    picture = (
        _picture(resources.textures[rng.integers(len(resources.textures))]) if resources.textures else _pattern(rng)
    )
    edge = min(picture.shape[:2])
    side = int(edge * rng.uniform(0.4, 1))
    top, left = (int(rng.integers(n - side + 1)) for n in picture.shape[:2])
    part = picture[top : top + side, left : left + side, :3]
    angle = rng.normal(0, 20)
    if rng.random() < 0.5:
        part = part[: max(int(side * rng.uniform(0.5, 1)), 1)]
        return drawing.draw_sticker(canvas.shape, part, canvas.center, canvas.extent * rng.uniform(1, 1.25), angle)
    radius = canvas.extent * 0.56
    patch = drawing.draw_sticker(canvas.shape, part, canvas.center, radius * 4.2, angle)
    patch[..., 3] *= drawing.round_spot(canvas.shape, canvas.center, radius, rng.uniform(0.05, 0.4), rng)
    return patch


def image_noise(canvas: Canvas, resources: EditResources, rng: np.random.Generator) -> np.ndarray:
    """A patch whose colours are grained, blurred, sharpened or turned to mosaic."""
    colors = np.clip(canvas.colors, 0, 1)
    how = rng.choice(["grain", "blur", "sharpen", "mosaic"], p=[0.5, 0.15, 0.2, 0.15])
    if how == "grain":
        grain = drawing.value_noise(canvas.shape, canvas.extent * rng.uniform(0.06, 0.35), rng)
        grain = grain if rng.random() < 0.6 else grain[..., :1]
        changed = colors + rng.uniform(0.08, 0.25) * grain
    elif how == "mosaic":
        cell = max(round(canvas.extent * rng.uniform(0.06, 0.15)), 2)
        rows, columns = ((np.arange(n) // cell * cell + cell // 2).clip(0, n - 1) for n in canvas.shape)
        changed = drawing.gaussian_blur(colors, cell / 2)[rows[:, None], columns[None]]
    else:
        soft = drawing.gaussian_blur(colors, max(canvas.extent * rng.uniform(0.03, 0.08), 1.0))
        changed = soft if how == "blur" else colors + rng.uniform(1, 2.5) * (colors - soft)
    cover = drawing.round_spot(canvas.shape, canvas.center, canvas.extent * 0.56, rng.uniform(0.05, 0.5), rng)
    return np.concatenate([np.clip(changed, 0, 1), cover[..., None]], -1).astype(np.float32)


LAYER_MAKERS = {"stroke": stroke, "text": text, "sticker": sticker, "photo": photo, "noise": image_noise}
"""Kinds that are layers over a view: kind -> (canvas, resources, rng) -> [H, W, 4]."""


@dataclass(frozen=True)
class PaintCoverage:
    """What an edit puts on N points."""

    colors: Tensor
    """[N, 3] display colour 0..1."""
    coverage: Tensor
    """[N] 0..1; points at 0 do not change."""


@dataclass(frozen=True)
class Recoloring:
    """Another hue for what is like a surface point and near it."""

    position: np.ndarray
    """[3] world."""
    radius: float
    """World units."""
    seed: int | np.random.Generator = field(repr=False)

    def paint(self, points: Tensor, colors: Tensor) -> PaintCoverage:
        """What the edit puts on points [N, 3] with display colours [N, 3]; the one next to `position` says what is
        alike: in chroma first, then in lightness; a tenth of the time, everything within the radius is meant."""
        rng = np.random.default_rng(self.seed)
        target = points.new_tensor(self.position, dtype=torch.float64)
        nearest = int(((points - target) ** 2).sum(1).argmin())
        distance = ((points - points[nearest]) ** 2).sum(-1).sqrt() / self.radius
        near = _smooth((1 - distance) / rng.uniform(0.05, 0.4))
        grey = luminance(colors)[:, None]
        chroma = colors - grey
        unlike = ((chroma - chroma[nearest]) ** 2).sum(-1) + 0.35 * (grey - grey[nearest])[:, 0] ** 2
        tolerance = rng.uniform(0.10, 0.22)
        alike = near * 0 + 1 if rng.random() < 0.1 else _smooth(2 - 1.5 * unlike.sqrt() / tolerance)
        hue = np.array(colorsys.hsv_to_rgb(rng.random(), 1.0, 1.0))
        tone = hue - float(luminance(hue))
        saturation = (4 * grey * (1 - grey)).clip(0, 1) ** 0.5
        level = (grey * rng.uniform(0.8, 1.25)).clip(0, 1)
        keep = rng.uniform(0, 0.3)
        tinted = level + keep * chroma + saturation * colors.new_tensor(tone * rng.uniform(0.35, 0.8))
        return PaintCoverage(tinted.clip(0, 1), near * alike * float(rng.choice([1.0, 1.0, 0.8])))


def contrasting_color(surround: np.ndarray, rng: np.random.Generator) -> Color:
    """A colour, mostly vivid, sometimes black or white, that shows on `surround` [3]: the best of three."""
    best, best_contrast = (0.5, 0.5, 0.5), -1.0
    for _ in range(3):
        if rng.random() < 0.25:
            level = 0.04 if rng.random() < 0.5 else 0.95
            color = (level, level, level)
        else:
            color = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.5, 1), rng.uniform(0.35, 1))
        contrast = float(((np.array(color) - surround) ** 2).sum())
        if contrast > best_contrast:
            best, best_contrast = color, contrast
    return best


def _line(canvas: Canvas, angle: float, aside: float) -> np.ndarray:
    along = np.array([math.cos(angle), math.sin(angle)])
    middle = np.array(canvas.center) + aside * np.array([-along[1], along[0]])
    return middle + np.linspace(-0.8, 0.8, 4)[:, None] * canvas.extent * along


def _scribble(canvas: Canvas, rng: np.random.Generator) -> np.ndarray:
    """[K, 2] points of a smooth walk about the center."""
    count, heading = int(rng.integers(3, 8)), rng.uniform(0, 2 * math.pi)
    bend = rng.normal(0, 0.7)
    turns = heading + np.cumsum(bend + rng.normal(0, 0.5, count))
    steps = np.stack([np.cos(turns), np.sin(turns)], 1) * canvas.extent * rng.uniform(0.35, 0.65)
    walk = np.cumsum(steps, 0)
    middle = np.array(canvas.center) + rng.normal(0, 0.15, 2) * canvas.extent
    return walk - (walk.min(0) + walk.max(0)) / 2 + middle


def _shape(rng: np.random.Generator) -> np.ndarray:
    """[192, 192, 4] a star, flower or disc of two colours with a white rim."""
    y, x = (np.mgrid[:192, :192] + 0.5) / 96 - 1
    angle, reach, points = np.arctan2(y, x), np.hypot(x, y), int(rng.integers(4, 9))
    ray = 4 * np.abs((angle * points / (2 * math.pi)) % 1 - 0.5) - 1  # -1..1 once per point
    edge = (0.62 + 0.22 * ray, 0.66 + 0.16 * np.cos(points * angle), 0.8)[rng.integers(3)]
    first = np.array(colorsys.hsv_to_rgb(rng.random(), 0.9, 0.9))
    second = np.array(colorsys.hsv_to_rgb(rng.random(), 0.8, 0.95))
    middle, body, rim = (np.clip((part * edge + wide - reach) * 60, 0, 1)[..., None] for part, wide in _PARTS)
    color = (first * (1 - middle) + second * middle) * body + 0.97 * (1 - body)
    return np.concatenate([color, rim], -1).astype(np.float32)


_PARTS = ((0.55, 0.0), (1.0, 0.0), (1.0, 0.09))
"""Middle, body and rim of a shape: times its outline, and how much wider."""


def _pattern(rng: np.random.Generator) -> np.ndarray:
    """[192, 192, 3] stripes, checks or clouds of two or three colours."""
    y, x = np.mgrid[:192, :192] / 192
    turn, count = rng.uniform(0, math.pi), rng.uniform(4, 12)
    u, v = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
    kind = rng.integers(3)
    if kind == 0:
        share = np.clip(np.sin(2 * math.pi * count * u) * 8 + 0.5, 0, 1)
    elif kind == 1:
        share = np.clip(np.sin(2 * math.pi * count * u) * np.sin(2 * math.pi * count * v) * 12 + 0.5, 0, 1)
    else:
        share = np.clip(0.5 + 0.5 * drawing.value_noise((192, 192), 48, rng)[..., 0], 0, 1)
    colors = [np.array(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0, 1), rng.uniform(0.2, 1))) for _ in range(2)]
    grain = 0.04 * drawing.value_noise((192, 192), 6, rng)
    return np.clip(colors[0] + share[..., None] * (colors[1] - colors[0]) + grain, 0, 1).astype(np.float32)


def _smooth(values: Tensor) -> Tensor:
    t = values.clamp(0, 1)
    return t * t * (3 - 2 * t)


@lru_cache(maxsize=128)
def _picture(path: Path) -> np.ndarray:
    """[h, w, 4] float32 0..1, at most 256 px. Raises ValueError when it cannot be read."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            small = image.convert("RGBA")
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: expected a picture ({error})") from None
    small.thumbnail((256, 256))
    return np.asarray(small, np.float32) / 255


def list_files(files: Sequence[str | Path] | str | Path) -> tuple[Path, ...]:
    """A folder's pictures or fonts in name order, or the files given."""
    if isinstance(files, (str, Path)):
        folder = Path(files)
        if not folder.is_dir():
            raise ValueError(f"{folder}: no such folder; expected a folder of pictures or fonts")
        suffixes = (".png", ".jpg", ".jpeg", ".webp", ".ttf", ".otf")
        return tuple(sorted(path for path in folder.iterdir() if path.suffix.lower() in suffixes))
    return tuple(Path(path) for path in files)
