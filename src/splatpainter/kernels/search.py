"""Binary search in a sorted array, for other kernels."""

from __future__ import annotations

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def first_not_below(keys, low, high, key):
    """Index of the first of keys[low:high] (ascending) that is >= key; `high` where none is."""
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low
