"""In-plane splitting: a row becomes a lattice of smaller ones in its own plane, and the picture hardly changes.

Each row may be halved along its two axes that are longest in the edited view, again and again. A halved row is replaced
by five of half its width, on a lattice of spacing SPACING widths; lattices of successive halvings share their sites, so
what neighbours put on the same site becomes one row. Without that, every further halving would stack more rows on the
same place (measured: twice the rows for 2 dB less). Pure geometry: knows no pictures.

Alpha compositing is not additive, so the children's peaks come from a table fitted to the composited alpha
(scripts/fit_split_table.py).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.splats import Splats

SPACING = 1.75
"""Distance between the sites of a level / the width (standard deviation) of its rows."""
REACH = 2
"""A row that is halved puts children on 2 REACH + 1 sites of the next level."""
LEVELS = 12
"""Most halvings along one axis."""
_SITE = 1 << 15
"""Sites of a key run from -_SITE to _SITE."""


@lru_cache(maxsize=1)
def table() -> tuple[np.ndarray, np.ndarray]:
    """([O] parent peak alphas, ascending, [O, REACH + 1] peaks of the central child and of those 1, 2 sites away)."""
    data = json.loads(files("splatpainter.lift").joinpath("split_table.json").read_text(encoding="utf-8"))
    return np.array(data["opacities"]), np.array(data["peaks"])


def child_peaks(opacities: np.ndarray) -> np.ndarray:
    """[N] parent peak alphas -> [N, 2 REACH + 1] peaks of the children, in the order of their sites."""
    known, peaks = table()
    inner = np.clip(opacities, known[0], known[-1])
    half = np.stack([np.interp(inner, known, column) for column in peaks.T], 1)
    half *= np.minimum(opacities / inner, 1)[:, None]  # below the table alpha is additive
    return half[:, np.abs(np.arange(-REACH, REACH + 1))]


def merged_peak(total: np.ndarray) -> np.ndarray:
    """Peak of the one row that replaces several of the same shape at one site, with peaks of this sum A: A - A^2 / 10.

    By measurement: after three halvings of one row the integral of alpha over the plane is within 2 % of the parent's
    for peaks from 0.4 to 0.98 (rms error 4-6 %). Rows of one site alone would want A - A^2 / 4; but their neighbours
    overlap them, and with it opaque rows lose 13 % (rms 18 %)."""
    return np.minimum(total - np.minimum(total, 5) ** 2 / 10, 0.999)


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


@dataclass(frozen=True)
class Lattice:
    """S rows on the lattices of their owners, which are among the B rows of `base`; at level (0, 0) they are these."""

    base: Splats
    axes: np.ndarray
    """[B, 2] the two own axes (0..2) along which each owner may be halved, the longer first."""
    sizes: np.ndarray
    """[B, 2] their lengths in pixels."""
    owner: np.ndarray
    """[S] int64."""
    level: np.ndarray
    """[S, 2] int64 halvings along each axis."""
    site: np.ndarray
    """[S, 2] int64 lattice sites, 0 in the middle, in spacings of the level."""
    peak: np.ndarray
    """[S] float64 peak alphas."""
    slot: np.ndarray
    """[S] bool: one row of each owner, near its middle, that takes the owner's place in the file."""

    @staticmethod
    def of(base: Splats, camera: Camera) -> Lattice:
        """Nothing halved yet."""
        sizes = projected_sizes(base, camera)
        axes = np.argsort(-sizes, 1)[:, :2]
        n, nothing = len(base), np.zeros((len(base), 2), np.int64)
        return Lattice(
            base,
            axes,
            np.take_along_axis(sizes, axes, 1),
            np.arange(n),
            nothing,
            nothing,
            base.opacities.astype(np.float64),
            np.ones(n, bool),
        )

    def __len__(self) -> int:
        return len(self.owner)

    @property
    def widths(self) -> np.ndarray:
        """[S, 2] standard deviations along the two axes, in pixels."""
        return self.sizes[self.owner] * 0.5**self.level

    def splats(self) -> Splats:
        """The S rows. Those that were never halved have their owner's bits."""
        out = self.base.take(self.owner)
        rows = np.flatnonzero(self.level.any(1))
        if not len(rows):
            return out
        owner, n = self.owner[rows], np.arange(len(rows))
        turn = rotations(self.base.quats[owner])
        means, scales, opacities = out.means.copy(), out.scales.copy(), out.opacities.copy()
        part, place = scales[rows], means[rows].astype(np.float64)
        for k in range(2):
            axis = self.axes[owner, k]
            width = self.base.scales[owner, axis] * 0.5 ** self.level[rows, k]
            place += (SPACING * width * self.site[rows, k])[:, None] * turn[n, :, axis]
            part[n, axis] = width
        means[rows], scales[rows] = place, part
        opacities[rows] = self.peak[rows]
        return replace(out, means=means, scales=scales, opacities=opacities)

    def halved(self, rows: np.ndarray, goal: float) -> tuple[Lattice, np.ndarray]:
        """Halve the given rows ([S] bool) along each axis on which they are wider than `goal` pixels.
        Returns the new lattice and [S'] an old row that each new one came from."""
        new, source = self, np.arange(len(self))
        for k in range(2):
            wide = rows[source] & (new.widths[:, k] > goal) & (new.level[:, k] < LEVELS)
            new, index = new._halved_along(np.flatnonzero(wide), k)
            source = source[index]
        return new, source

    def _halved_along(self, rows: np.ndarray, k: int) -> tuple[Lattice, np.ndarray]:
        if not len(rows):
            return self, np.arange(len(self))
        count = 2 * REACH + 1
        kept = np.setdiff1d(np.arange(len(self)), rows)
        source = np.concatenate([kept, np.repeat(rows, count)])
        level, site = self.level[source], self.site[source]
        step = np.tile(np.arange(-REACH, REACH + 1), len(rows))
        level[len(kept) :, k] += 1
        site[len(kept) :, k] = 2 * site[len(kept) :, k] + step
        peak = np.concatenate([self.peak[kept], child_peaks(self.peak[rows]).ravel()])
        slot = self.slot[source]
        slot[len(kept) :] &= step == 0
        return _merged(replace(self, owner=self.owner[source], level=level, site=site, peak=peak, slot=slot), source)


def _merged(lattice: Lattice, source: np.ndarray) -> tuple[Lattice, np.ndarray]:
    """One row per (owner, level, site); of several the first one's source is kept."""
    key = lattice.owner
    for level, site in zip(lattice.level.T, lattice.site.T, strict=True):
        key = (key * (LEVELS + 1) + level) * 2 * _SITE + (site + _SITE)
    _, first, index, number = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    total = np.bincount(index, lattice.peak)
    slot = np.zeros(len(first), bool)
    slot[index[lattice.slot]] = True
    return replace(
        lattice,
        owner=lattice.owner[first],
        level=lattice.level[first],
        site=lattice.site[first],
        peak=np.where(number > 1, merged_peak(total), lattice.peak[first]),
        slot=slot,
    ), source[first]
