"""Arrays as kernels take them, and masks as their set pixels."""

from __future__ import annotations

import math

import numpy as np


def aligned(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """np.empty on a 64-byte boundary, so that 16 float32 numbers are one cache line."""
    # numpy promises no alignment; kernels read whole cache lines.
    size = math.prod(shape) * dtype.itemsize
    raw = np.empty(size + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + size].view(dtype).reshape(shape)


def readonly(array: np.ndarray, dtype: np.dtype | type) -> np.ndarray:
    """A C-contiguous, aligned, read-only view or copy of a dtype: what inputs of kernels must be."""
    view = np.require(array, dtype, ["C", "A"]).view()
    view.flags.writeable = False
    return view


def set_pixels(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rows [Q], columns [Q]) of the set pixels of a mask ([H, W] bool), row by row: `np.nonzero` in a fifth of its
    time."""
    rows, columns = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return rows, columns
