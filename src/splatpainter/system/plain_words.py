"""Numbers and failures in words, as people read them in lines of output."""

from __future__ import annotations

import math


def reason(error: BaseException) -> str:
    """What the system said, without errno and file name."""
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def count(number: int, singular: str, plural: str = "") -> str:
    """`1 Gaussian`, `12,345 Gaussians`."""
    return f"{number:,} {singular if number == 1 else plural or singular + 's'}"


def size(number: int) -> str:
    """Bytes for people: `3.99 MB`."""
    for unit, power in (("GB", 9), ("MB", 6), ("kB", 3)):
        if number >= 10**power:
            return f"{number / 10**power:.2f} {unit}"
    return f"{number} bytes"


def seconds(timings: dict[str, float]) -> str:
    """`read 0.12 s, lift 0.31 s`."""
    return ", ".join(f"{name} {value:.2f} s" for name, value in timings.items())


def decibels(value: float | None) -> str:
    """`28.4 dB`; None: there was no such pixel; identical pictures have no number."""
    if value is None:
        return "no pixels"
    return f"{value:.1f} dB" if math.isfinite(value) and value < 999 else "identical"
