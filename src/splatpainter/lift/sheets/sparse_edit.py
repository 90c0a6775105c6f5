"""What an edit does to some Gaussians: the few that it writes, those that it empties, and those that it appends.

An edit works on all Gaussians that make its pixels, most of which are hidden and stay as they are: only what changes
travels from step to step.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Ids
from splatpainter.kernels.rows import extended
from splatpainter.order_statistics import distinct
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import ATTRIBUTES, Splats, float_bits
from splatpainter.system.quick_dataclass import dataclass

GEOMETRY = tuple(name for name in ATTRIBUTES if name != "sh")
"""Attributes that `Splats.geometry` takes."""


@dataclass(frozen=True)
class SparseEdit:
    """An edit of N Gaussians, as the few that it changes, empties and appends."""

    ids: Ids = field(repr=False)
    """[T] int64 ascending: those with other values."""
    values: Splats
    """T Gaussians: what they are now."""
    emptied: Ids = field(repr=False)
    """[E] int64 ascending, none of `ids`: those whose opacity is 0 now; their other values stay."""
    appended: Splats
    """A Gaussians, which come after the N."""
    parents: Ids = field(repr=False)
    """[A] int64 the one of the N that each of these was split from, or lies on or in place of."""

    def touched(self, before: Splats) -> Ids:
        """[T'] int64 ascending: those of `before` of which any bit changes."""
        changed = self.emptied[float_bits(before.opacities[self.emptied]) != 0]
        return np.sort(np.concatenate([self.ids, changed]), kind="stable")  # which joins two ascending runs

    def apply(self, before: Splats) -> Splats:
        """The N + A Gaussians. Arrays in which nothing changes are shared with `before`."""
        arrays = {}
        for name in ATTRIBUTES:
            old, new, tail = (getattr(splats, name) for splats in (before, self.values, self.appended))
            emptied = self.emptied if name == "opacities" else self.emptied[:0]
            # Attributes that nothing changes stay the same array, so that undo and memory cost nothing.
            if not len(tail) and not len(emptied) and np.array_equal(old[self.ids], new):
                continue
            arrays[name] = extended(old, tail)
            arrays[name][self.ids] = new
            arrays[name][emptied] = 0
        origin = None if before.origin is None else np.concatenate([before.origin, np.asarray(self.appended.origin)])
        return replace(before, **arrays, origin=origin)

    def take(self, before: Splats, ids: np.ndarray) -> Splats:
        """Some of the N + A Gaussians ([K] int64), without the others being put together; arrays of their own."""
        old = np.where(ids < len(before), ids, 0)
        out = self._written(before.take(old), ids, len(before), ATTRIBUTES)
        if before.origin is None:
            return out
        origin, added = before.origin[old], np.flatnonzero(ids >= len(before))
        origin[added] = np.asarray(self.appended.origin)[ids[added] - len(before)]
        return replace(out, origin=origin)

    def geometry(self, before: Splats, ids: np.ndarray) -> Splats:
        """`Splats.geometry` of some of the N + A Gaussians."""
        out = before.geometry(np.where(ids < len(before), ids, 0))
        return self._written(out, ids, len(before), GEOMETRY)

    def _written(self, out: Splats, ids: np.ndarray, count: int, names: tuple[str, ...]) -> Splats:
        """Write what the edit makes of the Gaussians `ids`; out: them before it, any values for those appended."""
        added, (here, index) = np.flatnonzero(ids >= count), _among(self.ids, ids)
        for name in names:
            values = getattr(out, name)
            values[here] = getattr(self.values, name).take(index, 0)
            values[added] = getattr(self.appended, name).take(ids[added] - count, 0)
        out.opacities[_among(self.emptied, ids)[0]] = 0
        return out

    def then(self, later: SparseEdit, before: Splats) -> SparseEdit:
        """This edit of `before` and one of the N + A Gaussians that it makes, which empties none, as one."""
        count, old = len(before), later.ids < len(before)
        ids = distinct(np.concatenate([self.ids, later.ids[old]]))
        # Those that stay empty are many, below a sheet, and of no interest but for that.
        emptied = self.emptied[float_bits(before.opacities[self.emptied]) != 0]
        emptied = emptied[~np.isin(emptied, ids, assume_unique=True)]
        values, appended = self.take(before, ids), self.appended.append(later.appended)
        index, added = np.searchsorted(ids, later.ids[old]), later.ids[~old] - count
        for name in ATTRIBUTES:
            new = getattr(later.values, name)
            getattr(values, name)[index] = new[old]
            getattr(appended, name)[added] = new[~old]
        if before.origin is not None:
            tails = [np.asarray(edit.appended.origin) for edit in (self, later)]
            appended = replace(appended, origin=np.concatenate(tails))
        # A Gaussian that this edit appended has its own parent among the N.
        parents = np.concatenate([self.parents, np.append(np.arange(count), self.parents)[later.parents]])
        return SparseEdit(ids, values, emptied, appended, parents)

    def within(self, ids: np.ndarray) -> SparseEdit:
        """The edit as one of more Gaussians, of which those of this edit are `ids` ([N] int64 ascending)."""
        return replace(self, ids=ids[self.ids], emptied=ids[self.emptied], parents=ids[self.parents])


def _among(ascending: np.ndarray, ids: np.ndarray) -> tuple[Ids, Ids]:
    """([K] which of `ids` are among some ascending ones, [K] which of these each is)."""
    index = np.searchsorted(ascending, ids)
    here = np.flatnonzero(index < len(ascending))
    here = here[ascending[index[here]] == ids[here]]
    return here, index[here]


@dataclass(frozen=True)
class EditedGaussians:
    """The N + A Gaussians that a sparse edit makes, of which only those that are asked for are put together: an edit
    that goes on in a few tiles costs what lies in these."""

    before: Splats
    edit: SparseEdit
    around: ProjectedView = field(repr=False)
    """View of `before`, at least the tiles that are asked for."""

    def __len__(self) -> int:
        return len(self.before) + len(self.edit.parents)

    def take(self, ids: np.ndarray) -> Splats:
        """As `Splats.take`."""
        return self.edit.take(self.before, ids)

    def geometry(self, ids: np.ndarray) -> Splats:
        """As `Splats.geometry`."""
        return self.edit.geometry(self.before, ids)

    def view(self, tiles: Bools) -> ProjectedView:
        """What `project` would give for some tiles ([TH, TW] bool), bit for bit."""
        if tiles.all():  # there `project` lists Gaussians that only might touch a tile, too
            return project(self.edit.apply(self.before), self.around.camera, tiles=tiles)
        edit, count = self.edit, len(self.before)
        ids = np.concatenate([edit.ids, np.arange(count, len(self))])
        # Only what the edit changed is projected; the rest is cut out of the view at hand.
        fresh = project(edit.values.append(edit.appended), self.around.camera, tiles=tiles)
        fresh = replace(fresh, gaussian_ids=ids[fresh.gaussian_ids], num_gaussians=len(self))
        return self.around.merged(fresh, tiles=tiles, without=np.concatenate([edit.ids, edit.emptied]))
