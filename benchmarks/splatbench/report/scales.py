"""Axes as numbers: ticks at round values, and the way from a value to a place. Knows no drawing."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

PAD = 0.06
"""Of an axis' length, left free at both ends."""


@dataclass(frozen=True)
class Scale:
    """Values low..high to places start..stop (pixels; stop may be the smaller one)."""

    low: float
    high: float
    start: float
    stop: float
    log: bool = False

    def __call__(self, value: float) -> float:
        a, b, v = (math.log(x) if self.log else x for x in (self.low, self.high, value))
        return self.start + (v - a) / (b - a) * (self.stop - self.start)


def fitted(values: Iterable[float], start: float, stop: float, log: bool = False) -> Scale:
    """A scale on which all values have room; those that are not finite, or not positive on a log scale, are left out.
    Raises ValueError where no value is left."""
    kept = [v for v in values if math.isfinite(v) and not (log and v <= 0)]
    if not kept:
        raise ValueError("axis: expected at least one finite value" + (" above 0" if log else ""))
    low, high = min(kept), max(kept)
    if log:
        ratio = max(high / low, 10.0)
        middle, room = math.sqrt(low * high), ratio ** (0.5 + PAD)
        return Scale(middle / room, middle * room, start, stop, True)
    span = (high - low) or max(abs(high), 1.0) * 0.1
    middle = (low + high) / 2
    return Scale(middle - span * (0.5 + PAD), middle + span * (0.5 + PAD), start, stop)


def linear_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten within low..high: the finest such step that gives no more than
    `most`. low < high."""
    exponent = math.floor(math.log10((high - low) / most)) - 1
    while True:
        for factor in (1, 2, 5):
            step = factor * 10.0**exponent
            first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
            if last - first + 1 <= most:
                return [_clean(k * factor, exponent) for k in range(first, last + 1)]
        exponent += 1


def log_ticks(low: float, high: float, most: int = 7) -> list[float]:
    """1, 2 and 5 times powers of ten within low..high; only powers of ten, or only some of them, where those would be
    more than `most`. 0 < low < high."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    for factors, stride in (((1, 2, 5), 1), ((1, 3), 1), *(((1,), k) for k in range(1, last - first + 2))):
        ticks = [_clean(f, e) for e in range(first, last + 1) if e % stride == 0 for f in factors]
        ticks = [t for t in ticks if low * (1 - 1e-9) <= t <= high * (1 + 1e-9)]
        if len(ticks) <= most:
            return ticks if len(ticks) > 1 else linear_ticks(low, high, most)
    raise AssertionError("a stride longer than the axis leaves one tick")


def tick_text(value: float) -> str:
    """A tick's number, no longer than it needs to be."""
    if value != 0 and not 1e-4 <= abs(value) < 1e7:
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    text = f"{value:,.6f}".rstrip("0").rstrip(".")
    return text.replace("-", "\N{MINUS SIGN}")


def _clean(factor: int, exponent: int) -> float:
    """factor * 10^exponent, as the nearest float to that decimal number."""
    return float(f"{factor}e{exponent}")
