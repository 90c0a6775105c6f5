"""Run one kernel on several threads: `run(kernel, *args)` calls kernel(*args, thread, threads) once per thread.

A kernel (splatpainter.kernels.library) releases the GIL and takes its share of the work from (thread, threads).
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ClassVar, TypeVar

from splatpainter.kernels.library import Kernel

THREADS_VARIABLE = "SPLATPAINTER_THREADS"
MIN_SHARED_NUMBERS = 1 << 16
"""Numbers from which on a kernel that hardly does more than read them is worth a second thread: it takes some 20
microseconds of work, and longer to wake, as long as 40,000 numbers take to be read."""
Item = TypeVar("Item")
Result = TypeVar("Result")
_local = threading.local()


def cpus() -> int:
    """CPUs that this process may use: those that `taskset` or a container left it, where the system tells."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def threads() -> int:
    """Threads per kernel: the environment variable SPLATPAINTER_THREADS, else `cpus()`; 1 inside `each`, and no more
    than `at_most` says. Raises ValueError when the variable is not a positive integer."""
    # Items are shared among threads already; each of them runs its kernels alone.
    most = getattr(_local, "most", None)
    if most == 1:
        return 1
    count = _all_threads()
    return count if most is None else min(most, count)


def _all_threads() -> int:
    text = os.environ.get(THREADS_VARIABLE)
    if not text:
        return cpus()
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"{THREADS_VARIABLE}: expected a positive integer, got {text!r}")
    return int(text)


def run(kernel: Callable[..., Any], *args: Any) -> None:
    """Call kernel(*args, thread, threads) for every thread and wait for all; the caller's thread does its share.
    Workers never wait for other workers, so any number of callers may run at once."""
    count = threads()
    share = kernel.bind(*args) if isinstance(kernel, Kernel) else functools.partial(kernel, *args)
    # No thread is woken for nothing.
    if count == 1:
        share(0, 1)
        return
    rest = [_Helper.take() for _ in range(1, count)]
    for thread, helper in enumerate(rest, 1):
        helper.begin(share, thread, count)
    try:
        share(0, count)
    finally:
        # Also when the caller's own share fails (Ctrl-C): the arrays must outlive every worker.
        errors = [helper.end() for helper in rest]
        for error in filter(None, errors):
            raise error


def run_sized(size: int, kernel: Callable[..., Any], *args: Any) -> None:
    """`run`, or by the caller's thread alone where there is too little to share out. size: numbers that the kernel
    reads or writes."""
    if size < MIN_SHARED_NUMBERS:
        kernel(*args, 0, 1)
    else:
        run(kernel, *args)


def each(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """[function(item) for item in items], the items shared out over threads; kernels inside run on one thread each. For
    many small jobs, where waking threads for every kernel would cost more than the kernels."""
    results: list[Any] = [None] * len(items)

    def share(thread: int, count: int) -> None:
        with alone():
            for i in range(thread, len(items), count):
                results[i] = function(items[i])

    run(share)
    return results


def alone() -> contextlib.AbstractContextManager[None]:
    """Kernels that this thread calls inside run on it alone: of work that is to leave the other CPUs free."""
    return at_most(1)


@contextlib.contextmanager
def at_most(count: int) -> Iterator[None]:
    """Kernels that this thread calls inside run on so many threads, or fewer."""
    before = getattr(_local, "most", None)
    _local.most = count if before is None else min(count, before)
    try:
        yield
    finally:
        _local.most = before


def beside(function: Callable[[], Result]) -> Callable[[], Result]:
    """Begin function() on a thread beside the caller's, for long work that leaves Python alone (hashes, files, large
    arrays); the call that is returned waits for its result, and raises what it raised. With one thread function()
    runs when the result is asked for."""
    if threads() == 1:
        return function
    results: list[Result] = []
    errors: list[BaseException] = []

    def work() -> None:
        try:
            results.append(function())
        except BaseException as error:  # raised by whoever waits for it
            errors.append(error)

    # A thread of its own: an executor would import logging, and this begins a few times in a process.
    worker = threading.Thread(target=work, name="splatpainter beside")
    worker.start()

    def result() -> Result:
        worker.join()
        for error in errors:
            raise error
        return results[0]

    return result


def ahead(items: Iterable[Item]) -> Iterator[Item]:
    """The same items, each made on a thread beside the caller's while that works with the one before: memory of the one
    before the last may be used again. Raises what making them raises. With one thread they are made when asked for."""
    count = threads()
    if count == 1:
        yield from items
        return
    source = iter(items)
    made: list[Item] = []
    ends = False

    def make(thread: int, helpers: int) -> None:
        nonlocal ends
        # One thread is with the item before.
        with at_most(count - 1):
            try:
                made.append(next(source))
            except StopIteration:
                ends = True

    while True:
        # Asked before the next one begins, which a quick thread has made by the next line: it would come too early, and
        # nothing would be made beside it.
        ready = bool(made)
        helper = _Helper.take()
        helper.begin(make, 1, 2)
        try:
            if ready:
                yield made.pop(0)
        finally:
            error = helper.end()
        if error is not None:
            raise error
        if ends:
            return


class _Helper:
    """A thread that takes shares of kernels, one after the other. Handed over by two locks: an executor's futures cost
    more than most kernels of a small edit."""

    idle: ClassVar[deque[_Helper]] = deque()
    """Those that wait, the last one first: its thread may still be awake."""

    def __init__(self) -> None:
        self._begins, self._ended = threading.Lock(), threading.Lock()
        self._begins.acquire()
        self._ended.acquire()
        self._share: Callable[[], None] | None = None
        self._error: BaseException | None = None
        threading.Thread(target=self._serve, name="splatpainter", daemon=True).start()

    @staticmethod
    def take() -> _Helper:
        """One that waits, or a new one."""
        try:
            return _Helper.idle.pop()
        except IndexError:
            return _Helper()

    def begin(self, share: Callable[[int, int], None], thread: int, count: int) -> None:
        self._share = functools.partial(share, thread, count)
        self._begins.release()

    def end(self) -> BaseException | None:
        """Wait for what was begun: what it raised."""
        self._ended.acquire()
        error, self._error = self._error, None
        _Helper.idle.append(self)
        return error

    def _serve(self) -> None:
        while True:
            self._begins.acquire()
            assert self._share is not None
            try:
                self._share()
            except BaseException as error:  # raised by whoever waits for it
                self._error = error
            self._share = None  # which holds the arrays
            self._ended.release()


def _forget() -> None:
    """A forked child has none of its parent's threads: waiting for them would hang."""
    _Helper.idle.clear()


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_forget)
