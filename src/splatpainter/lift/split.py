"""In-plane splitting: k smaller rows in a line along a row's own axis replace it and hardly change the picture.

Pure geometry: knows no pictures. Alpha compositing is not additive, so peaks, spacing and widths of the children come
from a table fitted to the composited alpha (scripts/fit_split_table.py).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.splats import Splats

MAX_CHILDREN = 8
"""Most children along one axis at one level."""


@dataclass(frozen=True)
class Line:
    """Children of a unit Gaussian along one axis, for one count k, by parent opacity."""

    width: float
    """Child standard deviation along the axis / the parent's."""
    opacities: np.ndarray
    """[O] parent peak alphas of the table, ascending."""
    spacing: np.ndarray
    """[O] distance between children / the parent's standard deviation."""
    across: np.ndarray
    """[O] child standard deviation along the other axes / the parent's (slightly below 1)."""
    peaks: np.ndarray
    """[O, k] child peak alphas."""


@lru_cache(maxsize=1)
def lines() -> dict[int, Line]:
    """{k: Line} for k = 2..MAX_CHILDREN."""
    data = json.loads(files("splatpainter.lift").joinpath("split_table.json").read_text())
    opacities = np.array(data["opacities"])
    out = {}
    for k, entry in data["counts"].items():
        rows = np.array(entry["rows"])
        out[int(k)] = Line(entry["width"], opacities, rows[:, 0], rows[:, 1], rows[:, 2:])
    return out


def rotations(quats: np.ndarray) -> np.ndarray:
    """[N, 4] w, x, y, z of any norm -> [N, 3, 3] rotation matrices, whose columns are the row's own axes."""
    w, x, y, z = (quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)).T
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(entries, 1).reshape(-1, 3, 3)


def projected_sizes(splats: Splats, camera: Camera) -> np.ndarray:
    """[N, 3] length in pixels of one standard deviation along each own axis, seen from the camera (without the
    renderer's 0.3 px^2 blur)."""
    turn = camera.world_to_camera[:3, :3].astype(np.float32)
    x, y, z = (splats.means @ turn.T + camera.world_to_camera[:3, 3].astype(np.float32)).T
    z = np.maximum(z, 1e-6)
    axes = np.einsum("ij,njk->nik", turn, rotations(splats.quats)) * splats.scales[:, None, :]  # [N, camera xyz, axis]
    u = camera.fx * (axes[:, 0] - (x / z)[:, None] * axes[:, 2]) / z[:, None]
    v = camera.fy * (axes[:, 1] - (y / z)[:, None] * axes[:, 2]) / z[:, None]
    return np.hypot(u, v)


def counts(sizes: np.ndarray, goal: float) -> np.ndarray:
    """[N] ints: fewest children (1..MAX_CHILDREN) whose width is at most `goal`, for parents of these sizes."""
    widths = np.array([1.0] + [lines()[k].width for k in range(2, MAX_CHILDREN + 1)])
    fits = sizes[:, None] * widths <= goal * 1.1
    return np.where(fits.any(1), fits.argmax(1) + 1, MAX_CHILDREN)


def split_axis(splats: Splats, axis: np.ndarray, k: np.ndarray) -> tuple[Splats, np.ndarray]:
    """Split every row into k [N] children (1: stays) along its own axis [N] (0..2).
    Returns the children, each parent's together and central child first, and [M] the parent's index of each."""
    parts: list[Splats] = []
    parents: list[np.ndarray] = []
    turn = rotations(splats.quats)
    for count in np.unique(k):
        rows = np.flatnonzero(k == count)
        some = splats.take(rows)
        if count == 1:
            parts.append(some)
            parents.append(rows)
            continue
        line = lines()[int(count)]
        known = np.clip(some.opacities, line.opacities[0], line.opacities[-1])
        spacing = np.interp(known, line.opacities, line.spacing)
        across = np.interp(known, line.opacities, line.across)
        peaks = np.stack([np.interp(known, line.opacities, line.peaks[:, j]) for j in range(count)], 1)
        peaks *= (some.opacities / known)[:, None]  # below the table's range alpha is additive
        steps = np.arange(count) - (count - 1) / 2
        middle_first = np.argsort(np.abs(steps), kind="stable")
        steps, peaks = steps[middle_first], peaks[:, middle_first]
        n, chosen = len(rows), axis[rows]
        along = turn[rows][np.arange(n), :, chosen] * some.scales[np.arange(n), chosen, None]  # [n, 3]
        means = some.means[:, None] + (spacing[:, None] * steps)[..., None] * along[:, None]
        scales = np.repeat(some.scales[:, None] * across[:, None, None], count, 1)
        scales[np.arange(n), :, chosen] = (some.scales[np.arange(n), chosen] * line.width)[:, None]
        spread = some.take(np.repeat(np.arange(n), count))
        kind = some.means.dtype
        parts.append(
            replace(
                spread,
                means=means.reshape(-1, 3).astype(kind),
                scales=scales.reshape(-1, 3).astype(kind),
                opacities=peaks.reshape(-1).astype(kind),
            )
        )
        parents.append(np.repeat(rows, count))
    joined = parts[0]
    for part in parts[1:]:
        joined = joined.append(part)
    index = np.concatenate(parents)
    order = np.argsort(index, kind="stable")
    return joined.take(order), index[order]


def split(splats: Splats, camera: Camera, goal: float) -> tuple[Splats, np.ndarray]:
    """Split rows along their two longest projected axes until children are about `goal` pixels wide (one standard
    deviation), or MAX_CHILDREN per axis. Returns as `split_axis`; the first child of each parent is the central one."""
    parents = np.arange(len(splats))
    for _ in range(2):
        sizes = projected_sizes(splats, camera)
        splats, index = split_axis(splats, sizes.argmax(1), counts(sizes.max(1), goal))
        parents = parents[index]
    return splats, parents
