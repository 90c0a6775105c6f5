"""Shared fixtures: the folder of real assets beside the checkout (tests that need it skip with a line when absent)."""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from _pytest.pathlib import import_path

SHARED = Path(os.environ.get("SPLATPAINTER_SHARED", Path(__file__).resolve().parents[1] / "shared"))

CHILD_PROCESSES = Path(__file__).resolve().parent / "tests" / "support" / "child_processes"
"""With a sitecustomize.py for the Python processes that tests start."""
MEMORY_DISK = Path("/dev/shm")
MIN_FREE_BYTES = 8 << 30
"""Of the memory disk, for the tests' files to lie there."""
SPARE_WORKERS = 1
"""Of xdist, more than there are cores."""
WORKER_BYTES = 2 << 30
"""Memory for a worker, its browser and what else its tests start."""
GARBAGE_OBJECTS = 50_000
"""Made since the last collection, after which the garbage collector looks at the young ones."""


def pytest_configure(config: pytest.Config) -> None:
    """Bytecode is kept, whatever the environment prefers: without it 16 s go by before the first test, and each of a
    hundred Python processes that tests start compiles its modules anew.

    A shell's background jobs ignore interrupts; tests that interrupt themselves would wait for ever.

    Of several workers each runs kernels on one thread: waking others for arrays of tests takes a tenth of the time of
    tests that render and lift. Tests of threads say how many (SPLATPAINTER_THREADS decides otherwise).

    Temporary files lie in memory where the system has a disk of it: half of the time of tests that commit to project
    files hundreds of times was the disk's. TMPDIR decides otherwise."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config, "workerinput"):
        os.environ.setdefault("SPLATPAINTER_THREADS", "1")
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    search_path = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if str(CHILD_PROCESSES) not in search_path:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(CHILD_PROCESSES), *search_path]))
    if "TMPDIR" not in os.environ and MEMORY_DISK.is_dir() and os.access(MEMORY_DISK, os.W_OK):
        if shutil.disk_usage(MEMORY_DISK).free >= MIN_FREE_BYTES:
            os.environ["TMPDIR"] = str(MEMORY_DISK)
            tempfile.tempdir = None  # is looked up again


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """What is imported while tests are collected stays: the garbage collector need not walk through torch for it, and
    not again in every test. In tests it comes after many objects, not after 700: kernels and networks are made of many.

    Of several workers each but the first imports a share of the test files of its own before all others: each file is
    rewritten by one worker, and the rest find its bytecode."""
    gc.disable()
    try:
        worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
        if worker > 0:
            _import_share(session, worker, int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))
        return (yield)
    finally:
        _remember_parsers()
        _remember_meshes()
        gc.freeze()
        gc.set_threshold(GARBAGE_OBJECTS, 20, 20)
        gc.enable()


def pytest_xdist_auto_num_workers() -> int:
    """Of `-n auto`: one more than there are cores, as tests that wait for a browser, a cluster or a program leave
    theirs idle (a second one would import and load more than it keeps busy), but no more than fit into memory."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):  # no such call on Windows
        return cores
    return max(min(cores + SPARE_WORKERS, memory // WORKER_BYTES), 1)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """xdist's workers start with equal runs of the tests, and take from the ends of each other's runs when theirs is
    over. Half of the runs start with the tests in a browser: these take longest and wait most, and the other half of
    the workers keeps the cores busy meanwhile. All runs end with short tests: none waits for another's last."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    runs: list[list[pytest.Item]] = [[] for _ in range(workers)]
    in_browser: dict[Path, list[pytest.Item]] = {}
    rest: list[pytest.Item] = []
    for item in items:
        drives = "browser" in getattr(item, "fixturenames", ())
        (in_browser.setdefault(item.path, []) if drives else rest).append(item)
    for tests in in_browser.values():  # one after the other: a browser that starts is 2 s of CPU time
        min(runs[: max(workers // 2, 1)], key=_weight).extend(tests)
    rest.sort(key=lambda test: test.get_closest_marker("slow") is None)
    items.clear()
    for left, run in zip(range(workers, 0, -1), reversed(runs), strict=True):
        count = max((len(rest) + sum(map(len, runs[:left]))) // left - len(run), 0)
        items += run + rest[:count]
        del rest[:count]
    items += rest


def _weight(tests: list[pytest.Item]) -> int:
    """About how long tests in a browser take."""
    return sum(4 if test.get_closest_marker("slow") else 1 for test in tests)


def _remember_parsers() -> None:
    """A parser is built once per process and command, not a thousand times: 10 ms each. What tyro makes of a dataclass
    is frozen, and knows none of the words. It has no public name: where it gets another one, all parsers are built."""
    specification = getattr(sys.modules.get("tyro._parsers"), "ParserSpecification", None)
    from_type = getattr(specification, "from_callable_or_type", None)
    if specification is None or from_type is None:
        return
    parsers: dict[Any, Any] = {}

    def remembered(f: Any, **settings: Any) -> Any:
        if settings.get("parent_classes") or settings.get("intern_prefix"):  # a part of another one
            return from_type(f, **settings)
        key = f, repr(settings)
        if key not in parsers:
            parsers[key] = from_type(f, **settings)
        return parsers[key]

    specification.from_callable_or_type = staticmethod(remembered)


def _remember_meshes() -> None:
    """Procedural objects are made once per process: most tests of training and of its data take the same few, and
    their textures are an eighth of such tests' time. Tests of `random_mesh` have imported the function itself."""
    procedural = sys.modules.get("splattrain.data.procedural")
    if procedural is not None:
        setattr(procedural, "random_mesh", functools.lru_cache(maxsize=32)(procedural.random_mesh))  # noqa: B010


def _import_share(session: pytest.Session, worker: int, workers: int) -> None:
    """Import one of so many equal parts of the test files of the folders that were asked for, as pytest will. A file
    that cannot be imported is for its collection to show."""
    folders = [session.config.invocation_params.dir / word.split("::")[0] for word in session.config.args]
    files = sorted({file for folder in folders if folder.is_dir() for file in folder.rglob("test_*.py")})
    for file in files[len(files) * worker // workers : len(files) * (worker + 1) // workers]:
        with contextlib.suppress(Exception):
            import_path(file, mode="importlib", root=session.config.rootpath, consider_namespace_packages=False)


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


def pytest_make_parametrize_id(val: object) -> str | None:
    """File contents are called "bytes" in test names: gzip and zip write the time, and workers must agree on names."""
    return "bytes" if isinstance(val, bytes | bytearray) else None
