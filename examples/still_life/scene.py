"""The still life: which things stand where, turned into Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from examples.still_life import light, outlines, paint
from examples.still_life.noise import value_noise
from examples.still_life.shapes import (
    Distance,
    Loft,
    lattice,
    quarter,
    revolve,
    revolved_distance,
    scatter,
    sweep,
    swept_distance,
    unit,
)

SPREAD = 0.72
"""Standard deviation over spacing: wide enough to close the surface, narrow enough to keep the brushwork crisp."""

Material: TypeAlias = Callable[[Loft, np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(loft, points [N, 3], u [N], v [N]) -> (albedo [N, 3] display sRGB, gloss [N] 0..1)."""


@dataclass(frozen=True)
class SurfaceSamples:
    """Surface samples before lighting, all float64."""

    points: np.ndarray
    """[N, 3]"""
    normals: np.ndarray
    """[N, 3] outwards."""
    tangents: np.ndarray
    """[N, 3] unit, along the first size."""
    sizes: np.ndarray
    """[N, 2] standard deviations along the tangent and across it, world units."""
    albedo: np.ndarray
    """[N, 3] display sRGB."""
    gloss: np.ndarray
    """[N] 0..1."""

    def keep(self, mask: np.ndarray) -> SurfaceSamples:
        return SurfaceSamples(*(getattr(self, name)[mask] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Thing:
    """One object of the scene."""

    loft: Loft
    material: Material
    distance: Distance | None
    """In the loft's own axes; None for an open sheet, which has no inside and casts no shadow."""
    spacing: float
    """World units between Gaussians where nothing is painted."""
    turn: np.ndarray
    """[3, 3] own axes -> world."""
    move: np.ndarray
    """[3] own origin in the world."""
    split: float = 0.09
    """Albedo range within a Gaussian's cell above which the Gaussian is made of four smaller ones."""

    def signed(self, points: np.ndarray) -> np.ndarray:
        """[N] signed distance of world points to a solid thing."""
        assert self.distance is not None
        return self.distance((points - self.move) @ self.turn)


def turned(axis: int, degrees: float) -> np.ndarray:
    """[3, 3] rotation about a world axis (0 x, 1 y, 2 z)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = [k for k in range(3) if k != axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = (-s, s) if axis != 1 else (s, -s)
    return matrix


def things() -> list[Thing]:
    """Pot, spout, handle, tea bowl, tea and lemon, standing on y = 0."""
    pot, bowl, lemon = revolve(outlines.POT, 900), revolve(outlines.BOWL), revolve(outlines.LEMON, 300)
    spout, handle = sweep(outlines.SPOUT, 0.92, 0.014), sweep(outlines.HANDLE, 1.35)
    tea = revolve(outlines.TEA, 100)
    still, pot_at, bowl_at = np.eye(3), np.array([0.0, 0.0, -0.14]), np.array([-0.45, 0.0, 0.50])
    lying = turned(1, 28) @ turned(2, -86)
    return [
        Thing(pot, paint.teapot, revolved_distance(pot), 0.0124, still, pot_at),
        Thing(spout, paint.spout, swept_distance(spout), 0.0112, still, pot_at),
        Thing(handle, paint.handle, swept_distance(handle), 0.0112, still, pot_at),
        Thing(bowl, paint.cup, revolved_distance(bowl), 0.0118, turned(1, 40), bowl_at),
        Thing(tea, paint.tea, None, 0.0140, still, bowl_at),
        Thing(lemon, paint.lemon, revolved_distance(lemon), 0.0105, lying, np.array([0.53, 0.164, 0.44]), 0.2),
    ]


def sample(thing: Thing, rng: np.random.Generator) -> SurfaceSamples:
    """Gaussians of one object: an even lattice, quartered where the pattern is finer than its cells."""
    loft = thing.loft
    u, v, size = scatter(loft, lambda at: np.full(len(at), thing.spacing), rng)
    u4, v4, size4 = quarter(loft, u, v, size)
    colours = _looks(thing, u4, v4)
    # Looked at a little beyond the cell too: a wide Gaussian beside an edge would otherwise fray it.
    around = _looks(thing, *quarter(loft, u, v, size, 1.0)[:2])
    busy = np.ptp(np.concatenate([colours, around], 1)[..., :3].mean(2), axis=1) > thing.split
    again = np.repeat(busy, 4)
    # Each Gaussian shows the mean over its cell, so that the edge of a mark is smooth however it crosses the Gaussians.
    fine = _looks(thing, *quarter(loft, u4[again], v4[again], size4[again])[:2])
    looks = np.concatenate([colours[~busy], fine]).mean(1)
    u, v, size = (np.concatenate([a[~busy], b[again]]) for a, b in ((u, u4), (v, v4), (size, size4)))
    points, normals, tangents = loft.frames(u, v)
    albedo, gloss = looks[:, :3], looks[:, 3]
    tangents, stretch = _along_edges(normals, tangents, np.concatenate([colours[~busy], fine])[..., :3].mean(2))
    sizes = SPREAD * size[:, None] * stretch
    points = points @ thing.turn.T + thing.move
    return SurfaceSamples(points, normals @ thing.turn.T, tangents @ thing.turn.T, sizes, albedo, gloss)


def _along_edges(normals: np.ndarray, tangents: np.ndarray, luma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(tangents [N, 3], stretch [N, 2]): Gaussians on an edge of the pattern turned to lie along it, narrower across
    it, as brush strokes would. luma: [N, 4] brightness at the quarters of the Gaussian's cell, in the order of
    shapes.quarter."""
    along = luma[:, 2] + luma[:, 3] - luma[:, 0] - luma[:, 1]
    around = luma[:, 1] + luma[:, 3] - luma[:, 0] - luma[:, 2]
    steep = np.hypot(along, around)
    angle = np.where(steep < 1e-3, 0.0, np.arctan2(around, along))[:, None]
    longer = 1 + 0.30 * np.clip(steep / 0.25, 0, 1)
    across = np.cos(angle) * tangents + np.sin(angle) * np.cross(tangents, normals)
    return across, np.stack([1 / longer, longer], 1)


def _looks(thing: Thing, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[N / 4, 4, 4] albedo and gloss of Gaussians that come in fours."""
    albedo, gloss = thing.material(thing.loft, thing.loft.points(u, v), u, v)
    return np.concatenate([albedo, gloss[:, None]], 1).reshape(-1, 4, 4)


def board(rng: np.random.Generator) -> SurfaceSamples:
    """Gaussians of the round board whose top is y = 0: Gaussians of the top lie along the grain."""
    steps, wide = (0.0215, 0.0088), 2 * outlines.BOARD_RADIUS
    flat = lattice(wide, wide, steps)
    flat = flat[np.hypot(flat[:, 0], flat[:, 1]) < outlines.BOARD_RADIUS - 2.1 * outlines.BEVEL]
    flat = flat + rng.uniform(-0.1, 0.1, flat.shape) * steps
    points = np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], 1)
    up, along = (np.broadcast_to(axis, points.shape) for axis in ([0.0, 1, 0], [1.0, 0, 0]))
    sizes = np.broadcast_to(SPREAD * np.array(steps), flat.shape)
    top = SurfaceSamples(points, up, along, sizes, *paint.wood(points))
    rim = revolve(outlines.board_rim(), 600)
    under = outlines.BOARD_RADIUS - 0.07  # u is the radius there; nobody looks closely
    u, v, size = scatter(rim, lambda at: np.where(at < under, 0.030, 0.0120), rng)
    points, normals, tangents = rim.frames(u, v)
    edge = SurfaceSamples(points, normals, tangents, np.repeat(SPREAD * size[:, None], 2, 1), *paint.wood(points))
    return _joined([top, edge])


def board_distance(points: np.ndarray) -> np.ndarray:
    """[N] signed distance to the board."""
    half = outlines.BOARD_HEIGHT / 2
    out = np.hypot(points[:, 0], points[:, 2]) - outlines.BOARD_RADIUS
    up = np.abs(points[:, 1] + half) - half
    return np.minimum(np.maximum(out, up), 0) + np.hypot(np.maximum(out, 0), np.maximum(up, 0))


def still_life(rng: np.random.Generator) -> tuple[SurfaceSamples, np.ndarray]:
    """(samples, sh [N, 16, 3]): every visible Gaussian of the scene, lit."""
    objects = things()
    parts = [(thing, sample(thing, rng)) for thing in objects] + [(None, board(rng))]
    solid = [thing for thing in objects if thing.distance is not None]
    visible = []
    for owner, part in parts:  # what is inside another object is never seen
        depth = np.min([thing.signed(part.points) for thing in solid if thing is not owner], 0)
        visible.append(part.keep(depth > -0.012))
    gaussians = _joined(visible)

    def nearest(points: np.ndarray) -> np.ndarray:
        return np.min([board_distance(points), *(thing.signed(points) for thing in solid)], 0)

    field = light.Field.sample(nearest, np.array([-1.2, -0.2, -1.2]), np.array([1.2, 1.15, 1.2]), 0.028)
    return gaussians, lit(gaussians, field)


def lit(gaussians: SurfaceSamples, field: light.Field) -> np.ndarray:
    """[N, 16, 3] SH of the Gaussians under the studio's light."""
    points, normals = gaussians.points.astype(np.float32), gaussians.normals.astype(np.float32)
    sky, openness = light.ambient(field, points, normals)
    seen = light.shadow(field, points, normals, light.KEY, 5.0)
    key = np.clip((normals @ light.KEY + 0.10) / 1.10, 0, 1) * seen
    diffuse = light.linear(gaussians.albedo) * (key[:, None] * light.KEY_COLOUR * 0.42 + 0.70 * sky)
    wobble = np.stack([value_noise(gaussians.points * [9, 30, 9] + k, 7 + k) for k in range(3)], 1)
    mirror = unit(gaussians.normals + 0.018 * wobble).astype(np.float32)
    return light.fit_sh(mirror, diffuse.astype(np.float32), gaussians.gloss.astype(np.float32), openness)


def _joined(parts: list[SurfaceSamples]) -> SurfaceSamples:
    return SurfaceSamples(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in SurfaceSamples.__dataclass_fields__)
    )
