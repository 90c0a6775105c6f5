"""What a process keeps of the memory that it has freed."""

from __future__ import annotations

import ctypes
import sys

MIN_RETURNED_BYTES = 4 << 20
"""Arrays from this size on go back to the system when they are freed: 50 of 275 MiB at the peak of the demo's edit,
for 0.1 s of page faults. Smaller ones are worth keeping."""
_M_MMAP_THRESHOLD = -3
"""Of malloc.h."""


def return_large_arrays() -> None:
    """For processes that make one edit and end: glibc learns to keep blocks of up to 32 MiB for the next ones, which
    pays in the studio. Elsewhere than with glibc nothing changes."""
    if sys.platform.startswith("linux"):
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(_M_MMAP_THRESHOLD, MIN_RETURNED_BYTES)
