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
from typing import Any, get_args

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.session import schema
from splatpainter.session.database import (
    ContentError,
    Database,
    closed_on_error,
    is_unwritable,
    one_line,
    open_readable,
    open_writable,
    try_writing,
)
from splatpainter.session.deltas import decode, encode
from splatpainter.session.layers import Document, Layer, Policy, digest
from splatpainter.session.lock import ProjectLock
from splatpainter.session.replay import Painted
from splatpainter.session.states import pack_state, unpack_state

STEPS = 1000
"""Steps of the history that are kept."""
PART = 1 << 20
"""Bytes of a part of the original."""
ELSEWHERE = "open elsewhere: this copy can be looked at, not changed; save_as makes one of your own"
UNWRITABLE = "cannot be written ({}): it can be looked at, not changed; save_as makes one that can"
FACT_KINDS: dict[str, type | tuple[type, ...]] = {
    "rows_touched": int,
    "rows_appended": int,
    "seconds": (int, float),
    "method": str,
    "note": str,
    "problem": str,
    "preset": str,
    "views": list,
}
"""Facts of a result that others read, and what they are."""


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

    def __init__(self, database: Database, lock: ProjectLock | None, read_only: str) -> None:
        self.path, self.read_only = database.path, read_only
        self._database, self._db, self._hold = database, database.connection, lock
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
            with one_line(path):
                return Project(_opened(path, readonly=False), lock, "")
        except BaseException:
            lock.release()
            raise

    @staticmethod
    def open(path: Path, readonly: bool | None = None) -> Project:
        """Open a project file. readonly None: only where it is open elsewhere or cannot be written; False: then it is
        an error. Raises ValueError: missing, damaged, no project, newer, of an older version and read-only."""
        version = schema.check_head(path)
        lock, why = None, "opened for reading only"
        if not readonly:
            lock, why = _lock_or_reason(path)
        try:
            with one_line(path):
                database = None
                if lock is not None:
                    try:
                        database = _opened(path, readonly=False)
                    except sqlite3.OperationalError as error:
                        if not is_unwritable(error):
                            raise
                        why = UNWRITABLE.format(" ".join(str(error).split()))
                        lock.release()
                        lock = None
                if database is None:
                    if readonly is False:
                        raise ValueError(f"{path}: {why}")
                    if version < schema.VERSION:
                        said = f"project version {version} must be opened for writing once, to be brought up"
                        raise ValueError(f"{path}: {said}; {why}")
                    database = _opened(path, readonly=True)
                return Project(database, lock, why)
        except BaseException:
            if lock is not None:
                lock.release()
            raise

    def close(self) -> None:
        """Fold the log into the one file. Closing twice does nothing."""
        with self._mutex:
            if self._hold is not None:
                # A reader in the way, or a full disk: all is in the log, for the next opener.
                with contextlib.suppress(sqlite3.Error):
                    self._database.start()
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
        with self._mutex:
            try:
                self._db.backup(target, pages=1024)
            except sqlite3.Error as error:
                if is_unwritable(error):
                    raise  # of the target, whose writer names it
                with one_line(self.path):
                    raise
        target.execute("PRAGMA journal_mode=DELETE").fetchall()

    # ---- reading

    def rows(self, query: str, *values: Any, kinds: tuple[type | tuple[type, ...], ...] = ()) -> list[tuple]:
        """All rows of a query. kinds: expected types of the columns. Raises ValueError: damaged."""
        with self._mutex:
            return self._database.rows(query, *values, kinds=kinds)

    def fact(self, name: str) -> str | None:
        """A fact by its name. Raises ValueError: it is no text."""
        found = self.rows("SELECT value FROM facts WHERE name = ?", name, kinds=(str,))
        return found[0][0] if found else None

    def original(self) -> Iterator[tuple[str, bytes]]:
        """(name, bytes) pieces of the original's files, in order. Raises ValueError: more than the file has."""
        with self._mutex, one_line(self.path):
            left = self._database.start()
        for file, part in self.rows("SELECT file, part FROM original ORDER BY part", kinds=(str, int)):
            query = "SELECT bytes FROM original WHERE file = ? AND part = ?"
            for (data,) in self.rows(query, file, part, kinds=(bytes,)):
                left -= len(data)
                if left < 0:
                    raise ValueError(f"{self.path}: damaged project file (its original has more bytes than the file)")
                yield file, data

    def blob(self, sha256: str) -> bytes:
        """Bytes of a picture. Raises ValueError: unknown or damaged."""
        found = self.rows("SELECT bytes FROM blobs WHERE sha256 = ?", sha256, kinds=(bytes,))
        if not found or files.sha256(found[0][0]) != sha256:
            raise ValueError(f"{self.path}: damaged project file (picture {sha256[:12]}... is missing or wrong)")
        return found[0][0]

    def result(self, key: str) -> Painted | None:
        """A stored result; its parts are decoded one at a time. Raises ValueError where it is damaged."""
        optional = (bytes, type(None))
        query = "SELECT facts, confidence, state FROM results WHERE key = ?"
        found = self.rows(query, key, kinds=(str, optional, optional))
        if not found:
            return None
        facts, confidence, state = found[0]
        where = f"{self.path}: result {key[:12]}..."
        delta = decode(self._parts(key), where)
        try:
            certain = None if confidence is None else np.frombuffer(confidence, np.uint8)
            if certain is not None and len(certain) != delta.count + len(delta.appended):
                raise ValueError(f"{len(certain)} values of confidence for {delta.count + len(delta.appended)} rows")
            return Painted(delta, _result_facts(facts), certain, None if state is None else unpack_state(state))
        except (ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"{where}: damaged ({error})") from None

    def _parts(self, key: str) -> Iterator[bytes]:
        for (part,) in self.rows("SELECT part FROM deltas WHERE result = ? ORDER BY part", key, kinds=(int,)):
            query = "SELECT bytes FROM deltas WHERE (result, part) = (?, ?)"
            yield from (data for (data,) in self.rows(query, key, part, kinds=(bytes,)))

    def bookmarks(self) -> list[Bookmark]:
        """The same objects as long as they are the same."""
        with self._mutex:
            if self._bookmarks is None or self.read_only:  # somebody else may write
                rows = self.rows("SELECT id, name, camera FROM bookmarks ORDER BY id", kinds=(int, str, str))
                where = f"{self.path}: bookmark"
                self._bookmarks = [Bookmark(str(k), name, Camera.from_json(text, where)) for k, name, text in rows]
            return list(self._bookmarks)

    def steps(self) -> tuple[list[Step], int]:
        """(the history, oldest first; place of the step in effect)."""
        steps = [Step(*row) for row in self.rows("SELECT id, label FROM steps ORDER BY id", kinds=(int, str))]
        cursor = self.fact("cursor") or ""
        places = [k for k, step in enumerate(steps) if str(step.id) == cursor]
        if not places:
            raise ValueError(f"{self.path}: damaged project file (step {cursor[:20]!r} of its history is missing)")
        return steps, places[0]

    def document(self, step: int) -> Document:
        """The layers as they were after a step. Raises ValueError: damaged."""
        where = f"{self.path}: layer"
        with one_line(self.path):
            found = self.rows("SELECT policies FROM steps WHERE id = ?", step, kinds=(str,))
            highest = self.rows("SELECT max(next_id) FROM steps", kinds=(int,))  # undone layers' ids stay theirs
            query = "SELECT content FROM step_layers JOIN layers ON layers.id = layer WHERE step = ? ORDER BY place"
            contents = self.rows(query, step, kinds=(str,))
            if not found:
                raise ContentError(f"step {step} of its history is missing")
        try:
            layers = tuple(Layer.parse(json.loads(text), where) for (text,) in contents)
            if len({layer.id for layer in layers}) < len(layers):
                raise ValueError("two layers have one id")
            return Document(layers, _policies(json.loads(found[0][0])), highest[0][0])
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
            raise ValueError(f"{where}: damaged ({str(error).removeprefix(f'{where}: ')})") from None

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
        with self._mutex, one_line(self.path):
            self._database.start()
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


def _result_facts(text: str) -> dict[str, Any]:
    """Facts of a result. Raises ValueError where one that others read is not what it should be."""
    facts = json.loads(text)
    if not isinstance(facts, dict):
        raise ValueError("its facts are no JSON object")
    for name, kind in FACT_KINDS.items():
        value = facts.get(name, kind() if isinstance(kind, type) else 0)
        if not isinstance(value, kind) or (isinstance(value, (int, float)) and not 0 <= value < 1e15):
            raise ValueError(f"unexpected {name} {value!r:.40}")
    for view in facts.get("views", ()):
        if not isinstance(view, dict):
            raise ValueError(f"unexpected view {view!r:.40}")
        scores = [view.get(name) for name in ("psnr_before", "psnr_after", "psnr_outside")]
        if not all(score is None or (isinstance(score, (int, float)) and abs(score) < 1e15) for score in scores):
            raise ValueError(f"unexpected scores {scores!r:.80}")
    return facts


def _policies(pairs: Any) -> tuple[tuple[str, str, Policy], ...]:
    """Raises ValueError where they are not [lower layer, upper layer, policy]."""
    out = []
    for pair in pairs:
        lower, upper, policy = pair
        if not (isinstance(lower, str) and isinstance(upper, str) and policy in get_args(Policy)):
            raise ValueError(f"unexpected policy {pair!r:.80}")
        out.append((lower, upper, policy))
    return tuple(out)


def _opened(path: Path, readonly: bool) -> Database:
    """The database, checked. readonly False: that it can be written has been tried, and older versions are brought up.
    Raises sqlite3.Error, ValueError."""
    connection = open_readable(path) if readonly else open_writable(path)
    with closed_on_error(connection):
        database = Database(path, connection)
        database.start()
        schema.check_tables(connection)
        if not readonly:
            try_writing(connection)
            schema.migrate(database)
        return database


def _lock_or_reason(path: Path) -> tuple[ProjectLock | None, str]:
    """(the lock of a project, "") or (None, why it cannot be written)."""
    try:
        lock = ProjectLock.take(path)
    except ValueError as error:
        return None, UNWRITABLE.format(str(error).removeprefix(f"{path}: "))
    return lock, "" if lock else ELSEWHERE


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
        with one_line(path):
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
