"""What an edit does to some Gaussians: the few that it writes, those that it empties, and those that it appends.

An edit works on all Gaussians that make its pixels, most of which are hidden and stay as they are: only what changes
travels from step to step.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Ids
from splatpainter.kernels.rows import extended
from splatpainter.splats import ATTRIBUTES, Splats, float_bits
from splatpainter.system.quick_dataclass import dataclass


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

    @staticmethod
    def of(after: Splats, ids: np.ndarray, parents: np.ndarray) -> SparseEdit:
        """after: N Gaussians, then the appended ones; ids: those of the N with other values; parents: [A]."""
        count = len(after) - len(parents)
        appended = after.take(np.arange(count, len(after)))
        return SparseEdit(ids, after.take(ids), np.zeros(0, np.int64), appended, parents)

    def touched(self, before: Splats) -> Ids:
        """[T'] int64 ascending: those of `before` of which any bit changes."""
        changed = self.emptied[float_bits(before.opacities[self.emptied]) != 0]
        return np.sort(np.concatenate([self.ids, changed]))

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

    def within(self, ids: np.ndarray) -> SparseEdit:
        """The edit as one of more Gaussians, of which those of this edit are `ids` ([N] int64 ascending)."""
        return replace(self, ids=ids[self.ids], emptied=ids[self.emptied], parents=ids[self.parents])
