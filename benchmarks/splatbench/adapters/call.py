"""One command of another system: its time, its output in a log, a time limit, and no process left behind."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from splatpainter import processes

DROPPED = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "PYTHONWARNINGS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables of this process that mean another environment, or this machine's sharing among processes."""
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|[\x00-\x08\x0b\x0c\x0e-\x1f]")
TAIL = 65536
"""Bytes of a log that are searched for its last line."""


def run(
    command: Sequence[str],
    folder: Path,
    log: Path,
    *,
    timeout: float,
    environment: Mapping[str, str] | None = None,
    python: str = "",
) -> float:
    """Seconds that a command took. It runs in `folder` in a process group of its own, reads nothing, and appends what
    it says to `log`. environment: variables besides this process's. python: its interpreter, whose folder goes first on
    PATH, as if its environment were active.

    Raises ValueError, with the last line that it said and the log's path: it cannot be started, ends with another
    status than 0, or takes longer than `timeout` seconds. All of its group are ended then, and also when this process
    is interrupted or killed."""
    surroundings = {k: v for k, v in os.environ.items() if k not in DROPPED} | {"PYTHONUNBUFFERED": "1"}
    if os.path.dirname(python):
        surroundings["PATH"] = os.path.dirname(python) + os.pathsep + surroundings.get("PATH", "")
    surroundings |= environment or {}
    name = " ".join([os.path.basename(command[0]), *command[1:3]]).splitlines()[0][:60]
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "ab") as output:
        output.write(f"$ {' '.join((word.splitlines() or [''])[0] for word in command)}\n".encode())
        output.flush()
        start = time.perf_counter()
        try:
            child = processes.begin(
                list(command),
                cwd=folder,
                env=surroundings,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise ValueError(f"{name}: cannot be started ({reason}; log: {log})") from None
        try:
            with _guarded(child):
                status = child.wait(timeout)
        except subprocess.TimeoutExpired:
            raise ValueError(f"{name}: took longer than {timeout:g} s; {_said(log)}") from None
        finally:
            seconds = time.perf_counter() - start
            processes.end(child)
    if status:
        how = f"ended by signal {-status}" if status < 0 else f"ended with status {status}"
        raise ValueError(f"{name}: {how}; {_said(log)}")
    return seconds


def last_line(log: Path) -> str:
    """The last line of a log that says something, since `run` wrote its command ("$ ...") there: no escape codes, no
    empty lines, no carets under code; of a line drawn over and over (a progress bar), its last state. "": none does."""
    try:
        with open(log, "rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - TAIL, 0))
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return ""
    for line in reversed(text.split("\n")):
        shown = [CONTROL.sub("", part).strip() for part in line.split("\r")]
        line = next((part for part in reversed(shown) if part), "")
        if line.startswith("$ "):
            return ""
        if re.search(r"\w", line):
            return line[:160]
    return ""


@contextlib.contextmanager
def _guarded(child: subprocess.Popen[bytes]) -> Iterator[None]:
    """While this lasts, the child's group ends with this process, even where that is killed: another process waits for
    the end of a pipe that only this one holds."""
    quiet = subprocess.DEVNULL
    command = processes.watch_command(child.pid)
    guard = processes.begin(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet)
    try:
        yield
    finally:
        guard.kill()
        guard.wait()
        assert guard.stdin is not None
        guard.stdin.close()


def _said(log: Path) -> str:
    line = last_line(log)
    return f"{line or 'it said nothing'} (log: {log})"
