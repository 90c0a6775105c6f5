"""Rows of large arrays, gathered and joined by all threads: what edits of a million Gaussians do again and again."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from splatpainter.kernels.arrays import aligned, readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import Result, each, run, threads
from splatpainter.kernels.row_bits import row_bits
from splatpainter.kernels.spare_copies import spare_copy_of
from splatpainter.splats import ATTRIBUTES, Splats

MIN_ROWS = 1 << 13
"""Fewer rows are not worth waking threads for."""
BLOCK_ROWS = 1 << 14
"""Rows of a block: what is computed of them on the way stays in the processor's cache."""


def by_blocks(function: Callable[[slice], Result], count: int) -> list[Result]:
    """[function(rows)] for all of `count` rows, in blocks that the threads share: for numpy's arithmetic of each row
    alone, which lets go of the interpreter's lock. Of a million rows each array on the way would be new memory."""
    blocks = [slice(first, min(first + BLOCK_ROWS, count)) for first in range(0, count, BLOCK_ROWS)]
    return list(map(function, blocks)) if count < MIN_ROWS else each(function, blocks)


def taken(values: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """`values.take(ids)` by all threads. values: [N]; ids: [M] int64, all of them of entries that there are."""
    out = aligned((len(ids),), values.dtype)
    by_blocks(lambda block: values.take(ids[block], out=out[block], mode="clip"), len(ids))
    return out


def take(splats: Splats, ids: np.ndarray) -> Splats:
    """`Splats.take` of numpy Gaussians. ids: [M] int64, none of them negative."""
    # Few rows, or float64 ones, are numpy's.
    if len(ids) < MIN_ROWS or any(getattr(splats, name).dtype != np.float32 for name in ATTRIBUTES):
        return splats.take(ids)
    ids, arrays = readonly(ids, np.int64), {}
    for name in ATTRIBUTES:
        values = getattr(splats, name)
        arrays[name] = aligned((len(ids), *values.shape[1:]), values.dtype)
        flat = arrays[name].reshape(len(ids), math.prod(values.shape[1:])).view(np.uint32)
        run(kernels.take_rows, row_bits(values), ids, flat)
    return replace(splats, **arrays, origin=None if splats.origin is None else splats.origin[ids])


def extended(values: np.ndarray, tail: np.ndarray) -> np.ndarray:
    """[N + A, ...] of [N, ...] and [A, ...]: `np.concatenate`, large arrays by all threads, or into a copy that was
    made ahead (spare_copies.py)."""
    n = len(values)
    spare = spare_copy_of(values, n + len(tail)) if values.dtype == tail.dtype else None
    if spare is not None:
        spare[n:] = tail
        return spare
    if n < MIN_ROWS or values.dtype != tail.dtype:
        return np.concatenate([values, tail])
    out = aligned((n + len(tail), *values.shape[1:]), values.dtype)
    out[n:] = tail
    count = threads()

    def copy(k: int) -> None:
        # numpy copies without the interpreter's lock, and new memory costs more than the copy.
        out[n * k // count : n * (k + 1) // count] = values[n * k // count : n * (k + 1) // count]

    each(copy, range(count))
    return out


def put(records: np.ndarray, columns: np.ndarray, values: np.ndarray, before: np.ndarray, rows: np.ndarray) -> None:
    """Put values ([M, C] float32) into columns ([C] int64) of records ([M, P] float32), but for those with the bits
    of `before` ([N, C]) in rows ([M] int64; -1: none)."""
    run(
        kernels.put_columns,
        row_bits(values),
        row_bits(before),
        readonly(rows, np.int64),
        readonly(columns, np.int64),
        records.view(np.uint32),
    )
