"""Shared fixtures: the folder of real assets beside the checkout (tests that need it skip with a line when absent)."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import pytest

from tests.support.worker_runs import in_runs

SHARED = Path(os.environ.get("SPLATPAINTER_SHARED", Path(__file__).resolve().parents[1] / "shared"))
MEMORY_DISK = Path("/dev/shm")
MIN_FREE_BYTES = 8 << 30
"""Of the memory disk, for the tests' files to lie there."""
WORKER_BYTES = 2 << 30
"""Memory for a worker, its browser and what else its tests start."""


def pytest_configure(config: pytest.Config) -> None:
    # A shell's background jobs ignore interrupts; tests that interrupt themselves would wait for ever.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    # Of several workers each runs kernels on one thread; tests of threads say how many.
    if hasattr(config, "workerinput"):
        os.environ.setdefault("SPLATPAINTER_THREADS", "1")
    # Bytecode is kept: without it each of a hundred Python processes that tests start compiles its modules anew.
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # Temporary files lie in memory where there is room (TMPDIR decides otherwise): disks take half of some tests' time.
    if "TMPDIR" not in os.environ and MEMORY_DISK.is_dir() and os.access(MEMORY_DISK, os.W_OK):
        if shutil.disk_usage(MEMORY_DISK).free >= MIN_FREE_BYTES:
            os.environ["TMPDIR"] = str(MEMORY_DISK)
            tempfile.tempdir = None  # is looked up again


def pytest_xdist_auto_num_workers() -> int:
    """Of `-n auto`: one more than there are cores, as tests that wait for a browser, a cluster or a program leave
    theirs idle, but no more than fit into memory."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # no such call on Windows
        return cores
    return max(min(cores + 1, memory // WORKER_BYTES), 1)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items[:] = in_runs(items, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))


def pytest_make_parametrize_id(val: object) -> str | None:
    """File contents are called "bytes" in test names: gzip and zip write the time, and workers must agree on names."""
    return "bytes" if isinstance(val, bytes | bytearray) else None


@pytest.fixture(scope="session")
def shared() -> Path:
    """The shared folder with data/ and perceptual/."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"no real assets: {SHARED / 'data'} is absent (set SPLATPAINTER_SHARED)")
    return SHARED


@pytest.fixture(params=["float32", "bfloat16"])
def precision(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The test runs twice, with networks in float32 and in bf16: any machine can do both, some slowly."""
    monkeypatch.setenv("SPLATPAINTER_PRECISION", request.param)
    return request.param


@pytest.fixture
def float32(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks in float32, for tests of its rounding, whatever this machine or the environment prefers."""
    monkeypatch.setenv("SPLATPAINTER_PRECISION", "float32")
