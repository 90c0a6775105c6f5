"""One process that tries inputs of one target, one after the other, under limits. What it does stands in shared memory,
so that the supervisor knows the input at which it died."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .target import Fault, Target, make_target, rng_of

FIELDS = (
    "stop",
    "seed",
    "started",
    "inputs",
    "opened",
    "refused",
    "failures",
    "slowest_us",
    "slowest_seed",
    "peak_kib",
)
"""Of the shared array of integers. started: 1 once the first input is tried."""
ROOM = 3 << 30
"""Bytes of address space beyond what the warmed-up process has."""


def scratch_root() -> str | None:
    """A folder in memory where there is one."""
    return "/dev/shm" if os.path.isdir("/dev/shm") and os.access("/dev/shm", os.W_OK) else None


def work(name: str, first: int, step: int, count: int, seconds: float, out: str, shared: Any) -> None:
    """Try up to `count` inputs with seeds first, first + step, ..., for at most `seconds`."""
    indices = {field: k for k, field in enumerate(FIELDS)}
    warnings.simplefilter("error")  # no warning may reach the user
    unraisable: list[str] = []
    sys.unraisablehook = lambda what: unraisable.append(f"{what.err_msg or 'ignored'}: {what.exc_value!r}")
    folder = Path(tempfile.mkdtemp(prefix="splatpainter-fuzz-", dir=scratch_root()))
    target = None
    try:
        target = make_target(name, folder)
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            target.warm_up()
        _limit_memory()
        base = _peak_kib()
        until = time.monotonic() + seconds
        shared[indices["started"]] = 1
        for k in range(count):
            if shared[indices["stop"]] or time.monotonic() > until:
                break
            seed = first + k * step
            shared[indices["seed"]] = seed
            cpu = time.process_time()
            fault = attempt(target, name, seed, shared, indices)
            spent = time.process_time() - cpu
            peak = _peak_kib()
            if fault is None and unraisable:
                fault = f"raised where nobody can catch it: {unraisable[0]}", ""
            if fault is None and (peak - base) * 1024 > target.memory_limit:
                fault = f"memory: the peak rose by {(peak - base) >> 10} MiB", ""
            if fault is None and spent > target.seconds_limit:
                fault = f"slow: {spent:.1f} CPU seconds", ""
            base = max(base, peak)
            unraisable.clear()
            if fault is not None:
                shared[indices["failures"]] += 1
                save_failure(Path(out), target, name, seed, *fault)
            shared[indices["inputs"]] += 1
            shared[indices["peak_kib"]] = peak
            if spent * 1e6 > shared[indices["slowest_us"]]:
                shared[indices["slowest_us"]], shared[indices["slowest_seed"]] = int(spent * 1e6), seed
    finally:
        if target is not None:
            target.close()
        shutil.rmtree(folder, ignore_errors=True)


def attempt(target: Target, name: str, seed: int, shared: Any, indices: dict[str, int]) -> tuple[str, str] | None:
    """(what went wrong in one line, traceback) of one input; None where all is well."""
    rng = rng_of(name, seed)
    try:
        verdict = target.check(target.make(rng), rng)
    except (KeyboardInterrupt, SystemExit):
        raise
    except Fault as error:
        return str(error), traceback.format_exc()
    except BaseException as error:
        return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}", traceback.format_exc()
    shared[indices["opened"]] += verdict.opened
    shared[indices["refused"]] += verdict.refused
    return None


def save_failure(out: Path, target: Target | None, name: str, seed: int, line: str, trace: str) -> Path:
    """Write the input, and what went wrong, to out/NAME-SEED."""
    folder = out / f"{name}-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(Exception):  # a fault of the mutations themselves is in the record
        for file, data in target.make(rng_of(name, seed)).items() if target is not None else ():
            (folder / file).write_bytes(data)
    record = {"target": name, "seed": seed, "fault": line, "where": last_lines(trace)}
    (folder / "fault.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    (folder / "trace.txt").write_text(trace, encoding="utf-8", errors="replace")
    return folder


def last_lines(trace: str) -> list[str]:
    """Innermost frames of the package in a traceback: two faults with the same ones are taken for one."""
    frames = [line.strip() for line in trace.splitlines() if line.strip().startswith("File ")]
    inside = [line for line in frames if "src/splatpainter/" in line.replace("\\", "/")]
    short = [line.replace("\\", "/").rpartition("src/splatpainter/")[2] for line in inside or frames]
    return [line.replace('"', "") for line in short[-2:]]


def _limit_memory() -> None:
    """Address space beyond which an allocation fails, where the system has such a limit."""
    if sys.platform == "win32":
        return
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ROOM, resource.RLIM_INFINITY))
    except (ImportError, OSError, ValueError, IndexError):
        return


def _peak() -> Callable[[], int]:
    status = Path("/proc/self/status")
    if status.exists():  # on Linux getrusage also counts what the parent had when it made this process
        return lambda: int(status.read_text(encoding="ascii").split("VmHWM:", 1)[1].split(None, 1)[0])
    if sys.platform == "win32":  # the peak is not watched there
        return lambda: 0
    import resource

    unit = 1024 if sys.platform == "darwin" else 1
    return lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // unit


_peak_kib = _peak()
"""Peak resident KiB of this process."""
