"""The order of work: one thread changes the asset, job after job; others look at it. The event loop never waits.

Knows no session. A job is a function of its Ticket, by which it reports progress and learns that it was cancelled.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")
READER_THREADS, BACKGROUND_THREADS = 2, 1
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
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="studio-writer")
        self._readers = ThreadPoolExecutor(READER_THREADS, thread_name_prefix="studio-reader")
        self._background = ThreadPoolExecutor(BACKGROUND_THREADS, thread_name_prefix="studio-background")
        self._max_jobs, self._waiting = max_jobs, 0

    async def write(self, job: Callable[[Ticket], Result], ticket: Ticket) -> Result:
        """The result of a job that may change the asset. Raises what it raises, Cancelled and Busy."""
        return await self._run(self._writer, job, ticket)

    async def read(self, job: Callable[[Ticket], Result], ticket: Ticket) -> Result:
        """The result of a job that only looks at snapshots."""
        return await self._run(self._readers, job, ticket)

    async def background(self, job: Callable[[Ticket], Result], ticket: Ticket) -> Result:
        """The result of a long job that only looks at snapshots."""
        return await self._run(self._background, job, ticket)

    async def _run(self, lane: ThreadPoolExecutor, job: Callable[[Ticket], Result], ticket: Ticket) -> Result:
        if self._waiting >= self._max_jobs:
            raise Busy

        def checked() -> Result:
            ticket.check()
            return job(ticket)

        self._waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(lane, checked)
        finally:
            self._waiting -= 1

    def close(self) -> None:
        """Wait for the jobs in work; those that have not begun are dropped."""
        for lane in (self._writer, self._readers, self._background):
            lane.shutdown(wait=True, cancel_futures=True)
