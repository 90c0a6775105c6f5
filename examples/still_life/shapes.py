"""Lofted surfaces, evenly scattered Gaussians on them, and their signed distances. Knows no colour, no light and no
Splats.

A loft is a chain of ellipses: a body of revolution has its centres on a straight axis, a handle or spout has them on a
bent path. Parameters: u runs along the chain (arc length of the outline, world units), v around it (radians).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

GOLDEN = np.pi * (3 - np.sqrt(5))
"""Golden angle, radians: successive points turned by it never line up, on a disc as on a cylinder (Vogel 1979)."""
STEP = 2e-3
"""Half-width of the finite differences below, in u; below it the polyline's corners would show in the highlights."""

MARGIN = 0.1
"""World units around a body within which its distance is exact; beyond, it is a lower bound."""
Distance: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""[N, 3] points -> [N] signed distance, world units."""


def curve(points: Sequence[Sequence[float]], count: int) -> np.ndarray:
    """[count, D] points, equally far apart, on the Catmull-Rom spline through the [P, D] control points."""
    knots = np.asarray(points, np.float64)
    padded = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    t = np.linspace(0, 1, 32, endpoint=False)[:, None]
    a, b, c, d = (padded[i : i + len(knots) - 1, None] for i in range(4))
    fine = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
    fine = np.concatenate([fine.reshape(-1, knots.shape[1]), knots[-1:]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    at = np.linspace(0, length[-1], count)
    return np.stack([np.interp(at, length, column) for column in fine.T], 1)


@dataclass(frozen=True)
class Loft:
    """M ellipses in a row, joined into a surface whose normals point outwards."""

    centres: np.ndarray
    """[M, 3] world units."""
    across: np.ndarray
    """[M, 3] unit vector of v = 0."""
    aside: np.ndarray
    """[M, 3] unit vector of v = 90 degrees."""
    radii: np.ndarray
    """[M, 2] half-axes along across and aside, world units, >= 0."""
    u: np.ndarray
    """[M] arc length of the outline, increasing from 0."""

    @property
    def length(self) -> float:
        return float(self.u[-1])

    def points(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """[N, 3] surface points. u [N] is clipped to the chain, v [N] in radians."""

        def at(values: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(u, self.u, column) for column in values.T], 1)

        radii = at(self.radii)
        return (
            at(self.centres)
            + (radii[:, :1] * np.cos(v)[:, None]) * at(self.across)
            + (radii[:, 1:] * np.sin(v)[:, None]) * at(self.aside)
        )

    def frames(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(points [N, 3], unit normals [N, 3], unit tangents along u [N, 3]) by central differences."""
        inner = np.clip(u, STEP, self.length - STEP)
        along = self.points(inner + STEP, v) - self.points(inner - STEP, v)
        around = self.points(inner, v + 1e-3) - self.points(inner, v - 1e-3)
        normals = unit(np.cross(around, along))
        return self.points(u, v), normals, unit(along)

    def radius(self, u: np.ndarray) -> np.ndarray:
        """[N] mean radius of the ellipse at u, for turning an angle into a length."""
        return np.interp(u, self.u, self.radii.mean(1))

    def u_at(self, height: float) -> float:
        """The first u whose centre reaches the height (y), or the u of the highest centre where none does."""
        above = np.nonzero(self.centres[:, 1] >= height)[0]
        return float(self.u[above[0] if len(above) else self.centres[:, 1].argmax()])


def revolve(outline: Sequence[Sequence[float]], count: int = 500) -> Loft:
    """Body of revolution around y. outline: [P, 2] control points (radius, height), walked so that the body is on the
    left hand (upwards along an outer wall)."""
    line = curve(outline, count)
    line[:, 0] = np.maximum(line[:, 0], 0)
    centres = np.zeros((count, 3))
    centres[:, 1] = line[:, 1]
    axis = np.broadcast_to
    return Loft(centres, axis([1.0, 0, 0], (count, 3)), axis([0, 0, -1.0], (count, 3)), line[:, [0, 0]], _lengths(line))


def sweep(path: Sequence[Sequence[float]], flatness: float = 1.0, lip: float = 0.0, count: int = 300) -> Loft:
    """Tube along a path in the xy plane. path: [P, 3] control points (x, y, radius); flatness: width along z over width
    in the plane; lip: wall thickness of an open end, which is then lined as far as the eye reaches; 0 for none."""
    line = curve(path, count)
    tangent = unit(np.gradient(_smooth(line[:, :2], 9), axis=0))
    if lip:  # over a round edge and back down inside; "along" turns with it, so these normals face the axis
        turn = np.linspace(0, np.pi, 10)[1:, None]
        over = line[-1] + lip / 2 * np.concatenate([tangent[-1] * np.sin(turn), np.cos(turn) - 1], 1)
        deep = np.arange(count - 2, count - count // 4, -1)
        line = np.concatenate([line, over, line[deep] - [0, 0, lip]])
        tangent = np.concatenate([tangent, np.repeat(tangent[-1:], len(turn), 0), tangent[deep]])
    total = len(line)
    centres = np.concatenate([line[:, :2], np.zeros((total, 1))], 1)
    across = np.stack([tangent[:, 1], -tangent[:, 0], np.zeros(total)], 1)
    aside = np.broadcast_to([0, 0, -1.0], (total, 3))
    radii = np.stack([line[:, 2], line[:, 2] * flatness], 1)
    return Loft(centres, across, aside, radii, _lengths(line))


def scatter(
    loft: Loft, spacing: Callable[[np.ndarray], np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, v, spacing), each [N]: a golden-angle lattice, `spacing(u)` world units apart, slightly jittered so that no
    regular pattern shows. Gaussians are finer where the outline bends more sharply than the spacing could follow."""
    fine = np.linspace(0, loft.length, 4000)
    outline = np.stack([loft.centres[:, 0], loft.centres[:, 1], loft.radii[:, 0]], 1)
    slope = _smooth(np.gradient(outline, loft.u, axis=0), 5)
    bend = np.interp(fine, loft.u, np.linalg.norm(np.gradient(slope, loft.u, axis=0), axis=1))
    step = np.minimum(spacing(fine), np.maximum(0.5 / np.maximum(bend, 1e-6), 0.0055))
    step = np.exp(_smooth(np.log(step)[:, None], 41)[:, 0])
    density = 2 * np.pi * np.maximum(loft.radius(fine), 1e-4) / step**2
    total = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine))])
    count = int(total[-1])
    u = np.interp((np.arange(count) + 0.5) * (total[-1] / count), total, fine)
    size = np.interp(u, fine, step)
    jitter = rng.uniform(-0.12, 0.12, (2, count)) * size
    v = np.arange(count) * GOLDEN + jitter[1] / np.maximum(loft.radius(u), size)
    return np.clip(u + jitter[0], 0, loft.length), v % (2 * np.pi), size


def quarter(
    loft: Loft, u: np.ndarray, v: np.ndarray, size: np.ndarray, apart: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(u, v, size), each [4 N]: every Gaussian's cell as four of half the size, those of a Gaussian next to each other.
    apart: distance between their centres, in sizes (0.5 tiles the cell)."""
    step = 0.5 * apart * size[:, None]
    u4 = np.clip(u[:, None] + np.array([-1, -1, 1, 1]) * step, 0, loft.length)
    around = np.maximum(loft.radius(u), size / 2)[:, None]
    v4 = v[:, None] + np.array([-1, 1, -1, 1]) * (step / around)
    return u4.ravel(), v4.ravel(), np.repeat(size / 2, 4)


def lattice(width: float, depth: float, steps: tuple[float, float]) -> np.ndarray:
    """[N, 2] points over the rectangle of that size centred at 0, about `steps` apart (a golden-ratio lattice)."""
    count = int(width * depth / (steps[0] * steps[1]))
    i = np.arange(count)
    return np.stack([((i * 0.6180339887498949) % 1 - 0.5) * width, ((i + 0.5) / count - 0.5) * depth], 1)


def revolved_distance(loft: Loft) -> Distance:
    """Signed distance to a body of revolution (negative inside), read from a table over (radius, height)."""
    outline = np.stack([loft.radii[:, 0], loft.centres[:, 1]], 1)[[*range(0, len(loft.u) - 1, 5), -1]]
    low, high = outline.min(0) - MARGIN, outline.max(0) + MARGIN
    low[0] = 0.0
    shape = np.ceil((high - low) / 0.01).astype(int) + 1
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, shape, strict=True)]
    table = _polygon_distance(outline, np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)).reshape(shape)

    def distance(points: np.ndarray) -> np.ndarray:
        cell = (np.stack([np.hypot(points[:, 0], points[:, 2]), points[:, 1]], 1) - low) / (high - low) * (shape - 1)
        cell = np.clip(cell, 0, shape - 1.001)
        i, j = cell.astype(int).T
        f, g = (cell % 1).T
        near = table[i, j] * (1 - g) + table[i, j + 1] * g
        return near * (1 - f) + (table[i + 1, j] * (1 - g) + table[i + 1, j + 1] * g) * f

    return _boxed(distance, loft)


def swept_distance(loft: Loft, parts: int = 12) -> Distance:
    """Signed distance to a tube, as a chain of cones with rounded joints (near enough for shadows)."""
    pick = np.linspace(0, len(loft.u) - 1, parts + 1).astype(int)
    ends, thick = loft.centres[pick], loft.radii[pick].mean(1)

    def distance(points: np.ndarray) -> np.ndarray:
        best = np.full(len(points), np.inf)
        for a, b, ra, rb in zip(ends[:-1], ends[1:], thick[:-1], thick[1:], strict=True):
            t = np.clip((points - a) @ (b - a) / max(np.sum((b - a) ** 2), 1e-12), 0, 1)
            gap = points - a - t[:, None] * (b - a)
            best = np.minimum(best, np.sqrt(np.einsum("ij,ij->i", gap, gap)) - (ra + (rb - ra) * t))
        return best

    return _boxed(distance, loft)


def _boxed(distance: Distance, loft: Loft) -> Distance:
    """The same distance, but far from the loft only the way to its bounding box, which is never too large."""
    reach = loft.radii.max(1, keepdims=True)
    low, high = (loft.centres - reach).min(0), (loft.centres + reach).max(0)

    def cheap(points: np.ndarray) -> np.ndarray:
        out = np.linalg.norm(points - np.clip(points, low, high), axis=1)
        near = out < MARGIN
        out[near] = distance(points[near])
        return out

    return cheap


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors along the last axis, to length 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def _lengths(line: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def _smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Box filter of odd width along the first axis, ends repeated."""
    padded = np.pad(values, ((width // 2, width // 2), (0, 0)), "edge")
    sums = np.cumsum(np.concatenate([np.zeros((1, values.shape[1])), padded]), axis=0)
    return (sums[width:] - sums[:-width]) / width


def _polygon_distance(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[N] signed distance to a body of revolution with the outline [M, 2], closed along the axis (where an edge is no
    surface); the sign is the even-odd rule."""
    best, inside = np.full(len(points), np.inf), np.zeros(len(points), bool)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if max(a[0], b[0]) < 1e-9:
            continue
        edge = b - a
        t = np.clip((points - a) @ edge / max(edge @ edge, 1e-18), 0, 1)
        best = np.minimum(best, np.sum((points - a - t[:, None] * edge) ** 2, 1))
        if a[1] != b[1]:
            crosses = (points[:, 1] < a[1]) != (points[:, 1] < b[1])
            inside ^= crosses & (points[:, 0] < a[0] + (points[:, 1] - a[1]) * edge[0] / edge[1])
    return np.where(inside, -1, 1) * np.sqrt(best)
