"""The project file's tables, and how files of older versions become files of this one.

A project is one SQLite database. `application_id` says that it is ours and `user_version` which version; both stand in
the first 100 bytes, so a newer file is refused before SQLite touches it.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Callable
from pathlib import Path

from splatpainter.io import files

APPLICATION = 0x53504C50
"""ASCII "SPLP"."""
VERSION = 2
SUFFIX = ".splatproj"

TABLES = """
CREATE TABLE facts (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE original (file TEXT NOT NULL, part INTEGER NOT NULL, bytes BLOB NOT NULL, PRIMARY KEY (file, part));
CREATE TABLE blobs (sha256 TEXT PRIMARY KEY, bytes BLOB NOT NULL);
CREATE TABLE layers (id INTEGER PRIMARY KEY, sha256 TEXT NOT NULL UNIQUE, content TEXT NOT NULL);
CREATE TABLE layer_blobs (
    layer INTEGER NOT NULL REFERENCES layers ON DELETE CASCADE, blob TEXT NOT NULL, PRIMARY KEY (layer, blob)
) WITHOUT ROWID;
CREATE TABLE steps (
    id INTEGER PRIMARY KEY, label TEXT NOT NULL, gesture TEXT, policies TEXT NOT NULL, next_id INTEGER NOT NULL
);
CREATE TABLE step_layers (
    step INTEGER NOT NULL REFERENCES steps ON DELETE CASCADE, place INTEGER NOT NULL, layer INTEGER NOT NULL,
    PRIMARY KEY (step, place)
) WITHOUT ROWID;
CREATE TABLE step_results (
    step INTEGER NOT NULL REFERENCES steps ON DELETE CASCADE, result TEXT NOT NULL, PRIMARY KEY (step, result)
) WITHOUT ROWID;
CREATE TABLE results (key TEXT PRIMARY KEY, facts TEXT NOT NULL, confidence BLOB, state BLOB);
CREATE TABLE deltas (
    result TEXT NOT NULL REFERENCES results ON DELETE CASCADE, part INTEGER NOT NULL, bytes BLOB NOT NULL,
    PRIMARY KEY (result, part)
);
CREATE TABLE bookmarks (id INTEGER PRIMARY KEY, name TEXT NOT NULL, camera TEXT NOT NULL);
CREATE INDEX step_layers_by_layer ON step_layers (layer);
CREATE INDEX layer_blobs_by_blob ON layer_blobs (blob);
CREATE INDEX step_results_by_result ON step_results (result);
"""


def check_head(path: Path) -> int:
    """Version of the project file at `path`, from its first bytes; nothing is changed. Raises ValueError: no such file,
    no project, cut short, newer than this version of the package."""
    head = files.read_head(path, 100)
    if len(head) < 100 or head[:16] != b"SQLite format 3\0":
        raise ValueError(f"{path}: expected a {SUFFIX} file, got another kind of file")
    number = int.from_bytes
    if number(head[68:72], "big") != APPLICATION:
        raise ValueError(f"{path}: expected a {SUFFIX} file, got a database of another program")
    version = number(head[60:64], "big")
    if version > VERSION:
        raise ValueError(
            f"{path}: was written by a newer splatpainter (project version {version}, this one reads up to {VERSION}); "
            "update splatpainter to open it"
        )
    page = number(head[16:18], "big")
    least = number(head[28:32], "big") * (65536 if page == 1 else page)
    if path.stat().st_size < least and not path.with_name(path.name + "-wal").exists():
        raise ValueError(f"{path}: damaged project file (cut short: {path.stat().st_size} of {least} bytes)")
    return version


def create(connection: sqlite3.Connection) -> None:
    """The tables of an empty database, in the caller's transaction."""
    connection.execute(f"PRAGMA application_id={APPLICATION}")
    for statement in TABLES.split(";"):
        if statement.strip():
            connection.execute(statement)
    connection.execute(f"PRAGMA user_version={VERSION}")


def migrate(connection: sqlite3.Connection, path: Path) -> None:
    """Bring an older database up to VERSION: all steps in one transaction, so a crash leaves the old file."""
    found = connection.execute("PRAGMA user_version").fetchone()[0]
    if found == VERSION:
        return
    if found > VERSION or found not in MIGRATIONS:
        raise ValueError(f"{path}: project version {found} cannot be read (expected 1 to {VERSION})")
    connection.execute("BEGIN IMMEDIATE")
    try:
        for version in range(found, VERSION):
            MIGRATIONS[version](connection)
        connection.execute(f"PRAGMA user_version={VERSION}")
        connection.execute("COMMIT")
    except BaseException:
        connection.execute("ROLLBACK")
        raise


def _from_1(connection: sqlite3.Connection) -> None:
    """Version 1 had no gestures, no thumbnails, one file as original, and called the blend mode "colour"."""
    connection.execute("ALTER TABLE steps ADD COLUMN gesture TEXT")
    name = connection.execute("SELECT value FROM facts WHERE name = 'name'").fetchone()[0]
    connection.execute("ALTER TABLE original RENAME TO original_1")
    connection.execute(
        "CREATE TABLE original (file TEXT NOT NULL, part INTEGER NOT NULL, bytes BLOB NOT NULL,"
        " PRIMARY KEY (file, part))"
    )
    connection.execute("INSERT INTO original SELECT ?, part, bytes FROM original_1", (name,))
    connection.execute("DROP TABLE original_1")
    for row, content in connection.execute("SELECT id, content FROM layers").fetchall():
        record = json.dumps(_renewed(json.loads(content)), sort_keys=True)
        sha = hashlib.sha256(record.encode()).hexdigest()
        connection.execute("UPDATE layers SET content = ?, sha256 = ? WHERE id = ?", (record, sha, row))


def _renewed(record: dict) -> dict:
    """A layer of version 1, and those inside it, as version 2 writes them."""
    blend = "color" if record["blend"] == "colour" else record["blend"]
    return {**record, "blend": blend, "thumbnail": None, "layers": [_renewed(layer) for layer in record["layers"]]}


MIGRATIONS: dict[int, Callable[[sqlite3.Connection], None]] = {1: _from_1}
"""What makes version n + 1 of version n."""
