"""What a kernel's bytes must be on every machine: inputs by integer arithmetic alone, and hashes of what comes out.

numpy's own generators and functions may differ in a last bit between versions and CPUs; whole numbers, and single sums
and products of floats, may not.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable

import numpy as np
import pytest

from splatpainter.kernels import library
from splatpainter.kernels.parallel import THREADS_VARIABLE

CPUS = ("base", "v3", "v4")
THREADS = ("1", "2", "3")


class Numbers:
    """The same numbers everywhere: SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators",
    2014)."""

    def __init__(self, seed: int) -> None:
        self._state = seed << 32

    def bits(self, count: int) -> np.ndarray:
        """[count] uint64."""
        first, self._state = self._state + 1, self._state + count
        x = np.arange(first, first + count, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return x ^ (x >> np.uint64(31))

    def integers(self, below: int, *shape: int) -> np.ndarray:
        """int64, 0 <= each < below."""
        return (self.bits(math.prod(shape)) >> np.uint64(33)).astype(np.int64).reshape(shape) % below

    def uniform(self, low: float, high: float, *shape: int) -> np.ndarray:
        """float64 between low and high."""
        unit = (self.bits(math.prod(shape)) >> np.uint64(12)).astype(np.float64) / 2**52
        return (unit * (high - low) + low).reshape(shape)

    def normal(self, *shape: int) -> np.ndarray:
        """float64 about normally distributed: the sum of twelve of uniform distribution."""
        total = self.uniform(-0.5, 0.5, *shape)
        for _ in range(11):
            total = total + self.uniform(-0.5, 0.5, *shape)
        return total

    def order(self, count: int) -> np.ndarray:
        """[count] int64 permutation."""
        return np.argsort(self.bits(count), kind="stable")


def digest(*arrays: np.ndarray) -> str:
    """Of shapes and bytes."""
    out = hashlib.sha256()
    for array in arrays:
        out.update(f"{array.dtype.str[1:]} {array.shape}".encode())
        out.update(np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"))).tobytes())
    return out.hexdigest()[:16]


def check(case: Callable[[], list[np.ndarray]], golden: str, cpu: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A case gives the golden bytes for a kind of CPU and any number of threads; skips where this machine is not of
    that kind."""
    if cpu not in library.current().cpus:
        pytest.skip(f"this CPU is not {cpu}")
    with library.using(cpu):
        for threads in THREADS:
            monkeypatch.setenv(THREADS_VARIABLE, threads)
            assert digest(*case()) == golden, f"{threads} threads"
