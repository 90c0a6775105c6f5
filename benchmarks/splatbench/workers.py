"""Child processes that work through lists and report line by line; one that dies costs the item it had in hand.

A child gets one JSON line on stdin, {..., "items": [{"label": ...}, ...]}, and writes {"begin": LABEL} and {"end":
LABEL, "said": ""} lines on stdout. Its stdin stays open: when this process dies, however, the child reads its end and
stops. Knows neither cases nor methods.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from splatpainter import processes
from splatpainter.kernels.parallel import VARIABLE

COMMAND: tuple[str, ...] = (sys.executable, "-m", "splatbench.worker")
LONGEST = 400
"""Characters of an error in a table."""


@dataclass(frozen=True)
class Plan:
    """What one child does; a new one goes on where one died."""

    name: str
    job: dict[str, Any]
    """JSON values, without items."""
    items: tuple[dict[str, Any], ...]
    log: Path
    """Gets what the child writes on stderr, and what the code in it prints."""
    threads: int | None = None
    """Per child; None: as many as this process would use."""


@dataclass(frozen=True)
class Event:
    """An item is done."""

    plan: Plan = field(repr=False)
    label: str
    said: str = ""
    """What the child had to say about it."""
    died: str = ""
    """How the child ended while it was at this item; "": it did not."""


class Children:
    """As a context: no child outlives the block."""

    def __init__(self) -> None:
        self._live: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._closed = False

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all children, and start no more."""
        with self._lock:
            self._closed = True
            live = list(self._live)
        for child in live:
            _end(child)

    def run(self, plans: Sequence[Plan], at_once: int = 1) -> Iterator[Event]:
        """Events of all plans, `at_once` children at a time, plans in their order."""
        if at_once <= 1 or len(plans) <= 1:
            for plan in plans:
                yield from self._walk(plan)
            return
        inbox: SimpleQueue[Event | BaseException | None] = SimpleQueue()

        def follow(plan: Plan) -> None:
            try:
                for event in self._walk(plan):
                    inbox.put(event)
                inbox.put(None)
            except BaseException as error:
                inbox.put(error)

        pool = ThreadPoolExecutor(at_once, thread_name_prefix="children")
        try:
            for plan in plans:
                pool.submit(follow, plan)
            left = len(plans)
            while left:
                event = inbox.get()
                if isinstance(event, BaseException):
                    raise event
                if event is None:
                    left -= 1
                else:
                    yield event
        except BaseException:
            self.close()
            raise
        finally:
            pool.shutdown(cancel_futures=True)

    def _walk(self, plan: Plan) -> Iterator[Event]:
        left = [item["label"] for item in plan.items]
        plan.log.parent.mkdir(parents=True, exist_ok=True)
        while left and not self._closed:
            begun = ""
            with open(plan.log, "ab") as log:
                start = log.tell()
                child = self._start(plan, left, log)
                if child is None:
                    return
                try:
                    for told in _lines(child):
                        if "begin" in told:
                            begun = told["begin"]
                        elif told["end"] in left:
                            left.remove(told["end"])
                            begun = ""
                            yield Event(plan, told["end"], told.get("said", ""))
                    code = processes.reap(child)
                finally:
                    _end(child)
                    with self._lock:
                        self._live.discard(child)
            if self._closed or not left:
                return
            reason = _reason(code, plan.log, start)
            lost = [begun] if begun in left else list(left)  # one that does not even begin would not with the others
            for label in lost:
                left.remove(label)
                yield Event(plan, label, died=reason)

    def _start(self, plan: Plan, labels: Sequence[str], log: Any) -> subprocess.Popen[bytes] | None:
        """A child at work on these items; None when no more are wanted."""
        items = [item for item in plan.items if item["label"] in labels]
        text = json.dumps({**plan.job, "items": items}) + "\n"
        variables = dict(os.environ)
        if plan.threads is not None:
            variables |= {VARIABLE: str(plan.threads), "OMP_NUM_THREADS": str(plan.threads)}
        with self._lock:
            if self._closed:
                return None
            pipe = subprocess.PIPE
            child = processes.begin(COMMAND, stdin=pipe, stdout=pipe, stderr=log, env=variables)
            self._live.add(child)
        assert child.stdin is not None
        with contextlib.suppress(OSError):  # it died at once: its exit code tells (a broken pipe; EINVAL on Windows)
            child.stdin.write(text.encode())
            child.stdin.flush()
        return child


def stop_with_parent() -> None:
    """In a child that has read its job: end it, and what it has started, when stdin ends."""

    def wait() -> None:
        while os.read(0, 4096):
            pass
        processes.end_own_group()

    threading.Thread(target=wait, daemon=True, name="stop with parent").start()


def last_line(error: BaseException) -> str:
    """An exception in one line, with its kind where it is no ValueError of ours."""
    text = " ".join(str(error).split()) or type(error).__name__
    return (text if isinstance(error, ValueError) else f"{type(error).__name__}: {text}")[:LONGEST]


def _lines(child: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    assert child.stdout is not None
    for line in child.stdout:
        with contextlib.suppress(ValueError):
            told = json.loads(line)
            if isinstance(told, dict) and ("begin" in told or "end" in told):
                yield told


def _end(child: subprocess.Popen[bytes]) -> None:
    """Kill a child and its group, if it is still there, and close its pipes."""
    if child.poll() is None:
        processes.kill(child)
    child.wait()
    for pipe in (child.stdin, child.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


def _reason(code: int, log: Path, start: int) -> str:
    if code < 0:
        name = processes.signal_name(code)
        hint = "; out of memory?" if name == "SIGKILL" else ""
        return f"its process ended by {name}{hint}"
    with open(log, "rb") as file:
        file.seek(start)
        said = file.read().decode(errors="replace").strip().splitlines()
    return f"its process ended with exit code {code}" + (f": {said[-1].strip()}" if said else "")[:LONGEST]
