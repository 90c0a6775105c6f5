"""Arrays as kernels take them, and masks as their set pixels."""

from __future__ import annotations

import math
import threading
from dataclasses import replace

import numpy as np

from splatpainter.kernels.library import address_of
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class IdleLimits:
    """Of memory that is kept for the next arrays. The system clears what it hands out: a fifth of the CPU time of
    drawing 100,000 Gaussians again and again."""

    smallest_bytes: int = 1 << 16
    """Of smaller arrays, malloc keeps the memory itself."""
    most_bytes: int = 128 << 20
    """Of all that is idle: the numbers of a million projected Gaussians, as they come and in order. With half of it a
    dab on a million had 10,000 page faults in place of 500, and 110 ms of the system's time in place of 27."""
    most_waste: float = 1.5
    """Memory serves arrays of at least its size divided by this."""


IDLE_LIMITS = IdleLimits()


class _IdleMemory:
    """Memory of arrays that are gone. Nobody waits for its lock: an array may end at any line, also inside of `take`,
    and in a child whose parent was there when it forked; what cannot be kept goes back to the system."""

    def __init__(self) -> None:
        self.memories: list[np.ndarray] = []
        """[bytes] uint8 each, the latest last."""
        self.size = 0
        """Bytes of all of them."""
        self.lock = threading.Lock()
        self.limits = IDLE_LIMITS

    def take(self, size: int) -> np.ndarray:
        """[size or more] uint8 of which nothing is known."""
        if self.lock.acquire(blocking=False):
            try:
                for k in range(len(self.memories) - 1, -1, -1):
                    if size <= self.memories[k].size <= self.limits.most_waste * size:
                        memory = self.memories.pop(k)
                        self.size -= memory.size
                        return memory
            finally:
                self.lock.release()
        return np.empty(size, np.uint8)

    def put(self, memory: np.ndarray) -> None:
        """Keep it in place of what has been idle for longest."""
        if not self.lock.acquire(blocking=False):
            return
        try:
            self.memories.append(memory)
            self.size += memory.size
            while self.size > self.limits.most_bytes:
                self.size -= self.memories.pop(0).size
        finally:
            self.lock.release()


_idle = _IdleMemory()


class _Lent:
    """Owner of an array's memory, which becomes idle with the last view of it."""

    def __init__(self, memory: np.ndarray, idle: _IdleMemory):
        self.memory, self.idle = memory, idle
        self.__array_interface__ = memory.__array_interface__

    def __del__(self) -> None:
        self.idle.put(self.memory)


def keep_no_idle_memory() -> None:
    """For processes that end soon: what arrays held goes back to the system with them."""
    _idle.limits = replace(IDLE_LIMITS, most_bytes=0)
    _idle.memories.clear()
    _idle.size = 0


def keeps_idle_memory() -> bool:
    """Whether memory is worth its time here: in processes that do not end soon."""
    return _idle.limits.most_bytes > 0


def aligned(shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """np.empty on a 64-byte boundary, so that 16 float32 numbers are one cache line; in memory of arrays that are gone,
    where some fits."""
    # numpy promises no alignment; kernels read whole cache lines.
    size = math.prod(shape) * dtype.itemsize
    small = size < IDLE_LIMITS.smallest_bytes
    raw = np.empty(size + 64, np.uint8) if small else np.asarray(_Lent(_idle.take(size + 64), _idle))
    start = -address_of(raw) % 64
    return raw[start : start + size].view(dtype).reshape(shape)


def copied(array: np.ndarray) -> np.ndarray:
    """A C-contiguous copy in memory as of `aligned`: of whole pictures, of which an edit copies a few."""
    out = aligned(array.shape, array.dtype)
    out[...] = array
    return out


def filled(shape: tuple[int, ...], value: int, dtype: np.dtype) -> np.ndarray:
    """np.full in memory as of `aligned`."""
    out = aligned(shape, dtype)
    out[...] = value
    return out


def readonly(array: np.ndarray, dtype: np.dtype | type) -> np.ndarray:
    """A C-contiguous, aligned, read-only view or copy of a dtype: what inputs of kernels must be."""
    # Most are such arrays already, and numpy asks in Python.
    fits = type(array) is np.ndarray and array.dtype == dtype and array.flags.c_contiguous and array.flags.aligned
    view = (array if fits else np.require(array, dtype, ["C", "A"])).view()
    view.flags.writeable = False
    return view


def set_pixels(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(rows [Q], columns [Q]) of the set pixels of a mask ([H, W] bool), row by row: `np.nonzero` in a fifth of its
    time."""
    rows, columns = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return rows, columns
