"""Medians over repeats, and the machine in one line. Knows no splats."""

from __future__ import annotations

import contextlib
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

CALIBRATION_NUMBERS = 500_000
SIMD = ("avx512f", "avx2", "fma", "avx", "sse4_2", "asimd", "neon")
"""Flags worth naming, widest first."""


@dataclass(frozen=True)
class Timing:
    """Repeats of one piece of work."""

    seconds: float
    """Seconds, median."""
    fastest: float
    repeats: int


def measure(work: Callable[[], Any], *, warmups: int = 1, repeats: int = 9, budget: float = 1.5) -> Timing:
    """Time `work` after `warmups` untimed calls: `repeats` times, or as often as fits `budget` seconds (at least 3)."""
    assert repeats >= 1
    for _ in range(warmups):
        work()
    times: list[float] = []
    while len(times) < repeats and (len(times) < 3 or sum(times) < budget):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return Timing(statistics.median(times), min(times), len(times))


def calibration() -> float:
    """Seconds of a fixed piece of numpy's work on one core (sums, products, a sort, roots of half a million numbers),
    the fastest of several: what lines of a run are divided by, so that machines and days compare."""
    values = np.random.default_rng(0).random(CALIBRATION_NUMBERS, np.float32)

    def work() -> float:
        return float(np.sqrt(np.sort(values) * values + values).cumsum(dtype=np.float64)[-1])

    return measure(work, repeats=9, budget=2).fastest


def machine() -> str:
    """One line: CPU, cores, SIMD, memory, versions, and how busy the machine was. Names no host and no path."""
    from splatpainter.kernels.parallel import threads

    info = _cpuinfo()
    flags = (info.get("flags") or info.get("Features") or "").split()
    simd = [flag for flag in SIMD if flag in flags]
    model = info.get("model name") or platform.processor() or platform.machine()
    parts = [f"{model}, {threads()} cores"]
    if simd:
        parts.append(" ".join(simd))
    if sys.platform != "win32":
        with contextlib.suppress(ValueError, OSError):
            parts.append(f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB")
    parts.append(f"{platform.system()} {platform.machine()}")
    versions = [f"{name} {installed_version(name)}" for name in ("numpy", "torch", "splatpainter")]
    parts.append(f"Python {platform.python_version()}, " + ", ".join(versions))
    if sys.platform != "win32":
        parts.append(f"load {os.getloadavg()[0]:.1f} at the start")
    return "; ".join(parts)


def _cpuinfo() -> dict[str, str]:
    """The first processor's entries."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return {}
    pairs = (line.partition(":") for line in text.split("\n\n", 1)[0].splitlines())
    return {name.strip(): value.strip() for name, _, value in pairs}


def installed_version(package: str) -> str:
    """Of a distribution; "absent" where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"
