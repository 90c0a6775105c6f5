"""Medians over repeats, measurements in fresh processes with their peak memory, and the machine in one line.

Knows no splats. Memory is measured in a process of its own, because a peak cannot be taken back: the interpreter, the
compiled kernels and the scene are part of it.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

SIMD = ("avx512f", "avx2", "fma", "avx", "sse4_2", "asimd", "neon")
"""Flags worth naming, widest first."""
CHILD = "from splatbench.timing import child; child()"


@dataclass(frozen=True)
class Timing:
    """Repeats of one piece of work."""

    seconds: float
    """Median."""
    least: float
    """Fastest."""
    repeats: int


@dataclass(frozen=True)
class Fresh:
    """What a fresh process did."""

    result: Any
    """What the function returned, through JSON."""
    seconds: float
    """From the start of the process to its end."""
    peak_mib: float
    """Largest resident memory of the process; NaN where the system does not tell."""


def measure(work: Callable[[], Any], *, warmups: int = 1, repeats: int = 9, budget: float = 1.5) -> Timing:
    """Time `work` after `warmups` untimed calls: `repeats` times, or as often as fits `budget` seconds (at least 3)."""
    assert repeats >= 1
    for _ in range(warmups):
        work()
    laps: list[float] = []
    while len(laps) < repeats and (len(laps) < 3 or sum(laps) < budget):
        start = time.perf_counter()
        work()
        laps.append(time.perf_counter() - start)
    return Timing(statistics.median(laps), min(laps), len(laps))


def in_fresh_process(task: str, arguments: dict[str, Any], environment: dict[str, str] | None = None) -> Fresh:
    """Call task ("module:function") with keyword arguments in a new interpreter. Arguments and result are JSON values;
    environment: variables to add. Raises RuntimeError with the last line of a process that fails."""
    job = json.dumps({"task": task, "arguments": arguments})
    variables = {**os.environ, **(environment or {})}
    start = time.perf_counter()
    command = [sys.executable, "-c", CHILD]
    done = subprocess.run(command, input=job, capture_output=True, encoding="utf-8", errors="replace", env=variables)
    seconds = time.perf_counter() - start
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else f"exit code {done.returncode}"
        raise RuntimeError(f"bench: {task} failed in a fresh process: {last}")
    answer = json.loads(done.stdout.splitlines()[-1])
    peak = answer["peak_mib"]
    return Fresh(answer["result"], seconds, math.nan if peak is None else peak)


def child() -> None:
    """The other end of `in_fresh_process`: a job on stdin, an answer as the last line on stdout."""
    job = json.loads(sys.stdin.read())
    module, function = job["task"].split(":")
    result = getattr(importlib.import_module(module), function)(**job["arguments"])
    peak = peak_mib()
    print(json.dumps({"result": result, "peak_mib": None if math.isnan(peak) else peak}))


def peak_mib() -> float:
    """Largest resident memory of this process so far, MiB; NaN where the system does not tell.

    Not getrusage where there is another way: on Linux its maximum is inherited through vfork, so that the child of a
    large process looks large."""
    try:
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    except OSError:
        pass
    if sys.platform == "win32":
        return math.nan
    try:
        import resource
    except ImportError:
        return math.nan
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def machine() -> str:
    """One line: CPU, cores, SIMD, memory, versions, and how busy the machine was. Names no host and no path."""
    info = _cpuinfo()
    flags = (info.get("flags") or info.get("Features") or "").split()
    simd = [flag for flag in SIMD if flag in flags]
    model = info.get("model name") or platform.processor() or platform.machine()
    parts = [f"{model}, {_cores()} cores"]
    if simd:
        parts.append(" ".join(simd))
    if sys.platform != "win32":
        with contextlib.suppress(ValueError, OSError):
            parts.append(f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB")
    parts.append(f"{platform.system()} {platform.machine()}")
    versions = [f"{name} {_version(name)}" for name in ("numba", "numpy", "torch", "splatpainter")]
    parts.append(f"Python {platform.python_version()}, " + ", ".join(versions))
    if sys.platform != "win32":
        parts.append(f"load {os.getloadavg()[0]:.1f} at the start")
    return "; ".join(parts)


def _cores() -> int:
    from splatpainter.kernels.parallel import threads

    return threads()


def _cpuinfo() -> dict[str, str]:
    """The first processor's entries."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return {}
    pairs = (line.partition(":") for line in text.split("\n\n", 1)[0].splitlines())
    return {name.strip(): value.strip() for name, _, value in pairs}


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"
