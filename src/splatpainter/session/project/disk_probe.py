"""What a folder's file system refuses: file locks (NFS without its lock daemon, Lustre, some SMB) and maps that several
processes share (9p, virtiofs, vboxsf). Knows no project.

Locks are tried with a new, empty file that nobody else knows, through SQLite: whatever SQLite needs is what is tried,
on every system and whatever the error is called there. Whoever opened a project's own file here and closed it again
would lose the locks that this process has on it: so POSIX has it.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import sqlite3
from pathlib import Path

NO_LOCKS = "its file system refuses file locks"
"""Why a project cannot be written in a folder."""
LOCAL_DISK = "use a folder on a local disk"
"""What helps there."""
LOCK_ERRORS = (
    "SQLITE_BUSY",
    "SQLITE_LOCKED",
    "SQLITE_PERM",
    "SQLITE_NOLFS",
    "SQLITE_PROTOCOL",
    "SQLITE_IOERR_LOCK",
    "SQLITE_IOERR_RDLOCK",
    "SQLITE_IOERR_UNLOCK",
    "SQLITE_IOERR_BLOCKED",
    "SQLITE_IOERR_CHECKRESERVEDLOCK",
)
"""Beginnings of the names of errors that locking raises; BUSY stands for ENOLCK, EACCES, EAGAIN and ETIMEDOUT too."""
PROBE_BYTES = 1 << 16
"""Bytes of a file that is written to see what the system says."""
MAP_ERRORS = ("SQLITE_IOERR_SHM", "SQLITE_READONLY_CANTINIT", "SQLITE_PROTOCOL")
"""Beginnings of the names of errors of a log (WAL) whose index cannot be shared."""


def speaks_of_locks(error: BaseException) -> bool:
    """Whether SQLite was refused a lock: somebody has it, or the file system has none."""
    return (getattr(error, "sqlite_errorname", "") or "").startswith(LOCK_ERRORS)


def speaks_of_maps(error: BaseException) -> bool:
    """Whether SQLite was refused memory that processes share."""
    return (getattr(error, "sqlite_errorname", "") or "").startswith(MAP_ERRORS)


def why_not_written(folder: Path) -> str:
    """What the system says to a file that is written in a folder: SQLite calls a quota that is used up, a disk that
    failed and one that became read-only by one name. "" where it can be written."""
    path = folder / f".locks.{secrets.token_hex(4)}.part"  # a name that `scratch.sweep_folder` knows
    try:
        with open(path, "xb") as file:
            file.write(bytes(PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error.strerror or str(error)
    finally:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
    return ""


def locks_refused(folder: Path) -> bool | None:
    """Whether no file in a folder can be locked; None where no file can be made to try it with."""
    path = folder / f".locks.{secrets.token_hex(4)}.part"  # a name that `scratch.sweep_folder` knows
    connection = None
    try:
        # A new file that nobody else knows: whatever refuses it is the file system, and no other holder.
        connection = sqlite3.connect(path, timeout=0, isolation_level=None)
        connection.execute("PRAGMA journal_mode=OFF")
        connection.execute("BEGIN EXCLUSIVE")
        return False
    except sqlite3.Error as error:
        return True if speaks_of_locks(error) else None
    finally:
        if connection is not None:
            connection.close()
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
