"""Which file an open project is: to notice, before anything is written, that another one has its name or that there is
none any more. Programs that synchronise folders replace, overwrite and delete files under whoever has them open; POSIX
lets them, and SQLite would go on writing into a file without a name.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from pathlib import Path

from splatpainter.session.project import database
from splatpainter.session.project.database import UnwritableError

GONE = "was deleted or moved while it was open"
REPLACED = "was replaced by another file while it was open"
OVERWRITTEN = "was overwritten by another program while it was open"
MAX_SPARE_BYTES = 32 << 20
"""Largest project file that is kept in memory as well: reading it again after a command takes a hundredth of a
second."""


class OpenFile:
    """The file that has a project's name when this is made. On Windows nobody replaces a file that is open."""

    def __init__(self, path: Path) -> None:
        """Raises UnwritableError: it cannot be reached."""
        self._path = path
        try:
            self._identity, self._written = _signature(path) or (None, None)
        except OSError as error:
            raise UnwritableError(f"{path}: cannot be reached ({error.strerror or error})") from None
        self._content: list[tuple] | None = None
        """What was written last; None: not known."""
        self._stands_alone = self._waits_in_log = False
        """Whether the file held all of it when it was noted, and whether what was committed since is in the log."""

    def note(self, connection: sqlite3.Connection) -> None:
        """What the file holds now was written through this connection. Raises nothing: what was committed is."""
        self._content = None
        self._stands_alone = self._waits_in_log = False
        with contextlib.suppress(sqlite3.Error, OSError):
            content = connection.execute(database.WRITTEN_LAST).fetchall()
            identity, written = _signature(self._path) or (None, None)
            if identity == self._identity:
                self._content, self._written = content, written
                self._stands_alone = not database.has_log(self._path)

    def waits_in_log(self) -> bool:
        """Whether a commit is in the log alone and the file as it was noted: then it is told from one that another
        program wrote, until the next `note`. SQLite folds long logs at once."""
        with contextlib.suppress(OSError):
            self._waits_in_log = self._stands_alone and _signature(self._path) == (self._identity, self._written)
        return self._waits_in_log

    def problem(self) -> str:
        """GONE, REPLACED or OVERWRITTEN, "" where the file is as it was left. Raises OSError: it cannot be reached."""
        signature = _signature(self._path)
        if signature is None:
            return GONE
        identity, written = signature
        if identity != self._identity:  # that of an open file is not given to another one
            return REPLACED
        if written != self._written:  # network folders correct the time of a file after a while
            if not self._is_as_written():
                return OVERWRITTEN
            self._written = written
        return ""

    def is_overwritten(self) -> bool:
        """Whether another program wrote into the file: what it holds now is not the project that was opened."""
        try:
            return self.problem() == OVERWRITTEN
        except OSError:
            return False

    def is_lost(self) -> str:
        """Why what is committed would not be found under the file's name, "" where it would be."""
        try:
            return self.problem()
        except OSError:
            return ""

    def check(self, has_spare: bool = False) -> None:
        """Raises UnwritableError where the file was deleted, moved or replaced, or cannot be reached, or where another
        program wrote into it and a copy of what it held is there (has_spare); ValueError where there is none."""
        try:
            problem = self.problem()
        except OSError as error:
            problem = f"cannot be reached ({error.strerror or error}), and nothing was changed"
            raise UnwritableError(f"{self._path}: {problem}; try again, or save_as another name") from None
        if problem == OVERWRITTEN and not has_spare:
            what_helps = "export what is shown, then open it again"
            raise ValueError(f"{self._path}: {problem}, and nothing was changed; {what_helps}")
        if problem:
            what_helps = "save_as another name keeps all that is open here"
            raise UnwritableError(f"{self._path}: {problem}, and nothing was changed; {what_helps}")

    def _is_as_written(self) -> bool:
        """Whether the file alone holds what was written last, as far as that can be said."""
        # Where the log may hold a part of what was noted, the file alone says nothing against it.
        if self._content is None or (database.has_log(self._path) and not self._waits_in_log):
            return True
        try:
            return database.written_last(self._path) == self._content
        except UnwritableError:
            return True
        except ValueError:
            return False


def spare_copy(path: Path) -> bytes | None:
    """A project file that stands alone, of at most MAX_SPARE_BYTES; None of others, and of what cannot be read."""
    try:
        if database.has_log(path) or path.stat().st_size > MAX_SPARE_BYTES:
            return None
        return path.read_bytes()
    except OSError:
        return None


def without_log(data: bytes) -> bytes:
    """A database file as one that has no log beside it: bytes 18 and 19 of its header, which say how it is written
    (SQLite's file format, 1.3), are 2 with a log, and none can be in memory."""
    return data[:18] + b"\x01\x01" + data[20:]


def _signature(path: Path) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """((device, inode), (nanoseconds of its last change, bytes)) of a file; None: there is none. Raises OSError."""
    try:
        status = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    return (status.st_dev, status.st_ino), (status.st_mtime_ns, status.st_size)
