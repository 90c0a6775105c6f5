"""Procedural materials: tileable colour, relief, metal and roughness pictures from a random generator. Pure numpy."""

from __future__ import annotations

import colorsys
from pathlib import Path

import numpy as np

from splatpainter.data.meshes import Material

SIZE = 256
"""Pixels per side of a texture."""
KINDS = ("noise", "stripes", "checks", "spots", "gradient", "bricks", "strokes", "cells", "marble", "plain")
PICTURES = (".jpg", ".jpeg", ".png", ".webp")


def random_material(rng: np.random.Generator, textures: str | Path | None = None) -> Material:
    """A material of a random kind; with a folder of pictures, two in five take one of those as base colour."""
    picture = _photo(rng, textures) if textures is not None and rng.random() < 0.4 else None
    if picture is None:
        kind = KINDS[int(rng.choice(len(KINDS), p=_odds()))]
        color, relief = pattern(kind, rng)
    else:
        color, relief = picture, noise(rng, float(rng.uniform(1.0, 2.2)))
    metallic = float(rng.uniform(0.6, 1.0)) if rng.random() < 0.15 else 0.0
    roughness = float(rng.uniform(0.15, 1.0))
    rough = None
    if rng.random() < 0.4:
        level = np.clip(0.75 + 0.25 * noise(rng, 1.5), 0, 1)
        rough = np.stack([np.full((SIZE, SIZE), 255.0), 255 * level], -1).astype(np.uint8)
    normals = relief_normals(relief, float(rng.uniform(1, 5))) if rng.random() < 0.35 else None
    coded = np.clip(color * 255 + 0.5, 0, 255).astype(np.uint8)
    return Material(coded, (1.0, 1.0, 1.0), rough, metallic, roughness, normals)


def _odds() -> np.ndarray:
    weights = np.array([3, 2, 2, 2, 1, 2, 3, 2, 2, 0.7])
    return weights / weights.sum()


def pattern(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(colour [SIZE, SIZE, 3] display sRGB 0..1, relief [SIZE, SIZE] about -1..1) of one of KINDS; both tile."""
    colors = palette(rng, 4)
    y, x = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    rough = noise(rng, 1.6)
    warp = 0.05 * rng.random() * noise(rng, 2.2)
    level, relief = np.zeros((SIZE, SIZE)), rough
    if kind == "noise":
        level = 0.5 + 0.4 * noise(rng, float(rng.uniform(0.8, 2.2)))
    elif kind == "stripes":
        a, b = rng.integers(0, 9, 2) if rng.random() < 0.6 else (0, int(rng.integers(3, 16)))
        wave = np.sin(2 * np.pi * ((a or 1) * x + b * y) + 40 * warp)
        level = np.clip(0.5 + wave * rng.uniform(0.6, 6), 0, 1)
        relief = wave
    elif kind == "checks":
        n = int(rng.integers(2, 9))
        level = ((np.floor((x + warp) * 2 * n) + np.floor((y + warp) * 2 * n)) % 2) * 0.9
        relief = level
    elif kind == "spots":
        gap, own, _ = cells(rng, int(rng.integers(15, 90)))
        size = rng.uniform(0.02, 0.06)
        inside = np.clip((size * (0.5 + own) - gap) * 200, 0, 1)
        return blend(colors[0], colors[1 + (own * 3).astype(int) % 3], inside), inside
    elif kind == "gradient":
        turn = np.sin(2 * np.pi * (y * int(rng.integers(1, 3)) + (x if rng.random() < 0.3 else 0 * x)) + 20 * warp)
        level = 0.5 + 0.5 * turn
    elif kind == "bricks":
        return _bricks(rng, colors, rough, x, y)
    elif kind == "strokes":
        return _strokes(rng, colors)
    elif kind == "cells":
        gap, own, edge = cells(rng, int(rng.integers(12, 80)))
        grout = np.clip((edge - 0.008) * 120, 0, 1)
        return blend(colors[0], ramp(colors[1:], own), grout) * (0.9 + 0.1 * rough)[..., None], grout
    elif kind == "marble":
        level = 0.5 + 0.5 * np.sin(2 * np.pi * int(rng.integers(1, 4)) * y + rng.uniform(2, 6) * noise(rng, 2.0))
        level = level ** rng.uniform(1, 3)
    tint = 1 + rng.uniform(0.03, 0.15) * rough
    return np.clip(ramp(colors, np.clip(level, 0, 1)) * tint[..., None], 0, 1), relief


def noise(rng: np.random.Generator, slope: float) -> np.ndarray:
    """[SIZE, SIZE] tileable noise of mean 0, two standard deviations to 1, amplitude ~ 1 / frequency^slope."""
    f = np.fft.fftfreq(SIZE)[:, None] ** 2 + np.fft.rfftfreq(SIZE)[None] ** 2
    f[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * f ** (-slope / 2)
    field = np.fft.irfft2(spectrum, (SIZE, SIZE))
    return np.clip(field / (2 * field.std()), -1.5, 1.5)


def palette(rng: np.random.Generator, count: int) -> np.ndarray:
    """[count, 3] display sRGB colours that go together: hues around one, or opposite, with different lightness."""
    hue, spread = rng.random(), rng.choice([0.04, 0.12, 0.5])
    vivid = rng.uniform(0.15, 0.95)
    colors = []
    for k in range(count):
        h = (hue + spread * rng.uniform(-0.5, 0.5) * (1 + (k % 2))) % 1
        s = np.clip(vivid * rng.uniform(0.5, 1.2), 0, 1)
        colors.append(colorsys.hls_to_rgb(h, float(rng.uniform(0.15, 0.88)), float(s)))
    return np.array(colors)


def ramp(colors: np.ndarray, level: np.ndarray) -> np.ndarray:
    """[..., 3] colours [K, 3] interpolated at level [...] 0..1."""
    stops = np.linspace(0, 1, len(colors))
    return np.stack([np.interp(level, stops, channel) for channel in colors.T], -1)


def blend(below: np.ndarray, above: np.ndarray, amount: np.ndarray) -> np.ndarray:
    return below + (above - below) * amount[..., None]


def cells(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(distance to the nearest of `count` seeds, that seed's own number 0..1, distance to the border between seeds):
    each [SIZE, SIZE], tileable (Worley 1996)."""
    half = SIZE // 2
    seeds = rng.random((count, 2))
    y, x = np.mgrid[0:half, 0:half] / half
    dx, dy = np.abs(x[..., None] - seeds[:, 0]), np.abs(y[..., None] - seeds[:, 1])
    d = np.hypot(np.minimum(dx, 1 - dx), np.minimum(dy, 1 - dy))
    two = np.argpartition(d, 1, -1)[..., :2]
    near = np.take_along_axis(d, two, -1)
    first = near.argmin(-1)
    own = rng.random(count)[np.take_along_axis(two, first[..., None], -1)[..., 0]]
    near.sort(-1)
    parts = np.stack([near[..., 0], own, near[..., 1] - near[..., 0]])
    gap, number, edge = parts.repeat(2, 1).repeat(2, 2)
    return gap, number, edge


def _bricks(
    rng: np.random.Generator, colors: np.ndarray, rough: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    rows, across = 2 * int(rng.integers(2, 6)), int(rng.integers(2, 6))
    row = np.floor(y * rows)
    u = (x * across + 0.5 * (row % 2)) % across
    joint = rng.uniform(0.03, 0.1)
    inside = np.minimum(np.minimum(u % 1, 1 - u % 1) * rows / across, np.minimum(y * rows % 1, 1 - y * rows % 1))
    solid = np.clip((inside - joint) * 30, 0, 1)
    own = rng.random((rows, across))[row.astype(int) % rows, np.floor(u).astype(int) % across]
    return np.clip(blend(colors[0], ramp(colors[1:], own), solid) * (1 + 0.12 * rough)[..., None], 0, 1), solid


def _strokes(rng: np.random.Generator, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Broad brush strokes, one over the other, on a tile."""
    color = np.broadcast_to(colors[0], (SIZE, SIZE, 3)).copy()
    relief = np.zeros((SIZE, SIZE))
    for _ in range(int(rng.integers(8, 30))):
        middle, angle = rng.integers(0, SIZE, 2), rng.uniform(0, np.pi)
        half, width, bend = rng.uniform(0.08, 0.35), rng.uniform(0.012, 0.06), rng.uniform(-1.5, 1.5)
        reach = min(int((half + width + abs(bend) * half**2) * SIZE) + 2, SIZE // 2)
        steps = np.arange(-reach, reach)
        window = np.ix_((middle[1] + steps) % SIZE, (middle[0] + steps) % SIZE)  # wraps, so that the tile stays one
        dy, dx = steps[:, None] / SIZE, steps[None] / SIZE
        along, off = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
        off = off + bend * along**2
        inside = np.clip((width - np.abs(off)) * 150, 0, 1) * np.clip((half - np.abs(along)) * 100, 0, 1)
        bristles = 1 + 0.12 * np.sin(off * rng.uniform(150, 500))
        tone = colors[int(rng.integers(1, len(colors)))] * rng.uniform(0.75, 1.2)
        color[window] = blend(color[window], np.clip(tone * bristles[..., None], 0, 1), inside)
        relief[window] = np.maximum(relief[window], inside * bristles)
    return color, relief


def relief_normals(relief: np.ndarray, strength: float) -> np.ndarray:
    """[h, w, 3] uint8 tangent-space normals (glTF, +y up) of a tiling height field; strength: height in pixels of 1."""
    slope_x = strength * (np.roll(relief, -1, 1) - np.roll(relief, 1, 1)) / 2
    slope_y = -strength * (np.roll(relief, -1, 0) - np.roll(relief, 1, 0)) / 2  # rows run down, v runs up
    normal = np.stack([-slope_x, -slope_y, np.ones_like(relief)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.clip(normal * 127.5 + 128, 0, 255).astype(np.uint8)


def _photo(rng: np.random.Generator, folder: str | Path) -> np.ndarray | None:
    """[SIZE, SIZE, 3] 0..1 one of the folder's pictures, or None where it cannot be read. Raises ValueError where there
    are none."""
    from PIL import Image

    files = sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in PICTURES)
    if not files:
        raise ValueError(f"{folder}: holds no pictures ({', '.join(PICTURES)}) for textures")
    try:
        with Image.open(files[int(rng.integers(len(files)))]) as image:
            return np.asarray(image.convert("RGB").resize((SIZE, SIZE), Image.Resampling.LANCZOS)) / 255.0
    except (OSError, ValueError):
        return None
