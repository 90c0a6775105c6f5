"""Which Gaussians differ between assets that a session has just shown, or made of each other: whoever asks again, or
asks about the way over a third one, need not compare all of their values. Only rows are held here, no Gaussians.
"""

from __future__ import annotations

import weakref

import numpy as np

from splatpainter.splats import ATTRIBUTES, Splats, changed_rows
from splatpainter.system.latest import Latest

MAX_RECENT = 16
"""Pairs of assets whose changed rows are at hand."""
MAX_ROWS = 1 << 18
"""Changed rows of a pair, beyond which comparing is as quick."""
Arrays = tuple[weakref.ref[np.ndarray], ...]
_recent = Latest[tuple[Arrays, Arrays, np.ndarray]](MAX_RECENT)
"""(one asset, another, rows that both have and that differ)."""


def note_changes(before: Splats, after: Splats, rows: np.ndarray) -> None:
    """Remember `changed_rows` of two assets (numpy)."""
    if len(rows) <= MAX_ROWS:
        _recent.note((_references(before), _references(after), rows))


def changes(before: Splats, after: Splats) -> np.ndarray:
    """`changed_rows` of two assets (numpy), [T] int64 ascending."""
    rows, over = None, []
    for one, two, changed in _recent:
        for near, far in ((one, two), (two, one)):
            if _is(near, after):
                if _is(far, before):
                    return changed
                over.append((far, changed))
    # Over a third asset the rows are a superset, which is compared: far fewer than all.
    for middle, changed in over:
        rows = rows if rows is not None else _over(before, middle, changed, min(len(before), len(after)))
    rows = changed_rows(before, after, rows)
    note_changes(before, after, rows)
    return rows


def _over(before: Splats, middle: Arrays, changed: np.ndarray, count: int) -> np.ndarray | None:
    """Rows below `count` that may differ where `changed` do from `middle` on; None: any."""
    means = middle[0]()
    for one, two, rows in _recent:
        for near, far in ((one, two), (two, one)):
            if _is(near, before) and _same(far, middle) and means is not None and len(means) >= count:
                differs = np.zeros(len(means), bool)
                differs[rows] = True
                differs[changed] = True
                return np.flatnonzero(differs[:count])
    return None


def _references(splats: Splats) -> Arrays:
    return tuple(weakref.ref(getattr(splats, name)) for name in ATTRIBUTES)


def _is(arrays: Arrays, splats: Splats) -> bool:
    return all(array() is getattr(splats, name) for array, name in zip(arrays, ATTRIBUTES, strict=True))


def _same(one: Arrays, two: Arrays) -> bool:
    return all(a() is not None and a() is b() for a, b in zip(one, two, strict=True))
