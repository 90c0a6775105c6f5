"""Opening and making a project's file: its lock, its database, and why it cannot be written."""

from __future__ import annotations

import os
import sqlite3
from pathlib import Path

from splatpainter.io import files
from splatpainter.session.project import database, holder
from splatpainter.session.project.database import Database, closed_on_error
from splatpainter.session.project.lock import LockRefused, ProjectLock
from splatpainter.system.atomic import MAX_NAME_BYTES
from splatpainter.system.quick_dataclass import dataclass

ELSEWHERE = "open elsewhere: this copy is read-only; save_as makes one of your own"
UNWRITABLE = "cannot be written ({}): it is read-only; save_as makes a copy that can be changed"


def open_database(path: Path, readonly: bool) -> Database:
    """The database, checked. readonly False: that it can be written has been tried. Raises sqlite3.Error,
    ValueError."""
    connection = database.open_readable(path) if readonly else database.open_writable(path)
    with closed_on_error(connection):
        bounded = Database(path, connection)
        bounded.start()
        database.check_tables(connection)
        if not readonly:
            database.try_writing(connection)
        return bounded


@dataclass(frozen=True)
class ReadOnly:
    """Why a project can only be looked at."""

    words: str
    """One line; "": it can be changed."""
    was_held: bool = False
    """Whether it is that somebody else had it open."""


def lock_or_reason(path: Path, despite_note: bool = False) -> tuple[ProjectLock | None, ReadOnly]:
    """(the lock of a project, nothing) or (None, why it cannot be written). despite_note: also where another computer's
    note says that it is open there."""
    try:
        lock = ProjectLock.take(path)
    except LockRefused as error:
        return None, ReadOnly(UNWRITABLE.format(error.reason))
    if lock is None:
        return None, ReadOnly(ELSEWHERE, was_held=True)
    # A lock that was given says nothing of other computers where locks do not reach them.
    if not despite_note and (other := holder.other_holder(path)):
        lock.release()
        return None, ReadOnly(holder.OPEN_THERE.format(other, holder.note_of(path).name), was_held=True)
    return lock, ReadOnly("")


def check_free(path: Path, overwrite: bool) -> None:
    """Raises ValueError where a file may not be written: a folder, or a file that is not to be overwritten."""
    if path.is_dir() or (path.exists() and not overwrite):
        raise ValueError(f"{path}: already exists; choose another name or allow overwriting")


def lock_target(path: Path, overwrite: bool) -> ProjectLock:
    longest = MAX_NAME_BYTES - len("..part-wal")  # of the files beside it, which are found by its whole name
    if (length := len(os.fsencode(path.name))) > longest:
        raise ValueError(f"{path}: expected a project's name of at most {longest} bytes, got {length}; shorten it")
    check_free(path, overwrite)
    if not path.parent.is_dir():
        raise ValueError(f"{path}: no such folder: {path.parent}; make it first")
    lock = ProjectLock.take(path)
    if lock is None:
        raise ValueError(f"{path}: is open elsewhere; close it there or choose another name")
    if other := holder.other_holder(path):
        lock.release()
        raise ValueError(f"{path}: is open on {other}, or was not closed there; choose another name")
    return lock


def create_database(path: Path, fill) -> None:
    """A database that appears at `path` filled and on disk, or not at all. The caller holds the lock of `path`."""
    partial = path.with_name(f".{path.name}.part")
    try:
        partial.unlink(missing_ok=True)  # of somebody who was killed here
        with database.one_line(path):
            connection = sqlite3.connect(partial, isolation_level=None)
            try:
                connection.execute("PRAGMA journal_mode=OFF").fetchall()  # it has no name yet: all or nothing anyway
                connection.execute("PRAGMA synchronous=OFF")
                fill(connection)
            finally:
                connection.close()
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        for ending in ("-wal", "-shm", "-journal"):  # of a project that was there and is replaced
            path.with_name(path.name + ending).unlink(missing_ok=True)
        files.replace(partial, path)
        files.sync_folder(path.parent)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        for ending in ("", "-wal", "-shm"):
            files.remove(partial.with_name(partial.name + ending))
