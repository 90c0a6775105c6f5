"""What a process keeps of the memory that it has freed."""

from __future__ import annotations

import ctypes
import sys

import numpy as np

from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class MallocOptions:
    """Of glibc's malloc."""

    mmap_threshold: int = -3
    """Number of the option in malloc.h."""
    trim_threshold: int = -1
    """Likewise."""
    arena_max: int = -8
    """Likewise."""
    most_arenas: int = 1
    """Heaps: with one for each thread, what one has freed is of no use to another. Demo's edit: 221 -> 214 MiB."""
    min_returned_bytes: int = 3 << 20
    """Arrays from this size on go back to the system when they are freed. Measured on the demo's edit with the next
    limit: 195 to 198 MiB at its peak and 50,000 page faults; 4 MiB 195 to 201 and 50,000, 8 MiB (with 16 MiB of the
    next) 211 and 37,000; without any limit 252."""
    most_idle_bytes: int = 12 << 20
    """So much memory of smaller arrays is for the next ones, at the end of the heap: with 6 MiB 193 MiB and 68,000 page
    faults, with 24 MiB 196 to 199 and 46,000. With glibc's 128 KiB the same pages went back and came again all the
    time."""


MALLOC = MallocOptions()
LARGEST_LEARNT_BYTES = (32 << 20) - (64 << 10)
"""glibc takes the size of a mapped block that is freed for the least of those to come, up to 32 MiB with its own
header and pages (DEFAULT_MMAP_THRESHOLD_MAX in malloc.c)."""
_returned: list[bool] = []
"""Whether this process is one that returns large arrays."""


def return_large_arrays() -> None:
    """For processes that make one edit and end: glibc learns to keep blocks of up to 32 MiB for the next ones, which
    pays in the studio. Elsewhere than with glibc nothing changes."""
    if sys.platform.startswith("linux"):
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(MALLOC.mmap_threshold, MALLOC.min_returned_bytes)
            mallopt(MALLOC.trim_threshold, MALLOC.most_idle_bytes)
            mallopt(MALLOC.arena_max, MALLOC.most_arenas)
            _returned.append(True)


def share_one_heap() -> None:
    """For processes that work on several threads, before the first of these: what one thread has freed serves the
    others. With a heap for each, the studio's first stroke on a million Gaussians had 33,000 page faults in place of
    400 to 11,000, and 1,270 to 1,290 MiB in place of 1,055. Elsewhere than with glibc nothing changes."""
    if sys.platform.startswith("linux"):
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(MALLOC.arena_max, MALLOC.most_arenas)


def keep_freed_arrays() -> None:
    """For processes that make edits: glibc keeps what arrays of up to 32 MiB have freed, which it does by itself after
    the first large one. Before it pages go back and come again: 3,000 of a dab on 100,000 Gaussians, an eighth of its
    CPU time. Where `return_large_arrays` was called, or elsewhere than with glibc, nothing changes."""
    # Nobody writes to it, so it never becomes memory.
    np.empty(LARGEST_LEARNT_BYTES, np.uint8)


def return_idle_memory() -> None:
    """Between two steps of such a process: free pieces amid its heap go back to the system, too."""
    if _returned:
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's alone
        if trim is not None:
            trim(0)
