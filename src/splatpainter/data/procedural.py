"""Random composed objects for training without any files (the idea of LRM-Zero's Zeroverse, arXiv 2406.09371).

One to nine primitives with random axes and turns, some with bumpy sides, some cut open, some as wire frames, each with
a material of its own, and part of the faces given to a neighbour's material. Written from the idea alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpainter.data import patterns, shapes
from splatpainter.data.meshes import Mesh, normalized, repaired

PART_ODDS = (5, 5, 5, 4, 4, 3, 2, 1, 1)
"""Relative odds of 1 to 9 parts."""


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
    whole = shapes.joined(solids)
    materials = tuple(patterns.random_material(rng, textures) for _ in range(count))
    mesh = Mesh(
        f"procedural {seed}",
        whole.vertices.astype(np.float32),
        whole.faces,
        whole.normals.astype(np.float32),
        whole.uvs.astype(np.float32),
        _traded(ids, rng, odds.traded),
        materials,
    )
    return normalized(repaired(mesh))


def rotation(rng: np.random.Generator) -> np.ndarray:
    """[3, 3] a uniform random rotation (unit quaternion of four normals)."""
    w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


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
