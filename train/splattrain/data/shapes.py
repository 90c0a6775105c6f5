"""Primitives of procedural objects as fine triangle grids, and what can be done to them: bumps, cuts, wire frames.

A solid is a closed set of patches; each patch is a grid over u, v in 0..1 with its own UVs, outside up. Sizes in the
solid's own units: it fills -1..1 before it is scaled. Pure numpy; knows no materials.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

Distance = Callable[[np.ndarray], np.ndarray]
"""Points [N, 3] -> [N] signed distance, negative inside."""
PRIMITIVES = ("box", "ellipsoid", "cylinder", "cone", "torus")
CELLS_PER_SIDE = 36
"""Cells along a patch's longer side."""


@dataclass(frozen=True)
class Solid:
    """Triangles with corners of their own where normals or UVs break."""

    vertices: np.ndarray
    """[V, 3] float64."""
    faces: np.ndarray
    """[F, 3] int64, outside counter-clockwise."""
    uvs: np.ndarray
    """[V, 2]."""
    normals: np.ndarray
    """[V, 3] unit."""

    def moved(self, matrix: np.ndarray, shift: np.ndarray) -> Solid:
        """matrix [3, 3] (det > 0) times the vertices, plus shift [3]."""
        normals = self.normals @ np.linalg.inv(matrix)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return Solid(self.vertices @ matrix.T + shift, self.faces, self.uvs, normals)


def joined(solids: list[Solid]) -> Solid:
    starts = np.cumsum([0, *(len(s.vertices) for s in solids)])
    return Solid(
        np.concatenate([s.vertices for s in solids]),
        np.concatenate([s.faces + start for s, start in zip(solids, starts, strict=False)]),
        np.concatenate([s.uvs for s in solids]),
        np.concatenate([s.normals for s in solids]),
    )


def primitive(kind: str, rng: np.random.Generator, bumpy: bool = False) -> Solid:
    """A primitive within -1..1. bumpy: every patch is raised and sunk by a smooth random height field that is 0 at its
    border, so that the solid stays closed."""
    patches = {"box": _box, "ellipsoid": _ball, "cylinder": _cylinder, "cone": _cone, "torus": _torus}[kind](rng)
    return joined([_solid(points, uvs, rng, bumpy) for points, uvs in patches])


Patch = tuple[np.ndarray, tuple[float, float]]
"""(points [a + 1, b + 1, 3], how often the texture repeats along the two directions)."""


def _mesh(cells_a: int, cells_b: int) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.linspace(0, 1, cells_a + 1), np.linspace(0, 1, cells_b + 1)
    first, second = np.meshgrid(a, b, indexing="ij")
    return first, second


def _box(rng: np.random.Generator) -> list[Patch]:
    a, b = _mesh(CELLS_PER_SIDE // 2, CELLS_PER_SIDE // 2)
    s, t = 2 * a - 1, 2 * b - 1
    one = np.ones_like(s)
    out = []
    for axis in range(3):
        for side in (1.0, -1.0):
            face = [one, one, one]
            face[axis] = side * one
            face[(axis + 1) % 3], face[(axis + 2) % 3] = (s, t) if side > 0 else (t, s)
            out.append((np.stack(face, -1), (1.0, 1.0)))
    return out


def _ball(rng: np.random.Generator) -> list[Patch]:
    a, b = _mesh(CELLS_PER_SIDE, CELLS_PER_SIDE // 2)
    around, down = 2 * np.pi * a, np.pi * b
    points = [np.sin(down) * np.sin(around), np.cos(down), np.sin(down) * np.cos(around)]
    return [(np.stack(points, -1)[::-1], (2.0, 1.0))]


def _disk(y: float, radius: float, up: bool) -> Patch:
    a, b = _mesh(CELLS_PER_SIDE, 6)
    around, r = 2 * np.pi * a, radius * b
    points = np.stack([r * np.sin(around), np.full_like(r, y), r * np.cos(around)], -1)
    return (points if not up else points[::-1]), (1.0, 1.0)


def _cylinder(rng: np.random.Generator) -> list[Patch]:
    taper = rng.uniform(0.6, 1.0) if rng.random() < 0.3 else 1.0
    a, b = _mesh(CELLS_PER_SIDE, CELLS_PER_SIDE // 3)
    around, y = 2 * np.pi * a, 2 * b - 1
    radius = 1 + (taper - 1) * b
    side = np.stack([radius * np.sin(around), y, radius * np.cos(around)], -1)
    return [(side, (3.0, 1.0)), _disk(1, taper, True), _disk(-1, 1, False)]


def _cone(rng: np.random.Generator) -> list[Patch]:
    a, b = _mesh(CELLS_PER_SIDE, CELLS_PER_SIDE // 3)
    around, y = 2 * np.pi * a, 2 * b - 1
    radius = 1 - 0.995 * b
    side = np.stack([radius * np.sin(around), y, radius * np.cos(around)], -1)
    return [(side, (3.0, 1.0)), _disk(-1, 1, False)]


def _torus(rng: np.random.Generator) -> list[Patch]:
    thick = rng.uniform(0.15, 0.45)
    a, b = _mesh(CELLS_PER_SIDE, CELLS_PER_SIDE // 2)
    around, about = 2 * np.pi * a, 2 * np.pi * b
    ring = (1 - thick) + thick * np.cos(about)
    points = np.stack([ring * np.sin(around), thick * np.sin(about), ring * np.cos(around)], -1)
    return [(points, (4.0, 1.0))]


def _solid(points: np.ndarray, repeats: tuple[float, float], rng: np.random.Generator, bumpy: bool) -> Solid:
    """Triangles, UVs and smooth normals of one patch; degenerate triangles (poles, tips) are dropped."""
    if bumpy:
        normal = _grid_normals(points)
        amount = rng.uniform(0.05, 0.25)
        points = points + (amount * _heights(points.shape[:2], rng))[..., None] * normal
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    u, v = np.meshgrid(np.linspace(0, repeats[0], rows), np.linspace(0, repeats[1], columns), indexing="ij")
    flat = points.reshape(-1, 3)
    cross = np.cross(flat[faces[:, 1]] - flat[faces[:, 0]], flat[faces[:, 2]] - flat[faces[:, 0]])
    faces = faces[np.linalg.norm(cross, axis=1) > 1e-9]
    return Solid(flat, faces, np.stack([u.ravel(), v.ravel()], 1), _grid_normals(points).reshape(-1, 3))


def _grid_normals(points: np.ndarray) -> np.ndarray:
    """[a, b, 3] unit normals of a grid by differences; across a seam or a pole both ends agree."""
    first, second = np.gradient(points, axis=0), np.gradient(points, axis=1)
    for along, axis in ((first, 0), (second, 1)):  # a closed direction: difference across the seam
        ends = np.moveaxis(points, axis, 0)
        if np.allclose(ends[0], ends[-1], atol=1e-9):
            grown = np.moveaxis(along, axis, 0)
            grown[0] = grown[-1] = (ends[1] - ends[-2]) / 2
    normal = np.cross(first, second)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    # A pole: the normal of the ring next to it, on average.
    for column, inner in ((0, 1), (-1, -2)):
        if (length[:, column] < 1e-9).all():
            normal[:, column] = normal[:, inner].mean(0)
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def _heights(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """[a, b] about -1..1: a random 5 x 5 grid, cubic in between, 0 on the border."""
    knots = np.zeros((7, 7))
    knots[1:-1, 1:-1] = rng.uniform(-1, 1, (5, 5))
    along = [_cubic(7, size) for size in shape]
    field = along[0] @ knots @ along[1].T
    rim = [np.minimum(1, 6 * np.minimum(t, 1 - t)) for t in (np.linspace(0, 1, size) for size in shape)]
    return field * rim[0][:, None] * rim[1][None]


def _cubic(knots: int, size: int) -> np.ndarray:
    """[size, knots] Catmull-Rom weights of evenly spaced knots, ends repeated."""
    t = np.linspace(0, knots - 1, size)
    base = np.minimum(t.astype(int), knots - 2)
    f = t - base
    weights = [-0.5 * f + f**2 - 0.5 * f**3, 1 - 2.5 * f**2 + 1.5 * f**3, 0.5 * f + 2 * f**2 - 1.5 * f**3]
    weights.append(-0.5 * f**2 + 0.5 * f**3)
    out = np.zeros((size, knots))
    for k, weight in enumerate(weights):
        np.add.at(out, (np.arange(size), np.clip(base + k - 1, 0, knots - 1)), weight)
    return out


def distance(kind: str) -> Distance:
    """Signed distance (exact or a bound) of a primitive of size 1, for cuts."""

    def box(p: np.ndarray) -> np.ndarray:
        q = np.abs(p) - 1
        return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)

    def ellipsoid(p: np.ndarray) -> np.ndarray:
        return np.linalg.norm(p, axis=1) - 1

    def cylinder(p: np.ndarray) -> np.ndarray:
        return np.maximum(np.hypot(p[:, 0], p[:, 2]) - 1, np.abs(p[:, 1]) - 1)

    def cone(p: np.ndarray) -> np.ndarray:
        slope = (2 * np.hypot(p[:, 0], p[:, 2]) + p[:, 1] - 1) / np.sqrt(5)
        return np.maximum(slope, -1 - p[:, 1])

    def torus(p: np.ndarray) -> np.ndarray:
        return np.hypot(np.hypot(p[:, 0], p[:, 2]) - 0.7, p[:, 1]) - 0.3

    return {"box": box, "ellipsoid": ellipsoid, "cylinder": cylinder, "cone": cone, "torus": torus}[kind]


def cut(solid: Solid, cutter: Distance, wall: float) -> Solid:
    """The solid as a shell of thickness `wall` without what lies inside the cutter: the outside clipped exactly at the
    cutter's surface, the same surface again further in and turned over, and a rim that joins the two."""
    value = cutter(solid.vertices)
    if (value > 0).all() or (value <= 0).all():
        return solid
    outer, rim = _clipped(solid, value)
    inner = Solid(outer.vertices - wall * outer.normals, outer.faces[:, ::-1], outer.uvs, -outer.normals)
    parts = [outer, inner]
    if len(rim):
        start, end = rim.T
        corners = [outer.vertices[start], outer.vertices[end], inner.vertices[end], inner.vertices[start]]
        points = np.concatenate(corners)
        a, b, c, d = np.arange(4 * len(rim)).reshape(4, -1)
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        uvs = np.concatenate([outer.uvs[start], outer.uvs[end], outer.uvs[end] + wall, outer.uvs[start] + wall])
        parts.append(Solid(points, faces[:, ::-1], uvs, np.tile(-normal, (4, 1))))
    return joined(parts)


def _clipped(solid: Solid, value: np.ndarray) -> tuple[Solid, np.ndarray]:
    """(what has value > 0, [R, 2] edges of the cut by vertex index). Triangles across the border are cut along the
    straight line where the value, linear on each edge, is 0."""
    inside = value[solid.faces] > 0
    count = inside.sum(1)
    complete = solid.faces[count == 3]
    # Turn each mixed triangle so that its odd corner comes first.
    mixed = solid.faces[(count == 1) | (count == 2)]
    keeps = inside[(count == 1) | (count == 2)]
    odd = np.where(keeps.sum(1) == 1, keeps.argmax(1), keeps.argmin(1))
    order = (odd[:, None] + np.arange(3)) % 3
    mixed, alone = np.take_along_axis(mixed, order, 1), keeps.sum(1) == 1
    p, q, r = mixed.T
    at = len(solid.vertices) + np.arange(2 * len(mixed))
    first, second = at[: len(mixed)], at[len(mixed) :]  # on the edges p-q and p-r
    ends = np.concatenate([np.stack([p, q], 1), np.stack([p, r], 1)])
    t = (value[ends[:, 0]] / (value[ends[:, 0]] - value[ends[:, 1]]))[:, None]

    def between(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[ends[:, 0]] * (1 - t) + values[ends[:, 1]] * t])

    lone = np.stack([p, first, second], 1)[alone]
    pair = ~alone
    quads = [np.stack([first, q, r], 1)[pair], np.stack([first, r, second], 1)[pair]]
    # The cut edge runs as the kept side's border does: with the outside to the left.
    rim = np.concatenate([np.stack([first, second], 1)[alone], np.stack([second, first], 1)[pair]])
    normals = between(solid.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    faces = np.concatenate([complete, lone, *quads])
    return Solid(between(solid.vertices), faces, between(solid.uvs), normals), rim


def wires(kind: str, thickness: float) -> Solid:
    """A wire frame of a primitive: thin six-sided bars along the lines of a coarse grid on it."""
    coarse = {"box": _box, "ellipsoid": _ball, "cylinder": _cylinder, "cone": _cone, "torus": _torus}[kind]
    edges = []
    for points, _ in coarse(np.random.default_rng(0)):
        rows, columns = points.shape[:2]
        step = [max((size - 1) // 4, 1) for size in (rows, columns)]
        lines = [points[k] for k in range(0, rows, step[0])] + [points[:, k] for k in range(0, columns, step[1])]
        for line in lines:
            thin = line[:: max((len(line) - 1) // 12, 1)]
            edges.append(np.stack([thin[:-1], thin[1:]], 1))
    bars = np.concatenate(edges)
    length = np.linalg.norm(bars[:, 1] - bars[:, 0], axis=1)
    bars, length = bars[length > 1e-6], length[length > 1e-6]
    keys = np.round(np.sort(np.linalg.norm(bars - 0.123, axis=2), 1), 5)
    _, unique = np.unique(np.concatenate([keys, np.round(bars.mean(1), 5)], 1), axis=0, return_index=True)
    bars, length = bars[unique], length[unique]
    along = (bars[:, 1] - bars[:, 0]) / length[:, None]
    helper = np.where(np.abs(along[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    side = np.cross(along, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    turn = np.linspace(0, 2 * np.pi, 7)
    ring = np.cos(turn)[None, :, None] * side[:, None] + np.sin(turn)[None, :, None] * other[:, None]  # [E, 7, 3]
    low = bars[:, :1] + thickness * ring - 0.3 * thickness * along[:, None]
    high = bars[:, 1:] + thickness * ring + 0.3 * thickness * along[:, None]
    vertices = np.stack([low, high], 2)  # [E, 7, 2, 3]
    index = np.arange(len(bars) * 14).reshape(len(bars), 7, 2)
    a, b, c, d = (part.ravel() for part in (index[:, :-1, 0], index[:, 1:, 0], index[:, 1:, 1], index[:, :-1, 1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    uvs = np.broadcast_to(np.stack(np.meshgrid(turn / 6, [0.0, 1.0], indexing="ij"), -1), (len(bars), 7, 2, 2))
    normals = np.broadcast_to(ring[:, :, None], vertices.shape)
    return Solid(vertices.reshape(-1, 3), faces, uvs.reshape(-1, 2), normals.reshape(-1, 3).copy())
