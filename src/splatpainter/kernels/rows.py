"""Rows of large arrays, gathered and compared by all threads: what edits of a million Gaussians do again and again."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.splats import ATTRIBUTES, Splats

MIN_ROWS = 1 << 13
"""Fewer rows are not worth waking threads for."""


def take(splats: Splats, ids: np.ndarray) -> Splats:
    """`Splats.take` of numpy Gaussians. ids: [M] int64, none of them negative."""
    # Few rows, or float64 ones, are numpy's.
    if len(ids) < MIN_ROWS or any(getattr(splats, name).dtype != np.float32 for name in ATTRIBUTES):
        return splats.take(ids)
    ids, arrays = readonly(ids, np.int64), {}
    for name in ATTRIBUTES:
        values = getattr(splats, name)
        arrays[name] = np.empty((len(ids), *values.shape[1:]), np.float32)
        flat = arrays[name].reshape(len(ids), math.prod(values.shape[1:])).view(np.uint32)
        run(kernels.take_rows, _rows(values), ids, flat)
    return replace(splats, **arrays, origin=None if splats.origin is None else splats.origin[ids])


def differing(before: np.ndarray, after: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """[M] bool: of which rows ([M] int64) any bit differs in two float32 arrays of the same width."""
    out = np.empty(len(ids), bool)
    if before is after:
        out[:] = False
    else:
        run(kernels.compare_rows, _rows(before), _rows(after), readonly(ids, np.int64), out)
    return out


def pick(records: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
    """Columns ([C] int64) of [N, P] float32 into [N, C] float32, every bit of them."""
    run(kernels.pick_columns, _rows(records), readonly(columns, np.int64), out.view(np.uint32))


def put(records: np.ndarray, columns: np.ndarray, values: np.ndarray, before: np.ndarray, rows: np.ndarray) -> None:
    """Put values ([M, C] float32) into columns ([C] int64) of records ([M, P] float32), but for those with the bits
    of `before` ([N, C]) in rows ([M] int64; -1: none)."""
    run(
        kernels.put_columns,
        _rows(values),
        _rows(before),
        readonly(rows, np.int64),
        readonly(columns, np.int64),
        records.view(np.uint32),
    )


def _rows(values: np.ndarray) -> np.ndarray:
    """[N, C] uint32, the bits of [N, ...] float32."""
    return readonly(values, np.float32).reshape(len(values), math.prod(values.shape[1:])).view(np.uint32)
