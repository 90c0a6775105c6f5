"""Rows of float32 arrays as their bits, and which of them differ. Knows no Gaussians."""

from __future__ import annotations

import math

import numpy as np

from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run


def differing(before: np.ndarray, after: np.ndarray, ids: np.ndarray | None = None) -> np.ndarray:
    """[M] bool: of which rows ([M] int64; None: all that both have) any bit differs in two float32 arrays of the same
    width."""
    out = np.zeros(min(len(before), len(after)) if ids is None else len(ids), bool)
    if before is not after and len(out):
        numbers = None if ids is None else readonly(ids, np.int64)
        run(kernels.compare_rows, row_bits(before), row_bits(after), numbers, out)
    return out


def row_bits(values: np.ndarray) -> np.ndarray:
    """[N, C] uint32, the bits of [N, ...] float32."""
    return readonly(values, np.float32).reshape(len(values), math.prod(values.shape[1:])).view(np.uint32)
