"""Projects on disks that refuse locks or shared maps, and in folders whose files other programs replace."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import splatpainter as sp
from splatpainter.session.project import database, open_file
from splatpainter.session.project.database import UnwritableError
from splatpainter.session.project.disk_probe import locks_refused
from splatpainter.session.project.project_file import Project
from splatpainter.session.project.scratch import ScratchFolder, sweep_folder
from tests.support.session_scenes import BLUE, GREEN, RED, asset, dab, flat, load, print_of, two_layers

posix_only = pytest.mark.skipif(sys.platform == "win32", reason="Windows lets nobody replace an open file")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "work.splatproj"


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


# Locks


def refuse_locks(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """No connection gets a lock, and SQLite gives the error this name: ENOLCK, EACCES and ETIMEDOUT are BUSY to it,
    ENOSYS and EOPNOTSUPP IOERR_RDLOCK or IOERR_LOCK, EPERM is PERM."""
    real = sqlite3.connect

    class Refused(sqlite3.Connection):
        address = ""

        def execute(self, statement: str, *values):  # type: ignore[override]
            free = "nolock=1" in self.address or "immutable=1" in self.address
            if not free and not statement.startswith("PRAGMA"):
                error = sqlite3.OperationalError("database is locked")
                error.sqlite_errorname = name
                raise error
            return super().execute(statement, *values)

    def connect(address, *words, **how):
        connection: Any = real(address, *words, **{**how, "factory": Refused})
        connection.address = str(address)
        return connection

    monkeypatch.setattr(sqlite3, "connect", connect)


@pytest.mark.parametrize("name", ["SQLITE_BUSY", "SQLITE_PERM", "SQLITE_IOERR_RDLOCK", "SQLITE_IOERR_LOCK"])
def test_where_locks_are_refused_projects_can_be_looked_at(
    path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    state = two_layers(path)
    data = path.read_bytes()
    refuse_locks(monkeypatch, name)
    assert locks_refused(path.parent) is True
    with load(path) as session:
        assert print_of(session) == state and session.verify() == []
        reason = "cannot be written (its file system refuses file locks)"
        assert session.read_only.startswith(reason) and "save_as" in session.read_only
        with pytest.raises(ValueError, match="refuses file locks"):
            session.undo()
    with load(path, readonly=True) as session:
        assert print_of(session) == state
    with pytest.raises(ValueError, match="refuses file locks"):
        load(path, readonly=False)
    with pytest.raises(ValueError, match=r"new\.splatproj: cannot be locked .*refuses file locks.*local disk") as error:
        flat(project=path.with_name("new.splatproj"))
    assert "damaged" not in str(error.value) and "elsewhere" not in str(error.value)
    assert path.read_bytes() == data and names(path.parent) == [path.name]  # no lock, no probe stays


@pytest.mark.parametrize("ending", ["-wal", "-journal"])
def test_what_needs_its_log_is_not_read_without_it(path: Path, monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    two_layers(path)
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode=WAL").fetchall()  # its head says that it has a log
    connection.close()
    path.with_name(path.name + ending).write_bytes(b"something")
    refuse_locks(monkeypatch, "SQLITE_BUSY")
    with pytest.raises(ValueError, match=rf"was not closed, and its file system refuses .*copy it and .*{ending} to"):
        load(path)
    path.with_name(path.name + ending).write_bytes(b"")
    with load(path) as session:
        assert len(session.layers) == 2


def test_locks_that_are_refused_later_are_no_damage(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The lock daemon of a server stops while a project is open."""
    with flat(project=path) as session:
        session.layers.add("paint", [dab(RED)])
        state = print_of(session)
        with monkeypatch.context() as patch:
            patch.setattr(database, "locks_refused", lambda folder: True)

            class Busy:
                def __getattr__(self, name: str):
                    return getattr(connection, name)

                def execute(self, statement: str, *values):
                    if statement == "BEGIN IMMEDIATE":
                        error = sqlite3.OperationalError("database is locked")
                        error.sqlite_errorname = "SQLITE_BUSY"
                        raise error
                    return connection.execute(statement, *values)

            connection = session._core.project._db
            patch.setattr(session._core.project, "_db", Busy())
            with pytest.raises(UnwritableError, match="nothing was changed: its file system refuses file locks"):
                session.layers.add("paint", [dab(BLUE)])
        assert print_of(session) == state
        session.layers.add("paint", [dab(BLUE)])


def test_a_lock_that_somebody_holds_is_no_refusal(path: Path) -> None:
    two_layers(path)
    with load(path):
        assert locks_refused(path.parent) is False
        with load(path) as second:
            assert second.read_only.startswith("open elsewhere")
        with pytest.raises(ValueError, match="is open elsewhere"):
            flat(project=path, overwrite=True)
    assert locks_refused(path.parent / "nowhere") is None
    (path.parent / ".locks.0123abcd.part").touch()  # of somebody who was killed while trying
    os.utime(path.parent / ".locks.0123abcd.part", (1, 1))
    sweep_folder(path.parent)
    assert names(path.parent) == [path.name]


def test_scratch_folders_need_no_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    refuse_locks(monkeypatch, "SQLITE_BUSY")
    folder = ScratchFolder("studio")
    assert names(folder.path) == []
    folder.close()
    assert names(tmp_path) == []


# Shared maps


def refuse_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    """As 9p, virtiofs and vboxsf do: a log without exclusive locks cannot be used."""
    real = sqlite3.connect

    class Refused(sqlite3.Connection):
        alone = False

        def execute(self, statement: str, *values):  # type: ignore[override]
            self.alone = self.alone or statement == "PRAGMA locking_mode=EXCLUSIVE"
            if statement == "PRAGMA journal_mode=WAL" and not self.alone:
                error = sqlite3.OperationalError("disk I/O error")
                error.sqlite_errorname = "SQLITE_IOERR_SHMMAP"
                raise error
            return super().execute(statement, *values)

    monkeypatch.setattr(sqlite3, "connect", lambda *words, **how: real(*words, **{**how, "factory": Refused}))


def test_where_maps_cannot_be_shared_everything_works(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse_maps(monkeypatch)
    with flat(project=path) as session:
        session.layers.add("paint", [dab(RED)], name="red")
        assert session._core.project._db.execute("PRAGMA journal_mode").fetchall() == [("delete",)]
        assert session._core.project._db.execute("PRAGMA synchronous").fetchall() == [
            (3,)
        ]  # EXTRA: the folder is synced
        assert names(path.parent) == [path.name, f"{path.name}-host", f"{path.name}-lock"]
        with load(path) as reader:
            assert print_of(reader) == print_of(session) and reader.read_only.startswith("open elsewhere")
            session.layers.add("paint", [dab(BLUE, 19)], name="blue")
            assert reader.refresh() and print_of(reader) == print_of(session)
        session.undo()
        session.files.save_as(path.with_name("other.splatproj"))
        session.redo()
    with load(path) as session:
        assert [layer.name for layer in session.layers] == ["red"] and session.redo() and session.verify() == []
    assert names(path.parent) == ["other.splatproj", path.name]


def test_a_log_that_is_left_is_played_where_maps_cannot_be_shared(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed on the host, opened in a virtual machine."""
    copy = path.with_name("copy.splatproj")
    with monkeypatch.context() as patch:
        patch.setattr(Project, "_fold", lambda self: None)
        with flat(project=path) as session:
            session.layers.add("paint", [dab(RED)], name="red")
            state = print_of(session)
            for ending in ("", "-wal"):
                shutil.copy(f"{path}{ending}", f"{copy}{ending}")
    refuse_maps(monkeypatch)
    with load(copy) as session:
        assert print_of(session) == state and session.note == ""
    assert names(path.parent) == [copy.name, path.name]


# One file


def test_a_copy_of_the_one_file_has_all_that_was_acknowledged(path: Path) -> None:
    copy = path.with_name("copy.splatproj")
    with flat(project=path) as session:
        for k, color in enumerate((RED, BLUE, GREEN)):
            session.layers.add("paint", [dab(color, 10 + 5 * k)])
            shutil.copy(path, copy)
            with load(copy) as other:
                assert print_of(other) == print_of(session) and other.verify() == []
        session.undo()
        session.bookmarks.add("front", dab().camera)
        shutil.copy(path, copy)
        with load(copy) as other:
            assert print_of(other) == print_of(session) and len(other.bookmarks) == 1


def test_what_is_settled_later_is_durable_at_once_and_whole_before_anything_looks_at_the_file(path: Path) -> None:
    copy = path.with_name("copy.splatproj")
    with flat(project=path) as session:
        with session.files.settling_later():
            session.layers.new("first")
        assert database.has_log(path)
        # Whoever opens it with its log has all of it, as after a crash.
        with load(path, readonly=True) as reader:
            assert [layer.name for layer in reader.layers] == ["first"]
        session.files.settle()
        assert not database.has_log(path)
        shutil.copyfile(path, copy)
        with load(copy, readonly=True) as alone:
            assert [layer.name for layer in alone.layers] == ["first"]
        for act in (
            lambda: session.layers.new("next"),
            lambda: session.files.save_copy(path.with_name("saved.splatproj")),
            lambda: session.files.is_in_place,
            lambda: session.close(),
        ):
            with session.files.settling_later():
                session.layers.new("later")
            assert database.has_log(path)
            act()
            assert not database.has_log(path)
    with load(path.with_name("saved.splatproj"), readonly=True) as saved:
        assert [layer.name for layer in saved.layers] == ["first", "later", "next", "later"]


def test_a_reader_keeps_no_command_waiting(path: Path) -> None:
    copy = path.with_name("copy.splatproj")
    with flat(project=path) as session:
        reader = sqlite3.connect(path)
        reader.execute("BEGIN")
        reader.execute("SELECT * FROM facts").fetchall()
        session.layers.add("paint", [dab(RED)])  # stays in the log
        assert database.has_log(path)
        session.layers.add("paint", [dab(BLUE, 19)])
        reader.close()
        session.layers.set(session.layers[0].id, name="red")
        assert not database.has_log(path)
        shutil.copy(path, copy)
        with load(copy) as other:
            assert print_of(other) == print_of(session) and len(other.layers) == 2


def stale_log(path: Path, *statements: str) -> bytes:
    """The log of a project after some statements, by default without its layers; its head says that it was closed."""
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA journal_mode=WAL").fetchall()
    connection.execute("PRAGMA wal_autocheckpoint=0").fetchall()
    for statement in statements or ("DELETE FROM step_layers", "UPDATE facts SET value = 'vase' WHERE name = 'name'"):
        connection.execute(statement)
    connection.commit()
    data = path.with_name(path.name + "-wal").read_bytes()
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    connection.execute("PRAGMA journal_mode=DELETE").fetchall()
    connection.close()
    return data


@pytest.mark.parametrize("readonly", [None, True])
def test_a_log_that_belongs_to_another_state_is_not_played(path: Path, readonly: bool | None) -> None:
    other, log = path.with_name("other.splatproj"), path.with_name(path.name + "-wal")
    state = two_layers(path)
    shutil.copy(path, other)
    data, file_data = stale_log(other), path.read_bytes()
    log.write_bytes(data)
    shutil.copy(path, path.with_name("plain.splatproj"))  # what SQLite itself makes of it
    path.with_name("plain.splatproj-wal").write_bytes(data)
    plain = sqlite3.connect(path.with_name("plain.splatproj"))
    assert plain.execute("SELECT count(*) FROM step_layers").fetchall() == [(0,)]
    plain.close()
    with load(path, readonly=readonly) as session:
        assert print_of(session) == state and len(session.layers) == 2
        if readonly:
            assert log.read_bytes() == data and path.read_bytes() == file_data
        else:
            assert f"{path.name}-wal.unused" in session.note
            assert path.with_name(f"{path.name}-wal.unused").read_bytes() == data
            session.layers.add("paint", [dab(GREEN)])
    with load(path, readonly=readonly) as session:
        assert len(session.layers) == (2 if readonly else 3) and session.verify() == []


@pytest.mark.parametrize("readonly", [None, True])
@pytest.mark.parametrize("is_other", [False, True])
def test_an_older_log_beside_a_copy_of_an_open_project_is_not_played(
    path: Path, readonly: bool | None, is_other: bool
) -> None:
    """Both were copied while it was open, the log first: or the log is of another project of the same name."""
    copy, older = path.with_name("copy.splatproj"), path.with_name("older.splatproj")
    with flat(project=path) as session:
        session.layers.add("paint", [dab(RED)], name="red")
        if is_other:
            flat(asset(8), older).close()
        else:
            shutil.copy(path, older)
        data = stale_log(older)
        session.layers.add("paint", [dab(BLUE, 19)], name="blue")
        state = print_of(session)
        shutil.copy(path, copy)
    assert copy.read_bytes()[18:20] == b"\2\2"  # its head says that there is a log
    log = path.with_name("copy.splatproj-wal")
    log.write_bytes(data)
    with load(copy, readonly=readonly) as session:
        assert print_of(session) == state and [layer.name for layer in session.layers] == ["red", "blue"]
        assert session.verify() == [] and ("-wal.unused" in session.note) == (not readonly)
    assert (log if readonly else path.with_name("copy.splatproj-wal.unused")).read_bytes() == data


def test_an_older_log_that_fits_is_not_played(path: Path) -> None:
    """It holds one page, that of the name and of the time of the latest step."""
    older = path.with_name("older.splatproj")
    two_layers(path)
    shutil.copy(path, older)
    data = stale_log(older, "UPDATE facts SET value = 'older' WHERE name = 'name'")
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA journal_mode=WAL").fetchall()
    connection.execute("UPDATE facts SET value = value + 1 WHERE name = 'edited'")
    connection.execute("UPDATE facts SET value = 'newer' WHERE name = 'name'")
    connection.close()
    path.with_name(path.name + "-wal").write_bytes(data)
    with load(path) as session:
        assert (
            session._core.project.fact("name") == "newer" and "-wal.unused" in session.note and session.verify() == []
        )


def test_a_log_of_a_killed_session_is_played(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = path.with_name("copy.splatproj")
    monkeypatch.setattr(Project, "_fold", lambda self: None)
    with flat(project=path) as session:
        session.layers.add("paint", [dab(RED)], name="red")
        for ending in ("", "-wal"):
            shutil.copy(f"{path}{ending}", f"{copy}{ending}")
        with load(copy) as other:
            assert [layer.name for layer in other.layers] == ["red"] and other.note == ""


@pytest.mark.parametrize("left", [b"", bytes(512), bytes(4096)])
def test_a_journal_with_nothing_to_roll_back_does_not_stay(
    path: Path, monkeypatch: pytest.MonkeyPatch, left: bytes
) -> None:
    """A writer killed between making its journal and writing to it leaves one; SQLite lets it lie until it writes."""
    refuse_maps(monkeypatch)
    state = two_layers(path)
    path.with_name(f"{path.name}-journal").write_bytes(left)
    with load(path) as session:
        assert print_of(session) == state
    assert names(path.parent) == [path.name]


def test_a_rollback_journal_that_is_needed_is_not_passed_over(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed in the middle of a commit where maps cannot be shared, looked at in a folder without rights."""
    state = two_layers(path)
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA cache_size=2")
    connection.execute("PRAGMA cache_spill=2")
    connection.execute("BEGIN IMMEDIATE")
    connection.execute("UPDATE layers SET content = content || zeroblob(50000)")
    copy = path.with_name("copy.splatproj")
    for ending in ("", "-journal"):
        shutil.copy(f"{path}{ending}", f"{copy}{ending}")
    connection.execute("ROLLBACK")
    connection.close()
    assert path.with_name("copy.splatproj-journal").stat().st_size
    with pytest.raises(ValueError, match=r"was not closed, .*copy it and copy\.splatproj-journal to another"):
        load(copy, readonly=True)
    data = bytearray(copy.read_bytes())
    pages = len(data) // 4096 + 9
    data[28:32] = pages.to_bytes(4, "big")  # the head is written before the pages that the file grew by
    copy.write_bytes(data)
    again = path.with_name("again.splatproj")
    for ending in ("", "-journal"):
        shutil.copy(f"{copy}{ending}", f"{again}{ending}")
    with load(copy) as session:
        assert print_of(session) == state and session.verify() == []
    with flat(project=again, overwrite=True) as session:  # a new one does not get the journal of the old one
        session.layers.add("paint", [dab(RED)])
    with load(again) as session:
        assert len(session.layers) == 1 and session.verify() == []


# Replaced, overwritten, deleted


def replaced(path: Path) -> None:
    other = path.with_name("other.splatproj")
    two_layers(other)
    os.replace(other, path)


def deleted(path: Path) -> None:
    path.unlink()


def moved(path: Path) -> None:
    path.rename(path.with_name("elsewhere.splatproj"))


@posix_only
@pytest.mark.parametrize(
    ("harm", "reason"),
    [(replaced, "was replaced by another file"), (deleted, "was deleted or moved"), (moved, "was deleted or moved")],
)
def test_nothing_is_acknowledged_for_a_file_that_is_gone(path: Path, harm, reason: str) -> None:
    fresh = path.with_name("fresh.splatproj")
    with flat(project=path) as session:
        session.layers.add("paint", [dab(RED)], name="red")
        state, calls = print_of(session), len(session.painter.calls)  # type: ignore[attr-defined]
        harm(path)
        there = path.read_bytes() if path.exists() else None
        for attempt in (
            lambda: session.layers.add("paint", [dab(BLUE, 19)]),
            session.undo,
            lambda: session.bookmarks.add("front", dab().camera),
            lambda: session.files.save_as(path),
        ):
            with pytest.raises(UnwritableError, match=rf"work\.splatproj: {reason}.*; save_as another name"):
                attempt()
        assert print_of(session) == state and len(session.painter.calls) == calls  # type: ignore[attr-defined]
        session.files.save_as(fresh)
        session.layers.add("paint", [dab(BLUE, 19)], name="blue")
        assert session.path == fresh
    assert (path.read_bytes() if path.exists() else None) == there
    assert not [name for name in names(path.parent) if "rescued" in name or name.endswith(("-wal", "-shm", "-lock"))]
    with load(fresh) as session:
        assert [layer.name for layer in session.layers] == ["red", "blue"] and session.verify() == []


@posix_only
def test_what_was_acknowledged_before_the_file_was_replaced_is_written_beside_it(path: Path) -> None:
    session = flat(project=path)
    session.layers.add("paint", [dab(RED)], name="red")
    state = print_of(session)
    path.with_name("work.rescued.splatproj").write_bytes(b"somebody's")
    replaced(path)
    data = path.read_bytes()
    with pytest.warns(UserWarning, match=r"was replaced .*is in work\.rescued2\.splatproj"):
        session.close()
    assert path.read_bytes() == data
    assert names(path.parent) == [f"work{k}.splatproj" for k in (".rescued", ".rescued2", "")]
    with load(path.with_name("work.rescued2.splatproj")) as rescued:
        assert print_of(rescued) == state


@posix_only
@pytest.mark.parametrize("harm", [replaced, deleted])
def test_a_session_that_changed_nothing_leaves_nothing(path: Path, harm, recwarn: pytest.WarningsRecorder) -> None:
    two_layers(path)
    session = load(path)
    harm(path)
    session.close()
    assert not recwarn.list and names(path.parent) == ([path.name] if harm is replaced else [])


@posix_only
def test_a_file_that_another_program_wrote_into_is_left_alone(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a project too large for a copy in memory."""
    monkeypatch.setattr(open_file, "MAX_SPARE_BYTES", 0)
    other = path.with_name("other.splatproj")
    two_layers(other)
    session = flat(project=path)
    session.layers.add("paint", [dab(RED)])
    shutil.copyfile(other, path)  # the same file: its inode stays
    for attempt in (
        lambda: session.layers.add("paint", [dab(BLUE)]),
        lambda: session.files.save_as(path.with_name("c.splatproj")),
    ):
        with pytest.raises(ValueError, match="was overwritten by another program .*; export what is shown"):
            attempt()
    session.close()
    assert path.read_bytes() == other.read_bytes() and names(path.parent) == [other.name, path.name]


@posix_only
@pytest.mark.parametrize("later", [False, True], ids=["", "before the log was folded"])
@pytest.mark.parametrize("content", ["another project", "an older state", "noise", "nothing"])
def test_what_was_overwritten_is_saved_anew(
    content: str, later: bool, path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    """Into the same file, whose inode stays, as some programs synchronise."""

    def settling(session: sp.Session) -> contextlib.AbstractContextManager[None]:
        return session.files.settling_later() if later else contextlib.nullcontext()

    other = path.with_name("other.splatproj")
    two_layers(other)
    session = flat(project=path)
    older = path.read_bytes()
    session.layers.add("paint", [dab(RED)])
    session.layers.add("paint", [dab(BLUE, 19)])
    with settling(session):
        session.undo()
    assert database.has_log(path) == later
    state = print_of(session)
    data = {"another project": other.read_bytes(), "an older state": older, "noise": b"x" * 9000}.get(content, b"")
    path.write_bytes(data)
    session.files.settle()
    assert path.read_bytes() == data
    with pytest.raises(UnwritableError, match="was overwritten by another program .*; save_as another name keeps all"):
        session.layers.add("paint", [dab(GREEN)])
    session.files.save_as(path.with_name("saved.splatproj"))
    assert path.read_bytes() == data and not database.has_log(path)
    assert print_of(session) == state and len(session.history) == 3
    session.layers.add("paint", [dab(GREEN)])
    state = print_of(session)
    session.close()
    with load(path.with_name("saved.splatproj")) as again:
        assert print_of(again) == state
        again.verify()
    unsaved = flat(project=path.with_name("b.splatproj"))
    unsaved.layers.add("paint", [dab(RED)])
    with settling(unsaved):
        unsaved.layers.add("paint", [dab(BLUE, 19)])
    path.with_name("b.splatproj").write_bytes(older)
    unsaved.close()
    assert path.with_name("b.splatproj").read_bytes() == older
    with load(path.with_name("b.rescued.splatproj")) as rescued:
        assert len(rescued.layers) == 2
    assert any("b.rescued.splatproj" in str(one.message) for one in recwarn.list)


@posix_only
def test_a_late_log_that_cannot_be_rescued_is_kept_beside_what_another_program_wrote(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = flat(project=path)
    older = path.read_bytes()
    session.layers.add("paint", [dab(RED)])
    with session.files.settling_later():
        session.layers.add("paint", [dab(BLUE, 19)])
    log = path.with_name(path.name + "-wal").read_bytes()
    path.write_bytes(older)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Project, "copy", full)
    session.close()
    assert path.read_bytes() == older
    assert path.with_name(path.name + database.UNUSED_LOG).read_bytes() == log


def test_another_time_alone_is_no_other_file(path: Path) -> None:
    with flat(project=path) as session:
        session.layers.add("paint", [dab(RED)])
        for moment in (1e9, 2e9):  # network folders correct times after a while
            os.utime(path, (moment, moment))
            session.layers.add("paint", [dab(BLUE)])
        with session.files.settling_later():
            session.layers.add("paint", [dab(BLUE)])
        os.utime(path, (1e9, 1e9))
        session.files.settle()
        assert not database.has_log(path)
    with load(path) as session:
        assert len(session.layers) == 4


def test_a_folder_that_cannot_be_reached_for_a_while(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with flat(project=path) as session:
        with monkeypatch.context() as patch:

            def stale(path: Path):
                raise OSError(errno.ESTALE, "Stale file handle")

            patch.setattr(open_file.os, "stat", stale)
            with pytest.raises(UnwritableError, match=r"cannot be reached \(Stale file handle\).*; try again"):
                session.layers.add("paint", [dab(RED)])
        session.layers.add("paint", [dab(RED)])
        assert len(session.layers) == 1


def test_what_is_committed_is_acknowledged_whatever_follows(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exactly once: a disk that fails right after a commit does not make it a failure."""
    with flat(project=path) as session:
        connection = session._core.project._db
        with monkeypatch.context() as patch:
            committed = []

            class Failing:
                def __getattr__(self, name: str):
                    return getattr(connection, name)

                def execute(self, statement: str, *values):
                    if committed and statement.startswith(("PRAGMA wal_checkpoint", database.WRITTEN_LAST)):
                        raise sqlite3.OperationalError("disk I/O error")
                    if statement == "COMMIT":
                        committed.append(1)
                    return connection.execute(statement, *values)

            patch.setattr(session._core.project, "_db", Failing())
            session.layers.add("paint", [dab(RED)])
        os.utime(path, (1e9, 1e9))  # and the server gives another time
        session.layers.add("paint", [dab(BLUE)])
        assert len(session.layers) == len(session.history) - 1 == 2
    with load(path) as session:
        assert len(session.layers) == 2 and session.verify() == []


def test_a_project_that_could_not_be_made_leaves_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(connection: sqlite3.Connection) -> None:
        error = sqlite3.OperationalError("database or disk is full")
        error.sqlite_errorname = "SQLITE_FULL"
        raise error

    monkeypatch.setattr(database, "try_writing", full)
    with pytest.raises(UnwritableError, match="disk is full"):
        flat(project=path)
    assert names(path.parent) == []


# As such disks do it


SCRIPT = """
import sys
from pathlib import Path
from tests.support.session_scenes import BLUE, RED, dab, flat, load
path = Path(sys.argv[1])
try:
    with flat(project=path) as session:
        session.layers.add("paint", [dab(RED)])
        session.undo()
        session.redo()
        session.files.save_as(path.with_name("b.splatproj"), overwrite=True)
        session.layers.add("paint", [dab(BLUE)])
    with load(path.with_name("b.splatproj")) as session:
        print(len(session.layers), session.verify(), repr(session.read_only))
except ValueError as error:
    print(error)
with load(Path(sys.argv[2])) as session:
    print(len(session.layers), session.read_only)
print(sorted(entry.name for entry in path.parent.iterdir()))
"""


@pytest.mark.shared
@pytest.mark.skipif(sys.platform != "linux" or shutil.which("gcc") is None, reason="needs Linux and a C compiler")
@pytest.mark.parametrize("refused", ["locks", "mmap", "rename1", "chmod,utime,fsyncdir,link,flock"])
def test_real_refusals(shared: Path, tmp_path: Path, refused: str) -> None:
    """The same with a library before the system's calls, so that SQLite's own are refused."""
    source, library = shared / "cases" / "_shim" / "shim.c", tmp_path / "shim.so"
    if not source.exists():
        pytest.skip(f"no faults to inject: {source} is absent")
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True, capture_output=True)
    folder = tmp_path / "disk"
    folder.mkdir()
    two_layers(folder / "old.splatproj")
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]),
        "SHIM": refused,
        "SHIM_DIR": str(folder),
        "LD_PRELOAD": str(library),
    }
    command = [sys.executable, "-c", SCRIPT, str(folder / "a.splatproj"), str(folder / "old.splatproj")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    made, opened, left = done.stdout.splitlines()
    if refused == "locks":
        assert "a.splatproj: cannot be locked (its file system refuses file locks)" in made
        assert opened.startswith("2 cannot be written (its file system refuses file locks)")
        assert left == "['old.splatproj']"
    else:
        assert (made, opened.strip()) == ("2 [] ''", "2")
        assert left == "['a.splatproj', 'b.splatproj', 'old.splatproj']"
