"""Child processes together with whatever they start: begun as a group of their own, ended as one.

On POSIX that is a session with its process group. Windows has neither: there a child gets a console group, which can be
sent Ctrl-Break, and is ended with all below it by `taskkill /T`, as long as it lives itself.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

GRACE_SECONDS = 5.0
"""Seconds between asking processes to end and ending them."""
BACKGROUND_NICE = 10
"""Niceness of processes that give way to others; 19 is the most."""
BACKGROUND_OOM_SCORE = 500
"""Score, of 1000: Linux ends them first where memory runs out."""
WATCH_WINDOWS = (
    "import subprocess, sys; sys.stdin.buffer.read(); "
    "subprocess.run(['taskkill', '/F', '/T', '/PID', sys.argv[1]], capture_output=True)"
)


def begin(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """`subprocess.Popen` in a group of its own: Ctrl-C reaches this process alone, which then ends its children."""
    if sys.platform == "win32":
        # A group of its own can be ended as a whole, with whatever the child started.
        flags = subprocess.CREATE_NEW_PROCESS_GROUP | options.pop("creationflags", 0)
        return subprocess.Popen(command, creationflags=flags, **options)
    return subprocess.Popen(command, start_new_session=True, **options)


def begin_background(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """`begin`, for work that gives way to everything else: to the processor, and where memory runs out."""
    if sys.platform == "win32":
        return begin(command, creationflags=subprocess.BELOW_NORMAL_PRIORITY_CLASS, **options)
    child = begin(command, **options)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PGRP, child.pid, BACKGROUND_NICE)
    with contextlib.suppress(OSError), open(f"/proc/{child.pid}/oom_score_adj", "w", encoding="ascii") as file:
        file.write(str(BACKGROUND_OOM_SCORE))
    return child


def kill(child: subprocess.Popen[Any]) -> None:
    """End a child of `begin` and its group at once, if there is any of it. Where it is reaped and leaves nobody behind,
    nothing happens."""
    if sys.platform == "win32":
        if child.poll() is None:
            _taskkill(child.pid)
            with contextlib.suppress(OSError):
                child.kill()
    else:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(child.pid, signal.SIGKILL)


def interrupt(child: subprocess.Popen[Any]) -> None:
    """What Ctrl-C is to a child of `begin` (Windows: Ctrl-Break, as Ctrl-C does not reach other groups)."""
    with contextlib.suppress(OSError):
        child.send_signal(signal.CTRL_BREAK_EVENT if sys.platform == "win32" else signal.SIGINT)


def end(child: subprocess.Popen[Any]) -> None:
    """End a child of `begin` and whatever is left of its group, also what it started and left behind: asked first, by
    force after GRACE_SECONDS."""
    if sys.platform == "win32":
        if child.poll() is None:
            with contextlib.suppress(OSError):
                child.send_signal(signal.CTRL_BREAK_EVENT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(GRACE_SECONDS)
        kill(child)
    else:
        # Asked first, so that it can remove files in the making.
        for sign, patience in ((signal.SIGTERM, GRACE_SECONDS), (signal.SIGKILL, 1.0)):
            try:
                os.killpg(child.pid, sign)
            except (ProcessLookupError, PermissionError):
                break
            until = time.monotonic() + patience
            while time.monotonic() < until and _group_alive(child):
                time.sleep(0.02)
    with contextlib.suppress(subprocess.TimeoutExpired):
        child.wait(1.0)


def reap(child: subprocess.Popen[Any]) -> int:
    """The exit code of a child of `begin` that is about to end; what it started and left behind is killed."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # its group is its own until it is reaped
        kill(child)
        return child.wait()
    code = child.wait()  # Python for macOS has waitid from 3.13 on only
    kill(child)
    return code


def watch_command(pid: int) -> list[str]:
    """A process that reads its stdin to the end and then ends the group of process `pid`: whoever holds the other end
    of that pipe takes the group along when it is killed."""
    if sys.platform == "win32":
        return [sys.executable, "-S", "-c", WATCH_WINDOWS, str(pid)]
    return ["/bin/sh", "-c", 'read line; kill -s KILL -- "-$1"', "sh", str(pid)]


def end_this_group() -> None:
    """End this process and, where it leads its group, what it has started. Does not return."""
    if sys.platform != "win32" and os.getpgrp() == os.getpid():
        os.killpg(os.getpgrp(), signal.SIGKILL)
    if sys.platform == "win32":
        _taskkill(os.getpid())
    os._exit(1)


def signal_name(code: int) -> str:
    """Name of the signal that ended a process, by its exit code (negative on POSIX; Windows has none): "SIGKILL"."""
    return signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"


def _taskkill(pid: int) -> None:
    with contextlib.suppress(OSError):
        subprocess.run(["taskkill", "/F", "/T", "/PID", str(pid)], capture_output=True, check=False)


def _group_alive(child: subprocess.Popen[Any]) -> bool:
    """Whether anybody of the child's group is left. The child itself is reaped, so that it does not count dead."""
    child.poll()
    if sys.platform == "win32":
        return child.returncode is None
    try:
        os.killpg(child.pid, 0)
    except (ProcessLookupError, PermissionError):
        return False
    return True
