"""Which computer has a project open, as a note beside it (NAME.splatproj-host): locks of some network folders, and of
all folders that are synchronised, hold on one computer alone.

The note says the computer's name and, on Linux, which start of its system: containers have names of their own and share
that. It is written when a project is opened for writing and removed when it is closed. One of another computer says
that the project is open there, or that it was not closed there; nobody can tell which without a clock that both share,
so its user decides. One of this computer says nothing: here the lock holds.
"""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path

from splatpainter.io import files
from splatpainter.system.quick_dataclass import dataclass

NOTE_ENDING = "-host"
"""Ending of the note's file name, after the project's."""
MAX_NOTE_BYTES = 1 << 12
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
OPEN_THERE = "open on {}, or was not closed there: this copy is read-only; close it there or, if it is not open there, "
OPEN_THERE += "remove {}"


@dataclass(frozen=True)
class Computer:
    """One that has a project open."""

    name: str
    boot: str = ""
    """Which start of its system; "": not known."""

    def is_the_same(self, other: Computer) -> bool:
        return self.name == other.name or bool(self.boot and self.boot == other.boot)


def this_computer() -> Computer:
    """That of this process."""
    import socket  # needed by projects alone

    try:
        boot = BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        boot = ""
    # platform.node() has the same answer, but Windows is asked for its version on the way, which can take long.
    return Computer(socket.gethostname(), boot)


def note_of(project: Path) -> Path:
    """Where the note of a project lies."""
    return project.with_name(project.name + NOTE_ENDING)


def other_holder(project: Path) -> str:
    """Name of another computer that has a project open, or did not close it; "" where no note says so."""
    noted = _noted(project)
    return "" if noted is None or noted.is_the_same(this_computer()) else files.printable(noted.name, 60)


def take_note(project: Path) -> None:
    """Note that this computer has a project open. Its lock is held. Where the folder takes no file there is none."""
    computer, path = this_computer(), note_of(project)
    record = json.dumps({"name": computer.name, "boot": computer.boot})
    with contextlib.suppress(OSError):
        # A new file: what has its name may be a link to any file of this user, or a pipe, which nobody may read.
        path.unlink(missing_ok=True)
        with open(path, "x", encoding="utf-8") as file:
            file.write(record)


def drop_note(project: Path) -> None:
    """Remove this computer's note; that of another one stays."""
    if not other_holder(project):
        files.remove(note_of(project))


def _noted(project: Path) -> Computer | None:
    path = note_of(project)
    try:
        if not os.path.isfile(path):
            return None
        with open(path, "rb") as file:
            record = json.loads(file.read(MAX_NOTE_BYTES))
        name, boot = record["name"], record["boot"]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    return Computer(name, boot) if isinstance(name, str) and isinstance(boot, str) else None
