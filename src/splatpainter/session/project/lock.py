"""One writer per project file: a lock that dies with its process.

The lock is an exclusive SQLite transaction on an empty database beside the project (NAME.splatproj-lock). SQLite takes
the operating system's own file locks (fcntl, LockFileEx), so a killed process frees them at once, and two openers in
one process exclude each other too, which plain fcntl locks do not. The package filelock (data/shards.py) would do as
well; a session has SQLite at hand and needs no further package. A lock row with a heartbeat would need clocks, a time
to wait after a crash, and would trust a stopped process to be dead; locking the project database itself would keep
readers out as well. On network folders it is as good as the locks of that file system; where that refuses all locks,
no project is written (disk_probe.py tells such a refusal from a lock that somebody holds).
"""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path

from splatpainter.io import files
from splatpainter.session.project.database import connect, file_uri, is_unwritable
from splatpainter.session.project.disk_probe import LOCAL_DISK, NO_LOCKS, locks_refused, speaks_of_locks
from splatpainter.system.atomic import is_mounted_read_only

READ_ONLY_DISK = "its disk is mounted read-only"
LOCK_ENDING = "-lock"
"""Ending of the lock's file name, after the project's."""


class LockRefused(ValueError):
    """A project's lock that cannot be made, which is not that somebody holds it."""

    def __init__(self, project: Path, reason: str, words: str = "cannot be locked", advice: str = "") -> None:
        super().__init__(f"{project}: {words} ({reason}){f'; {advice}' if advice else ''}")
        self.reason = reason
        """Why, without the project's name: "its disk is mounted read-only"."""


class ProjectLock:
    """Held from `take` until `release`."""

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self._connection, self._path, self.is_held = connection, path, True

    @staticmethod
    def take(project: Path) -> ProjectLock | None:
        """The lock of a project file, or None: somebody holds it. Raises LockRefused naming the project where none can
        be made: its folder allows no new files or no locks, its disk is mounted read-only, or something else has the
        lock's name."""
        path = project.with_name(project.name + LOCK_ENDING)
        for _ in range(100):
            connection = _locked(path, project)
            if connection is None:
                return None
            # The file may have been removed by a holder who left between our opening it and our locking it: then what
            # we hold is a file without a name. If the name stands for another file, that can be locked again.
            with contextlib.suppress(ValueError):
                again = _locked(path, project, is_tried=True)
                if again is None:
                    return ProjectLock(connection, path)
                again.close()
            connection.close()
        raise LockRefused(project, "others lock and leave it again and again")

    @staticmethod
    def is_free(project: Path) -> bool:
        """Whether nobody holds a project file, at this moment. Costs one look for the lock's file, or one try to read
        it, and makes and changes nothing: any number of those who wait may ask, every few seconds."""
        path = project.with_name(project.name + LOCK_ENDING)
        if not path.exists():
            return True
        # Of a holder that was killed the file is still there. Reading it takes the lock that readers share, which a
        # holder refuses; whoever takes the lock in these microseconds is refused too, and looks again later.
        try:
            with contextlib.closing(connect(f"{file_uri(path)}?mode=ro", wait_seconds=0)) as connection:
                connection.execute("SELECT name FROM sqlite_master").fetchall()
                return True
        except sqlite3.Error:
            return not path.exists()

    def release(self) -> None:
        """Remove the file and let go. In this order: whoever locks the file in between finds that its name is gone."""
        removed, self.is_held = False, False
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)
            removed = True
        self._connection.close()
        if not removed:  # Windows removes no open file: neither ours before, nor by now that of the next holder
            files.remove(self._path)


def _locked(path: Path, project: Path, is_tried: bool = False) -> sqlite3.Connection | None:
    """None: somebody holds it. is_tried: it is known that files can be locked there."""
    connection, is_new = None, False
    try:
        is_new = not path.exists()
        if not is_new and (not path.is_file() or path.stat().st_size):  # ours are empty; `release` removes them
            raise LockRefused(project, f"{path.name} is in the way")
        connection = sqlite3.connect(path, timeout=0, isolation_level=None, check_same_thread=False)
        connection.execute("PRAGMA journal_mode=OFF")
        connection.execute("BEGIN EXCLUSIVE")
        return connection
    except FileNotFoundError:  # removed between the two looks
        return None
    except sqlite3.Error as error:
        if connection is not None:
            connection.close()
        if speaks_of_locks(error):
            if is_tried or not locks_refused(path.parent):
                return None
            if is_new:
                files.remove(path)
            raise LockRefused(project, NO_LOCKS, advice=LOCAL_DISK) from None
        if is_unwritable(error) and is_mounted_read_only(path.parent):
            raise LockRefused(project, READ_ONLY_DISK, "cannot be written") from None
        reason = "its folder allows no new files" if is_unwritable(error) else " ".join(str(error).split())
        raise LockRefused(project, reason) from None
