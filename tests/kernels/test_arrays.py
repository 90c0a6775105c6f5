"""Arrays for kernels: aligned ones, and the memory that they leave to the next."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from splatpainter.kernels import arrays, library
from splatpainter.kernels.arrays import IDLE_LIMITS, aligned, readonly
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


def test_addresses_are_those_that_numpy_lists():
    memory = np.arange(60.0).reshape(5, 12)
    fixed = memory.view()
    fixed.flags.writeable = False
    for array in (memory, memory[2:, 3:], memory[:0], memory.T, fixed, np.empty(0), np.ma.masked_array(memory)):
        assert library.address_of(array) == array.__array_interface__["data"][0]
    assert library._listed_address(memory[1:]) == library._read_address(memory[1:]), "what numpy lists is slow"


def test_what_is_as_kernels_take_it_is_not_copied():
    memory = np.arange(24, dtype=np.float32).reshape(4, 6)
    view = readonly(memory, np.float32)
    assert np.shares_memory(view, memory) and not view.flags.writeable and memory.flags.writeable
    unaligned = np.frombuffer(bytes(25), np.uint8)[1:].view(np.float32)
    for other in (memory.T, memory.astype(np.float64), memory.astype(">f4"), memory[:, ::2], unaligned):
        copy = readonly(other, np.float32)
        assert copy.dtype == np.dtype("=f4") and copy.flags.c_contiguous and copy.flags.aligned
        assert np.array_equal(copy, other) and not copy.flags.writeable
        assert not np.shares_memory(copy, np.asarray(other))
