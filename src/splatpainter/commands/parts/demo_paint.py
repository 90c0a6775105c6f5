"""What the demo paints: lettering, a brush stroke, a sticker, evening light. Pictures in, pictures out; knows no asset.

All places are parts of the picture's size, so that any size looks the same.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.portable import cos, exp, inverse, power, sin
from splatpainter.pictures.drawing import centered_text

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

RED = (196, 44, 38)
TEAL = (14, 124, 122)
STICKER_POSITION = (-0.02, 0.45, 0.80)
"""Where the sticker lies: on the board's top, in front of the pot (axes of demo.py: y down)."""
SUPERSAMPLING = 4
"""Drawn this much larger, then averaged down: Pillow's own shapes have hard edges."""
STICKER = 768
"""Pixels of the flat sticker before it is laid down."""


def over(picture: np.ndarray, color: tuple[int, int, int], alpha: np.ndarray) -> np.ndarray:
    """Paint: picture [H, W, 3] 0..1 under a colour 0..255 with alpha [H, W] 0..1."""
    return picture + alpha[..., None] * (np.array(color) / 255 - picture)


def lettering(size: int, text: str, center: tuple[float, float], height: float, bend: float) -> np.ndarray:
    """[size, size] alpha of a line of text around `center` (x, y), letters `height` tall, its ends lifted by `bend`."""
    from PIL import ImageFont

    # Drawn larger and averaged: Pillow's letters have edges of one step.
    big = size * SUPERSAMPLING
    font, weight_px = ImageFont.load_default(height * big), round(0.02 * height * big)
    flat = centered_text((big, big), text, (center[0] * big, center[1] * big), font, weight_px)
    # The ends are lifted, so that the line seems to go around the pot.
    columns = np.arange(big)
    lift = np.round(bend * big * ((columns / big - center[0]) / 0.15) ** 2).astype(int)
    rows = np.clip(columns[:, None] + lift[None], 0, big - 1)
    return _reduced(flat[rows, columns[None]])


def stroke(size: int, start: tuple[float, float], end: tuple[float, float], width: float, wave: float) -> np.ndarray:
    """[size, size] alpha of one pull of a flat brush from left to right: pressure swells and fades, hairs run dry one
    after the other, edges are soft. width: at full pressure; wave: how far the path swings."""
    # In parts of the picture's size, so that it looks the same at any.
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    t = (x - start[0]) / (end[0] - start[0])
    s = np.clip(t, 1e-3, 0.999)
    # A hand does not draw straight: it swings, and less towards the end.
    path = start[1] + (end[1] - start[1]) * s + wave * sin(math.pi * (2.1 * s - 0.15)) * (1 - 0.35 * s)
    pressure = 0.2 + 0.8 * power(np.maximum(sin(math.pi * power(s, 0.6)), 0), 0.6)
    cap = np.sqrt(1 - (1 - np.minimum(s / 0.03, 1)) ** 2)  # the brush touches down round
    radius = width / 2 * pressure * cap
    across = (y - path) / radius  # -1..1 over the width
    soft = np.clip((1 - np.abs(across)) * radius * size / 1.5, 0, 1)  # an edge of 1.5 pixels
    soft *= (t > 0) * np.clip((1 - t) * 40, 0, 1)
    # A fixed seed: the demo looks the same each time.
    hairs = np.random.default_rng(4).uniform(0, 1, 15)  # how late each runs dry
    position = np.clip((across + 1) / 2 * (len(hairs) - 1), 0, len(hairs) - 1.001)
    left = position.astype(int)
    wet = hairs[left] * (left + 1 - position) + hairs[left + 1] * (position - left)
    dry = np.clip((s - 0.5 - 0.45 * wet) / 0.10, 0, 1)
    return soft * (1 - 0.85 * dry) * 0.97


def sun() -> Image:
    """A sticker: a smiling sun with a white border, on a transparent square."""
    from PIL import Image, ImageDraw, ImageFilter

    big = STICKER * 2
    middle = big / 2
    # Drawn twice as large as it is used, for smooth edges.
    picture = Image.new("RGBA", (big, big))
    draw = ImageDraw.Draw(picture)
    rays, outer, inner = 12, 0.43 * big, 0.30 * big
    corners = []
    for k in range(rays * 2):
        reach = outer if k % 2 == 0 else inner
        angle = math.pi * k / rays
        corners.append((middle + reach * sin(angle), middle - reach * cos(angle)))
    draw.polygon(corners, fill=(240, 120, 24, 255))
    _disc(draw, middle, middle, 0.285 * big, (255, 205, 52, 255))
    for side in (-1, 1):
        _disc(draw, middle + side * 0.105 * big, middle - 0.055 * big, 0.030 * big, (70, 36, 20, 255))
        _disc(draw, middle + side * 0.165 * big, middle + 0.045 * big, 0.043 * big, (250, 140, 90, 255))
    smile = [middle - 0.12 * big, middle - 0.09 * big, middle + 0.12 * big, middle + 0.13 * big]
    draw.arc(smile, 25, 155, fill=(70, 36, 20, 255), width=round(0.026 * big))
    # The border is the silhouette grown by a blur, as stickers are cut.
    silhouette = picture.getchannel("A").resize((STICKER, STICKER), Image.Resampling.BOX)
    blurred = np.asarray(silhouette.filter(ImageFilter.GaussianBlur(0.02 * STICKER)))
    grown = Image.fromarray(np.where(blurred > 20, 255, 0).astype(np.uint8))
    border = Image.merge("RGBA", [Image.new("L", grown.size, 252)] * 3 + [grown.filter(ImageFilter.GaussianBlur(1))])
    return Image.alpha_composite(border, picture.resize((STICKER, STICKER), Image.Resampling.BOX))


def laid_down(
    sticker: Image, camera: Camera, center: tuple[float, float, float], radius: float, facing: float
) -> np.ndarray:
    """[H, W, 4] 0..1, colours times alpha: the sticker lying flat (on a plane of constant y) as the camera sees it.
    center: [3] and radius: world units; facing: degrees by which its foot is turned from +z towards +x."""
    from PIL import Image

    # Laid on the board and seen in perspective: a flat picture would float before it.
    turn = math.radians(facing)
    right, near = np.array([cos(turn), 0, -sin(turn)]), np.array([sin(turn), 0, cos(turn)])
    middle = np.array(center)
    world = [middle + radius * (a * right + b * near) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    seen = camera.project(np.array(world))[0] * SUPERSAMPLING
    solution = _to_square(seen, sticker.width)
    big = (camera.width * SUPERSAMPLING, camera.height * SUPERSAMPLING)
    # Colours times alpha before anything is averaged, or the border would turn dark.
    straight = np.asarray(sticker, np.float32) / 255
    straight[..., :3] *= straight[..., 3:]  # averaging wants colours times alpha
    packed = Image.fromarray((straight * 255 + 0.5).astype(np.uint8), "RGBA")
    out = packed.transform(big, Image.Transform.PERSPECTIVE, solution.tolist(), Image.Resampling.BILINEAR)
    return np.asarray(out.reduce(SUPERSAMPLING), np.float32) / 255


def evening(picture: np.ndarray) -> np.ndarray:
    """[H, W, 3] 0..1 in the light of a low sun from the left: golden there, dim and violet on the other side."""
    width = picture.shape[1]
    x = (np.arange(width) + 0.5) / width
    # From warm to cool across the picture, as a low sun from one side lights it.
    light = 1 / (1 + exp(8 * (x - 0.56)))  # 1 left .. 0 right
    warm, cool = np.array([1.20, 0.94, 0.62]), np.array([0.62, 0.52, 0.66])
    gain = cool + light[None, :, None] * (warm - cool)
    return np.clip(power(np.clip(picture, 0, 1), 1.1) * gain, 0, 1).astype(np.float32)


def painted(picture: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W, 3] 0..1: the recommended view of the bundled asset with lettering and a stroke on the pot, and the sticker
    on the board."""
    size = camera.width
    out = np.clip(picture, 0, 1).astype(np.float64)
    # In order: what is painted later lies above.
    out = over(out, RED, lettering(size, "tea time", (0.497, 0.487), 0.088, 0.0085))
    out = over(out, TEAL, stroke(size, (0.358, 0.562), (0.645, 0.548), 0.028, 0.010))
    sticker = laid_down(sun(), camera, STICKER_POSITION, 0.215, -6)
    return (out * (1 - sticker[..., 3:]) + sticker[..., :3]).astype(np.float32)


def _disc(draw: ImageDraw, x: float, y: float, radius: float, fill: tuple[int, ...]) -> None:
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=fill)


def _to_square(corners: np.ndarray, side: float) -> np.ndarray:
    """[8] coefficients of Pillow's perspective transform that takes four corners [4, 2], in turn, to those of a square
    from the origin on (Heckbert, Fundamentals of texture mapping and image warping, 1989)."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = corners
    (ax, ay), (bx, by), (cx, cy) = (x1 - x2, y1 - y2), (x3 - x2, y3 - y2), (x0 - x1 + x2 - x3, y0 - y1 + y2 - y3)
    # From the unit square to the corners; the way back is the inverse.
    g, h = ((cx * by - bx * cy) / (ax * by - bx * ay), (ax * cy - cx * ay) / (ax * by - bx * ay))
    forwards = [[x1 - x0 + g * x1, x3 - x0 + h * x3, x0], [y1 - y0 + g * y1, y3 - y0 + h * y3, y0], [g, h, 1.0]]
    back = inverse(np.array(forwards)) * np.array([[side], [side], [1.0]])
    return (back / back[2, 2]).reshape(-1)[:8]


def _reduced(values: np.ndarray) -> np.ndarray:
    size = values.shape[0] // SUPERSAMPLING
    return values.reshape(size, SUPERSAMPLING, size, SUPERSAMPLING).mean((1, 3)) / 255
