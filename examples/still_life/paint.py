"""What the things are made of: procedural albedo (display sRGB) and gloss of every material. No light here.

Patterns are drawn as a painter would: brush marks with soft edges, washes that pool darker at their rims, a hand that
never repeats a leaf exactly.
"""

from __future__ import annotations

import numpy as np

from examples.still_life.noise import edge, fractal_noise, hashed, leaf, specks, value_noise, wrapped
from examples.still_life.shapes import Loft

CREAM = np.array([0.915, 0.890, 0.840])
COBALT = np.array([0.055, 0.115, 0.400])
WASH = np.array([0.400, 0.510, 0.740])
CLAY = np.array([0.640, 0.470, 0.340])
IRON = np.array([0.420, 0.300, 0.200])
FRONT = -np.pi / 2
"""The angle v that faces +z, the calm side."""

RINGS = ((0.052, 0.0060, 1.1), (0.570, 0.0080, 1.1), (0.686, 0.0060, 1.1), (0.704, 0.0030, 0.8), (0.790, 0.0060, 1.1))
"""Painted rings of the pot: height, half-width (world units), strength of the brush."""


def mix(base: np.ndarray, colour: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """[N, 3] base moved towards colour by amount [N] in 0..1."""
    return base + (colour - base) * amount[:, None]


class Brush:
    """Cobalt on the given points: pale wash, pigment pooled at the rim of a mark, uneven as a loaded brush is."""

    def __init__(self, points: np.ndarray) -> None:
        self.uneven = 0.18 * value_noise(points * 38, 31) + 0.20 * value_noise(points * 12, 32)

    def __call__(self, base: np.ndarray, distance: np.ndarray, strength: float = 1.0) -> np.ndarray:
        """[N, 3] base with a mark where distance [N] < 0. strength: 0.5 wash .. 1 full .. 1.3 solid."""
        near = distance < 0.006
        if not near.any():
            return base
        d = distance[near]
        depth = 0.62 + self.uneven[near] + 0.40 * edge(np.abs(d + 0.0045) - 0.0045, 0.004)
        depth = np.clip(depth * strength, 0.15, 1)
        cover = edge(d, 0.0032) * (0.75 + 0.25 * depth)
        out = base.copy()
        out[near] += (WASH + (COBALT - WASH) * depth[:, None] - out[near]) * cover[:, None]
        return out


def glaze(points: np.ndarray) -> np.ndarray:
    """[N, 3] the cream ground: cloudy, and faintly flecked with iron as stoneware is."""
    ground = CREAM + 0.012 * fractal_noise(points * 5, 3)[:, None] * np.array([1.0, 0.9, 0.6])
    return mix(ground, IRON, 0.16 * specks(points, 0.030, 0.55, (0.004, 0.010), 11))


def teapot(loft: Loft, points: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(albedo [N, 3], gloss [N]) of the pot and its lid."""
    brush = Brush(points)
    s = u + 0.0035 * value_noise(np.stack([np.cos(v), np.sin(v), 3 * u], 1) * 4, 5)  # the hand is not a lathe
    clay = edge(points[:, 1] - 0.030 - 0.006 * value_noise(points * 14, 8), 0.004)
    colour = mix(glaze(points), CLAY + 0.05 * value_noise(points * 60, 9)[:, None], clay)
    for height, half, strength in RINGS:
        colour = brush(colour, np.abs(s - loft.u_at(height)) - half, strength)
    colour = _petals(brush, colour, s - loft.u_at(0.064), v, count=26, length=0.125, around=0.365)
    colour = _vine(brush, colour, s - loft.u_at(0.628), v, count=20, around=0.405)
    colour = _petals(brush, colour, s - loft.u_at(0.795), v, count=14, length=0.105, around=0.165)
    colour = brush(colour, loft.u_at(0.900) - s, 1.3)
    colour = _branch(brush, colour, wrapped(v - FRONT - np.pi, 2 * np.pi) * 0.49, points[:, 1])
    return colour, 1 - clay


def _petals(
    brush: Brush, base: np.ndarray, s: np.ndarray, v: np.ndarray, *, count: int, length: float, around: float
) -> np.ndarray:
    """A ring of upright pointed petals: outline, wash, and one dark stroke in the middle of each."""
    cell = np.floor(v / (2 * np.pi) * count)
    x = (v / (2 * np.pi) * count - cell - 0.5) * (2 * np.pi / count) * around
    which = np.stack([cell % count], 1)
    tall = length * (0.95 + 0.1 * hashed(which, 41))
    half = np.pi / count * around * 0.94
    t = np.clip(s / tall, 0, 1)
    outline = half * np.sqrt(np.clip(1 - t**2.2, 0, 1)) * (0.82 + 0.25 * t)
    inside = np.maximum(np.abs(x) - outline, np.maximum(-s, s - tall))
    colour = mix(base, WASH, 0.38 * edge(inside, 0.004) * (0.45 + 0.75 * (1 - t)))
    colour = brush(colour, np.abs(inside + 0.004) - 0.0038)
    stroke = leaf(s - 0.14 * length, x, 0.08 * (hashed(which, 42) - 0.5), 0.6 * length, 0.16 * half + 0.002)
    return brush(colour, stroke, 1.15)


def _vine(brush: Brush, base: np.ndarray, s: np.ndarray, v: np.ndarray, *, count: int, around: float) -> np.ndarray:
    """A waving stem with leaves on both sides and berries between them; count must be even."""
    pitch = 2 * np.pi / count * around
    stem = 0.012 * np.sin(v * count / 2)
    colour = brush(base, np.abs(s - stem) - 0.0032, 0.95)
    rise = s - 0.5 * stem
    for shift in (0, 1):  # a leaf reaches into the next cell, so each row looks at two
        cell = np.floor(v / (2 * np.pi) * count) - shift
        which = np.stack([cell % count], 1)
        up = np.where(cell % 2 == 0, 1.0, -1.0)
        x = v * around - (cell + 0.35 + 0.12 * hashed(which, 51)) * pitch
        angle = up * (0.42 + 0.25 * hashed(which, 52))
        colour = brush(colour, leaf(x, rise, angle, 0.105, 0.016 + 0.004 * hashed(which, 53)))
        colour = brush(colour, leaf(x - 0.02, rise, -angle * 1.5, 0.062, 0.0125), 0.75)
        colour = brush(colour, np.hypot(x - 0.062, rise + up * 0.036) - 0.008, 1.2)
    return colour


def _branch(brush: Brush, base: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The picture on the far side: a branch with leaves and blossoms. x, y: [N] world units across and up."""
    away = (np.abs(x) > 0.44) | (y < 0.17) | (y > 0.57)
    x, y = np.where(away, 9.0, x), np.where(away, 9.0, y)
    rng = np.random.default_rng(23)

    def twig(at: np.ndarray | float) -> np.ndarray | float:
        return 0.27 + 0.30 * (at + 0.33) - 0.25 * (at + 0.33) ** 2 + 0.008 * np.sin(24 * at)

    colour = brush(base, np.where(np.abs(x) < 0.35, np.abs(y - twig(x)) - 0.0075 * (0.9 - x), 1.0), 1.1)
    for k, at in enumerate(np.linspace(-0.31, 0.345, 14)):
        angle = (-1) ** k * rng.uniform(0.6, 1.15) + 0.2
        shape = leaf(x - at, y - twig(at), angle, rng.uniform(0.085, 0.120), rng.uniform(0.016, 0.022))
        colour = brush(colour, shape, rng.uniform(0.7, 1.1))
    for at, rise in ((-0.20, 0.105), (-0.02, -0.085), (0.15, 0.110)):
        dx, dy = x - at, y - twig(at) - rise
        colour = brush(colour, np.maximum(np.abs(dx) - 0.004, np.abs(dy + rise / 2) - abs(rise) / 2))
        middle = np.hypot(dx, dy)
        bloom = middle - 0.046 * (0.72 + 0.28 * np.abs(np.cos(2.5 * np.arctan2(dy, dx))))
        colour = mix(colour, CREAM, edge(bloom, 0.004))
        colour = brush(colour, np.abs(bloom + 0.004) - 0.004)
        colour = brush(colour, middle - 0.0095, 1.2)
    return colour


def spout(loft: Loft, points: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(albedo, gloss): cream, a dipped cobalt tip, two rings and a row of strokes."""
    brush = Brush(points)
    tip = loft.u_at(1e9)  # the highest centre: the lip
    hand = 0.003 * value_noise(points * 12, 61)
    colour = brush(glaze(points), np.abs(u - tip) - 0.042 + hand, 1.25)
    colour = brush(colour, np.abs(u - tip + 0.066 + hand) - 0.004)
    around = wrapped(v, 2 * np.pi / 9) * loft.radius(u)
    return brush(colour, leaf(tip - 0.09 - u, around, 0.0, 0.10, 0.009), 0.95), np.ones(len(u))


def handle(loft: Loft, points: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(albedo, gloss): cobalt along the back, broken by bars near the ends."""
    brush = Brush(points)
    middle = np.abs(u - 0.5 * loft.length)
    bars = np.abs(wrapped(u - 0.5 * loft.length, 0.052)) - 0.0085
    bars = np.maximum(bars, np.abs(middle - 0.36 * loft.length) - 0.09 * loft.length)
    colour = brush(glaze(points), bars + 0.002 * value_noise(points * 20, 63))
    solid = middle - 0.245 * loft.length + 0.006 * value_noise(points * 15, 62)
    return brush(colour, solid, 1.25), np.ones(len(u))


def cup(loft: Loft, points: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(albedo, gloss): the tea bowl, glazed inside and out over a clay foot."""
    brush = Brush(points)
    lip = loft.u_at(1e9)
    s = u + 0.003 * value_noise(points * 13, 71)
    outer = u < lip
    clay = edge(points[:, 1] - 0.022 - 0.004 * value_noise(points * 16, 72), 0.004) * outer
    colour = mix(glaze(points + 3.1), CLAY, clay)
    colour = brush(colour, np.abs(s - lip) - 0.014, 1.5)
    s = np.where(outer, s, 9.0)
    colour = brush(colour, np.abs(s - lip + 0.038) - 0.0032, 0.9)
    return _petals(brush, colour, s - loft.u_at(0.040), v, count=15, length=0.095, around=0.16), 1 - clay


def tea(loft: Loft, points: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(albedo, gloss): green tea, lighter where it is shallow at the wall."""
    rim = np.clip(loft.radius(u) / 0.15, 0, 1) ** 4
    colour = mix(np.broadcast_to([0.60, 0.545, 0.13], (len(u), 3)), np.array([0.80, 0.77, 0.44]), rim)
    return colour, np.full(len(u), 1.0)


def lemon(loft: Loft, points: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(albedo, gloss): yellow with pores, greener at the tips, a brown stalk scar at one end."""
    colour = np.broadcast_to([0.955, 0.800, 0.170], (len(u), 3)).copy()
    colour += 0.035 * fractal_noise(points * 9, 81)[:, None] * np.array([0.8, 1.0, 0.5])
    tips = np.clip(np.abs(points[:, 1]) / 0.23 - 0.62, 0, 1) * 1.6
    colour = mix(colour, np.array([0.78, 0.74, 0.20]), tips)
    pores = specks(points, 0.022, 0.9, (0.003, 0.006), 83)
    colour = mix(colour, np.array([0.86, 0.64, 0.07]), 0.5 * pores)
    scar = edge(np.hypot(points[:, 0], points[:, 2]) - 0.020, 0.006) * (points[:, 1] < 0)
    return mix(colour, np.array([0.45, 0.36, 0.16]), scar), np.full(len(u), 0.30)


def wood(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(albedo [N, 3], gloss [N]) of the board: four planks along x, each cut from its own log, end grain on the rim."""
    width = 0.56
    plank = np.floor(points[:, 2] / width + 0.5 + 0.02)
    which = np.stack([plank], 1)
    heart = np.stack([0.35 + 0.5 * hashed(which, 91), (hashed(which, 92) - 0.5) * 0.5], 1)
    tilt = (hashed(which, 93) - 0.5) * 0.22
    x = points[:, 0] + 3 * plank
    bent = np.stack([x * 0.8, points[:, 1] * 2, points[:, 2] * 2], 1)
    y = points[:, 1] + heart[:, 0] + tilt * x + 0.05 * fractal_noise(bent, 94, 2)
    z = wrapped(points[:, 2] + 0.02 * width, width) + heart[:, 1] + 0.035 * fractal_noise(bent, 95, 2)
    rings = np.hypot(y, z) * 21 + 0.5 * value_noise(bent * 2.5, 96)
    phase = rings % 1
    late = phase**2.2 * edge(phase - 0.93, 0.07)  # growth darkens slowly, then a new year starts abruptly
    year = hashed(np.stack([np.floor(rings), plank], 1), 97)
    fibre = value_noise(np.stack([x * 5, points[:, 1] * 60, points[:, 2] * 75], 1), 98)
    cloud = fractal_noise(np.stack([x * 1.2, points[:, 1] * 4, points[:, 2] * 4], 1), 99, 2)
    light, dark = np.array([0.735, 0.545, 0.365]), np.array([0.475, 0.305, 0.180])
    amount = 0.12 + 0.62 * late * (0.6 + 0.6 * year) + 0.11 * fibre + 0.12 * cloud + 0.22 * (hashed(which, 90) - 0.5)
    colour = mix(np.broadcast_to(light, points.shape), dark, np.clip(amount, 0, 1.1))
    pore = value_noise(np.stack([x * 11, points[:, 1] * 90, points[:, 2] * 110], 1), 89)
    colour = colour * (1 - 0.13 * edge(0.62 - pore, 0.1))[:, None]
    seam = edge(np.abs(wrapped(points[:, 2] + 0.02 * width - width / 2, width)) - 0.0035, 0.003)
    return mix(colour, np.array([0.20, 0.12, 0.07]), 0.75 * seam), np.full(len(points), 0.20)
