"""Paint as layers over a picture: brush strokes with pressure, lettering, stickers, photo patches, noise.

A layer is [H, W, 4] float32: display colour 0..1 and coverage 0..1, the colour not multiplied by it. Points are (x, y)
in pixels, pixel centres at +0.5. Pure: what is random is drawn by the caller or from the generator given.

    layer = draw_stroke((height, width), points, pressure, Brush(12), color)
    picture = over(picture, stack_layers(layer, draw_text((height, width), "hello", center, 30, color)))
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.kernels.portable import arctan2, cos, exp, hypot, sin
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont, ImageFont

NO_LETTER = "\U0010ffff"
"""A code that Unicode never gives to a letter."""
SUPERSAMPLING = 3
"""Text and stickers are drawn this much larger per axis and averaged."""
OCTAVES = 3
"""Of value noise."""


@dataclass(frozen=True)
class Brush:
    """A round brush."""

    width: float
    """Diameter at full pressure, pixels."""
    hardness: float = 0.8
    """0: falls off from the middle; 1: a hard edge."""
    flow: float = 1.0
    """Coverage of the stroke's middle, 0..1."""
    bristles: int = 0
    """Hairs that leave streaks along the stroke; 0: none."""


def over(image: np.ndarray, layer: np.ndarray) -> np.ndarray:
    """[H, W, 3] picture with a layer on top."""
    share = layer[..., 3:]
    return (image * (1 - share) + layer[..., :3] * share).astype(np.float32)


def stack_layers(below: np.ndarray, above: np.ndarray) -> np.ndarray:
    """[H, W, 4] two layers as one."""
    # Porter and Duff's "over" with straight colours: weigh, then divide by the coverage.
    share = above[..., 3:] + below[..., 3:] * (1 - above[..., 3:])
    colors = above[..., :3] * above[..., 3:] + below[..., :3] * below[..., 3:] * (1 - above[..., 3:])
    return np.concatenate([colors / np.maximum(share, 1e-6), share], -1).astype(np.float32)


def catmull_rom(points: np.ndarray, count: int) -> np.ndarray:
    """[count, C] samples, evenly in parameter, of the uniform Catmull-Rom spline through points
    [K, C], K >= 2; its ends are the first and the last point."""
    # Mirrored ends, so that the spline reaches the first and the last point.
    ends = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    at = np.linspace(0, len(points) - 1, count)
    k = np.minimum(at.astype(int), len(points) - 2)
    t = (at - k)[:, None]
    a, b, c, d = (ends[k + j] for j in range(4))
    return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**2 * t)


def draw_stroke(
    shape: tuple[int, int],
    points: np.ndarray,
    pressure: np.ndarray,
    brush: Brush,
    color: tuple[float, float, float],
    seed: int = 0,
) -> np.ndarray:
    """A brush drawn along the spline through points [K, 2], its width following pressure [K] (0..1). seed: of the
    bristles, which carry more or less paint and run dry towards the end."""
    coverage = np.zeros(shape, np.float32)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    # Dabs an eighth of a width apart look like one line.
    count = max(int(length / max(0.12 * brush.width, 0.7)), 2)
    path = catmull_rom(np.concatenate([points, pressure[:, None]], 1), count)
    hairs = np.random.default_rng(seed).uniform(0, 1, (2, max(brush.bristles, 1) + 1))
    along = np.gradient(path[:, :2], axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-6)
    for k, (x, y, p) in enumerate(path):
        radius = max(brush.width / 2 * np.clip(p, 0.05, 1.2), 0.5)
        box = _box(shape, x, y, radius + 1)
        if box is None:
            continue
        dx = np.arange(box[1].start, box[1].stop, dtype=np.float32) + np.float32(0.5 - x)
        dy = (np.arange(box[0].start, box[0].stop, dtype=np.float32) + np.float32(0.5 - y))[:, None]
        rim = max((1 - brush.hardness) * radius, 0.7)
        dab = np.clip((radius - np.sqrt(dx * dx + dy * dy)) / rim + 0.25, 0, 1)
        # Smoothstep: no visible ring where the falloff begins.
        dab = dab * dab * (3 - 2 * dab)
        if brush.bristles:
            # Hairs run along the stroke: each has its place across it, its wetness and where it runs dry.
            across = (along[k, 0] * dy - along[k, 1] * dx) / radius
            hair = np.clip((across + 1) / 2 * brush.bristles, 0, brush.bristles - 1e-3)
            left = hair.astype(int)
            wet, dry = ((value[left] * (left + 1 - hair) + value[left + 1] * (hair - left)) for value in hairs)
            dab = dab * (0.45 + 0.55 * wet) * np.clip((0.75 + 0.6 * dry - k / count) * 5, 0, 1)
        # The largest dab counts: overlapping dabs of one stroke do not darken.
        np.maximum(coverage[box], dab, out=coverage[box])
    return solid_layer(coverage * brush.flow, color)


def draw_text(
    shape: tuple[int, int],
    text: str,
    center: tuple[float, float],
    height: float,
    color: tuple[float, float, float],
    font: Path | None = None,
    angle: float = 0.0,
    outline: tuple[float, float, float] | None = None,
    weight: float = 0.0,
) -> np.ndarray:
    """Antialiased text. center: of the text; height: of its capitals, pixels; font: a TrueType or OpenType file, by
    default Pillow's own scalable font; angle: degrees, counter-clockwise; outline: colour of a rim around the letters;
    weight: how much fatter the letters become, in parts of `height`. Raises ValueError when the font cannot be read."""
    from PIL import Image, ImageDraw

    letters, rim = load_font(font, height * SUPERSAMPLING), round(0.09 * height * SUPERSAMPLING) if outline else 0
    bold = round(weight * height * SUPERSAMPLING)
    left, top, right, bottom = (round(v) for v in letters.getbbox(text, stroke_width=rim + bold, anchor="ls"))
    size = (max(right - left, 1) + 2, max(bottom - top, 1) + 2)
    stamp = np.zeros((size[1], size[0], 4), np.float32)
    # The outline first, the letters over it.
    for ink, stroke_width in ((outline, rim + bold), (color, bold)):
        if ink is not None:
            part = Image.new("L", size)  # coverage alone: drawn in colour, the edges would mix with black
            ImageDraw.Draw(part).text((1 - left, 1 - top), text, 255, letters, anchor="ls", stroke_width=stroke_width)
            stamp = stack_layers(stamp, solid_layer(np.asarray(part, np.float32) / 255, ink))
    return draw_sticker(shape, stamp, center, max(size) / SUPERSAMPLING, angle)


def draw_sticker(
    shape: tuple[int, int],
    stamp: np.ndarray,
    center: tuple[float, float],
    size: float,
    angle: float = 0.0,
    flow: float = 1.0,
) -> np.ndarray:
    """A picture [h, w, 4] (or [h, w, 3], opaque), 0..1, laid down around `center`. size: of its longer side, pixels;
    angle: degrees, counter-clockwise; flow: of its coverage."""
    from PIL import Image

    if stamp.shape[2] == 3:
        stamp = np.concatenate([stamp, np.ones_like(stamp[..., :1])], -1)
    out = np.zeros((*shape, 4), np.float32)
    longest = max(stamp.shape[:2])
    box = _box(shape, *center, hypot(*stamp.shape[:2]) / longest * size / 2 + 1)
    if box is None:
        return out
    shrink = max(int(longest / (size * 2)), 1)  # bilinear looks at 2 x 2 pixels: bring it near them first
    packed = Image.fromarray((np.clip(stamp, 0, 1) * 255 + 0.5).astype(np.uint8), "RGBA").reduce(shrink)
    scale, turn = longest / shrink / (size * SUPERSAMPLING), math.radians(angle)  # source pixels per fine pixel
    # Pillow wants the inverse map: from pixels of the result to those of the stamp.
    a, b = cos(turn) * scale, -sin(turn) * scale
    x, y = (center[0] - box[1].start) * SUPERSAMPLING, (center[1] - box[0].start) * SUPERSAMPLING
    matrix = (a, b, packed.width / 2 - a * x - b * y, -b, a, packed.height / 2 + b * x - a * y)
    big = ((box[1].stop - box[1].start) * SUPERSAMPLING, (box[0].stop - box[0].start) * SUPERSAMPLING)
    laid = packed.transform(big, Image.Transform.AFFINE, matrix, Image.Resampling.BILINEAR).reduce(SUPERSAMPLING)
    out[box] = np.asarray(laid, np.float32) / 255  # Pillow averages RGBA with colours times coverage, and divides again
    out[..., 3] *= flow
    return out


def round_spot(
    shape: tuple[int, int], center: tuple[float, float], radius: float, softness: float, rng: np.random.Generator
) -> np.ndarray:
    """[H, W] coverage of an irregular round spot: its radius swings by a third. softness: 0..1 of the radius."""
    y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) + np.float32(0.5) for n in shape), indexing="ij")
    dx, dy = x - np.float32(center[0]), y - np.float32(center[1])
    angle, reach = arctan2(dy, dx), hypot(dx, dy)
    edge = np.full(shape, radius, np.float32)
    # A few harmonics of the angle: round, but not a circle.
    for k in (2, 3, 5):
        edge += radius * rng.uniform(-0.14, 0.14) * cos(k * angle + np.float32(rng.uniform(0, 2 * np.pi)))
    fall = np.clip((edge - reach) / max(softness * radius, 0.8), 0, 1)
    return fall * fall * (3 - 2 * fall)


def value_noise(shape: tuple[int, int], grain: float, rng: np.random.Generator) -> np.ndarray:
    """[H, W, 3] value noise of mean about 0 and standard deviation about 1. grain: pixels of its coarsest spots."""
    from PIL import Image

    out, total = np.zeros((*shape, 3), np.float32), 0.0
    # Finer and weaker octaves; the sum of squares brings the deviation back to about 1.
    for k in range(OCTAVES):
        step = max(grain / 2**k, 1.0)
        small = (max(math.ceil(shape[0] / step), 2), max(math.ceil(shape[1] / step), 2))
        for c in range(3):
            cells = Image.fromarray(rng.standard_normal(small).astype(np.float32))
            out[..., c] += 0.6**k * np.asarray(cells.resize((shape[1], shape[0]), Image.Resampling.BICUBIC))
        total += 0.36**k
    return out / np.float32(math.sqrt(total) * 0.7)


def solid_layer(coverage: np.ndarray, color: tuple[float, ...]) -> np.ndarray:
    """[H, W] coverage in one colour -> layer."""
    out = np.empty((*coverage.shape, 4), np.float32)
    out[..., :3], out[..., 3] = color, coverage
    return out


def gaussian_blur(image: np.ndarray, radius: float) -> np.ndarray:
    """[H, W, C] after a Gaussian of standard deviation `radius` pixels; edges are repeated."""
    reach = max(math.ceil(3 * radius), 1)
    kernel = exp(-0.5 * (np.arange(-reach, reach + 1) / max(radius, 1e-3)) ** 2).astype(np.float32)
    kernel /= kernel.sum()
    out = image.astype(np.float32)
    for axis in (0, 1):
        width = [(reach, reach) if k == axis else (0, 0) for k in range(3)]
        padded = np.pad(out, width, mode="edge")
        n = out.shape[axis]
        out = kernel[0] * np.take(padded, range(n), axis)
        for k in range(1, len(kernel)):
            out += kernel[k] * np.take(padded, range(k, k + n), axis)
    return out


def centered_text(
    shape: tuple[int, int],
    text: str,
    center: tuple[float, float],
    letters: FreeTypeFont | ImageFont,
    weight_px: int,
) -> np.ndarray:
    """[H, W] uint8 coverage of text whose middle is at `center` (x, y, pixels). letters: a Pillow font; weight_px: how
    much fatter each letter becomes on either side (Pillow's own font has one weight)."""
    from PIL import Image, ImageDraw

    coverage = Image.new("L", (shape[1], shape[0]))
    ImageDraw.Draw(coverage).text(center, text, 255, letters, anchor="mm", stroke_width=weight_px, stroke_fill=255)
    return np.asarray(coverage)


def load_font(font: Path | None, height: float) -> FreeTypeFont | ImageFont:
    """A font at the size where its capitals are `height` pixels tall. Raises ValueError when it cannot be read."""
    from PIL import ImageFont

    if font and not font.exists():
        raise ValueError(f"{font}: expected a TrueType or OpenType font (no such file)")
    load = (lambda size: ImageFont.truetype(str(font), size)) if font else ImageFont.load_default
    try:
        # Fonts differ in how high a capital is at one size: measured at 100, then scaled.
        _, top, _, bottom = load(100).getbbox("H")
        return load(max(round(100 * height / max(bottom - top, 1)), 1))
    except OSError as error:
        raise ValueError(f"{font}: expected a TrueType or OpenType font ({error})") from None


def missing_letters(text: str, letters: FreeTypeFont | ImageFont) -> list[str]:
    """Letters of a text that a font does not have, each once, as they come: they are drawn as NO_LETTER is."""

    def shape(letter: str) -> tuple[tuple[int, int], bytes]:
        mask: Any = letters.getmask(letter)  # Pillow's stubs do not say that it is bytes
        return mask.size, bytes(mask)

    none = shape(NO_LETTER)

    # Blanks have no shape, and a font may draw what it lacks so.
    return [letter for letter in dict.fromkeys(text) if not letter.isspace() and shape(letter) == none]


def _box(shape: tuple[int, int], x: float, y: float, reach: float) -> tuple[slice, slice] | None:
    """The pixels within `reach` of a place along both axes; None outside the picture."""
    top, bottom = max(int(y - reach), 0), min(int(y + reach) + 2, shape[0])
    left, right = max(int(x - reach), 0), min(int(x + reach) + 2, shape[1])
    return (slice(top, bottom), slice(left, right)) if top < bottom and left < right else None
