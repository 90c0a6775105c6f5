"""Copies of large arrays that somebody made ahead of the edit that writes into them: of a million Gaussians a stroke
changes some thousands, and copying the others would be a tenth of its time. A copy is used once, and gone when its
owner drops it before.
"""

from __future__ import annotations

import weakref

import numpy as np

from splatpainter.kernels.arrays import aligned
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.latest import Latest
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class SpareLimits:
    """Of which arrays there are copies. Source: an edit copies 32 MiB in 5 to 8 ms, mostly of new memory."""

    smallest_bytes: int = 1 << 25
    """Smaller arrays are copied as quickly by the edit itself."""
    most_bytes: int = 1 << 29
    """Of larger assets none is held: a stroke must not double what they take."""
    room: float = 1 / 16
    """Rows that may be appended, over those that there are. Memory that nobody writes costs nothing."""
    most_offered: int = 32
    """Copies that are looked through."""


SPARE_LIMITS = SpareLimits()


class SpareCopy:
    """The copy of an array that nobody writes to, with room behind its last row."""

    def __init__(self, values: np.ndarray) -> None:
        """values: [N, ...]."""
        room = int(SPARE_LIMITS.room * len(values))
        copy = aligned((len(values) + room, *values.shape[1:]), values.dtype)
        copy[: len(values)] = values
        self._of, self._copies = weakref.ref(values), [copy]
        _offered.note(weakref.ref(self))

    def taken(self, values: np.ndarray, rows: int) -> np.ndarray | None:
        """[rows, ...] to be written to, its first N rows those of `values`; None where it is no copy of that, was taken
        before, or has no room."""
        if self._of() is not values:
            return None
        try:
            copy = self._copies.pop()  # of several threads only one gets it
        except IndexError:
            return None
        return copy[:rows] if rows <= len(copy) else None


_offered = Latest["weakref.ref[SpareCopy]"](SPARE_LIMITS.most_offered)


def spare_copies(splats: Splats) -> tuple[SpareCopy, ...]:
    """Copies of the large arrays of numpy Gaussians, offered as long as somebody holds them."""
    arrays = [array for name in ATTRIBUTES if (array := getattr(splats, name)).nbytes >= SPARE_LIMITS.smallest_bytes]
    if sum(array.nbytes for array in arrays) > SPARE_LIMITS.most_bytes:
        return ()
    return tuple(map(SpareCopy, arrays))


def spare_copy_of(values: np.ndarray, rows: int) -> np.ndarray | None:
    """A copy of the very same array that somebody made ahead, as [rows, ...] of which the first N are filled; None
    where there is none."""
    for reference in _offered:
        spare = reference()
        copy = None if spare is None else spare.taken(values, rows)
        if copy is not None:
            return copy
    return None
