"""The project file as an SQLite database that strangers may have made: its tables, bounded reading, typed columns, and
errors of one line.

`application_id` says that a database is ours and `user_version` which version; both stand in the first 100 bytes, so a
file of another version is refused before SQLite touches it.

What a query gives and what it costs is held against the size of the file: rows that share pages, or a tree whose
branches lead to the same leaf, would else be gigabytes and hours out of some kilobytes.
"""

from __future__ import annotations

import contextlib
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from splatpainter.io import files
from splatpainter.session.project.disk_probe import (
    LOCAL_DISK,
    LOCK_ERRORS,
    NO_LOCKS,
    locks_refused,
    speaks_of_locks,
    speaks_of_maps,
    why_not_written,
)

APPLICATION_ID = 0x53504C50
"""ASCII "SPLP"."""
VERSION = 1
"""Of the tables and of what stands in them: the only one that is read (docs/compatibility.md)."""
SUFFIX = ".splatproj"
MAX_LOG_BYTES = 4 << 20
"""Most bytes of the log beside an open project, after it was folded back into the file."""

TABLES = """
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE original (file TEXT NOT NULL, part INTEGER NOT NULL, bytes BLOB NOT NULL, PRIMARY KEY (file, part));
CREATE TABLE blobs (sha256 TEXT PRIMARY KEY, bytes BLOB NOT NULL);
CREATE TABLE layers (
    id INTEGER PRIMARY KEY, sha256 TEXT NOT NULL UNIQUE, content TEXT NOT NULL, previous INTEGER
);
CREATE TABLE layer_blobs (
    layer INTEGER NOT NULL REFERENCES layers ON DELETE CASCADE, blob TEXT NOT NULL, PRIMARY KEY (layer, blob)
) WITHOUT ROWID;
CREATE TABLE steps (
    id INTEGER PRIMARY KEY, label TEXT NOT NULL, gesture TEXT, policies TEXT NOT NULL, next_id INTEGER NOT NULL,
    assets TEXT
);
CREATE TABLE step_layers (
    step INTEGER NOT NULL REFERENCES steps ON DELETE CASCADE, place INTEGER NOT NULL, layer INTEGER NOT NULL,
    PRIMARY KEY (step, place)
) WITHOUT ROWID;
CREATE TABLE step_results (
    step INTEGER NOT NULL REFERENCES steps ON DELETE CASCADE, result TEXT NOT NULL, PRIMARY KEY (step, result)
) WITHOUT ROWID;
CREATE TABLE results (key TEXT PRIMARY KEY, facts TEXT NOT NULL, confidence BLOB, state BLOB, previous TEXT);
CREATE TABLE deltas (
    result TEXT NOT NULL REFERENCES results ON DELETE CASCADE, part INTEGER NOT NULL, bytes BLOB NOT NULL,
    PRIMARY KEY (result, part)
);
CREATE TABLE bookmarks (id INTEGER PRIMARY KEY, name TEXT NOT NULL, camera TEXT NOT NULL);
CREATE INDEX step_layers_by_layer ON step_layers (layer);
CREATE INDEX layer_blobs_by_blob ON layer_blobs (blob);
CREATE INDEX step_results_by_result ON step_results (result);
"""

MAX_SCHEMA_ROWS = 64
"""Tables and indexes that are looked at."""
OPS_BETWEEN_CHECKS = 20_000
"""Instructions of SQLite's machine between two looks at how many there were."""
FREE_OPS = 20_000_000
"""Instructions that every statement or transaction may take (about a second)."""
OPS_PER_BYTE = 16
"""How many more it may take for each byte of the file. The smallest rows take 10 bytes, and some 20
instructions each."""
BYTES_PER_VALUE = 1
"""A value takes at least that much in a file; beside texts and blobs, which take their length."""
UNWRITABLE = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_AUTH", *LOCK_ERRORS)
"""Names of errors (their beginnings) that speak of the disk, or of who else has the file, not of the content."""
WAIT_SECONDS = 10.0
"""How long a statement waits for another connection to let go of the file."""
UNUSED_LOG = "-wal.unused"
"""Ending of what a log that does not belong to its file is called from then on."""


class ContentError(ValueError):
    """The content of a project file is not what a project holds."""


class UnwritableError(ValueError):
    """The disk is full, or does not let the project be written: another place may."""


class Database:
    """A connection whose statements are bounded. Not locked: its owner orders the calls of several threads."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self.connection = path, connection
        self._ops = 0
        self._max_ops = FREE_OPS
        connection.set_progress_handler(self._count_ops, OPS_BETWEEN_CHECKS)

    def start(self) -> int:
        """Count instructions from here on. Returns the bytes of the database."""
        self._ops, self._max_ops = 0, FREE_OPS
        # By the size of the file, which a stranger has to send: cost then grows with what was sent.
        pages = self.connection.execute("PRAGMA page_count").fetchone()[0]
        size = pages * self.connection.execute("PRAGMA page_size").fetchone()[0]
        self._max_ops = FREE_OPS + OPS_PER_BYTE * size
        return size

    def rows(self, query: str, *values: Any, kinds: tuple[type | tuple[type, ...], ...] = ()) -> list[tuple]:
        """All rows of a query, no more bytes than the file has. kinds: expected types of the columns.
        Raises ContentError."""
        with one_line(self.path):
            # Counted while rows come, so that a query without end is stopped and not collected.
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
        return self._ops > self._max_ops


@contextlib.contextmanager
def one_line(path: Path) -> Iterator[None]:
    """SQLite's errors, and ContentError, as ValueErrors of one line that name `path`."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError, OverflowError, RecursionError, ContentError) as error:
        # Locks first: their errors count as unwritable too, and what helps is another disk, not more room.
        message = files.printable(" ".join(str(error).split()), 300)  # SQLite quotes damaged bytes
        if speaks_of_locks(error) and locks_refused(path.parent):
            message = f"{NO_LOCKS}; {LOCAL_DISK}"
            raise UnwritableError(f"{path}: cannot be read or written, and nothing was changed: {message}") from None
        if is_unwritable(error):
            # Of a full disk SQLite knows; of all else it says "disk I/O error".
            vague = (getattr(error, "sqlite_errorname", "") or "").startswith("SQLITE_IOERR")
            reason = (why_not_written(path.parent) if vague else "") or message
            raise UnwritableError(f"{path}: cannot be read or written ({reason}); nothing was changed") from None
        raise ValueError(f"{path}: damaged project file ({message})") from None


def is_unwritable(error: BaseException) -> bool:
    """Whether an error speaks of a full disk, missing rights, a lock, or a folder that allows no files."""
    return (getattr(error, "sqlite_errorname", "") or "").startswith(UNWRITABLE)


def file_uri(path: Path) -> str:
    """file:///... of a path. Not `Path.as_uri`, which makes a network folder (//server/share) a server, which SQLite
    refuses."""
    name = path.resolve().as_posix()
    return ("file://" if name.startswith("/") else "file:///") + quote(name)


def connect(uri: str, wait_seconds: float = WAIT_SECONDS) -> sqlite3.Connection:
    """A connection in autocommit mode that any thread may use."""
    return sqlite3.connect(uri, uri=True, timeout=wait_seconds, isolation_level=None, check_same_thread=False)


def open_writable(path: Path) -> sqlite3.Connection:
    """The database for writing, with a log (WAL); where the file system has no maps that processes can share, with a
    rollback journal, which is as durable. The caller holds the project's lock. Raises sqlite3.Error."""
    try:
        return _writable(path, shares_maps=True)
    except sqlite3.OperationalError as error:
        if not speaks_of_maps(error):
            raise
    files.remove(path.with_name(path.name + "-shm"))  # what was tried
    return _writable(path, shares_maps=False)


def _writable(path: Path, shares_maps: bool) -> sqlite3.Connection:
    connection = connect(f"{file_uri(path)}?mode=rw")
    with closed_on_error(connection):
        if not shares_maps:  # alone, SQLite keeps the index of a log that is there in its own memory
            connection.execute("PRAGMA locking_mode=EXCLUSIVE").fetchall()
        _distrust(connection)
        mode = connection.execute(f"PRAGMA journal_mode={'WAL' if shares_maps else 'DELETE'}").fetchall()[0][0]
        if not shares_maps:
            connection.execute("PRAGMA locking_mode=NORMAL").fetchall()
        connection.execute(f"PRAGMA synchronous={'FULL' if mode == 'wal' else 'EXTRA'}")  # EXTRA: the folder too
        connection.execute(f"PRAGMA journal_size_limit={MAX_LOG_BYTES}").fetchall()
        connection.execute("PRAGMA fullfsync=ON")  # macOS: past the disk's own cache; nothing elsewhere
        connection.execute("SELECT name FROM sqlite_master LIMIT 1").fetchall()  # the log's index is mapped, or refused
        if mode == "delete":
            # What had to be rolled back was, by that read. A journal that is still there is of a writer that was killed
            # before it had anything to roll back, or after its commit; SQLite would leave it until the next write.
            files.remove(path.with_name(path.name + "-journal"))
        return connection


def try_writing(connection: sqlite3.Connection) -> None:
    """Begin to write what is there already. Raises sqlite3.Error where nothing may be written, or somebody else writes.
    A full disk is met by the first command: pages that stay the same are not written."""
    # Better asked now than at the first command. Opening alone leaves every byte, so that copies need not be renewed.
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
    Raises sqlite3.Error; ValueError where its log is needed and cannot be read."""
    uri, why = f"{file_uri(path)}?mode=ro", "its folder cannot be written"
    if has_foreign_log(path):
        return _readable(f"{uri}&immutable=1")  # which looks at no log
    try:
        return _readable(uri, wait_seconds=0)
    except sqlite3.OperationalError as error:
        if not is_unwritable(error):
            raise
        locked, maps = speaks_of_locks(error), speaks_of_maps(error)
    # Held or refused looks the same to SQLite: one is waited for, the other never ends.
    if locked:
        refused = locks_refused(path.parent)
        try:
            if not refused:  # somebody is writing at this moment
                return _readable(uri)
        except sqlite3.OperationalError as error:
            if refused is not None or not speaks_of_locks(error):
                raise
        why = NO_LOCKS
        with contextlib.suppress(sqlite3.OperationalError):  # it needs its log
            return _readable(f"{uri}&nolock=1")
    elif maps:
        why = "its file system has no maps that programs can share"
    # Reading past a log would show an older state as if it were the present one.
    pending = [name for name in (f"{path.name}-wal", f"{path.name}-journal") if _size(path.with_name(name))]
    if pending:
        raise ValueError(f"{path}: was not closed, and {why}; copy it and {pending[0]} to another folder")
    return _readable(f"{uri}&immutable=1")


def _readable(uri: str, wait_seconds: float = WAIT_SECONDS) -> sqlite3.Connection:
    connection = connect(uri, wait_seconds)
    with closed_on_error(connection):
        _distrust(connection)
        connection.execute(f"PRAGMA busy_timeout={WAIT_SECONDS * 1000:.0f}").fetchall()
        return connection


def has_log(path: Path) -> bool:
    """Whether changes may be in a log beside the database."""
    return _size(path.with_name(path.name + "-wal")) > 0


def has_foreign_log(path: Path) -> bool:
    """Whether the log beside a database is not of this state of it. SQLite would play it all the same, and so lose what
    is newer; programs that synchronise folders bring such logs from elsewhere. A database says in its head whether
    there may be changes in a log, from before there is one until it is gone; where it does, what it holds alone must
    not be later than what it holds with its log, nor of another original, nor sound where that is damaged."""
    if not has_log(path):
        return False
    if files.read_head(path, 20)[18:20] == b"\1\1":  # write and read version: rollback
        return has_log(path)  # else it was closed between the two looks
    try:
        alone = dict(written_last(path))
    except ValueError:  # half of the log may be in the file already: then it is needed
        return False
    try:
        # A log that makes the project older than it is alone was brought from elsewhere.
        together = dict(_facts(path, f"{file_uri(path)}?mode=ro"))
        return alone.get("sha256") != together.get("sha256") or _edited(alone) > _edited(together)
    except UnwritableError:
        return False
    except ValueError:
        return _passes_check(path)


def _edited(facts: dict[str, Any]) -> float:
    """When the latest step was made, seconds since 1970; 0: never. Raises ValueError."""
    return float(facts.get("edited", 0))


def set_log_aside(path: Path) -> str:
    """Take a log away that does not belong to a database; the name that it has then, "" where there was none. The
    caller holds the project's lock. Raises ValueError where it cannot be renamed."""
    if not has_foreign_log(path):
        return ""
    name = path.name + UNUSED_LOG
    try:
        files.replace(path.with_name(path.name + "-wal"), path.with_name(name))
        path.with_name(path.name + "-shm").unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{path}: the log beside it is not of this file, and cannot be renamed ({reason})") from None
    return name


def written_last(path: Path) -> list[tuple[Any, ...]]:
    """What tells one state of a project file from another, as the file alone says it. Raises ValueError."""
    return _facts(path, f"{file_uri(path)}?mode=ro&immutable=1")


def _passes_check(path: Path) -> bool:
    """Whether a database is whole without its log."""
    try:
        with one_line(path), contextlib.closing(_readable(f"{file_uri(path)}?mode=ro&immutable=1")) as connection:
            return Database(path, connection).rows("PRAGMA quick_check(1)") == [("ok",)]
    except ValueError:
        return False


def _facts(path: Path, uri: str) -> list[tuple[Any, ...]]:
    with one_line(path), contextlib.closing(_readable(uri)) as connection:
        return Database(path, connection).rows(WRITTEN_LAST, kinds=(str, str))


WRITTEN_LAST = "SELECT name, value FROM facts WHERE name IN ('cursor', 'edited', 'sha256') ORDER BY name"


def _size(path: Path) -> int:
    """Bytes of a file, 0 where it is missing."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


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


def check_head(path: Path) -> None:
    """Raises ValueError, from the first bytes of the file at `path` alone: no such file, no project, cut short, of a
    version that this package does not read."""
    # Before SQLite opens it: a file of a newer version is not to be touched.
    head = files.read_head(path, 100)
    if len(head) < 100 or head[:16] != b"SQLite format 3\0":
        raise ValueError(f"{path}: expected a {SUFFIX} file, got another kind of file")
    number = int.from_bytes
    if number(head[68:72], "big") != APPLICATION_ID:
        raise ValueError(f"{path}: expected a {SUFFIX} file, got a database of another program")
    version = number(head[60:64], "big")
    if version > VERSION:
        raise ValueError(
            f"{path}: was written by a newer splatpainter (project version {version}, this one reads up to {VERSION}); "
            "update splatpainter to open it"
        )
    if version < VERSION:
        raise ValueError(f"{path}: damaged project file (project version {version}, expected {VERSION})")
    # A copy that was cut short opens well enough, and would fail at some later page.
    page = number(head[16:18], "big")
    size = number(head[28:32], "big") * (65536 if page == 1 else page)
    logs = (path.with_name(path.name + ending) for ending in ("-wal", "-journal"))  # which may have the rest
    if path.stat().st_size < size and not any(log.exists() for log in logs):
        raise ValueError(f"{path}: damaged project file (cut short: {path.stat().st_size} of {size} bytes)")


def create_tables(connection: sqlite3.Connection) -> None:
    """The tables of an empty database, in the caller's transaction."""
    connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
    for statement in TABLES.split(";"):
        if statement.strip():
            connection.execute(statement)
    connection.execute(f"PRAGMA user_version={VERSION}")


def check_tables(connection: sqlite3.Connection) -> None:
    """Raises ContentError where the database holds anything but the tables and indexes of a project, as `create_tables`
    writes them: views, triggers, virtual tables and computed columns would run when rows are read or written."""
    query = f"SELECT type, name, sql FROM sqlite_master LIMIT {MAX_SCHEMA_ROWS + 1}"
    # What is not exactly ours might run when rows are read, so forms are compared and not judged.
    present = set()
    for kind, name, text in connection.execute(query).fetchall():
        if kind == "index" and text is None and str(name).startswith("sqlite_autoindex_"):
            continue  # of a PRIMARY KEY or UNIQUE
        if not isinstance(text, str) or _squeezed(text) not in _FORMS:
            raise ContentError(f"unexpected {str(kind)[:20]} {str(name)[:40]!r}")
        present.add(name)
    missing = sorted(_TABLE_NAMES - present)
    if missing:
        raise ContentError(f"no such table: {missing[0]}")


def _squeezed(statement: str) -> str:
    """A statement without what the layout adds."""
    return re.sub(r"\s*([(),])\s*", r"\1", " ".join(statement.replace('"', "").split()))


_FORMS = {_squeezed(statement) for statement in TABLES.split(";") if statement.strip()}
_TABLE_NAMES = {statement.split()[2] for statement in TABLES.split(";") if statement.split()[:2] == ["CREATE", "TABLE"]}
