"""The one batch of a studio: planned, at work in a program of its own (`splatpainter batch --events`), done. Its jobs
and their results outlive the pages that asked for them, and end with the studio.

The program gives way to the studio, and it ends when its stdin does: also where the studio is killed.
"""

from __future__ import annotations

import contextlib
import json
import secrets
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import field
from pathlib import Path
from typing import IO, Any, Literal

from splatpainter.batch.plan import Job, JobList
from splatpainter.server.batches.batch_folder import JOBS
from splatpainter.sources.backends.command import last_line
from splatpainter.system import processes
from splatpainter.system.quick_dataclass import dataclass

BatchState = Literal["planned", "running", "cancelling", "done", "cancelled"]
JobState = Literal["queued", "running", "done", "failed", "cancelled"]
PROGRAM = (sys.executable, "-P", "-m", "splatpainter", "batch", JOBS, "--events")
"""Run in the batch's folder: so what it says names files below it, and no others."""
CANCEL_SECONDS = 15.0
"""Seconds between asking the program to end and ending it."""
MAX_LINE_BYTES = 4 << 20
"""Most bytes of one event."""
ERRORS = "stderr.txt"


@dataclass
class BatchJob:
    """One result of a batch, or what has become of it."""

    job: Job
    words: str
    """What is done for it."""
    state: JobState = "queued"
    record: dict[str, Any] = field(default_factory=dict)
    """Record of the job, as in its summary.json, once it is done or failed."""


@dataclass
class StudioBatch:
    """All jobs of one batch."""

    id: str
    folder: Path
    title: str
    """One line for people."""
    plan: JobList
    jobs: list[BatchJob]
    state: BatchState = "planned"
    child: subprocess.Popen[bytes] | None = None
    follower: threading.Thread | None = None
    deadline: threading.Timer | None = None
    """Ends the program where it does not end when it is asked to."""

    @property
    def at_work(self) -> bool:
        return self.state in ("running", "cancelling")


class Batches:
    """The studio's one batch, if there is any; may be used from several threads."""

    def __init__(self, root: Path) -> None:
        """root: the folder in which its folder is made."""
        self._root = root
        self._lock = threading.RLock()
        self._present: StudioBatch | None = None
        self._preparing = False
        self.revision = 0
        """How often something changed: what was described at a lower one is older. Read before describing."""
        self.changed: Callable[[StudioBatch | None, int | None], None] = lambda batch, number: None
        """Called, from any thread, with the batch and the number of the job that changed; None: the whole of it."""

    @property
    def present(self) -> StudioBatch | None:
        return self._present

    def get(self, id: str) -> StudioBatch:
        """The batch of this id. Raises ValueError for one that is no longer available."""
        batch = self._present
        if batch is None or batch.id != id:
            raise ValueError("batch: no longer available; make it again")
        return batch

    def make(self, prepare: Callable[[Path], tuple[JobList, list[str], str]]) -> StudioBatch:
        """Plan another batch; the results of the one before are removed. prepare: fills a new folder and returns the
        jobs, what is done for each, and the title. Raises ValueError: one is at work, and what `prepare` refuses."""
        # Held only while it is decided: copying projects takes long, and other commands must not wait for it.
        with self._lock:
            if self._preparing or (self._present is not None and self._present.at_work):
                raise ValueError("batch: another one is running; cancel it, or wait for its end")
            self._preparing = True
        id = secrets.token_hex(8)
        folder = self._root / id
        try:
            plan, words, title = prepare(folder)
            jobs = [BatchJob(job, word) for job, word in zip(plan.jobs, words, strict=True)]
            batch = StudioBatch(id, folder, title, plan, jobs)
        except BaseException:
            # Half a folder is no batch; the one before stays where it was.
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            with self._lock:
                self._preparing = False
        # Replaced in one step, and the old results go only when nobody can ask for them any more.
        with self._lock:
            before, self._present = self._present, batch
        if before is not None:
            shutil.rmtree(before.folder, ignore_errors=True)
        self._tell(batch, None)
        return batch

    def start(self, id: str) -> StudioBatch:
        """Raises ValueError: not planned, or the program cannot be started."""
        # State and child change together, so that two pages cannot start it twice.
        with self._lock:
            batch = self.get(id)
            if batch.state != "planned":
                raise ValueError(f"batch: is {batch.state} already; plan another one")
            try:
                # What the program complains of goes to a file, whose last line explains an early end.
                with open(batch.folder / ERRORS, "wb") as errors:
                    batch.child = processes.begin_background(
                        PROGRAM, cwd=batch.folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors
                    )
            except OSError as error:
                raise ValueError(f"batch: cannot be started ({error.strerror or error})") from None
            batch.state = "running"
            # A thread reads its events, so that no command has to wait for it.
            batch.follower = threading.Thread(target=self._follow, args=(batch,), name="studio-batch", daemon=True)
            batch.follower.start()
        self._tell(batch, None)
        return batch

    def cancel(self, id: str) -> StudioBatch:
        """End it; results that are done stay. Raises ValueError: it is not at work."""
        with self._lock:
            batch = self.get(id)
            if batch.state != "running":
                raise ValueError(f"batch: is {batch.state}; there is nothing to cancel")
            # Its stdin is closed: the program ends by itself and leaves whole files.
            batch.state = "cancelling"
            assert batch.child is not None
            child = batch.child
            with contextlib.suppress(OSError):
                child.stdin.close()  # type: ignore[union-attr]
            # One that does not listen is ended; results that are done stay either way.
            batch.deadline = threading.Timer(CANCEL_SECONDS, processes.kill, (child,))
            batch.deadline.daemon = True
            batch.deadline.start()
        self._tell(batch, None)
        return batch

    def discard(self, id: str) -> None:
        """Remove a batch that is not at work, with its results. Raises ValueError."""
        with self._lock:
            batch = self.get(id)
            if batch.at_work:
                raise ValueError("batch: is at work; cancel it first")
            self._present = None
        # Outside of the lock: removing many files takes a while.
        shutil.rmtree(batch.folder, ignore_errors=True)
        self._tell(None, None)

    def close(self) -> None:
        """End whatever is at work, and remove everything."""
        with self._lock:
            batch, self._present = self._present, None
            # Clients are gone by now, so nobody is told.
            self.changed = lambda batch, number: None
        if batch is None:
            return
        # The studio ends, so the program is not asked but ended; finished jobs are on the disk.
        if batch.child is not None:
            processes.kill(batch.child)
        if batch.follower is not None:
            batch.follower.join()
        if batch.deadline is not None:
            batch.deadline.cancel()
        shutil.rmtree(batch.folder, ignore_errors=True)

    def _tell(self, batch: StudioBatch | None, number: int | None) -> None:
        """Report a change to `changed`."""
        with self._lock:
            # Counted up before it is told, so that each event has a number of its own.
            self.revision += 1
        self.changed(batch, number)

    def _follow(self, batch: StudioBatch) -> None:
        """Read what the program says until it ends."""
        child = batch.child
        assert child is not None and child.stdout is not None and child.stdin is not None
        ended = False
        # Only what the program says in its own format; libraries print lines of theirs.
        for event in _events(child.stdout):
            if event.get("event") == "end":
                ended = True
                continue
            number = event.get("job")
            # A number that is none of ours is a fault of the program's and must not stop the reading.
            if not isinstance(number, int) or not 0 <= number < len(batch.jobs):
                continue
            job = batch.jobs[number]
            if event["event"] == "started":
                job.state = "running"
            else:
                job.record = event["record"]
                job.state = "done" if job.record.get("status") == "done" else "failed"
            self._tell(batch, number)
        # Both ends are closed and the child is reaped, or it would stay as a zombie until the studio ends.
        child.stdout.close()
        with contextlib.suppress(OSError):
            child.stdin.close()
        processes.reap(child)
        # Jobs that were not done by then will not be; each one gets the reason.
        with self._lock:
            if batch.deadline is not None:
                batch.deadline.cancel()
            cancelled = batch.state == "cancelling"
            reason = f"the batch ended too early{last_line(batch.folder / ERRORS)}"
            for job in batch.jobs:
                if job.state in ("queued", "running"):
                    job.state = "cancelled" if cancelled else "failed"
                    job.record = {"error": "cancelled" if cancelled else reason}
            batch.state = "cancelled" if cancelled else "done"
        if not ended:
            (batch.folder / "out" / "index.html").unlink(missing_ok=True)  # it does not say what has become of all
        self._tell(batch, None)


def _events(stream: IO[bytes]) -> Any:
    while line := stream.readline(MAX_LINE_BYTES):
        try:
            event = json.loads(line)
        except ValueError:
            continue  # a stray line of a library
        if isinstance(event, dict) and event.get("event") in ("started", "ended", "end"):
            yield event
