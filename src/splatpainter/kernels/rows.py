"""Rows of large arrays, gathered and compared by all threads: what edits of a million Gaussians do again and again."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit

from splatpainter.kernels.parallel import run
from splatpainter.kernels.simd import readonly
from splatpainter.splats import ATTRIBUTES, Splats

MIN_ROWS = 1 << 13
"""Fewer rows are not worth waking threads for."""


def take(splats: Splats, ids: np.ndarray) -> Splats:
    """`Splats.take` of numpy Gaussians. ids: [M] int64, none of them negative."""
    if len(ids) < MIN_ROWS or any(getattr(splats, name).dtype != np.float32 for name in ATTRIBUTES):
        return splats.take(ids)
    ids, arrays = readonly(ids, np.int64), {}
    for name in ATTRIBUTES:
        values = getattr(splats, name)
        arrays[name] = np.empty((len(ids), *values.shape[1:]), np.float32)
        run(_take, _rows(values), ids, arrays[name].reshape(len(ids), math.prod(values.shape[1:])))
    return replace(splats, **arrays, origin=None if splats.origin is None else splats.origin[ids])


def differing(before: np.ndarray, after: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """[M] bool: of which rows ([M] int64) any bit differs in two float32 arrays of the same width."""
    out = np.empty(len(ids), bool)
    if before is after:
        out[:] = False
    else:
        run(_differ, _rows(before), _rows(after), readonly(ids, np.int64), out)
    return out


def _rows(values: np.ndarray) -> np.ndarray:
    """[N, C] uint32, the bits of [N, ...] float32."""
    return readonly(values, np.float32).reshape(len(values), math.prod(values.shape[1:])).view(np.uint32)


@njit(nogil=True, cache=True, error_model="numpy", boundscheck=False)
def _take(values, ids, out, thread, threads):
    count, bits = ids.shape[0], out.view(np.uint32)
    for k in range(count * thread // threads, count * (thread + 1) // threads):
        row = ids[k]
        for c in range(values.shape[1]):
            bits[k, c] = values[row, c]


@njit(nogil=True, cache=True, error_model="numpy", boundscheck=False)
def _differ(before, after, ids, out, thread, threads):
    count = ids.shape[0]
    for k in range(count * thread // threads, count * (thread + 1) // threads):
        row, same = ids[k], True
        for c in range(before.shape[1]):
            same &= before[row, c] == after[row, c]
        out[k] = not same


def warm() -> None:
    """Compile (or load) the kernels."""
    ids, ones = np.zeros(1, np.int64), np.ones((2, 3), np.float32)
    run(_take, _rows(ones), readonly(ids, np.int64), np.empty((1, 3), np.float32))
    differing(ones, ones.copy(), ids)
