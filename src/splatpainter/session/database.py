"""SQLite as a file that strangers may have made: bounded reading, typed columns, and its errors as one line.

What a query gives and what it costs is held against the size of the file: rows that share pages, or a tree whose
branches lead to the same leaf, would else be gigabytes and hours out of some kilobytes.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from splatpainter.io.files import printable

OPS_BETWEEN_CHECKS = 20_000
"""Instructions of SQLite's machine between two looks at how many there were."""
FREE_OPS = 20_000_000
"""Instructions that every statement or transaction may take (about a second), ..."""
OPS_PER_BYTE = 16
"""... and how many more for each byte of the file. The smallest rows take 10 bytes, and some 20 instructions each."""
BYTES_PER_VALUE = 1
"""A value takes at least that much in a file; beside texts and blobs, which take their length."""
UNWRITABLE = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_PERM", "SQLITE_AUTH")
"""Names of errors (their beginnings) that speak of the disk, not of the content."""


class ContentError(ValueError):
    """The content of a project file is not what a project holds."""


class Database:
    """A connection whose statements are bounded. Not locked: its owner orders the calls of several threads."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self.connection = path, connection
        self._ops = 0
        self._most_ops = FREE_OPS
        connection.set_progress_handler(self._count_ops, OPS_BETWEEN_CHECKS)

    def start(self) -> int:
        """Count instructions from here on. Returns the bytes of the database."""
        self._ops, self._most_ops = 0, FREE_OPS
        pages = self.connection.execute("PRAGMA page_count").fetchone()[0]
        size = pages * self.connection.execute("PRAGMA page_size").fetchone()[0]
        self._most_ops = FREE_OPS + OPS_PER_BYTE * size
        return size

    def rows(self, query: str, *values: Any, kinds: tuple[type | tuple[type, ...], ...] = ()) -> list[tuple]:
        """All rows of a query, no more bytes than the file has. kinds: expected types of the columns.
        Raises ContentError."""
        with one_line(self.path):
            left, out = self.start(), []
            for row in self.connection.execute(query, values):
                left -= sum(len(value) if isinstance(value, (str, bytes)) else BYTES_PER_VALUE for value in row)
                if left < 0:
                    raise ContentError("a query gives more bytes than the file has")
                for value, kind in zip(row, kinds, strict=True) if kinds else ():
                    if not isinstance(value, kind):
                        raise ContentError(f"unexpected {type(value).__name__} in a column")
                out.append(row)
            return out

    def _count_ops(self) -> int:
        self._ops += OPS_BETWEEN_CHECKS
        return self._ops > self._most_ops


@contextlib.contextmanager
def one_line(path: Path) -> Iterator[None]:
    """SQLite's errors, and ContentError, as ValueErrors of one line that name `path`."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError, OverflowError, RecursionError, ContentError) as error:
        message = printable(" ".join(str(error).split()), 300)  # SQLite quotes damaged bytes
        if is_unwritable(error):
            raise ValueError(f"{path}: cannot be read or written ({message}); nothing was changed") from None
        raise ValueError(f"{path}: damaged project file ({message})") from None


def is_unwritable(error: BaseException) -> bool:
    """Whether an error speaks of a full disk, missing rights or a folder that allows no files."""
    return (getattr(error, "sqlite_errorname", "") or "").startswith(UNWRITABLE)


def _uri(path: Path) -> str:
    """file:///... of a path. Not `Path.as_uri`, which makes a network folder (//server/share) a server, which SQLite
    refuses."""
    name = path.resolve().as_posix()
    return ("file://" if name.startswith("/") else "file:///") + quote(name)


def connect(uri: str) -> sqlite3.Connection:
    """A connection in autocommit mode that any thread may use."""
    return sqlite3.connect(uri, uri=True, timeout=10, isolation_level=None, check_same_thread=False)


def open_writable(path: Path) -> sqlite3.Connection:
    """The database for writing, in WAL mode; that it can be written has been tried. Raises sqlite3.Error."""
    connection = connect(f"{_uri(path)}?mode=rw")
    with closed_on_error(connection):
        _distrust(connection)
        connection.execute("PRAGMA journal_mode=WAL").fetchall()
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA fullfsync=ON")  # macOS: past the disk's own cache; nothing elsewhere
        return connection


def try_writing(connection: sqlite3.Connection) -> None:
    """Write what is there already. Raises sqlite3.Error where the disk is full or nothing may be written."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        connection.execute("UPDATE facts SET value = value WHERE name = 'cursor'")
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


def open_readable(path: Path) -> sqlite3.Connection:
    """The database for reading only; nothing in its folder is made or changed where it was closed properly.
    Raises sqlite3.Error; ValueError where its log is needed and the folder allows no files."""
    uri = f"{_uri(path)}?mode=ro"
    log = path.with_name(path.name + "-wal")
    connection = connect(uri)
    try:
        with closed_on_error(connection):
            _distrust(connection)
            return connection
    except sqlite3.OperationalError as error:
        if not is_unwritable(error):
            raise
        if log.exists() and log.stat().st_size:
            raise ValueError(
                f"{path}: was not closed, and its folder cannot be written; copy it and {log.name} to another folder"
            ) from None
    connection = connect(f"{uri}&immutable=1")
    with closed_on_error(connection):
        _distrust(connection)
        return connection


def _distrust(connection: sqlite3.Connection) -> None:
    connection.execute("PRAGMA foreign_keys=ON")
    connection.execute("PRAGMA trusted_schema=OFF")
    connection.execute("PRAGMA cell_size_check=ON")
    connection.execute("PRAGMA mmap_size=0").fetchall()
    connection.execute("SELECT name FROM sqlite_master LIMIT 1").fetchall()  # reads the file for the first time


@contextlib.contextmanager
def closed_on_error(connection: sqlite3.Connection) -> Iterator[None]:
    """Close a connection where the block raises."""
    try:
        yield
    except BaseException:
        connection.close()
        raise
