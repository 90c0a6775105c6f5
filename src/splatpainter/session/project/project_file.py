"""The project file: one SQLite database that every acknowledged change is in. Knows no painter.

WAL with synchronous=FULL while open: a commit is on disk when it returns, and is then folded back into the one file, so
that a copy of that file is whole; the studio folds it when its answer is on the way (`settling_later`). Before each
commit the file is looked at: it may have been replaced. All access goes through one connection and its lock, so several
threads may read while one writes.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import secrets
import shutil
import sqlite3
import tempfile
import threading
import time
import warnings
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from splatpainter.cameras import Camera
from splatpainter.io import files
from splatpainter.session.document.document import (
    MAX_REASON,
    MAX_STROKES,
    Document,
    Layer,
    Policy,
    check_stroke,
)
from splatpainter.session.document.scene_asset import MAIN_ASSET_ID, SceneAsset, parse_assets
from splatpainter.session.project import database, holder
from splatpainter.session.project.database import ContentError, Database, UnwritableError, is_unwritable
from splatpainter.session.project.lock import ProjectLock
from splatpainter.session.project.open_file import OpenFile, spare_copy, without_log
from splatpainter.session.project.project_opening import (
    UNWRITABLE,
    ReadOnly,
    create_database,
    lock_or_reason,
    lock_target,
    open_database,
)
from splatpainter.session.project.stored_layers import store_layer, sweep
from splatpainter.session.project.stored_results import loaded_result, store_result
from splatpainter.session.replay.delta import decode
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.system.jsonio import brief
from splatpainter.system.quick_dataclass import dataclass

MAX_STEPS = 1000
"""Steps of the history; older ones are dropped."""
FOLD_WAIT_SECONDS = 0.2
"""How long a commit waits for readers, before what it wrote stays in the log until the next one."""


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


class Project:
    """An open project file. `read_only` says why it cannot be written, "" where it can; `note` what was found beside it
    when it was opened, and where its layers went if it was replaced until it was closed; "": nothing."""

    def __init__(self, bounded: Database, lock: ProjectLock | None, reason: ReadOnly, note: str = "") -> None:
        self.path, self.note = bounded.path, note
        self.read_only, self.was_held = reason.words, reason.was_held
        self._database, self._db, self._lock = bounded, bounded.connection, lock
        self._file = None if lock is None else OpenFile(bounded.path)
        if lock is not None:
            holder.take_note(self.path)
            weakref.finalize(self, _drop_note, self.path, lock, os.getpid())
        self._spare: bytes | None = None
        """The file as it was left last, where it has at most MAX_SPARE_BYTES: once another program wrote into it,
        SQLite reads only that."""
        self._has_written = False
        """Whether something was committed since it was opened."""
        self._is_settled = True
        """Whether all that was committed is folded into the file, as far as readers let it."""
        self._settles_later = False
        self._mutex = threading.RLock()
        self._bookmarks: list[Bookmark] | None = None
        self._steps: list[Step] | None = None
        self._sizes: dict[str, int] = {}
        """Bytes of results, by key. This and the steps: only while nobody else can write."""
        self._parsed: dict[str, Layer] = {}
        """Strokes by the hash of their row: most are the same in all documents."""

    # ---- opening and closing

    @staticmethod
    def create(path: Path, facts: dict[str, str], original: Iterable[tuple[str, bytes]], overwrite: bool) -> Project:
        """A new project file with the original's files as (name, bytes) pieces in order. It appears at `path` complete
        or not at all. Raises ValueError: it exists, is open elsewhere, or cannot be written."""

        new_id = secrets.token_hex(4)

        def fill(connection: sqlite3.Connection) -> None:
            connection.execute("PRAGMA auto_vacuum=INCREMENTAL")
            connection.execute("BEGIN")
            database.create_tables(connection)
            connection.executemany("INSERT INTO facts VALUES (?, ?)", [*facts.items(), ("cursor", "1"), ("id", new_id)])
            for part, (name, data) in enumerate(original):
                connection.execute("INSERT INTO original VALUES (?, ?, ?)", (name, part, data))
            connection.execute("INSERT INTO steps (id, label, policies, next_id) VALUES (1, 'open', '[]', 1)")
            connection.execute("COMMIT")

        lock, is_new = lock_target(path, overwrite), not path.exists()
        try:
            create_database(path, fill)
            try:
                with database.one_line(path):
                    return Project(open_database(path, readonly=False), lock, ReadOnly(""))._settled()
            except BaseException:
                for ending in ("", "-wal", "-shm", "-journal") if is_new else ():
                    files.remove(path.with_name(path.name + ending))
                raise
        except BaseException:
            holder.drop_note(path)
            lock.release()
            raise

    @staticmethod
    def open(path: Path, readonly: bool | None = None, despite_note: bool = False) -> Project:
        """Open a project file. readonly None: only where it is open elsewhere or cannot be written; False: then it is
        an error. despite_note: its user knows that it is not open on the computer whose note lies beside it. Raises
        ValueError: missing, damaged, no project, of another version."""
        database.check_head(path)
        lock, reason, note = None, ReadOnly("opened for reading only"), ""
        if not readonly:
            lock, reason = lock_or_reason(path, despite_note)
        try:
            if lock is not None and (unused := database.set_log_aside(path)):
                note = f"{path}: a log of another state of this file lay beside it; it is not used, and is now {unused}"
            with database.one_line(path):
                bounded = None
                if lock is not None:
                    try:
                        bounded = open_database(path, readonly=False)
                    except sqlite3.OperationalError as error:
                        if not is_unwritable(error):
                            raise
                        reason = ReadOnly(UNWRITABLE.format(" ".join(str(error).split())))
                        lock.release()
                        lock = None
                if bounded is None:
                    if readonly is False:
                        raise ValueError(f"{path}: {reason.words}")
                    bounded = open_database(path, readonly=True)
                return Project(bounded, lock, reason, note)._settled()
        except BaseException:
            if lock is not None:
                holder.drop_note(path)
                lock.release()
            raise

    def close(self, is_copied: bool = False) -> None:
        """Fold the log into the one file. Where that was replaced or deleted by another program, what was done in it
        goes into a file beside it (is_copied: it is in another one already). Closing twice does nothing."""
        with self._mutex:
            if self._lock is not None:
                self.settle()
            problem = "" if self._file is None or self._lock is None else self._file.is_lost()
            has_copy = is_copied or not problem or not self._has_written or self._rescue(problem)
            if self._lock is not None and not problem:
                # A reader in the way, or a full disk: all is in the log, for the next opener.
                with contextlib.suppress(sqlite3.Error):
                    self._database.start()
                    self._db.execute("PRAGMA busy_timeout=0").fetchall()
                    self._db.executescript("PRAGMA incremental_vacuum")  # execute() would free one page
                    self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
                    self._db.execute("PRAGMA journal_mode=DELETE").fetchall()
            if problem and not self._is_settled:
                # SQLite would fold the log into what is there now.
                log = f"{self.path}-wal"
                with contextlib.suppress(OSError):
                    if not has_copy:
                        shutil.copyfile(log, f"{self.path}{database.UNUSED_LOG}")
                with contextlib.suppress(OSError):
                    os.truncate(log, 0)
            self._db.close()
            if problem and not database.has_log(self.path):  # SQLite leaves these beside a file that is not its own
                for ending in ("-wal", "-shm"):
                    files.remove(self.path.with_name(self.path.name + ending))
            if self._lock is not None:
                holder.drop_note(self.path)
                self._lock.release()
                self._lock = None

    def _rescue(self, problem: str) -> bool:
        """Write what was done in a file that is gone into a new one beside it. Returns whether that could be done."""
        names = (f"{self.path.stem}.rescued{k}{database.SUFFIX}" for k in itertools.chain([""], range(2, 1000)))
        target = next((path for path in map(self.path.with_name, names) if not path.exists()), None)
        with contextlib.suppress(ValueError, OSError):  # its folder went too, or its disk is full
            if target is not None:
                self.copy(target)
                self.note = f"{self.path}: {problem}; what was done in it is in {target.name}"
                warnings.warn(self.note, stacklevel=4)
                return True
        return False

    def check_file(self) -> None:
        """Raises UnwritableError where the file was deleted, moved or replaced since it was opened, or cannot be
        reached, ValueError where another program wrote into it: nothing that is committed would be found again."""
        if self._file is not None:
            with self._mutex:
                self.settle()
                self._file.check(self._spare is not None)
                # Two that opened it before either could see the other's note.
                if other := holder.other_holder(self.path):
                    problem = f"was opened on {other} too, and nothing was changed"
                    raise UnwritableError(f"{self.path}: {problem}; save_as another name keeps all that is open here")

    def _fold(self) -> None:
        """Fold the log into the file, where no reader needs it. A full disk: all is in the log."""
        with contextlib.suppress(sqlite3.Error):
            self._database.start()
            self._db.execute(f"PRAGMA busy_timeout={FOLD_WAIT_SECONDS * 1000:.0f}").fetchall()
            try:
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            finally:
                self._db.execute(f"PRAGMA busy_timeout={database.WAIT_SECONDS * 1000:.0f}").fetchall()

    @contextlib.contextmanager
    def settling_later(self) -> Iterator[None]:
        """What is committed meanwhile is on the disk as ever, and stays in the log until `settle`, or whatever looks at
        the file next: for whoever has an answer to give in between."""
        self._settles_later = True
        try:
            yield
        finally:
            self._settles_later = False

    def settle(self) -> None:
        """Fold what was committed into the file, unless that is done. Not into what another program wrote there since:
        what is committed stays in the log, for copies (`_clone`)."""
        with self._mutex:
            if not self._is_settled and not (self._file is not None and self._file.is_overwritten()):
                self._settled()

    def _settled(self) -> Project:
        """This, with what was written folded into the file, which is from now on as it is now."""
        if self._file is not None:
            self._fold()
            self._file.note(self._db)
            spare = spare_copy(self.path)
            self._spare = None if self._file.is_lost() else spare
        self._is_settled = True
        return self

    def copy(self, path: Path, overwrite: bool = False) -> None:
        """Copy the project to another file, compact; it appears complete or not at all. Raises ValueError: it exists,
        is open elsewhere, or cannot be written; another program wrote into this one."""
        with self._mutex:  # nobody is between a commit and what is noted of it
            self.settle()
            is_overwritten = self._file is not None and self._file.is_overwritten()
            spare = self._spare if is_overwritten else None
            if is_overwritten and spare is None:
                self.check_file()
        lock = lock_target(path, overwrite)
        try:
            create_database(path, lambda connection: self._clone(connection, spare))
        finally:
            lock.release()

    def _clone(self, target: sqlite3.Connection, spare: bytes | None) -> None:
        """Copy what there is into another database. spare: bytes of a file to copy in place of that which is open."""
        with self._mutex, contextlib.ExitStack() as stack:
            source = self._db
            if spare is not None:
                source = stack.enter_context(self._opened_spare(spare))
            try:
                source.backup(target, pages=1024)
            except sqlite3.Error as error:
                if is_unwritable(error):
                    raise  # of the target, whose writer names it
                with database.one_line(self.path):
                    raise
        target.execute("PRAGMA journal_mode=DELETE").fetchall()

    @contextlib.contextmanager
    def _opened_spare(self, spare: bytes) -> Iterator[sqlite3.Connection]:
        """The project as it was left, with what waits in the log."""
        if self._is_settled:
            with contextlib.closing(sqlite3.connect(":memory:")) as source:
                source.deserialize(without_log(spare))
                yield source
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / self.path.name
            path.write_bytes(spare)
            shutil.copyfile(f"{self.path}-wal", f"{path}-wal")
            database.set_log_aside(path)
            with contextlib.closing(sqlite3.connect(path)) as source:
                yield source

    # ---- reading

    def rows(self, query: str, *values: Any, kinds: tuple[type | tuple[type, ...], ...] = ()) -> list[tuple]:
        """All rows of a query. kinds: expected types of the columns. Raises ValueError: damaged."""
        with self._mutex:
            return self._database.rows(query, *values, kinds=kinds)

    def fact(self, name: str) -> str | None:
        """A fact by its name. Raises ValueError: it is no text."""
        values = self.rows("SELECT value FROM facts WHERE name = ?", name, kinds=(str,))
        return values[0][0] if values else None

    def facts_named(self, prefix: str) -> list[str]:
        """Names of facts that begin with a prefix, ascending."""
        query = "SELECT name FROM facts WHERE substr(name, 1, ?) = ? ORDER BY name"
        return [name for (name,) in self.rows(query, len(prefix), prefix, kinds=(str,))]

    def original(self, folder: str = "") -> Iterator[tuple[str, bytes]]:
        """(name, bytes) pieces of the original's files, in order; folder: of an asset that was added (it ends in "/",
        which no name of the original has). Raises ValueError: more than the file has."""
        with self._mutex, database.one_line(self.path):
            left = self._database.start()
        for name, part in self.rows("SELECT file, part FROM original ORDER BY part", kinds=(str, int)):
            if not name.startswith(folder) or "/" in name[len(folder) :]:
                continue
            file = name
            query = "SELECT bytes FROM original WHERE file = ? AND part = ?"
            for (data,) in self.rows(query, file, part, kinds=(bytes,)):
                left -= len(data)
                if left < 0:
                    raise ValueError(f"{self.path}: damaged project file (its original has more bytes than the file)")
                yield file[len(folder) :], data

    def blob(self, sha256: str) -> bytes:
        """Bytes of a picture. Raises ValueError: unknown or damaged."""
        rows = self.rows("SELECT bytes FROM blobs WHERE sha256 = ?", sha256, kinds=(bytes,))
        if not rows or files.sha256(rows[0][0]) != sha256:
            raise ValueError(f"{self.path}: damaged project file (picture {sha256[:12]}... is missing or wrong)")
        return rows[0][0]

    def has_result(self, key: str) -> bool:
        """Whether a result is stored, damaged or not."""
        return bool(self.rows("SELECT 1 FROM results WHERE key = ?", key))

    def result_bytes(self, key: str) -> int:
        """Bytes that a result's delta takes; 0: there is none."""
        with self._mutex:
            if key not in self._sizes or self.read_only:
                query = "SELECT coalesce(sum(length(bytes)), 0) FROM deltas WHERE result = ?"
                self._sizes[key] = self.rows(query, key)[0][0]
            return self._sizes[key]

    def result(self, key: str) -> LayerResult | None:
        """A stored result; its parts are decoded one at a time. Raises ValueError where it is damaged."""
        optional = (bytes, type(None))
        query = "SELECT facts, confidence, state FROM results WHERE key = ?"
        rows = self.rows(query, key, kinds=(str, optional, optional))
        if not rows:
            return None
        facts, confidence, state = rows[0]
        where = f"{self.path}: result {key[:12]}..."
        delta = decode(self._parts(key), where)
        try:
            return loaded_result(delta, facts, confidence, state)
        except (ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"{where}: damaged ({error})") from None

    def _parts(self, key: str) -> Iterator[bytes]:
        for (part,) in self.rows("SELECT part FROM deltas WHERE result = ? ORDER BY part", key, kinds=(int,)):
            query = "SELECT bytes FROM deltas WHERE (result, part) = (?, ?)"
            yield from (data for (data,) in self.rows(query, key, part, kinds=(bytes,)))

    def bookmarks(self) -> list[Bookmark]:
        """Bookmarks in order; the same objects as long as they are the same."""
        with self._mutex:
            if self._bookmarks is None or self.read_only:  # somebody else may write
                rows = self.rows("SELECT id, name, camera FROM bookmarks ORDER BY id", kinds=(int, str, str))
                where = f"{self.path}: bookmark"
                self._bookmarks = [Bookmark(str(k), name, Camera.from_json(text, where)) for k, name, text in rows]
            return list(self._bookmarks)

    def steps(self) -> tuple[list[Step], int]:
        """(the history, oldest first; index of the step in effect)."""
        with self._mutex:
            steps = self._steps
            if steps is None or self.read_only:
                query = "SELECT id, label FROM steps ORDER BY id"
                steps = self._steps = [Step(*row) for row in self.rows(query, kinds=(int, str))]
            cursor = self.fact("cursor") or ""
            for index in reversed(range(len(steps))):
                if str(steps[index].id) == cursor:
                    return list(steps), index
        raise ValueError(f"{self.path}: damaged project file (step {cursor[:20]!r} of its history is missing)")

    def gesture(self) -> str:
        """The gesture of the step in effect (`commit`); "" of one that has none."""
        query = "SELECT coalesce(gesture, '') FROM steps WHERE id = ?"
        rows = self.rows(query, int(self.fact("cursor") or 0), kinds=(str,))
        return rows[0][0] if rows else ""

    def document(self, step: int) -> Document:
        """The layers as they were after a step. Raises ValueError: damaged."""
        where = f"{self.path}: layer"
        with database.one_line(self.path):
            policies = self.rows("SELECT policies FROM steps WHERE id = ?", step, kinds=(str,))
            assets = self._assets(step)
            highest = self.rows("SELECT max(next_id) FROM steps", kinds=(int,))  # undone layers' ids stay theirs
            query = "SELECT id, content FROM step_layers JOIN layers ON layers.id = layer WHERE step = ? ORDER BY place"
            contents = self.rows(query, step, kinds=(int, str))
            if not policies:
                raise ContentError(f"step {step} of its history is missing")
        try:
            layers = tuple(self._layer(row, json.loads(text), where) for row, text in contents)
            if len({layer.id for layer in layers}) < len(layers):
                raise ValueError("two layers have one id")
            ids = {asset.id for asset in assets}
            if any(layer.asset not in ids for layer in layers if layer.asset != MAIN_ASSET_ID):
                raise ValueError("a layer belongs to an asset that is missing")
            return Document(layers, _policies(json.loads(policies[0][0])), highest[0][0], assets)
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
            reason = files.printable(str(error).removeprefix(f"{where}: "), MAX_REASON)
            raise ValueError(f"{where}: damaged ({reason})") from None

    def _assets(self, step: int) -> tuple[SceneAsset, ...]:
        """The assets of a step. Raises ValueError: damaged."""
        rows = self.rows("SELECT assets FROM steps WHERE id = ?", step, kinds=((str, type(None)),))
        try:
            return parse_assets(json.loads(rows[0][0])) if rows and rows[0][0] else ()
        except (ValueError, RecursionError) as error:
            reason = files.printable(str(error), MAX_REASON)
            raise ValueError(f"{self.path}: damaged project file ({reason})") from None

    def _layer(self, row: int, record: Any, where: str) -> Layer:
        """The layer of a row, with its strokes. Raises ValueError: damaged."""
        count = record.pop("strokes", 0)
        layer = Layer.parse(record, where)
        if not count:
            return layer
        query = (
            "WITH RECURSIVE chain(id, place) AS (SELECT previous, 1 FROM layers WHERE id = ? UNION ALL "
            f"SELECT previous, place + 1 FROM layers JOIN chain USING (id) WHERE place < {MAX_STROKES}) "
            "SELECT sha256, content FROM chain JOIN layers USING (id) ORDER BY place DESC"
        )
        strokes = []
        for sha, text in self.rows(query, row, kinds=(str, str)):
            stroke = self._parsed.get(sha)
            if stroke is None:
                stroke = self._parsed[sha] = Layer.parse(json.loads(text), where)
                check_stroke(stroke)
            strokes.append(stroke)
        if len(strokes) != count:
            raise ValueError(f"{len(strokes)} strokes instead of {brief(count)}")
        return replace(layer, strokes=tuple(strokes))

    # ---- writing: each of these is one durable transaction

    def commit(
        self,
        label: str,
        document: Document,
        results: Iterable[str],
        new: Transaction,
        gesture: str | None = None,
    ) -> set[str]:
        """A new step after the one in effect; steps that were undone are dropped. gesture: a step of the same gesture
        right before is replaced. Returns the keys of results that are no longer stored."""
        with self._writing() as db:
            # What was undone is gone with the first new step, and of a dragged slider only the last position stays.
            at = int(db.execute("SELECT value FROM facts WHERE name = 'cursor'").fetchone()[0])
            dropped = db.execute("DELETE FROM steps WHERE id > ?", (at,)).rowcount
            if gesture is not None:
                query = "DELETE FROM steps WHERE id = ? AND gesture = ? AND id > (SELECT min(id) FROM steps)"
                dropped += db.execute(query, (at, gesture)).rowcount
            dropped += db.execute("DELETE FROM steps WHERE id <= ?", (at - MAX_STEPS,)).rowcount
            # The step itself, then what it names: files of assets, pictures, layers, results.
            step = at + 1
            assets = json.dumps([asset.record() for asset in document.assets]) if document.assets else None
            entry = (step, label, gesture, json.dumps(document.policies), document.next_id, assets)
            columns = "(id, label, gesture, policies, next_id, assets)"
            db.execute(f"INSERT INTO steps {columns} VALUES (?, ?, ?, ?, ?, ?)", entry)
            for part, (name, data) in enumerate(new.files):
                db.execute("INSERT OR IGNORE INTO original VALUES (?, ?, ?)", (name, part, data))
            for name, data in new.blobs.items():
                db.execute("INSERT OR IGNORE INTO blobs VALUES (?, ?)", (name, data))
            for index, layer in enumerate(document.layers):
                db.execute("INSERT INTO step_layers VALUES (?, ?, ?)", (step, index, store_layer(db, layer)))
            for key, result in new.results.items():
                store_result(db, key, result, new.previous.get(key))
            db.executemany("INSERT OR IGNORE INTO step_results VALUES (?, ?)", [(step, key) for key in results])
            _set_cursor(db, step)
            # Only a step that is gone can leave something that nobody needs.
            removed = sweep(db) if dropped else set()
            self._forget_sizes(new.results, removed)
            steps, self._steps = self._steps, None  # until it is done
        if steps is not None and not dropped:
            self._steps = [*steps, Step(step, label)]
        return removed

    def move(self, step: int, results: Iterable[str], new: Transaction) -> None:
        """Another step takes effect (undo, redo). results: of its asset, in case some had to be made anew."""
        with self._writing() as db:
            self._forget_sizes(new.results)
            for key, result in new.results.items():
                store_result(db, key, result, new.previous.get(key))
            db.executemany("INSERT OR IGNORE INTO step_results VALUES (?, ?)", [(step, key) for key in results])
            _set_cursor(db, step)

    def fold(self, keys: Sequence[str], key: str, result: LayerResult, next_key: str) -> set[str]:
        """One result in place of several in a row: it is what `next_key`, which follows them, needs now. Returns the
        keys of results that are no longer stored."""
        with self._writing() as db:
            store_result(db, key, result, None)
            db.execute("UPDATE results SET previous = ? WHERE key = ?", (key, next_key))
            rows = [(old,) for old in keys]
            db.executemany("DELETE FROM step_results WHERE result = ?", rows)
            db.executemany("DELETE FROM results WHERE key = ?", rows)
            removed = sweep(db).union(keys)
            self._forget_sizes([key], removed)
        with self._mutex, contextlib.suppress(sqlite3.Error):  # a full disk: the room is free within the file
            self._database.start()
            self._db.executescript("PRAGMA incremental_vacuum")  # execute() would free one page
            self._settled()
        return removed

    def _forget_sizes(self, *groups: Iterable[str]) -> None:
        for key in (key for group in groups for key in group):
            self._sizes.pop(key, None)

    def add_bookmark(self, name: str, camera: Camera) -> str:
        query = "INSERT INTO bookmarks (name, camera) VALUES (?, ?)"
        with self._mutex:
            bookmarks = self.bookmarks()
            with self._writing() as db:
                bookmark = Bookmark(str(db.execute(query, (name, camera.to_json())).lastrowid), name, camera)
            self._bookmarks = [*bookmarks, bookmark]
            return bookmark.id

    def delete_bookmark(self, bookmark: str) -> None:
        with self._mutex:
            bookmarks = self.bookmarks()
            with self._writing() as db:
                if not db.execute("DELETE FROM bookmarks WHERE CAST(id AS TEXT) = ?", (bookmark,)).rowcount:
                    raise ValueError(f"bookmark: no bookmark with id {brief(bookmark)}")
            self._bookmarks = [entry for entry in bookmarks if entry.id != bookmark]

    def set_fact(self, name: str, value: str) -> None:
        with self._writing() as db:
            db.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (name, value))

    def delete_fact(self, name: str) -> None:
        with self._writing() as db:
            db.execute("DELETE FROM facts WHERE name = ?", (name,))

    @contextlib.contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        if self.read_only:
            raise ValueError(f"{self.path}: {self.read_only}")
        with self._mutex, database.one_line(self.path):
            self.check_file()
            self._database.start()
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
            self._has_written, self._is_settled = True, False
            if not (self._settles_later and self._file is not None and self._file.waits_in_log()):
                self._settled()


class Transaction:
    """What a command has prepared and not committed yet, in front of what the project file holds: pictures and results
    by hash."""

    def __init__(self, project: Project) -> None:
        self.project = project
        self.clear()

    def clear(self) -> None:
        """Forget what is new: it was committed, or its command failed."""
        self.blobs: dict[str, bytes] = {}
        self.files: Iterable[tuple[str, bytes]] = ()
        """Pieces of the file of an asset that is added, as (folder and name, bytes)."""
        self.results: dict[str, LayerResult] = {}
        self.previous: dict[str, str] = {}
        """Key of a stroke's result -> that of the stroke before."""

    def blob(self, sha256: str) -> bytes:
        """Bytes of a picture. Raises ValueError: unknown or damaged."""
        return self.blobs.get(sha256) or self.project.blob(sha256)

    def has(self, key: str) -> bool:
        """Whether there is a result, damaged or not."""
        return key in self.results or self.project.has_result(key)

    def get(self, key: str) -> LayerResult | None:
        """A result, None where there is none that can be read: it is computed again, and `verify` reports damage."""
        try:
            return self.results.get(key) or self.project.result(key)
        except ValueError:
            return None

    def put(self, key: str, result: LayerResult, previous: str | None = None) -> None:
        """Store a result. previous: key of another one that is to be kept as long as this one."""
        if not self.project.read_only:
            self.results[key] = result
            if previous is not None:
                self.previous[key] = previous


def _set_cursor(db: sqlite3.Connection, step: int) -> None:
    db.execute("UPDATE facts SET value = ? WHERE name = 'cursor'", (str(step),))
    db.execute("INSERT OR REPLACE INTO facts VALUES ('edited', ?)", (f"{time.time():.3f}",))


def _policies(pairs: Any) -> tuple[tuple[str, str, Policy], ...]:
    """Raises ValueError where they are not [lower layer, upper layer, policy]."""
    out = []
    for pair in pairs:
        lower, upper, policy = pair
        if not (isinstance(lower, str) and isinstance(upper, str) and policy in get_args(Policy)):
            raise ValueError(f"unexpected policy {pair!r:.80}")
        out.append((lower, upper, policy))
    return tuple(out)


def _drop_note(path: Path, lock: ProjectLock, process: int) -> None:
    """Of a project that was not closed: its process ended, as scripts do, or nobody refers to it any more."""
    if lock.is_held and os.getpid() == process:  # a fork of it leaves the note alone
        holder.drop_note(path)
