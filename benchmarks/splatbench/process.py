"""Child processes of the benches: workers, fresh interpreters, commands of other systems, the studio's server.

Each is begun in a group of its own and supervised in a `child` block: whatever ends that block ends the process and all
that it started. Built on `splatpainter.system.processes`; knows neither cases nor methods nor splats.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from splatpainter.kernels.parallel import THREADS_VARIABLE
from splatpainter.system import processes

PIPE, DEVNULL = subprocess.PIPE, subprocess.DEVNULL
MAX_ERROR_CHARS = 400
"""Most characters of an error in a table."""
MAX_LOG_LINE_CHARS = 160
LOG_TAIL_BYTES = 65536
"""Bytes at the end of a log that are searched for its last line."""
FRESH = "from splatbench.process import answer_fresh; answer_fresh()"
OTHER_ENVIRONMENT = (
    "PYTHONPATH",
    "PYTHONHOME",
    "VIRTUAL_ENV",
    "PYTHONWARNINGS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
)
"""Variables of this process that other systems do not get: they mean this environment, or this machine's sharing."""
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|[\x00-\x08\x0b\x0c\x0e-\x1f]")
SERVER_PATIENCE_SECONDS = 120
"""Seconds for a server to end after an interrupt."""


@contextlib.contextmanager
def child(command: Sequence[str], *, grace: bool = False, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """`subprocess.Popen` in a group of its own, which does not outlive the block; its pipes are closed. grace: it is
    asked to end first, and killed after processes.GRACE_SECONDS. Raises OSError where it cannot be started."""
    process = processes.begin(list(command), **options)
    try:
        yield process
    finally:
        if grace:
            processes.end(process)
        elif process.poll() is None:
            processes.kill(process)
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe is not None:
                with contextlib.suppress(OSError):  # what it did not read
                    pipe.close()


# One measurement in a fresh interpreter.


@dataclass(frozen=True)
class FreshRun:
    """Result of a fresh process."""

    result: Any
    """What the function returned, through JSON."""
    seconds: float
    """Seconds from the start of the process to its end."""
    peak_mib: float
    """Largest resident memory of the process; NaN where the system does not tell."""


def in_fresh_process(task: str, arguments: dict[str, Any], environment: dict[str, str] | None = None) -> FreshRun:
    """Call task ("module:function") with keyword arguments in a new interpreter. Arguments and result are JSON values;
    environment: variables to add. Raises RuntimeError with the last line of a process that fails."""
    job = json.dumps({"task": task, "arguments": arguments}).encode()
    variables = {**os.environ, **(environment or {})}
    start = time.perf_counter()
    with child([sys.executable, "-c", FRESH], env=variables, stdin=PIPE, stdout=PIPE, stderr=PIPE) as process:
        output, errors = process.communicate(job)
    seconds = time.perf_counter() - start
    if process.returncode:
        lines = errors.decode(errors="replace").strip().splitlines()
        last = lines[-1] if lines else f"exit code {process.returncode}"
        raise RuntimeError(f"bench: {task} failed in a fresh process: {last}")
    answer = json.loads(output.decode(errors="replace").splitlines()[-1])
    peak = answer["peak_mib"]
    return FreshRun(answer["result"], seconds, math.nan if peak is None else peak)


def answer_fresh() -> None:
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
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    if sys.platform == "win32":
        return math.nan
    try:
        import resource
    except ImportError:
        return math.nan
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1 << 20 if sys.platform == "darwin" else 1 << 10)


def forget_peak() -> None:
    """Start the peak of resident memory anew, where the system can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


# A command of another system.


def run_command(
    command: Sequence[str],
    folder: Path,
    log: Path,
    *,
    timeout: float,
    environment: Mapping[str, str] | None = None,
    python: str = "",
) -> float:
    """Seconds that a command took. It runs in `folder`, reads nothing, and appends its output to `log`. environment:
    variables besides this process's. python: its interpreter, whose folder goes first on PATH, as if its environment
    were active.

    Raises ValueError, with the last line of its output and the log's path: it cannot be started, ends with another
    status than 0, or takes longer than `timeout` seconds. All of its group are ended then, and also when this process
    is interrupted or killed."""
    variables = {k: v for k, v in os.environ.items() if k not in OTHER_ENVIRONMENT} | {"PYTHONUNBUFFERED": "1"}
    if os.path.dirname(python):
        variables["PATH"] = os.path.dirname(python) + os.pathsep + variables.get("PATH", "")
    variables |= environment or {}
    name = " ".join([os.path.basename(command[0]), *command[1:3]]).splitlines()[0][:60]
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "ab") as output, contextlib.ExitStack() as stack:
        output.write(f"$ {' '.join((word.splitlines() or [''])[0] for word in command)}\n".encode())
        output.flush()
        streams = {"stdin": DEVNULL, "stdout": output, "stderr": subprocess.STDOUT}
        start = time.perf_counter()
        try:
            process = stack.enter_context(child(command, grace=True, cwd=folder, env=variables, **streams))
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ValueError(f"{name}: cannot be started ({reason}; log: {log})") from None
        watch = processes.watch_command(process.pid)  # ends the group when this process is killed
        with child(watch, stdin=PIPE, stdout=DEVNULL, stderr=DEVNULL) as guard:
            try:
                status = process.wait(timeout)
            except subprocess.TimeoutExpired:
                raise ValueError(f"{name}: took longer than {timeout:g} s; {_logged(log)}") from None
            finally:
                seconds = time.perf_counter() - start
                guard.kill()  # before the end of its pipe makes it kill: the group is ended politely first
    if status:
        how = f"ended by signal {-status}" if status < 0 else f"ended with status {status}"
        raise ValueError(f"{name}: {how}; {_logged(log)}")
    return seconds


def last_log_line(log: Path) -> str:
    """The last line of a log that says something, since `run_command` wrote its command ("$ ...") there: no escape
    codes, no empty lines, no carets under code; of a line drawn over and over (a progress bar), its last state. "":
    there is none."""
    try:
        with open(log, "rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - LOG_TAIL_BYTES, 0))
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return ""
    for line in reversed(text.split("\n")):
        states = [CONTROL.sub("", part).strip() for part in line.split("\r")]
        line = next((state for state in reversed(states) if state), "")
        if line.startswith("$ "):
            return ""
        if re.search(r"\w", line):
            return line[:MAX_LOG_LINE_CHARS]
    return ""


def _logged(log: Path) -> str:
    return f"{last_log_line(log) or 'it said nothing'} (log: {log})"


# A server.


@contextlib.contextmanager
def server(
    command: Sequence[str], ready: str, environment: Mapping[str, str] | None = None
) -> Iterator[tuple[subprocess.Popen[bytes], re.Match[str]]]:
    """A server process and the match of `ready`, a regular expression, in the first line on its stderr that has one.
    environment: variables besides this process's. At the end it is interrupted as by Ctrl-C, and killed where that
    does not help. Raises RuntimeError with its last line where it ends before."""
    variables = {**os.environ, **(environment or {})}
    with child(command, stdout=DEVNULL, stderr=PIPE, env=variables) as process:
        assert process.stderr is not None
        last, match = "", None
        for line in process.stderr:
            last = line.decode(errors="replace").strip()
            if match := re.search(ready, last):
                break
        if match is None:
            raise RuntimeError(last or f"exit code {process.wait()}")
        drain = threading.Thread(target=process.stderr.read)  # a full pipe would stop the server
        drain.start()
        try:
            yield process, match
        finally:
            if process.poll() is None:
                processes.interrupt(process)
            try:
                process.wait(SERVER_PATIENCE_SECONDS)
            except subprocess.TimeoutExpired:
                processes.kill(process)
            drain.join()


# Workers: child processes that go through lists and report line by line; one that dies costs the item it had in hand.
#
# A worker gets one JSON line on stdin, {..., "items": [{"label": ...}, ...]}, and writes {"begin": LABEL} and {"end":
# LABEL, "message": ""} lines on stdout. Its stdin stays open: when this process dies, however, the worker reads its end
# and stops.


@dataclass(frozen=True)
class WorkerJob:
    """What one worker does; a new one goes on where one died."""

    name: str
    values: dict[str, Any]
    """JSON values, without items."""
    items: tuple[dict[str, Any], ...]
    log: Path
    """Gets what the worker writes on stderr, and what the code in it prints."""
    threads: int | None = None
    """Per worker; None: as many as this process would use."""


@dataclass(frozen=True)
class WorkerEvent:
    """An item is done."""

    job: WorkerJob = field(repr=False)
    label: str
    message: str = ""
    """The worker's remark about it."""
    crash: str = ""
    """How the worker ended while it was at this item; "": it did not."""


class Workers:
    """A pool as a context: no worker outlives the block."""

    def __init__(self, command: Sequence[str]) -> None:
        """command: a program that calls `answer_jobs`."""
        self._command = tuple(command)
        self._live: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._closed = False

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all workers, and start no more."""
        with self._lock:
            self._closed = True
            live = list(self._live)
        for process in live:
            processes.kill(process)

    def run(self, jobs: Sequence[WorkerJob], at_once: int = 1) -> Iterator[WorkerEvent]:
        """Events of all jobs, `at_once` workers at a time, jobs in their order."""
        if at_once <= 1 or len(jobs) <= 1:
            for job in jobs:
                yield from self._events(job)
            return
        inbox: SimpleQueue[WorkerEvent | BaseException | None] = SimpleQueue()

        def follow(job: WorkerJob) -> None:
            try:
                for event in self._events(job):
                    inbox.put(event)
                inbox.put(None)
            except BaseException as error:
                inbox.put(error)

        pool = ThreadPoolExecutor(at_once, thread_name_prefix="workers")
        try:
            for job in jobs:
                pool.submit(follow, job)
            running = len(jobs)
            while running:
                event = inbox.get()
                if isinstance(event, BaseException):
                    raise event
                if event is None:
                    running -= 1
                else:
                    yield event
        except BaseException:
            self.close()
            raise
        finally:
            pool.shutdown(cancel_futures=True)

    def _events(self, job: WorkerJob) -> Iterator[WorkerEvent]:
        pending = [item["label"] for item in job.items]
        job.log.parent.mkdir(parents=True, exist_ok=True)
        while pending and not self._closed:
            current, code = "", 0
            with open(job.log, "ab") as log, contextlib.ExitStack() as stack:
                start = log.tell()
                process = self._start(job, pending, log, stack)
                if process is None:
                    return
                for report in _reports(process):
                    if "begin" in report:
                        current = report["begin"]
                    elif report["end"] in pending:
                        pending.remove(report["end"])
                        current = ""
                        yield WorkerEvent(job, report["end"], report.get("message", ""))
                code = processes.reap(process)
            if self._closed or not pending:
                return
            reason = _reason(code, job.log, start)
            lost = [current] if current in pending else list(pending)  # one that does not even begin never would
            for label in lost:
                pending.remove(label)
                yield WorkerEvent(job, label, crash=reason)

    def _start(
        self, job: WorkerJob, labels: Sequence[str], log: Any, stack: contextlib.ExitStack
    ) -> subprocess.Popen[bytes] | None:
        """A worker at work on these items until `stack` ends; None once this is closed."""
        items = [item for item in job.items if item["label"] in labels]
        text = json.dumps({**job.values, "items": items}) + "\n"
        variables = dict(os.environ)
        if job.threads is not None:
            variables |= {THREADS_VARIABLE: str(job.threads), "OMP_NUM_THREADS": str(job.threads)}
        with self._lock:
            if self._closed:
                return None
            process = stack.enter_context(child(self._command, stdin=PIPE, stdout=PIPE, stderr=log, env=variables))
            self._live.add(process)
        stack.callback(self._forget, process)
        assert process.stdin is not None
        with contextlib.suppress(OSError):  # it died at once: its exit code tells (a broken pipe; EINVAL on Windows)
            process.stdin.write(text.encode())
            process.stdin.flush()
        return process

    def _forget(self, process: subprocess.Popen[bytes]) -> None:
        with self._lock:
            self._live.discard(process)


def answer_jobs(begin: Callable[[dict[str, Any]], Callable[[dict[str, Any]], str]]) -> None:
    """The other end of `Workers`: read the job, go through its items. begin(job) gives the function that does one item
    and returns a message; what either prints goes to the log."""
    job = json.loads(sys.stdin.readline())
    threading.Thread(target=_stop_with_parent, daemon=True, name="stop with parent").start()
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as channel:
        os.dup2(2, 1)

        def report(**values: str) -> None:
            channel.write(json.dumps(values) + "\n")
            channel.flush()

        work = begin(job)
        for item in job["items"]:
            report(begin=item["label"])
            report(end=item["label"], message=work(item))


def one_line(error: BaseException) -> str:
    """An exception in one line, with its kind where it is no ValueError of ours."""
    text = " ".join(str(error).split()) or type(error).__name__
    return (text if isinstance(error, ValueError) else f"{type(error).__name__}: {text}")[:MAX_ERROR_CHARS]


def _stop_with_parent() -> None:
    """End this process, and what it has started, when stdin ends."""
    while os.read(0, 4096):
        pass
    processes.end_this_group()


def _reports(process: subprocess.Popen[bytes]) -> Iterator[dict[str, Any]]:
    assert process.stdout is not None
    for line in process.stdout:
        with contextlib.suppress(ValueError):
            report = json.loads(line)
            if isinstance(report, dict) and ("begin" in report or "end" in report):
                yield report


def _reason(code: int, log: Path, start: int) -> str:
    if code < 0:
        name = processes.signal_name(code)
        hint = "; out of memory?" if name == "SIGKILL" else ""
        return f"its process ended by {name}{hint}"
    with open(log, "rb") as file:
        file.seek(start)
        lines = file.read().decode(errors="replace").strip().splitlines()
    return f"its process ended with exit code {code}" + (f": {lines[-1].strip()}" if lines else "")[:MAX_ERROR_CHARS]
