"""The project file as an SQLite database that strangers may have made: its tables, how files of older versions become
files of this one, bounded reading, typed columns, and errors of one line.

`application_id` says that a database is ours and `user_version` which version; both stand in the first 100 bytes, so a
newer file is refused before SQLite touches it.

What a query gives and what it costs is held against the size of the file: rows that share pages, or a tree whose
branches lead to the same leaf, would else be gigabytes and hours out of some kilobytes.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

from splatpainter.io import files

APPLICATION_ID = 0x53504C50
"""ASCII "SPLP"."""
VERSION = 4
FIRST_READABLE = 2
"""Oldest version that can be looked at without being brought up."""
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

OLDER_TABLES = """
CREATE TABLE original (part INTEGER PRIMARY KEY, bytes BLOB NOT NULL);
CREATE TABLE steps (id INTEGER PRIMARY KEY, label TEXT NOT NULL, policies TEXT NOT NULL, next_id INTEGER NOT NULL);
CREATE TABLE steps (
    id INTEGER PRIMARY KEY, label TEXT NOT NULL, policies TEXT NOT NULL, next_id INTEGER NOT NULL, gesture TEXT
);
CREATE TABLE steps (
    id INTEGER PRIMARY KEY, label TEXT NOT NULL, gesture TEXT, policies TEXT NOT NULL, next_id INTEGER NOT NULL
);
CREATE TABLE steps (
    id INTEGER PRIMARY KEY, label TEXT NOT NULL, policies TEXT NOT NULL, next_id INTEGER NOT NULL, gesture TEXT,
    assets TEXT
);
CREATE TABLE layers (id INTEGER PRIMARY KEY, sha256 TEXT NOT NULL UNIQUE, content TEXT NOT NULL);
CREATE TABLE results (key TEXT PRIMARY KEY, facts TEXT NOT NULL, confidence BLOB, state BLOB);
"""
"""Tables as older versions made them, and as bringing it up leaves them, where they differ from TABLES."""
MAX_SCHEMA_ROWS = 64
"""Tables and indexes that are looked at."""
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
        pages = self.connection.execute("PRAGMA page_count").fetchone()[0]
        size = pages * self.connection.execute("PRAGMA page_size").fetchone()[0]
        self._max_ops = FREE_OPS + OPS_PER_BYTE * size
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
        return self._ops > self._max_ops


@contextlib.contextmanager
def one_line(path: Path) -> Iterator[None]:
    """SQLite's errors, and ContentError, as ValueErrors of one line that name `path`."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError, OverflowError, RecursionError, ContentError) as error:
        message = files.printable(" ".join(str(error).split()), 300)  # SQLite quotes damaged bytes
        if is_unwritable(error):
            raise UnwritableError(f"{path}: cannot be read or written ({message}); nothing was changed") from None
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
        connection.execute(f"PRAGMA journal_size_limit={MAX_LOG_BYTES}").fetchall()
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


def check_head(path: Path) -> int:
    """Version of the project file at `path`, from its first bytes; nothing is changed. Raises ValueError: no such file,
    no project, cut short, newer than this version of the package."""
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
    page = number(head[16:18], "big")
    size = number(head[28:32], "big") * (65536 if page == 1 else page)
    if path.stat().st_size < size and not path.with_name(path.name + "-wal").exists():
        raise ValueError(f"{path}: damaged project file (cut short: {path.stat().st_size} of {size} bytes)")
    return version


def create_tables(connection: sqlite3.Connection) -> None:
    """The tables of an empty database, in the caller's transaction."""
    connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
    for statement in TABLES.split(";"):
        if statement.strip():
            connection.execute(statement)
    connection.execute(f"PRAGMA user_version={VERSION}")


def check_tables(connection: sqlite3.Connection) -> None:
    """Raises ContentError where the database holds anything but the tables and indexes of a project in a form that
    some version wrote: views, triggers, virtual tables and computed columns would run when rows are read or written."""
    query = f"SELECT type, name, sql FROM sqlite_master LIMIT {MAX_SCHEMA_ROWS + 1}"
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


_FORMS = {_squeezed(statement) for statement in (TABLES + OLDER_TABLES).split(";") if statement.strip()}
_TABLE_NAMES = {statement.split()[2] for statement in TABLES.split(";") if statement.split()[:2] == ["CREATE", "TABLE"]}


def migrate(database: Database) -> None:
    """Bring an older database up to VERSION: all steps in one transaction, so a crash leaves the old file. Raises
    ContentError where that cannot be done."""
    path, connection = database.path, database.connection
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version == VERSION:
        return
    if version not in MIGRATIONS:
        raise ContentError(f"{path}: project version {version} cannot be read (expected 1 to {VERSION})")
    size = database.start()
    connection.execute("BEGIN IMMEDIATE")
    try:
        for step in range(version, VERSION):
            MIGRATIONS[step](database, size)
        connection.execute(f"PRAGMA user_version={VERSION}")
        connection.execute("COMMIT")
    except BaseException as error:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        if isinstance(error, (KeyError, TypeError, AttributeError, IndexError, json.JSONDecodeError)):
            raise ContentError(f"a layer or fact of version {version} is missing or wrong: {error!r:.80}") from None
        raise


def _from_1(database: Database, size: int) -> None:
    """Version 1 had no gestures, no thumbnails, one file as original, and called the blend mode "colour"."""
    connection = database.connection
    if connection.execute("SELECT total(length(bytes)) FROM original").fetchone()[0] > size:
        raise ContentError("the original has more bytes than the file")
    connection.execute("ALTER TABLE steps ADD COLUMN gesture TEXT")
    name = connection.execute("SELECT value FROM facts WHERE name = 'name'").fetchone()[0]
    connection.execute("ALTER TABLE original RENAME TO original_1")
    connection.execute(
        "CREATE TABLE original (file TEXT NOT NULL, part INTEGER NOT NULL, bytes BLOB NOT NULL,"
        " PRIMARY KEY (file, part))"
    )
    connection.execute("INSERT INTO original SELECT ?, part, bytes FROM original_1", (name,))
    connection.execute("DROP TABLE original_1")
    for row, content in database.rows("SELECT id, content FROM layers", kinds=(int, str)):
        record = json.dumps(_renewed(json.loads(content)), sort_keys=True)
        sha = hashlib.sha256(record.encode()).hexdigest()
        connection.execute("UPDATE layers SET content = ?, sha256 = ? WHERE id = ?", (record, sha, row))


def _renewed(record: dict) -> dict:
    """A layer of version 1, and those inside it, as version 2 writes them."""
    blend = "color" if record["blend"] == "colour" else record["blend"]
    return {**record, "blend": blend, "thumbnail": None, "layers": [_renewed(layer) for layer in record["layers"]]}


def _from_2(database: Database, size: int) -> None:
    """Version 2 had no layers of strokes."""
    database.connection.execute("ALTER TABLE layers ADD COLUMN previous INTEGER")
    database.connection.execute("ALTER TABLE results ADD COLUMN previous TEXT")


def _from_3(database: Database, size: int) -> None:
    """Version 3 had one asset."""
    database.connection.execute("ALTER TABLE steps ADD COLUMN assets TEXT")


MIGRATIONS: dict[int, Callable[[Database, int], None]] = {1: _from_1, 2: _from_2, 3: _from_3}
"""What makes version n + 1 of version n."""
