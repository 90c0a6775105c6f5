"""Project files of strangers: one line, within bounds, whatever is in their rows."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
import sys
import tempfile
import time
from pathlib import Path

import pytest

import splatpainter as sp
from splatpainter.session.document.document import Document, Layer, move_layer, resolve_conflict
from splatpainter.session.document.layer_view import View
from splatpainter.session.kinds.painted_layers import PaintLayer
from splatpainter.session.project import database, lock
from splatpainter.session.project.asset_files import is_local_path, is_plain_name
from splatpainter.session.project.lock import ProjectLock
from splatpainter.session.project.project_file import Project
from splatpainter.session.project.scratch import OWNER, ScratchFolder, sweep_folder, sweep_scratch
from splatpainter.session.replay import delta
from tests.support.session_scenes import BLUE, RED, asset, dab, flat, load, print_of, two_layers
from tests.support.systems import posix_only

DEEP = "[" * 100_000
LAYER = "UPDATE layers SET content = json_set(content, {}) WHERE id = 1"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "work.splatproj"


def changed(path: Path, *statements: str, values: tuple = ()) -> None:
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(statement, values if "?" in statement else ())


def test_a_view_has_as_many_pixels_as_a_picture_that_can_be_read() -> None:
    largest = View(sp.look_at((0, 0, 3), (0, 0, 0), width=8192, height=8192), "0" * 64)
    assert View.parse(largest.record(), "a layer") == largest
    with pytest.raises(ValueError, match="a layer: expected a view of at most 67 megapixels"):
        View.parse(View(largest.camera.resized(8192, 8193), "0" * 64).record(), "a layer")


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE facts SET value = x'00' WHERE name = 'cursor'",
        "UPDATE facts SET value = 9223372036854775807 WHERE name = 'cursor'",
        "UPDATE facts SET value = '1e400' WHERE name = 'cursor'",
        "UPDATE facts SET value = x'ff' WHERE name = 'name'",
        "UPDATE facts SET value = x'ff' WHERE name = 'path'",
        "UPDATE facts SET value = '..' WHERE name = 'name'; UPDATE facts SET value = 'ply' WHERE name = 'format'",
        "UPDATE steps SET label = x'00ff'",
        "UPDATE steps SET next_id = 'many'",
        "UPDATE steps SET policies = '{\"a\": 1}'",
        "UPDATE steps SET policies = '[[1, 2, 3]]'",
        f"UPDATE steps SET policies = '{DEEP}'",
        "UPDATE layers SET content = x'00'",
        "UPDATE layers SET content = 'null'",
        "UPDATE layers SET content = '[]'",
        f"UPDATE layers SET content = '{DEEP}'",
        LAYER.format("'$.opacity', json('1e999')"),
        LAYER.format("'$.views[0].camera.width', json('1e999')"),
        LAYER.format("'$.views[0].camera.width', 2000000000, '$.views[0].mask', null"),
        LAYER.format("'$.views', json('[' || substr(replace(hex(zeroblob(40)), '00', ',{}'), 2) || ']')"),
        LAYER.format("'$.thumbnail', 7"),
        LAYER.format("'$.operation', json('[1]')"),
        LAYER.format("'$.operation.kind', 'brush'"),
        LAYER.format("'$.operation.angle_limit', json('[1]')"),
        "UPDATE layers SET content = replace(content, '\"red\"', '\"\\ud800\"') WHERE id = 1",
        "UPDATE original SET file = '..'",
        "UPDATE original SET file = '../../escaped'",
        "UPDATE original SET file = ''",
        "UPDATE original SET bytes = 'text'",
        "UPDATE original SET bytes = zeroblob(20)",
        "UPDATE original SET part = 'x' WHERE part = 1",
        "DELETE FROM original",
        "UPDATE step_layers SET layer = 1",
        "DROP TABLE bookmarks",
        "ALTER TABLE facts ADD COLUMN more TEXT",
        "CREATE TRIGGER t AFTER UPDATE ON facts BEGIN DELETE FROM original; END",
        "CREATE TABLE notes (a)",
        "CREATE INDEX own ON facts (upper(value))",
        "DROP TABLE bookmarks; CREATE VIEW bookmarks AS SELECT 1 AS id, 'a' AS name, '{}' AS camera",
        "DROP TABLE bookmarks; CREATE VIRTUAL TABLE bookmarks USING fts5(id, name, camera)",
        "DROP TABLE bookmarks; CREATE TABLE bookmarks (id INTEGER PRIMARY KEY, name TEXT NOT NULL,"
        " camera TEXT AS (hex(zeroblob(100000000))))",
    ],
)
@pytest.mark.parametrize("kind", ["file", "rows"])
def test_wrong_rows_are_one_line_and_leave_nothing(tmp_path: Path, path: Path, kind: str, statement: str) -> None:
    ply = tmp_path / "vase.ply"
    sp.write(ply, asset(6))
    with flat(ply if kind == "file" else None, path) as session:
        session.layers.add("paint", [dab(RED)], name="red")
        session.layers.add("paint", [dab(BLUE, 19)], name="blue")
    changed(path, *statement.split("; ") if "TRIGGER" not in statement else [statement])
    if kind == "rows" and ("'..' WHERE name" in statement or "original SET file" in statement):
        return  # names of files that are not made
    before = sorted(entry.name for entry in tmp_path.iterdir())
    with pytest.raises(ValueError) as raised:
        load(path)
    text = str(raised.value)
    assert "\n" not in text and len(text) < 1000 and str(path) in text, text
    assert sorted(entry.name for entry in tmp_path.iterdir()) == before and not (tmp_path.parent / "escaped").exists()


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE results SET facts = '[]'",
        'UPDATE results SET facts = \'{"rows_touched": "many"}\'',
        "UPDATE results SET facts = '{\"seconds\": NaN}'",
        "UPDATE results SET facts = '{\"views\": [1]}'",
        f"UPDATE results SET facts = '{DEEP}'",
        "UPDATE results SET facts = x'00'",
        "UPDATE results SET confidence = zeroblob(7)",
        "UPDATE results SET confidence = 'text'",
        "UPDATE results SET state = x'0001'",
        "UPDATE results SET state = 'text'",
        "UPDATE deltas SET bytes = 'text'",
        "UPDATE deltas SET bytes = x''",
        "UPDATE deltas SET part = 'x' || part",
    ],
)
def test_wrong_results_are_computed_again(path: Path, statement: str) -> None:
    state = two_layers(path)
    changed(path, statement)
    with load(path) as session:
        assert print_of(session) == state and len(session.painter.calls) == 2  # type: ignore[attr-defined]
        assert all(isinstance(session.layers.facts(layer.id).get("seconds", 0.0), float) for layer in session.layers)


def test_a_control_character_in_an_error_of_sqlite_is_not_printed(path: Path) -> None:
    two_layers(path)
    schema = "UPDATE sqlite_master SET sql = 'CREATE TABLE ' || char(7) || '(' WHERE name = 'bookmarks'"
    changed(path, "PRAGMA writable_schema = ON", schema)
    with pytest.raises(ValueError, match="malformed database schema") as caught:
        load(path)
    assert str(caught.value).isprintable() and str(path) in str(caught.value)


def test_a_name_of_5000_characters_is_refused_in_a_short_line(tmp_path: Path, path: Path) -> None:
    sp.write(tmp_path / "vase.ply", asset(6))
    flat(tmp_path / "vase.ply", path).close()
    changed(path, "UPDATE facts SET value = hex(zeroblob(2500)) WHERE name = 'name'")
    with pytest.raises(ValueError, match="damaged project file") as caught:
        load(path)
    assert str(caught.value).isprintable() and len(str(caught.value)) < len(str(path)) + 400


NESTED: list = []
for _ in range(200):
    NESTED = [{"children": NESTED}]
LONG = {
    "operation.method": NESTED,
    "operation.kind": "x" * 5000,
    "blend": ["x"] * 2000,
    "operation.mode": {"x" * 5000: 1},
    "name": "x" * 5000,
    "opacity": "x" * 5000,
    "thumbnail": "x" * 5000,
    "operation": ["x" * 5000],
    "operation.placed": ["x" * 5000],
    "operation.brush": "x" * 5000,
}


@pytest.mark.parametrize("field", LONG)
def test_a_layer_is_refused_in_a_line_that_quotes_little_of_it(path: Path, field: str) -> None:
    two_layers(path)
    wrong = "'$.opacity', 2, '$.name'" if field == "name" else f"'$.{field}'"
    changed(path, LAYER.format(f"{wrong}, json(?)"), values=(json.dumps(LONG[field]),))
    with pytest.raises(ValueError, match="layer: damaged") as caught:
        load(path)
    assert str(caught.value).isprintable() and len(str(caught.value)) < len(str(path)) + 400


@pytest.mark.parametrize("value", ["/" + "x" * 5000, "/" + "x/" * 2000 + "x.ply"])
def test_a_path_of_5000_characters_is_refused_in_a_short_line(tmp_path: Path, path: Path, value: str) -> None:
    sp.write(tmp_path / "vase.ply", asset(6))
    flat(tmp_path / "vase.ply", path, embed=False).close()
    changed(path, "UPDATE facts SET value = ? WHERE name = 'path'", values=(value,))
    for how in ({}, {"folder": tmp_path}, {"embedded": True}):
        with pytest.raises(ValueError, match="its original|names a file as its original") as caught:
            load(path, **how)
        assert str(caught.value).isprintable() and len(str(caught.value)) < len(str(path)) + 450


def test_a_packed_original_is_refused_in_a_line_that_quotes_little_of_it(path: Path) -> None:
    import zstandard

    flat(None, path).close()
    for head in ({"version": [256] * 500}, {"version": 1, "coefficients": 1, "count": "x" * 5000}):
        part = zstandard.ZstdCompressor().compress(json.dumps(head).encode())
        changed(path, "UPDATE original SET bytes = ? WHERE part = 0", values=(part,))
        with pytest.raises(ValueError, match="the original: damaged") as caught:
            load(path)
        assert str(caught.value).isprintable() and len(str(caught.value)) < len(str(path)) + 400


def test_unknown_layers_are_refused_in_a_short_line(path: Path) -> None:
    document = Document(tuple(Layer(f"{k}" + "x" * 100, "red", PaintLayer()) for k in range(200)))
    for change in (
        lambda: document.index("y" * 5000),
        lambda: document.index(str(NESTED)),
        lambda: resolve_conflict(document, "y" * 5000, "z" * 5000, "first"),
        lambda: resolve_conflict(document, "1", "2", "y" * 5000),  # type: ignore[arg-type]
        lambda: move_layer(document, document.layers[0].id, 10**4000),
    ):
        with pytest.raises(ValueError, match="expected") as caught:
            change()
        assert str(caught.value).isprintable() and len(str(caught.value)) < 500


def bomb(head: dict, parts: int) -> list[bytes]:
    """The parts of a delta: a head, and much that packs to nothing."""
    import zstandard

    pack = zstandard.ZstdCompressor(level=3).compress
    return [pack(json.dumps(head).encode()), pack(b""), *[pack(bytes(delta.PART_BYTES))] * parts]


def test_a_delta_unpacks_no_more_than_its_packed_bytes_justify(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delta, "UNPACKED_FREE_BYTES", 8 << 20)
    rows = 1 << 24
    parts = bomb({"version": 1, "count": 0, "rows": 0, "appended": rows, "coefficients": 1}, 40)
    with pytest.raises(ValueError, match="unpack to more than"):
        delta.decode(parts)
    for head in (DEEP, '{"version": 1, "coefficients": 1, "count": 1e999, "rows": 0, "appended": 0}', "[]", "7"):
        with pytest.raises(ValueError, match="damaged"):
            delta.decode([_packed(head)])


def _packed(text: str) -> bytes:
    import zstandard

    return zstandard.ZstdCompressor().compress(text.encode())


def test_a_query_ends_where_the_file_gives_no_reason_to_go_on(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    two_layers(path)
    monkeypatch.setattr(database, "FREE_OPS", 200_000)
    project = Project.open(path)
    try:
        endless = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT count(*) FROM n"
        with pytest.raises(ValueError, match=r"work\.splatproj: damaged project file \(interrupted\)"):
            project.rows(endless)
        with pytest.raises(ValueError, match="more bytes than the file has"):
            project.rows("SELECT bytes FROM original, (SELECT 1 UNION SELECT 2 UNION SELECT 3), steps, steps, steps")
        assert project.rows("SELECT 1") == [(1,)]  # and the connection goes on
    finally:
        project.close()


# Originals that are only named


def named(path: Path, where: Path | str, source: Path) -> None:
    """A project of `source` that says that it lies at `where`."""
    with flat(source, path, embed=False, overwrite=True):
        pass
    changed(path, "UPDATE facts SET value = ? WHERE name = 'path'", values=(str(where),))


def test_a_project_that_has_to_hold_its_original_opens_no_file(tmp_path: Path, path: Path) -> None:
    ply = tmp_path / "vase.ply"
    sp.write(ply, asset(6))
    messages = set()
    for where in (ply, tmp_path / "missing.ply", "/dev/zero", "C:\\x.ply"):
        named(path, where, ply)
        with pytest.raises(ValueError, match="does not hold it") as error:
            load(path, embedded=True)
        messages.add(str(error.value))
    assert len(messages) == 1  # and tells nothing about what is there
    with flat(ply, path, overwrite=True):
        pass
    load(path, embedded=True).close()


def test_originals_stay_inside_the_folder(tmp_path: Path) -> None:
    folder, secret = tmp_path / "shared", tmp_path / "secret.ply"
    folder.mkdir()
    inside = folder / "vase.ply"
    for secret_path in (inside, secret):
        sp.write(secret_path, asset(6))
    (folder / "sub").mkdir()
    path = folder / "work.splatproj"
    messages = set()
    outside = [secret, tmp_path / "missing.ply", "../secret.ply", "sub/../../secret.ply", folder / ".." / "secret.ply"]
    outside += ["..\\secret.ply", "C:\\secret.ply", "\\\\server\\share\\x.ply", folder, "."]
    if hasattr(os, "symlink"):
        try:
            (folder / "link.ply").symlink_to(secret)
            (folder / "links").symlink_to(tmp_path)
            (folder / "round.ply").symlink_to(folder / "round.ply")
            outside += [folder / "link.ply", "links/secret.ply", "links/missing.ply", "round.ply"]
        except OSError:
            pass  # Windows without the right to make links
    for where in outside:
        named(path, where, inside)
        with pytest.raises(ValueError) as error:
            load(path, folder=folder)
        messages.add(str(error.value))
    assert len(messages) == 1 and "lies outside the folder shared" in messages.pop()
    for where in (inside.resolve(), "vase.ply"):
        named(path, where, inside)
        with load(path, folder=folder) as session:
            assert session.verify() == []
    named(path, "gone.ply", inside)
    with pytest.raises(ValueError, match=r"its original .*gone\.ply is gone"):
        load(path, folder=folder)


@posix_only
def test_a_pipe_is_no_original(tmp_path: Path, path: Path) -> None:
    ply, pipe = tmp_path / "vase.ply", tmp_path / "pipe.ply"
    sp.write(ply, asset(6))
    assert sys.platform != "win32"
    os.mkfifo(pipe)
    named(path, pipe, ply)
    for how in ({}, {"folder": tmp_path}, {"original": pipe}):
        with pytest.raises(ValueError, match="neither a file nor a folder"):
            load(path, **how)


def test_names_and_paths_of_all_systems() -> None:
    for name in ("", ".", "..", "a/b", "a\\b", "a\0b", "a\nb"):
        assert not is_plain_name(name, windows=False) and not is_plain_name(name, windows=True)
    for name in ("CON", "con.ply", "Nul.tar.ply", "lpt9.x", "a:b.ply", "C:x", "x.ply.", "x "):
        assert is_plain_name(name, windows=False) and not is_plain_name(name, windows=True)
    for name in ("x" * 256, "\u00e9" * 128, "\ud800" * 86):  # bytes count
        assert not is_plain_name(name, windows=False) and is_plain_name(name[:85], windows=False)
    assert is_plain_name("vase.ply", windows=True) and is_plain_name("context.ply", windows=True)
    assert is_local_path("C:\\x\\vase.ply", windows=True) and is_local_path("/x/vase.ply", windows=False)
    for name in ("\\\\server\\share\\x.ply", "//server/share/x.ply", "\\\\?\\C:\\x", "\\\\.\\pipe\\x", "x.ply", "C:x"):
        assert not is_local_path(name, windows=True)


# Where nothing can be written


class Unwritable(sqlite3.Connection):
    """A connection on a disk that is full."""

    def execute(self, statement: str, *values):  # type: ignore[override]
        if statement.startswith(("UPDATE", "INSERT", "CREATE", "PRAGMA journal_mode=WAL")):
            error = sqlite3.OperationalError("database or disk is full")
            error.sqlite_errorname = "SQLITE_FULL"
            raise error
        return super().execute(statement, *values)

    def backup(self, *words, **how):
        self.execute("INSERT")


def full(monkeypatch: pytest.MonkeyPatch) -> None:
    real = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda *words, **how: real(*words, **{**how, "factory": Unwritable}))


def readonly(monkeypatch: pytest.MonkeyPatch) -> None:
    """SQLite itself refuses to write, as on a folder without rights (which mean nothing to root)."""
    real = sqlite3.connect

    def connect(path, *words, **how):
        if str(path).endswith("-lock") or ".part" in str(path):
            error = sqlite3.OperationalError("unable to open database file")
            error.sqlite_errorname = "SQLITE_CANTOPEN"
            raise error
        return real(str(path).replace("mode=rw", "mode=ro"), *words, **how)

    monkeypatch.setattr(sqlite3, "connect", connect)


@pytest.mark.parametrize(("disk", "raised"), [(full, "disk is full"), (readonly, "its folder allows no new files")])
def test_what_cannot_be_written_can_be_looked_at(
    path: Path, monkeypatch: pytest.MonkeyPatch, disk, raised: str
) -> None:
    state = two_layers(path)
    data = path.read_bytes()
    with monkeypatch.context() as patch:
        disk(patch)
        with load(path) as session:
            assert print_of(session) == state and raised in session.read_only and "save_as" in session.read_only
            assert "part" not in session.read_only and "-lock" not in session.read_only
            for attempt in (
                lambda: session.layers.add("paint", [dab()]),
                session.undo,
                lambda: session.layers.set("1", opacity=0),
            ):
                with pytest.raises(ValueError, match=raised):
                    attempt()
            target = path.with_name("copy.splatproj")
            with pytest.raises(ValueError) as error:
                session.files.save_as(target)
            assert str(error.value).startswith(f"{target}: cannot be") and str(path) not in str(error.value)
            assert ".part" not in str(error.value) and "\n" not in str(error.value)
        with pytest.raises(ValueError, match=raised):
            load(path, readonly=False)
        with pytest.raises(ValueError, match=r"new\.splatproj: cannot be") as error:
            flat(project=path.with_name("new.splatproj"))
        assert ".part" not in str(error.value)
    assert path.read_bytes() == data and [entry.name for entry in path.parent.iterdir()] == [path.name]
    with load(path) as session:
        assert session.read_only == "" and session.undo()


def test_a_disk_that_is_mounted_read_only_is_called_so(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was said that nothing could be locked there, or that the folder allowed no files: chmod would not help."""
    two_layers(path)
    readonly(monkeypatch)
    monkeypatch.setattr(lock, "is_mounted_read_only", lambda folder: folder == path.parent)
    with load(path) as session:
        assert session.read_only.startswith("cannot be written (its disk is mounted read-only): it is read-only")
    target = path.with_name("new.splatproj")
    with pytest.raises(ValueError, match=r"cannot be written \(its disk is mounted read-only\)$"):
        flat(project=target)


def test_a_file_that_sqlite_opens_for_reading_only_is_read_only(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    two_layers(path)
    real = sqlite3.connect
    monkeypatch.setattr(
        sqlite3, "connect", lambda name, *w, **h: real(str(name).replace("mode=rw", "mode=ro"), *w, **h)
    )
    with load(path) as session:
        assert "readonly" in session.read_only and len(session.layers) == 2


def test_an_export_that_fails_names_its_target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with flat() as session:
        target = tmp_path / "out.ply"

        def nowhere(path, splats, **options):
            raise ValueError(f"{path}: cannot be written (No space left on device)")

        monkeypatch.setattr("splatpainter.session.project.asset_files.write", nowhere)
        with pytest.raises(ValueError) as error:
            session.files.export(target)
        assert str(error.value) == f"{target}: cannot be written (No space left on device)"

        def refused(*words, **how):
            raise PermissionError(13, "Permission denied", str(tmp_path / ".out.ply.abc.part"))

        monkeypatch.setattr("splatpainter.session.project.asset_files.tempfile.TemporaryDirectory", refused)
        with pytest.raises(ValueError) as error:
            session.files.export(target)
        assert str(error.value) == f"{target}: cannot be written (Permission denied)"
    assert not list(tmp_path.iterdir())


def test_a_damaged_original_is_said_without_the_place_it_was_unpacked_to(tmp_path: Path, path: Path) -> None:
    ply = tmp_path / "vase.ply"
    sp.write(ply, asset(6))
    with flat(ply, path):
        pass
    changed(path, "UPDATE original SET bytes = x'706c790a' WHERE part = 1")
    with pytest.raises(ValueError) as error:
        load(path)
    assert "vase.ply" in str(error.value) and "splatpainter-" not in str(error.value)


# What killed processes leave


def test_left_overs_are_swept_and_nothing_else(tmp_path: Path, path: Path) -> None:
    two_layers(path)
    old = time.time() - 1e6
    ours = [".out.ply.0123abcd.part", ".work.splatproj.part", ".new.splatproj.part-journal", "gone.splatproj-lock"]
    theirs = [
        "notes.part",
        ".hidden.part",
        ".out.ply.0123abcx.part",
        "x-lock",
        "full.splatproj-lock",
        ".new.ply.89abcdef.part",
    ]
    for name in [*ours, *theirs]:
        (tmp_path / name).write_bytes(b"x" if name.startswith("full") else b"")
        if not name.startswith(".new.ply"):  # that one is being written
            os.utime(tmp_path / name, (old, old))
    (tmp_path / ".export.spz.ab12cd_9.part").mkdir()
    (tmp_path / ".export.spz.ab12cd_9.part" / "export.spz").write_bytes(b"x")
    os.utime(tmp_path / ".export.spz.ab12cd_9.part", (old, old))
    (tmp_path / "pictures.part").mkdir()
    with load(path):
        swept = sweep_folder(tmp_path)
        assert ".work.splatproj.part" not in swept and (tmp_path / "work.splatproj-lock").exists()  # in use
    assert sorted([*swept, *sweep_folder(tmp_path)]) == sorted([*ours, ".export.spz.ab12cd_9.part"])
    assert sorted(entry.name for entry in tmp_path.iterdir()) == sorted([*theirs, "pictures.part", path.name])
    assert sweep_folder(tmp_path / "nowhere") == []


def test_a_new_scratch_folder_that_somebody_sweeps_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program that starts at the same time may take it for a left-over before it is locked."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    take, calls = ProjectLock.take, []

    def taken(project: Path) -> ProjectLock | None:
        calls.append(project)
        if len(calls) == 1:  # swept while its lock was made
            shutil.rmtree(project.parent)
            return take(project)
        return None if len(calls) == 2 else take(project)  # 2: the sweeper holds it

    monkeypatch.setattr(ProjectLock, "take", staticmethod(taken))
    folder = ScratchFolder("studio")
    assert len(calls) == 3 and [path.name for path in tmp_path.iterdir()] == [folder.path.name]
    folder.close()
    monkeypatch.setattr(ProjectLock, "take", staticmethod(lambda project: take(project / "nowhere")))
    with pytest.raises(ValueError, match="cannot be locked"):
        ScratchFolder("studio")
    assert not list(tmp_path.iterdir())


def test_scratch_folders_go_with_their_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    live, dead = ScratchFolder("studio"), ScratchFolder("blobs")
    (dead.path / "rows.ply").write_bytes(b"x")
    dead._lock._connection.close()  # as when its process is killed: the file stays, the lock goes  # type: ignore[union-attr]
    (tmp_path / "splatpainter-studio-notebook").mkdir()
    (tmp_path / "splatpainter-studio-notebook" / "mine.txt").write_bytes(b"")
    (tmp_path / "splatpainter-mine").mkdir()
    empty = tmp_path / "splatpainter-verify-abcd1234"
    empty.mkdir()
    assert sweep_scratch(tmp_path) == [dead.path.name]
    assert sorted(sweep_scratch(tmp_path, -1)) == [empty.name]
    assert live.path.exists() and (live.path / f"{OWNER}-lock").exists() and not dead.path.exists()
    live.close()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["splatpainter-mine", "splatpainter-studio-notebook"]


def test_a_users_file_with_the_name_of_a_lock_is_left_alone(path: Path) -> None:
    two_layers(path)
    lock_path = path.with_name("work.splatproj-lock")
    lock_path.write_bytes(b"my notes")
    with load(path) as session:
        assert "in the way" in session.read_only
    assert lock_path.read_bytes() == b"my notes"


def test_why_a_project_is_read_only_is_said_whole_whatever_its_name(tmp_path: Path) -> None:
    """The reason was cut out of an error's words, at the first "; ", which a name may hold, too."""
    path = tmp_path / "cannot be locked (old; new).splatproj"
    two_layers(path)
    path.with_name(path.name + "-lock").write_bytes(b"my notes")
    with load(path) as session:
        assert f"({path.name}-lock is in the way): it is read-only" in session.read_only
        assert not session.files.can_be_taken_over
