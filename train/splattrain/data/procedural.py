"""Random composed objects for training without any files (the idea of LRM-Zero's Zeroverse, arXiv 2406.09371).

One to nine primitives with random axes and turns, some with bumpy sides, some cut open, some as wire frames, each with
a material of its own, and part of the faces given to a neighbour's material. Written from the idea alone. Materials are
tileable colour, relief, metal and roughness pictures of S x S pixels (SIDE_PX).
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpainter.transforms import quat_to_matrix
from splattrain.data import shapes
from splattrain.data.materials import Material
from splattrain.data.meshes import Mesh, normalized, repaired

PART_ODDS = (5, 5, 5, 4, 4, 3, 2, 1, 1)
"""Relative odds of 1 to 9 parts."""
SIDE_PX = 256
"""Edge of a texture."""
SHAPE = (SIDE_PX, SIDE_PX)
PATTERNS = ("noise", "stripes", "checks", "spots", "gradient", "bricks", "strokes", "cells", "marble", "plain")
PICTURES = (".jpg", ".jpeg", ".png", ".webp")


@dataclass(frozen=True)
class Odds:
    """How often each thing happens to a part."""

    bumpy: float = 0.35
    """Sides raised and sunk by a height field."""
    cut: float = 0.3
    """Opened by a cutter, with a wall behind."""
    wires: float = 0.08
    """A wire frame in place of the solid."""
    traded: float = 0.5
    """Some of its faces (up to 25 %) carry the material of the part before."""


def random_mesh(seed: int, textures: str | Path | None = None, odds: Odds = Odds()) -> Mesh:
    """A textured object of 1-9 parts, normalised as load_mesh does. Deterministic in the seed (and the pictures).

    textures: a folder of pictures, used as base colour of some parts. Raises ValueError when it holds none.
    """
    rng = np.random.default_rng([seed, 2406, 9371])
    if textures is not None and not Path(textures).is_dir():
        raise ValueError(f"{textures}: no such folder; expected a folder of pictures for textures")
    weights = np.array(PART_ODDS) / sum(PART_ODDS)
    count = 1 + int(rng.choice(len(PART_ODDS), p=weights))
    solids, ids = [], []
    reached: list[np.ndarray] = []
    for k in range(count):
        solid = _part(rng, odds)
        turn = rotation(rng)
        axes = rng.uniform(0.25, 2.0, 3) if rng.random() < 0.7 else np.full(3, rng.uniform(0.4, 1.5))
        # A new part starts at a point of an old one, so that the object hangs together.
        anchor = np.zeros(3) if not reached else reached[int(rng.integers(len(reached)))]
        shift = anchor + rng.uniform(-0.3, 0.3, 3) * axes.max()
        placed = solid.moved(turn @ np.diag(axes), shift)
        solids.append(placed)
        ids.append(np.full(len(placed.faces), k))
        reached += list(placed.vertices[rng.integers(len(placed.vertices), size=3)])
    solid = shapes.joined(solids)
    materials = tuple(random_material(rng, textures) for _ in range(count))
    mesh = Mesh(
        f"procedural {seed}",
        solid.vertices.astype(np.float32),
        solid.faces,
        solid.normals.astype(np.float32),
        solid.uvs.astype(np.float32),
        _traded(ids, rng, odds.traded),
        materials,
    )
    return normalized(repaired(mesh))


def rotation(rng: np.random.Generator) -> np.ndarray:
    """[3, 3] a uniform random rotation (unit quaternion of four normals)."""
    return quat_to_matrix(rng.standard_normal((1, 4)))[0]


def _part(rng: np.random.Generator, odds: Odds) -> shapes.Solid:
    kind = shapes.PRIMITIVES[int(rng.integers(len(shapes.PRIMITIVES)))]
    if rng.random() < odds.wires:
        return shapes.wires(kind, float(rng.uniform(0.02, 0.05)))
    solid = shapes.primitive(kind, rng, bumpy=rng.random() < odds.bumpy)
    if rng.random() < odds.cut:
        solid = shapes.cut(solid, _cutter(solid, rng), float(rng.uniform(0.04, 0.08)))
    return solid


def _cutter(solid: shapes.Solid, rng: np.random.Generator) -> shapes.Distance:
    """A random primitive that bites into the surface of the solid."""
    kind = shapes.PRIMITIVES[int(rng.integers(len(shapes.PRIMITIVES)))]
    measure = shapes.distance(kind)
    size = rng.uniform(0.35, 0.8, 3)
    turn = rotation(rng)
    middle = solid.vertices[int(rng.integers(len(solid.vertices)))] * rng.uniform(0.6, 1.1)
    return lambda points: measure((points - middle) @ turn / size) * float(size.min())


def _traded(ids: list[np.ndarray], rng: np.random.Generator, odds: float) -> np.ndarray:
    """[F] material of each face: a run of up to 25 % of a part's faces takes the material of the part before."""
    out = [part.copy() for part in ids]
    for k in range(1, len(out)):
        if rng.random() < odds:
            run = int(rng.uniform(0.05, 0.25) * len(out[k]))
            start = int(rng.integers(len(out[k]) - run + 1))
            out[k][start : start + run] = k - 1
    return np.concatenate(out)


def random_material(rng: np.random.Generator, textures: str | Path | None = None) -> Material:
    """A material of a random kind; with a folder of pictures, two in five take one of those as base colour."""
    picture = _photo(rng, textures) if textures is not None and rng.random() < 0.4 else None
    if picture is None:
        kind = PATTERNS[int(rng.choice(len(PATTERNS), p=_pattern_odds()))]
        color, relief = pattern(kind, rng)
    else:
        color, relief = picture, noise(rng, float(rng.uniform(1.0, 2.2)))
    metallic = float(rng.uniform(0.6, 1.0)) if rng.random() < 0.15 else 0.0
    roughness = float(rng.uniform(0.15, 1.0))
    rough = None
    if rng.random() < 0.4:
        level = np.clip(0.75 + 0.25 * noise(rng, 1.5), 0, 1)
        rough = np.stack([np.full(SHAPE, 255.0), 255 * level], -1).astype(np.uint8)
    normals = relief_normals(relief, float(rng.uniform(1, 5))) if rng.random() < 0.35 else None
    coded = np.clip(color * 255 + 0.5, 0, 255).astype(np.uint8)
    return Material(coded, (1.0, 1.0, 1.0), rough, metallic, roughness, normals)


def _pattern_odds() -> np.ndarray:
    weights = np.array([3, 2, 2, 2, 1, 2, 3, 2, 2, 0.7])
    return weights / weights.sum()


def pattern(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(colour [S, S, 3] display sRGB 0..1, relief [S, S] about -1..1) of one of PATTERNS; both tile."""
    colors = palette(rng, 4)
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX] / SIDE_PX
    rough = noise(rng, 1.6)
    warp = 0.05 * rng.random() * noise(rng, 2.2)
    level, relief = np.zeros(SHAPE), rough
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
        gap, numbers, _ = cells(rng, int(rng.integers(15, 90)))
        size = rng.uniform(0.02, 0.06)
        inside = np.clip((size * (0.5 + numbers) - gap) * 200, 0, 1)
        return blend(colors[0], colors[1 + (numbers * 3).astype(int) % 3], inside), inside
    elif kind == "gradient":
        turn = np.sin(2 * np.pi * (y * int(rng.integers(1, 3)) + (x if rng.random() < 0.3 else 0 * x)) + 20 * warp)
        level = 0.5 + 0.5 * turn
    elif kind == "bricks":
        return _bricks(rng, colors, rough, x, y)
    elif kind == "strokes":
        return _strokes(rng, colors)
    elif kind == "cells":
        gap, numbers, edge = cells(rng, int(rng.integers(12, 80)))
        grout = np.clip((edge - 0.008) * 120, 0, 1)
        return blend(colors[0], ramp(colors[1:], numbers), grout) * (0.9 + 0.1 * rough)[..., None], grout
    elif kind == "marble":
        level = 0.5 + 0.5 * np.sin(2 * np.pi * int(rng.integers(1, 4)) * y + rng.uniform(2, 6) * noise(rng, 2.0))
        level = level ** rng.uniform(1, 3)
    tint = 1 + rng.uniform(0.03, 0.15) * rough
    return np.clip(ramp(colors, np.clip(level, 0, 1)) * tint[..., None], 0, 1), relief


def noise(rng: np.random.Generator, slope: float) -> np.ndarray:
    """[S, S] tileable noise of mean 0, two standard deviations to 1, amplitude ~ 1 / frequency^slope."""
    f = np.fft.fftfreq(SIDE_PX)[:, None] ** 2 + np.fft.rfftfreq(SIDE_PX)[None] ** 2
    f[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal(SHAPE)) * f ** (-slope / 2)
    field = np.fft.irfft2(spectrum, SHAPE)
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
    each [S, S], tileable (Worley 1996)."""
    half = SIDE_PX // 2
    seeds = rng.random((count, 2))
    at = np.arange(half) / half
    dx, dy = (np.abs(at - seeds[:, axis, None]) for axis in (0, 1))
    d = np.hypot(np.minimum(dx, 1 - dx)[:, None], np.minimum(dy, 1 - dy)[:, :, None])
    first = d.argmin(0)
    numbers, near = rng.random(count)[first], d.min(0)
    np.put_along_axis(d, first[None], np.inf, 0)
    parts = np.stack([near, numbers, d.min(0) - near])
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
    numbers = rng.random((rows, across))[row.astype(int) % rows, np.floor(u).astype(int) % across]
    return np.clip(blend(colors[0], ramp(colors[1:], numbers), solid) * (1 + 0.12 * rough)[..., None], 0, 1), solid


def _strokes(rng: np.random.Generator, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Broad brush strokes, one over the other, on a tile."""
    color = np.broadcast_to(colors[0], (SIDE_PX, SIDE_PX, 3)).copy()
    relief = np.zeros(SHAPE)
    for _ in range(int(rng.integers(8, 30))):
        middle, angle = rng.integers(0, SIDE_PX, 2), rng.uniform(0, np.pi)
        half, width, bend = rng.uniform(0.08, 0.35), rng.uniform(0.012, 0.06), rng.uniform(-1.5, 1.5)
        reach = min(int((half + width + abs(bend) * half**2) * SIDE_PX) + 2, SIDE_PX // 2)
        steps = np.arange(-reach, reach)
        window = np.ix_(
            (middle[1] + steps) % SIDE_PX, (middle[0] + steps) % SIDE_PX
        )  # wraps, so that the tile stays one
        dy, dx = steps[:, None] / SIDE_PX, steps[None] / SIDE_PX
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
    """[S, S, 3] 0..1 one of the folder's pictures, or None where it cannot be read. Raises ValueError where there
    are none."""
    from PIL import Image

    files = sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in PICTURES)
    if not files:
        raise ValueError(f"{folder}: holds no pictures ({', '.join(PICTURES)}) for textures")
    try:
        with Image.open(files[int(rng.integers(len(files)))]) as image:
            return np.asarray(image.convert("RGB").resize(SHAPE, Image.Resampling.LANCZOS)) / 255.0
    except (OSError, ValueError):
        return None
