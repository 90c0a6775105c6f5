"""Arrays for kernels: aligned ones, and the memory that they leave to the next."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.kernels import arrays
from splatpainter.kernels.arrays import IDLE_LIMITS, aligned
from splatpainter.kernels.parallel import each

FLOAT = np.dtype(np.float32)


@pytest.fixture(autouse=True)
def idle(monkeypatch: pytest.MonkeyPatch) -> arrays._IdleMemory:
    """None at first, and not that of other tests."""
    monkeypatch.setattr(arrays, "_idle", arrays._IdleMemory())
    return arrays._idle


@pytest.mark.parametrize("shape", [(0,), (0, 16), (1,), (7, 16), (100_000,), (40_000, 16)])
@pytest.mark.parametrize("dtype", [np.float32, np.int64, np.uint8])
def test_arrays_are_aligned_writable_and_of_the_shape(shape: tuple[int, ...], dtype: type):
    for _ in range(2):
        array = aligned(shape, np.dtype(dtype))
        assert array.shape == shape and array.dtype == dtype and array.flags.c_contiguous and array.flags.writeable
        assert array.size == 0 or array.ctypes.data % 64 == 0
        array[...] = 1


def test_memory_is_used_again_when_the_last_view_is_gone(idle: arrays._IdleMemory):
    array = aligned((100_000,), FLOAT)
    address, part = array.ctypes.data, array[5:10]
    del array
    assert not idle.memories, "a view of it is still there"
    assert aligned((100_000,), FLOAT).ctypes.data != address
    part[:] = 3
    del part
    again = aligned((90_000,), FLOAT)
    assert again.ctypes.data == address and again.shape == (90_000,)
    assert aligned((90_000,), FLOAT).ctypes.data != address, "it is that of an array that is there"
    # Much smaller and larger ones leave it to those that fit.
    del again
    assert aligned((50_000,), FLOAT).ctypes.data != address and aligned((101_000,), FLOAT).ctypes.data != address


def test_only_so_much_is_kept(idle: arrays._IdleMemory):
    idle.limits = replace(IDLE_LIMITS, most_bytes=1_000_000)
    held = [aligned((50_000,), FLOAT) for _ in range(9)]  # 0.2 MB each
    held.clear()
    assert 0.7e6 < sum(memory.nbytes for memory in idle.memories) <= 1e6
    aligned((1_000,), FLOAT)
    assert len(idle.memories) == 4, "small arrays are none of its business"
    aligned((300_000,), FLOAT)
    assert sum(memory.nbytes for memory in idle.memories) <= 1e6


def test_processes_that_end_soon_keep_nothing(idle: arrays._IdleMemory):
    aligned((100_000,), FLOAT)
    assert idle.memories
    arrays.keep_no_idle_memory()
    assert not idle.memories
    aligned((100_000,), FLOAT)
    assert not idle.memories


def test_nobody_waits_for_it_and_threads_share_it(idle: arrays._IdleMemory):
    with idle.lock:  # as where an array ends inside of `take`, or in a child of a process that was there
        del (held := [aligned((100_000,), FLOAT)])[0]
        assert not held and not idle.memories

    def fill(number: int) -> bool:
        array = aligned((60_000 - number,), FLOAT)
        array[:] = number
        threading.Event().wait(0.001)
        return bool((array == number).all())

    assert all(each(fill, range(60))), "one array's memory was two arrays'"
