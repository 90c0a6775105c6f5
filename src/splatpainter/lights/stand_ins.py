"""Few Gaussians that stand for many, where an asset is far denser than light looks at it.

Views around an asset are small, and what a place sees changes slowly: of a million Gaussians dozens lie in a pixel, and
tell together what each would tell alone. Those of one small cell that face one way are one disc with their mean place,
direction, spread, colour and area of opacity. Large Gaussians, and assets that are not dense, stand for themselves.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max, row_norm


@dataclass(frozen=True)
class StandInLimits:
    """Source: measured on dense surfels of tuning meshes where an entry gives figures, else taste."""

    few: int = 200_000
    """Gaussians that stand for themselves, however close they lie."""
    cells: float = 0.7
    """Edge of a cell in pixels of the views around. As coarse as shadow maps of a million Gaussians are (four times
    their distance)."""
    largest: float = 0.7
    """Standard deviation in edges of a cell, up to which a Gaussian belongs to it."""
    directions: int = 3
    """Parts of the range of each component of an axis, by which axes are told apart: both sides of a thin wall are not
    one, where their axes say so."""
    worth: float = 0.7
    """Share of the Gaussians that are left, beyond which all stand for themselves."""
    max_cells: int = 1 << 18
    """Cells either way along an axis: what lies farther off shares the outermost ones."""
    piece: int = 8192
    """Gaussians whose light a thread folds at a time: they fit its cache."""
    most_opaque: float = 0.99
    """Opacity of a disc that is covered more than once."""


STAND_INS = StandInLimits()


@dataclass(frozen=True)
class StandIns:
    """F Gaussians in place of N."""

    splats: Splats
    """[F], with base colours alone."""
    of: Ids = field(repr=False)
    """[N] int64 which one stands for each; 0 where it cannot be drawn."""
    share: Floats = field(repr=False)
    """[N] float64 of each in the one that stands for it; 0 where it cannot be drawn."""

    def mean(self, values: Floats) -> Floats:
        """[F, C] float64 means of [N, C]."""
        weighted = (self.share * column for column in values.T)
        columns: list[Floats] = [
            np.bincount(self.of, column, len(self.splats)).astype(np.float64) for column in weighted
        ]
        return np.stack(columns, 1)

    def normals(self, normals: Floats) -> Floats:
        """[F, 3] float32 unit means of normals [N, 3]; zeros where they cancel out."""
        mean = self.mean(normals)
        return (mean / np.maximum(row_norm(mean), 1e-9)[:, None]).astype(np.float32)

    def colored(self, splats: Splats) -> Splats:
        """The F with the mean base colours of the N Gaussians of an asset of this shape."""
        return replace(self.splats, sh=self.mean(splats.sh[:, 0]).astype(np.float32)[:, None])


def stand_ins(splats: Splats, axes: Floats, center: Floats, cell: float) -> StandIns | None:
    """None where the asset is not dense. splats: all drawable; axes: [N, 3] float32 unit, the shortest ones, towards
    their positive ends; center [3] and cell: where cells lie, and their edge, world units."""
    count = len(splats)
    if count <= STAND_INS.few:
        return None
    longest, shortest = row_max(splats.scales), -row_max(-splats.scales)
    middle = splats.scales.sum(1) - longest - shortest
    group = _groups(splats.means, axes, center, cell, longest <= STAND_INS.largest * cell)
    few = int(group.max()) + 1
    if few > STAND_INS.worth * count:
        return None
    # The area of opacity is what a small Gaussian shows of itself, and its weight in all means.
    disc = (longest * middle).astype(np.float64)
    area = splats.opacities * disc
    weight = np.maximum(area, 1e-30)
    share = weight / np.bincount(group, weight)[group]
    # Those that stand for themselves stay what they are; of each group the first holds the place.
    first = np.empty(few, np.int64)
    first[group[::-1]] = np.arange(count - 1, -1, -1)
    base = replace(splats, sh=splats.sh[:, :1], source=None, origin=None).take(first)
    merged = StandIns(base, group, share)
    several = np.bincount(group) > 1
    means, normals = merged.mean(splats.means), merged.normals(axes)
    # How far they spread along the disc and across it: each by itself, and their places.
    away = splats.means - means.astype(np.float32)[group]
    height = (away * normals[group]).sum(1)
    height *= height
    flat = merged.mean(np.stack([longest * longest + middle * middle + (away * away).sum(1) - height], 1))[:, 0] / 2
    deep = merged.mean(np.stack([shortest * shortest + height], 1))[:, 0]
    # Some have no size at all.
    opacity = np.minimum(np.bincount(group, area) / np.maximum(flat, np.finfo(np.float32).tiny), STAND_INS.most_opaque)
    discs = {
        "means": means,
        "quats": _upright(normals),
        "scales": np.sqrt(np.stack([flat, flat, deep], 1)),
        "opacities": opacity,
    }
    columns = {}
    for name, values in discs.items():
        original = getattr(base, name)
        columns[name] = np.where(several.reshape(-1, *[1] * (original.ndim - 1)), values, original).astype(np.float32)
    return replace(merged, splats=replace(base, **columns))


def _groups(means: Floats, axes: Floats, center: Floats, cell: float, small: np.ndarray) -> Ids:
    """[N] int64 from 0: which small ([N] bool) Gaussians lie in one cell and face one way; each other one is alone."""
    half, parts = STAND_INS.max_cells, STAND_INS.directions
    key = np.zeros(len(means), np.int64)
    for axis in range(3):
        index = np.floor((means[:, axis] - np.float32(center[axis])) * np.float32(1 / cell))
        key = key * (2 * half) + (index.clip(-half, half - 1).astype(np.int64) + half)
    for axis in range(3):
        key = key * parts + ((axes[:, axis] + 1) * np.float32(parts / 2)).clip(0, parts - 1).astype(np.int64)
    # As one number: rows of numbers sort ten times as slowly.
    numbers = np.unique(key[small], return_inverse=True)[1].reshape(-1)
    group = np.empty(len(means), np.int64)
    group[small] = numbers
    group[~small] = np.arange(len(means) - len(numbers)) + (int(numbers.max()) + 1 if len(numbers) else 0)
    return group


def _upright(normals: Floats) -> Floats:
    """[F, 4] quaternions of any norm that turn z to unit normals [F, 3]."""
    x, y, z = normals.T.astype(np.float64)
    # The shortest turn, from whichever end of z is nearer: half a turn about x leads to the other one.
    zero = np.zeros_like(x)
    above, below = np.stack([1 + z, -y, x, zero], 1), np.stack([-y, 1 - z, zero, x], 1)
    return np.where((z >= 0)[:, None], above, below)
