"""In-plane splitting: a Gaussian becomes a lattice of smaller ones in its plane, and the picture hardly changes.

Each Gaussian may be halved along its two axes that are longest in the edited view, again and again. A halved one is
replaced by five of half its width, on a lattice of spacing SPACING widths; lattices of successive halvings share their
sites, so what neighbours put on the same site becomes one. Without that, every further halving would stack more of them
on one site (measured: twice the Gaussians for 2 dB less). Pure geometry: knows no pictures.

Alpha compositing is not additive, so the children's peaks come from a table fitted to the composited alpha
(scripts/calibrate/split_table.py).
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from importlib.resources import files

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels import portable
from splatpainter.kernels.rows import take
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix, turned

SPACING = 1.75
"""Distance between the sites of a level / the width (standard deviation) of its Gaussians."""
CHILD_REACH_SITES = 2
"""A Gaussian that is halved puts children on 2 CHILD_REACH_SITES + 1 sites of the next level."""
MAX_LEVEL = 12
"""Halvings along one axis."""
_MAX_SITE = 1 << 15
"""Sites of a key run from -_MAX_SITE to _MAX_SITE."""


@lru_cache(maxsize=1)
def table() -> tuple[np.ndarray, np.ndarray]:
    """([O] parent peak alphas, ascending, [O, CHILD_REACH_SITES + 1] peaks of the central child and of those 1, 2 sites
    away)."""
    data = json.loads(files("splatpainter.lift.local").joinpath("split_table.json").read_text(encoding="utf-8"))
    return np.array(data["opacities"]), np.array(data["peaks"])


def child_peaks(opacities: np.ndarray) -> np.ndarray:
    """[N] parent peak alphas -> [N, 2 CHILD_REACH_SITES + 1] peaks of the children, in the order of their sites."""
    parents, peaks = table()
    # The table ends where alpha is as good as additive (below) or opaque (above).
    inner = np.clip(opacities, parents[0], parents[-1])
    half = np.stack([portable.interp(inner, parents, column) for column in peaks.T], 1)
    half *= np.minimum(opacities / inner, 1)[:, None]  # below the table alpha is additive
    return half[:, np.abs(np.arange(-CHILD_REACH_SITES, CHILD_REACH_SITES + 1))]


def merged_peak(total: np.ndarray) -> np.ndarray:
    """Peak of the Gaussian that replaces several of the same shape at one site, with peaks of this sum A: A - A^2 / 10.

    By measurement: after three halvings of one the integral of alpha over the plane is within 2 % of the parent's
    for peaks from 0.4 to 0.98 (rms error 4-6 %). Those of one site alone would want A - A^2 / 4; but their neighbours
    overlap them, and with it opaque ones lose 13 % (rms 18 %)."""
    return np.minimum(total - np.minimum(total, 5) ** 2 / 10, 0.999)


def projected_sizes(splats: Splats, camera: Camera) -> np.ndarray:
    """[N, 3] length in pixels of one standard deviation along each axis, seen from the camera (without the
    renderer's 0.3 px^2 blur)."""
    turn = camera.world_to_camera[:3, :3].astype(np.float32)
    x, y, z = (portable.matmul(splats.means, turn.T) + camera.world_to_camera[:3, 3].astype(np.float32)).T
    z = np.maximum(z, 1e-6)
    axes = turned(turn, quat_to_matrix(splats.quats)) * splats.scales[:, None, :]  # [N, camera xyz, axis]
    u = camera.fx * (axes[:, 0] - (x / z)[:, None] * axes[:, 2]) / z[:, None]
    v = camera.fy * (axes[:, 1] - (y / z)[:, None] * axes[:, 2]) / z[:, None]
    return portable.hypot(u, v)


@dataclass(frozen=True)
class Lattice:
    """S Gaussians on the lattices of their parents, the B Gaussians of `base`; at level (0, 0) they are these."""

    base: Splats
    axes: np.ndarray
    """[B, 2] the two axes (0..2) along which each parent may be halved, the longer first."""
    sizes: np.ndarray
    """[B, 2] their lengths in pixels."""
    parent: Ids
    """[S] int64."""
    level: Ids
    """[S, 2] int64 halvings along each axis."""
    site: Ids
    """[S, 2] int64 lattice sites, 0 at the centre, in spacings of the level."""
    peak: Floats
    """[S] float64 peak alphas."""
    slot: Bools
    """[S] bool: one child of each parent, near its centre, that takes the parent's index in the asset."""

    @staticmethod
    def of(base: Splats, camera: Camera, parent: Ids | None = None, sized: Ids | None = None) -> Lattice:
        """Nothing halved yet. parent: [S] int64 ascending, those of the base that there are (default: all); sized: [Q]
        int64, those that may be halved (default: all). The others have no sizes: finding these is what takes time."""
        n = len(base)
        parent = np.arange(n) if parent is None else parent
        if sized is None:
            sizes = projected_sizes(base, camera)
            axes = np.argsort(-sizes, 1, kind="stable")[:, :2]
            sizes = np.take_along_axis(sizes, axes, 1)
        else:
            # Sizes of the few that may be halved: finding them for all would take most of the time of an edit.
            lengths = projected_sizes(base.geometry(sized), camera)
            order = np.argsort(-lengths, 1, kind="stable")[:, :2]
            axes, sizes = np.zeros((n, 2), np.int64), np.zeros((n, 2), lengths.dtype)
            axes[sized], sizes[sized] = order, np.take_along_axis(lengths, order, 1)
        zeros, peak = np.zeros((len(parent), 2), np.int64), base.opacities[parent].astype(np.float64)
        return Lattice(base, axes, sizes, parent, zeros, zeros, peak, np.ones(len(parent), bool))

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def widths(self) -> np.ndarray:
        """[S, 2] standard deviations along the two axes, in pixels."""
        return np.ldexp(self.sizes.take(self.parent, 0).astype(np.float64), -self.level)

    def take(self, ids: Ids) -> Lattice:
        """A part of them. ids: [K] int64."""
        taken = {name: getattr(self, name).take(ids, 0) for name in ("parent", "level", "site", "peak", "slot")}
        return replace(self, **taken)

    def splats(self) -> Splats:
        """The S Gaussians. Those that were never halved have their parent's bits."""
        out = take(self.base, self.parent)
        halved = np.flatnonzero(self.level.any(1))
        if not len(halved):
            return out
        parent, n = self.parent[halved], np.arange(len(halved))
        rotation = quat_to_matrix(self.base.quats[parent])
        means, scales, opacities = out.means.copy(), out.scales.copy(), out.opacities.copy()
        part, center = scales[halved], means[halved].astype(np.float64)
        # A child's centre: its site times the spacing, along the parent's own axes.
        for k in range(2):
            axis = self.axes[parent, k]
            width = self.base.scales[parent, axis] * np.ldexp(1.0, -self.level[halved, k])
            center += (SPACING * width * self.site[halved, k])[:, None] * rotation[n, :, axis]
            part[n, axis] = width
        means[halved], scales[halved] = center, part
        opacities[halved] = self.peak[halved]
        return replace(out, means=means, scales=scales, opacities=opacities)

    def halved(self, coarse: np.ndarray, goal_px: float) -> tuple[Lattice, np.ndarray]:
        """(the lattice with the `coarse` Gaussians ([S] bool) halved along each axis on which they are wider than
        `goal_px`, [S'] an old one that each new one came from)."""
        new, source = self, np.arange(len(self))
        for k in range(2):
            wide = coarse[source] & (new.widths[:, k] > goal_px) & (new.level[:, k] < MAX_LEVEL)
            # One axis after the other: five children an axis, twenty-five for both.
            new, index = new._halved_along(np.flatnonzero(wide), k)
            source = source[index]
        return new, source

    def _halved_along(self, ids: np.ndarray, k: int) -> tuple[Lattice, np.ndarray]:
        if not len(ids):
            return self, np.arange(len(self))
        count = 2 * CHILD_REACH_SITES + 1
        unchanged = np.ones(len(self), bool)
        unchanged[ids] = False
        rest = np.flatnonzero(unchanged)
        source = np.concatenate([rest, np.repeat(ids, count)])
        level, site = self.level[source], self.site[source]
        step = np.tile(np.arange(-CHILD_REACH_SITES, CHILD_REACH_SITES + 1), len(ids))
        level[len(rest) :, k] += 1
        site[len(rest) :, k] = 2 * site[len(rest) :, k] + step
        peak = np.concatenate([self.peak[rest], child_peaks(self.peak[ids]).ravel()])
        slot = self.slot[source]
        # Of the children the central one takes the parent's index.
        slot[len(rest) :] &= step == 0
        return _merged(replace(self, parent=self.parent[source], level=level, site=site, peak=peak, slot=slot), source)


def _merged(lattice: Lattice, source: np.ndarray) -> tuple[Lattice, np.ndarray]:
    """One Gaussian per (parent, level, site), in this order; of several the first one's source stays. Those that were
    never halved are alone at theirs."""
    # Equal parent, level and site are the same place: what several halvings put there becomes one.
    key = lattice.parent
    for level, site in zip(lattice.level.T, lattice.site.T, strict=True):
        key = (key * (MAX_LEVEL + 1) + level) * 2 * _MAX_SITE + (site + _MAX_SITE)
    halved = lattice.level.any(1)
    alone, ids = np.flatnonzero(~halved), np.flatnonzero(halved)
    _, first, index, number = np.unique(key[ids], return_index=True, return_inverse=True, return_counts=True)
    total = np.bincount(index, lattice.peak[ids], len(first))
    slot = np.zeros(len(first), bool)
    slot[index[lattice.slot[ids]]] = True
    first = ids[first]
    chosen = np.concatenate([alone, first])
    # A lone child keeps its fitted peak; only sums are corrected for overlap.
    peak = np.concatenate([lattice.peak[alone], np.where(number > 1, merged_peak(total), lattice.peak[first])])
    slot = np.concatenate([lattice.slot[alone], slot])
    order = np.argsort(key[chosen], kind="stable")  # two ascending rows
    merged = replace(lattice.take(chosen[order]), peak=peak[order], slot=slot[order])
    return merged, source[chosen[order]]
