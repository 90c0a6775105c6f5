"""The order of work: one thread changes the asset, job after job; others look at it. The event loop never waits.

Knows no session. A job has a Ticket, by which it reports progress and learns that it was cancelled.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Literal, TypeVar

Result = TypeVar("Result")
Lane = Literal["write", "read", "background"]
THREADS: dict[Lane, int] = {"write": 1, "read": 2, "background": 2}
MAX_JOBS = 512
"""Jobs that may wait; beyond that a client is told to come back later."""


class Cancelled(Exception):
    """The job was asked to stop."""


class Busy(Exception):
    """Too many jobs wait."""


class Ticket:
    """One job's line to whoever asked for it; safe to use from any thread."""

    def __init__(self, on_progress: Callable[[float, str], None] | None = None) -> None:
        self._cancelled = threading.Event()
        self._on_progress = on_progress
        self.ends_with_page = False
        """Whether it is to be cancelled where its page stays away."""

    def cancel(self) -> None:
        """Ask the job to stop; it does at its next `check` or `report`."""
        self._cancelled.set()

    def check(self) -> None:
        """Raises Cancelled when it was asked to stop."""
        if self._cancelled.is_set():
            raise Cancelled

    def report(self, share: float, stage: str) -> None:
        """Tell how far it is (0..1). Raises Cancelled as `check`."""
        self.check()
        if self._on_progress is not None:
            self._on_progress(min(max(share, 0.0), 1.0), stage)


class WorkQueue:
    """Three lanes: `write` runs jobs one after the other, in the order in which they came; `read` is for quick looks at
    snapshots; `background` for long work that changes nothing, so that it holds up neither."""

    def __init__(self, max_jobs: int = MAX_JOBS) -> None:
        self._lanes = {lane: ThreadPoolExecutor(threads, f"studio-{lane}") for lane, threads in THREADS.items()}
        self._max_jobs, self._waiting = max_jobs, 0

    async def run(self, lane: Lane, job: Callable[[], Result], ticket: Ticket) -> Result:
        """The result of a job. Raises what it raises, Cancelled and Busy."""
        # Refused and not kept waiting: a client that sends without end must not fill the memory.
        if self._waiting >= self._max_jobs:
            raise Busy

        # Looked at when its turn comes: a job that was cancelled while it waited costs nothing.
        def checked() -> Result:
            ticket.check()
            return job()

        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._lanes[lane], checked)
        finally:
            self._waiting -= 1

    def write(self, job: Callable[[], Result]) -> Result:
        """The result of a job on the lane `write`, for a job of the lane `background`, which waits for it here. Raises
        what it raises, and Cancelled where the queue is being closed."""
        # The writer's lane has one thread, so what a background job writes keeps its place in the order.
        try:
            future = self._lanes["write"].submit(job)
        except RuntimeError:  # closed
            raise Cancelled from None
        try:
            return future.result()
        except CancelledError:
            raise Cancelled from None

    def follow(self, work: Callable[[], object]) -> None:
        """Let `work` be the next of the lane `write` but for jobs that wait already, in whatever time nobody waits for;
        not at all where the queue is being closed. Nobody hears what it raises."""
        with contextlib.suppress(RuntimeError):  # closed
            self._lanes["write"].submit(work)

    def close(self) -> None:
        """Wait for the jobs in work; those that have not begun are dropped."""
        # In order to end soon: what has begun is finished, what has not is dropped.
        for executor in self._lanes.values():
            executor.shutdown(wait=True, cancel_futures=True)
