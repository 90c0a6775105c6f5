"""The project file: one SQLite database that every acknowledged change is in. Knows no painter and no rows.

WAL with synchronous=FULL while open: a commit is on disk when it returns. On closing the log is folded back into the
one file. All access goes through one connection and its lock, so several threads may read while one writes.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.session import schema
from splatpainter.session.deltas import decode, encode
from splatpainter.session.layers import Document, Layer, digest
from splatpainter.session.lock import ProjectLock
from splatpainter.session.replay import Painted
from splatpainter.session.states import pack_state, unpack_state

STEPS = 1000
"""Steps of the history that are kept."""
PART = 1 << 20
"""Bytes of a part of the original."""
ELSEWHERE = "open elsewhere: this copy can be looked at, not changed; save_as makes one of your own"


@dataclass(frozen=True)
class Step:
    """One entry of the history."""

    id: int
    label: str


@dataclass(frozen=True)
class Bookmark:
    """A view to come back to."""

    id: str
    name: str
    camera: Camera


@dataclass
class Additions:
    """What one commit brings besides the document."""

    blobs: dict[str, bytes] = field(default_factory=dict)
    results: dict[str, Painted] = field(default_factory=dict)


class Project:
    """An open project file. `read_only` says why it cannot be written, "" where it can."""

    def __init__(self, path: Path, connection: sqlite3.Connection, lock: ProjectLock | None, read_only: str) -> None:
        self.path, self.read_only = path, read_only
        self._db, self._hold = connection, lock
        self._mutex = threading.RLock()
        self._bookmarks: list[Bookmark] | None = None

    # ---- opening and closing

    @staticmethod
    def create(path: Path, facts: dict[str, str], original: Iterable[tuple[str, bytes]], overwrite: bool) -> Project:
        """A new project file with the original's files as (name, bytes) pieces in order. It appears at `path` whole.
        Raises ValueError: it exists, is open elsewhere, or cannot be written."""

        def fill(connection: sqlite3.Connection) -> None:
            connection.execute("PRAGMA auto_vacuum=INCREMENTAL")
            connection.execute("BEGIN")
            schema.create(connection)
            connection.executemany("INSERT INTO facts VALUES (?, ?)", [*facts.items(), ("cursor", "1")])
            for part, (name, data) in enumerate(original):
                connection.execute("INSERT INTO original VALUES (?, ?, ?)", (name, part, data))
            connection.execute("INSERT INTO steps (id, label, policies, next_id) VALUES (1, 'open', '[]', 1)")
            connection.execute("COMMIT")

        lock = _claim(path, overwrite)
        try:
            _place(path, fill)
            return Project(path, _open(path, readonly=False), lock, "")
        except BaseException:
            lock.release()
            raise

    @staticmethod
    def open(path: Path, readonly: bool | None = None) -> Project:
        """Open a project file. readonly None: only where it is open elsewhere; False: then it is an error.
        Raises ValueError: missing, damaged, no project, newer, of an older version and read-only."""
        version = schema.check_head(path)
        lock = None if readonly else ProjectLock.take(path)
        if lock is None and readonly is False:
            raise ValueError(f"{path}: {ELSEWHERE}")
        why = "" if lock else ("opened for reading only" if readonly else ELSEWHERE)
        if lock is None and version < schema.VERSION:
            raise ValueError(f"{path}: project version {version} must be opened for writing once, to be brought up")
        connection = None
        try:
            with _clear(path):
                connection = _open(path, readonly=lock is None)
                if lock is not None:
                    schema.migrate(connection, path)
            return Project(path, connection, lock, why)
        except BaseException:
            if connection is not None:
                connection.close()
            if lock is not None:
                lock.release()
            raise

    def close(self) -> None:
        """Fold the log into the one file. Closing twice does nothing."""
        with self._mutex:
            if self._hold is not None:
                with contextlib.suppress(
                    sqlite3.Error
                ):  # a reader is in the way: all is in the log, for the next opener
                    self._db.execute("PRAGMA busy_timeout=0").fetchall()
                    self._db.execute("PRAGMA incremental_vacuum").fetchall()
                    self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
                    self._db.execute("PRAGMA journal_mode=DELETE").fetchall()
            self._db.close()
            if self._hold is not None:
                self._hold.release()
                self._hold = None

    def copy(self, path: Path, overwrite: bool = False) -> None:
        """The same project in another file, compact; it appears whole. Raises ValueError: it exists, is open elsewhere,
        or cannot be written."""
        lock = _claim(path, overwrite)
        try:
            _place(path, lambda connection: self._clone(connection))
        finally:
            lock.release()

    def _clone(self, target: sqlite3.Connection) -> None:
        with self._mutex, _clear(self.path):
            self._db.backup(target, pages=1024)
        target.execute("PRAGMA journal_mode=DELETE").fetchall()

    # ---- reading

    def rows(self, query: str, *values: Any) -> list[tuple]:
        with self._mutex, _clear(self.path):
            return self._db.execute(query, values).fetchall()

    def fact(self, name: str) -> str | None:
        found = self.rows("SELECT value FROM facts WHERE name = ?", name)
        return found[0][0] if found else None

    def original(self) -> Iterator[tuple[str, bytes]]:
        """(name, bytes) pieces of the original's files, in order."""
        for file, part in self.rows("SELECT file, part FROM original ORDER BY part"):
            yield file, self.rows("SELECT bytes FROM original WHERE file = ? AND part = ?", file, part)[0][0]

    def blob(self, sha256: str) -> bytes:
        """Bytes of a picture. Raises ValueError: unknown or damaged."""
        found = self.rows("SELECT bytes FROM blobs WHERE sha256 = ?", sha256)
        if not found or files.sha256(found[0][0]) != sha256:
            raise ValueError(f"{self.path}: damaged project file (picture {sha256[:12]}... is missing or wrong)")
        return found[0][0]

    def result(self, key: str) -> Painted | None:
        """A stored result; its parts are decoded one at a time. Raises ValueError where it is damaged."""
        found = self.rows("SELECT facts, confidence, state FROM results WHERE key = ?", key)
        if not found:
            return None
        facts, confidence, state = found[0]
        where = f"{self.path}: result {key[:12]}..."
        delta = decode(self._parts(key), where)
        try:
            certain = None if confidence is None else np.frombuffer(confidence, np.uint8)
            return Painted(delta, dict(json.loads(facts)), certain, None if state is None else unpack_state(state))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{where}: damaged ({error})") from None

    def _parts(self, key: str) -> Iterator[bytes]:
        for (part,) in self.rows("SELECT part FROM deltas WHERE result = ? ORDER BY part", key):
            yield from (
                data for (data,) in self.rows("SELECT bytes FROM deltas WHERE (result, part) = (?, ?)", key, part)
            )

    def bookmarks(self) -> list[Bookmark]:
        """The same objects as long as they are the same."""
        with self._mutex:
            if self._bookmarks is None or self.read_only:  # somebody else may write
                rows = self.rows("SELECT id, name, camera FROM bookmarks ORDER BY id")
                where = f"{self.path}: bookmark"
                self._bookmarks = [Bookmark(str(k), name, Camera.from_json(text, where)) for k, name, text in rows]
            return list(self._bookmarks)

    def steps(self) -> tuple[list[Step], int]:
        """(the history, oldest first; place of the step in effect)."""
        steps = [Step(*row) for row in self.rows("SELECT id, label FROM steps ORDER BY id")]
        at = int(self.fact("cursor") or 0)
        places = [k for k, step in enumerate(steps) if step.id == at]
        if not places:
            raise ValueError(f"{self.path}: damaged project file (step {at} of its history is missing)")
        return steps, places[0]

    def document(self, step: int) -> Document:
        """The layers as they were after a step."""
        where = f"{self.path}: layer"
        ((policies,),) = self.rows("SELECT policies FROM steps WHERE id = ?", step)
        ((following,),) = self.rows("SELECT max(next_id) FROM steps")  # ids of undone layers are not used again
        query = "SELECT content FROM step_layers JOIN layers ON layers.id = layer WHERE step = ? ORDER BY place"
        try:
            layers = tuple(Layer.parse(json.loads(text), where) for (text,) in self.rows(query, step))
            return Document(layers, tuple((a, b, c) for a, b, c in json.loads(policies)), following)
        except (json.JSONDecodeError, TypeError, AttributeError) as error:
            raise ValueError(f"{where}: damaged ({error})") from None

    # ---- writing: each of these is one durable transaction

    def commit(
        self,
        label: str,
        document: Document,
        results: Iterable[str],
        more: Additions,
        gesture: str | None = None,
    ) -> set[str]:
        """A new step after the one in effect; steps that were undone are dropped. gesture: a step of the same gesture
        right before is replaced. Returns the keys of results that are no longer stored."""
        with self._writing() as db:
            at = int(db.execute("SELECT value FROM facts WHERE name = 'cursor'").fetchone()[0])
            dropped = db.execute("DELETE FROM steps WHERE id > ?", (at,)).rowcount
            if gesture is not None:
                query = "DELETE FROM steps WHERE id = ? AND gesture = ? AND id > (SELECT min(id) FROM steps)"
                dropped += db.execute(query, (at, gesture)).rowcount
            dropped += db.execute("DELETE FROM steps WHERE id <= ?", (at - STEPS,)).rowcount
            step = at + 1
            entry = (step, label, gesture, json.dumps(document.policies), document.next_id)
            db.execute("INSERT INTO steps (id, label, gesture, policies, next_id) VALUES (?, ?, ?, ?, ?)", entry)
            for name, data in more.blobs.items():
                db.execute("INSERT OR IGNORE INTO blobs VALUES (?, ?)", (name, data))
            for place, layer in enumerate(document.layers):
                db.execute("INSERT INTO step_layers VALUES (?, ?, ?)", (step, place, _stored(db, layer)))
            for key, painted in more.results.items():
                _store_result(db, key, painted)
            db.executemany("INSERT OR IGNORE INTO step_results VALUES (?, ?)", [(step, key) for key in results])
            _move(db, step)
            return _swept(db) if dropped else set()

    def move(self, step: int, results: Iterable[str], more: Additions) -> None:
        """Another step takes effect (undo, redo). results: of its asset, in case some had to be made anew."""
        with self._writing() as db:
            for key, painted in more.results.items():
                _store_result(db, key, painted)
            db.executemany("INSERT OR IGNORE INTO step_results VALUES (?, ?)", [(step, key) for key in results])
            _move(db, step)

    def add_bookmark(self, name: str, camera: Camera) -> str:
        query = "INSERT INTO bookmarks (name, camera) VALUES (?, ?)"
        with self._mutex:
            known = self.bookmarks()
            with self._writing() as db:
                made = Bookmark(str(db.execute(query, (name, camera.to_json())).lastrowid), name, camera)
            self._bookmarks = [*known, made]
            return made.id

    def delete_bookmark(self, bookmark: str) -> None:
        with self._mutex:
            known = self.bookmarks()
            with self._writing() as db:
                if not db.execute("DELETE FROM bookmarks WHERE CAST(id AS TEXT) = ?", (bookmark,)).rowcount:
                    raise ValueError(f"bookmark: there is none with id {bookmark!r}")
            self._bookmarks = [one for one in known if one.id != bookmark]

    def set_fact(self, name: str, value: str) -> None:
        with self._writing() as db:
            db.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (name, value))

    @contextlib.contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        if self.read_only:
            raise ValueError(f"{self.path}: {self.read_only}")
        with self._mutex, _clear(self.path):
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise


def _stored(db: sqlite3.Connection, layer: Layer) -> int:
    """Row of a layer in this very form, made if there is none."""
    text = _text(layer)
    sha = digest(text)
    db.execute("INSERT OR IGNORE INTO layers (sha256, content) VALUES (?, ?)", (sha, text))
    row = db.execute("SELECT id FROM layers WHERE sha256 = ?", (sha,)).fetchone()[0]
    db.executemany("INSERT OR IGNORE INTO layer_blobs VALUES (?, ?)", [(row, blob) for blob in layer.blobs()])
    return row


def _store_result(db: sqlite3.Connection, key: str, painted: Painted) -> None:
    state = None if painted.state is None else pack_state(painted.state)
    certain = None if painted.confidence is None else painted.confidence.tobytes()
    db.execute("DELETE FROM results WHERE key = ?", (key,))
    db.execute("INSERT INTO results VALUES (?, ?, ?, ?)", (key, json.dumps(painted.facts), certain, state))
    for part, data in enumerate(encode(painted.delta)):
        db.execute("INSERT INTO deltas VALUES (?, ?, ?)", (key, part, data))


def _move(db: sqlite3.Connection, step: int) -> None:
    db.execute("UPDATE facts SET value = ? WHERE name = 'cursor'", (str(step),))


def _swept(db: sqlite3.Connection) -> set[str]:
    """Delete what no step needs any more; the keys of deleted results."""
    unused = "NOT IN (SELECT result FROM step_results)"
    gone = {key for (key,) in db.execute(f"SELECT key FROM results WHERE key {unused}")}
    db.execute(f"DELETE FROM results WHERE key {unused}")
    db.execute("DELETE FROM layers WHERE id NOT IN (SELECT layer FROM step_layers)")
    db.execute("DELETE FROM blobs WHERE sha256 NOT IN (SELECT blob FROM layer_blobs)")
    return gone


def _text(layer: Layer) -> str:
    return json.dumps(layer.record(), sort_keys=True)


@contextlib.contextmanager
def _clear(path: Path) -> Iterator[None]:
    """SQLite's errors as one line."""
    try:
        yield
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:  # the latter: SQLite quotes the damaged bytes
        name = getattr(error, "sqlite_errorname", "") or ""
        said = " ".join(str(error).split())
        if name.startswith(("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_READONLY", "SQLITE_CANTOPEN")):
            raise ValueError(f"{path}: cannot be read or written ({said}); nothing was changed") from None
        raise ValueError(f"{path}: damaged project file ({said})") from None


def _open(path: Path, readonly: bool) -> sqlite3.Connection:
    mode = "ro" if readonly else "rw"
    uri = f"{path.resolve().as_uri()}?mode={mode}"
    connection = sqlite3.connect(uri, uri=True, timeout=10, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA foreign_keys=ON")
        connection.execute("PRAGMA trusted_schema=OFF")
        if not readonly:
            connection.execute("PRAGMA journal_mode=WAL").fetchall()
            connection.execute("PRAGMA synchronous=FULL")
            connection.execute("PRAGMA fullfsync=ON")  # macOS: past the disk's own cache; nothing elsewhere
        connection.execute("SELECT count(*) FROM facts").fetchall()
        return connection
    except BaseException:
        connection.close()
        raise


def _claim(path: Path, overwrite: bool) -> ProjectLock:
    if path.is_dir() or (path.exists() and not overwrite):
        raise ValueError(f"{path}: already exists; choose another name or allow overwriting")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: no such folder: {path.parent}; make it first")
    lock = ProjectLock.take(path)
    if lock is None:
        raise ValueError(f"{path}: is open elsewhere; close it there or choose another name")
    return lock


def _place(path: Path, fill) -> None:
    """A database that appears at `path` filled and on disk, or not at all. The caller holds the lock of `path`."""
    partial = path.with_name(f".{path.name}.part")
    try:
        partial.unlink(missing_ok=True)  # of somebody who was killed here
        with _clear(path):
            connection = sqlite3.connect(partial, isolation_level=None)
            try:
                connection.execute("PRAGMA journal_mode=OFF").fetchall()  # it has no name yet: all or nothing anyway
                connection.execute("PRAGMA synchronous=OFF")
                fill(connection)
            finally:
                connection.close()
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        for ending in ("-wal", "-shm"):  # of a project that was there and is replaced
            path.with_name(path.name + ending).unlink(missing_ok=True)
        files.replace(partial, path)
        files.sync_folder(path.parent)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        for ending in ("", "-wal", "-shm"):
            partial.with_name(partial.name + ending).unlink(missing_ok=True)
