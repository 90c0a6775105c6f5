"""Medians, quantiles and distinct values, of numpy's bits without numpy's way there: its own functions import
`numpy.ma`, a twentieth of the time of a short command, to ask whether an array is masked."""

from __future__ import annotations

from typing import Any

import numpy as np

MAX_EXACT = 1 << 53
"""Up to this float64 holds every whole number."""
MAX_KEY = 1 << 62
"""A key in int64, and room for a sum."""


def median(values: np.ndarray) -> Any:
    """Along the first axis of [N, ...] floats, N > 0, as np.median(values, axis=0): of an even number the mean of both
    in the middle, NaN where there is one."""
    count = len(values)
    middle = count // 2
    ordered = np.partition(values, [middle - 1, middle, -1] if count % 2 == 0 else [middle, -1], axis=0)
    out = ordered[middle] if count % 2 else (ordered[middle - 1] + ordered[middle]) / 2
    return _nan_where_there_is_one(out, ordered[-1])


def quantile(values: np.ndarray, share: float) -> Any:
    """Along the first axis of [N, ...] floats, N > 0, as np.quantile(values, share, axis=0): between two neighbours by
    the straight line (Hyndman & Fan's method 7), NaN where there is one. share: 0..1."""
    virtual_index = (len(values) - 1) * share
    lower = int(virtual_index)
    upper, weight = min(lower + 1, len(values) - 1), virtual_index - lower
    ordered = np.partition(values, [lower, upper, -1], axis=0)
    low, high = ordered[lower], ordered[upper]
    # From the nearer end, so that a weight of 1 gives the upper one itself.
    out = high - (high - low) * (1 - weight) if weight >= 0.5 else low + (high - low) * weight
    return _nan_where_there_is_one(out, ordered[-1])


def distinct(values: np.ndarray) -> np.ndarray:
    """Of [N] numbers without NaN, ascending, as np.unique(values), which asks a hash table since numpy 2.3: of twenty
    million keys it takes thirty times as long."""
    ordered = np.sort(values)
    return ordered[_begins(ordered)]


def groups(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of [N] keys without NaN, by ascending key: ([K] first index of each key, [N] number of each one's key, [K] how
    many have it), as np.unique tells."""
    order = keys.argsort(kind="stable")
    begins = _begins(keys[order])
    numbers = np.empty(len(keys), np.int64)
    numbers[order] = np.cumsum(begins) - 1
    return order[begins], numbers, np.diff(np.append(np.flatnonzero(begins), len(keys)))


def row_keys(rows: np.ndarray) -> np.ndarray:
    """[N] int64 of [N, C] whole numbers: one key for equal rows, in the order in which np.unique(rows, axis=0) has
    them, which compares bytes of rows and takes ten times as long."""
    keys, size = np.zeros(len(rows), np.int64), 1
    if not len(rows):
        return keys
    for column in rows.T:
        # What does not fit beside the others is numbered anew: strays may lie anywhere.
        if not -MAX_EXACT < column.min() <= column.max() < MAX_EXACT:
            column = groups(column)[1]
        column = column.astype(np.int64)
        column -= column.min()
        span = int(column.max()) + 1
        if size * span > MAX_KEY:
            keys, column = groups(keys)[1], groups(column)[1]
            size, span = int(keys.max()) + 1, int(column.max()) + 1
        keys, size = keys * span + column, size * span
    return keys


def _begins(ordered: np.ndarray) -> np.ndarray:
    """[N] bool: which of ordered keys differ from the one before them."""
    return np.append(np.ones(min(len(ordered), 1), bool), ordered[1:] != ordered[:-1])


def without(values: np.ndarray, excluded: np.ndarray) -> np.ndarray:
    """Of [N] integers those that are none of [M], distinct and ascending, as np.setdiff1d(values, excluded)."""
    left = distinct(values)
    return left[np.isin(left, distinct(excluded), assume_unique=True, invert=True)]


def _nan_where_there_is_one(values: Any, last: Any) -> Any:
    """NaN are sorted behind all numbers. last: the largest of each column."""
    return np.where(np.isnan(last), last, values)[()]
