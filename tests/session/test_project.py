"""The project file: what was acknowledged is in it, one writer at a time, and no file is harmed."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import splatpainter as sp
from splatpainter.painter import Painter
from splatpainter.session import Session
from splatpainter.session.project.database import APPLICATION_ID, VERSION
from splatpainter.session.project.lock import ProjectLock
from tests.support.lift_scenes import same_bits
from tests.support.session_scenes import (
    BLUE,
    CAMERA,
    GREEN,
    RED,
    asset,
    dab,
    flat,
    load,
    print_of,
    two_layers,
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "work.splatproj"


def test_everything_is_there_again(path):
    with flat(project=path) as session:
        first = session.layers.add("paint", [dab(RED)], name="red")
        session.layers.add("paint", [dab(BLUE, 19)], opacity=0.5, blend="lighten")
        session.layers.set(first.id, visible=False)
        session.layers.resolve_conflict("1", "2", "first")
        session.undo()
        mark = session.bookmarks.add("front", CAMERA)
        session.bookmarks.add("gone", CAMERA)
        session.bookmarks.delete("2")
        layers, history = tuple(session.layers), tuple(session.history)
        cursor, state = session.history.cursor, print_of(session)
        picture = session.files.blob(first.views[0].picture or "")
        small = session.files.blob(first.thumbnail or "")
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]  # one file
    with load(path) as session:
        assert (*session.layers,) == layers and (*session.history,) == history
        assert session.history.cursor == cursor
        assert print_of(session) == state and session.painter.calls == []  # type: ignore[attr-defined]
        (bookmark,) = session.bookmarks
        assert (bookmark.id, bookmark.name) == (mark, "front")
        np.testing.assert_array_equal(bookmark.camera.world_to_camera, CAMERA.world_to_camera)
        assert session.files.blob(first.views[0].picture or "") == picture and small[:4] == b"\x89PNG"
        assert session.redo() and not session.redo()
        session.history.jump(0)
        assert same_bits(session.splats, asset())
        assert session.verify() == []
        with pytest.raises(ValueError, match="bookmark: no bookmark with id '9'"):
            session.bookmarks.delete("9")


def test_a_session_without_a_project_leaves_nothing(path):
    with flat() as session:
        session.layers.add("paint", [dab()])
        assert session.path is None
        temporary = session._core.project.path
        session.files.save_as(path)
        assert session.path == path and not temporary.exists()
        session.layers.add("paint", [dab(BLUE)])
        state = print_of(session)
    with load(path) as session:
        assert print_of(session) == state and len(session.layers) == 2


def test_save_as_leaves_the_old_file_as_it_is(path):
    two_layers(path)
    other = path.with_name("other.splatproj")
    with load(path) as session:
        session.files.save_copy(other)
        with pytest.raises(ValueError, match="already exists"):
            session.files.save_as(other)
        session.files.save_as(other, overwrite=True)
        session.layers.add("paint", [dab(GREEN)])
    with load(path) as old, load(other) as new:
        assert len(old.layers) == 2 and len(new.layers) == 3
        with pytest.raises(ValueError, match="open elsewhere"):
            old.files.save_as(other, overwrite=True)
    with pytest.raises(ValueError, match=r"ending in \.splatproj"):
        flat(project=path.with_suffix(".db"))
    with pytest.raises(ValueError, match="no such folder"):
        flat(project=path.parent / "none" / "a.splatproj")
    with pytest.raises(ValueError, match="is a project already"):
        Session(path, other)


def test_an_asset_that_cannot_be_drawn_leaves_no_file(path):
    splats = asset(3)
    splats.means[:] = np.nan
    with pytest.raises(ValueError, match="^asset: none of the 9 Gaussians can be drawn"):
        flat(splats, path)
    assert not list(path.parent.iterdir())


# The original


def test_the_original_file_is_kept_byte_for_byte(tmp_path, path):
    ply = tmp_path / "vase.ply"
    sp.write(ply, asset(8))
    data = ply.read_bytes()
    with flat(ply, path) as session:
        session.layers.add("paint", [dab()])
        assert session.original.sha256 == sp.read(ply).sha256
    ply.unlink()
    with load(path) as session:
        session.files.export(tmp_path / "again.ply")
        session.undo()
        session.files.export(tmp_path / "same.ply")
    assert (tmp_path / "same.ply").read_bytes() == data
    assert (tmp_path / "again.ply").read_bytes() != data


def test_a_folder_of_planes_is_kept_too(tmp_path, path):
    folder = tmp_path / "sog"
    folder.mkdir()
    sp.write(folder / "meta.json", asset(8, 0))
    for k, source in enumerate((folder, folder / "meta.json", sp.read(folder))):
        copy_path = tmp_path / f"{k}.splatproj"
        with flat(source, copy_path) as session:
            rows = session.splats
        with load(copy_path) as session:
            assert same_bits(session.splats, rows) and session.original.source is not None


def test_only_the_path_of_the_original(tmp_path, path):
    ply, moved = tmp_path / "vase.ply", tmp_path / "moved.ply"
    sp.write(ply, asset(40))
    with flat(ply, path, embed=False) as session:
        session.layers.add("paint", [dab()])
        state = print_of(session)
    assert path.stat().st_size < ply.stat().st_size
    with load(path) as session:
        assert print_of(session) == state
    ply.rename(moved)
    with pytest.raises(ValueError, match=r"its original .*vase\.ply is gone; load with original=PATH if it moved"):
        load(path)
    with load(path, original=moved) as session:
        assert print_of(session) == state and session.verify() != []  # verify looks at the place it knows
    sp.write(moved, asset(39), overwrite=True)
    with pytest.raises(ValueError, match="the original is not the one that the project was made from"):
        load(path, original=moved)
    with pytest.raises(ValueError, match="embed=False needs an asset that was read from a file"):
        flat(asset(), path, embed=False, overwrite=True)


def test_rows_that_are_no_file_any_more_are_kept_as_rows(tmp_path, path):
    ply = tmp_path / "vase.ply"
    sp.write(ply, asset(6))
    splats = sp.read(ply)
    ply.write_bytes(b"something else")
    with flat(splats, path) as session:
        assert session._core.project.fact("format") == "rows"
    with load(path) as session:
        assert same_bits(session.splats, splats)


@pytest.mark.shared
@pytest.mark.parametrize("name", ["massa.v2.spz", "playbot_lod4.glb", "massa.compressed.ply", "playbot_lod3.sog"])
def test_real_files_come_back_byte_for_byte(shared, tmp_path, path, name):
    source = shared / "data" / "splats" / name
    with flat(source, path) as session:
        session.layers.add("look", look="gain", settings={"gain": [1.2, 1, 1]})
        session.undo()
    with load(path) as session:
        session.files.export(tmp_path / name)
    assert (tmp_path / name).read_bytes() == source.read_bytes()


# One writer


def test_the_second_opener_may_look_but_not_touch(path):
    two_layers(path)
    with load(path) as writer, load(path) as reader:
        assert writer.read_only == "" and reader.read_only.startswith("open elsewhere")
        assert print_of(reader) == print_of(writer)
        for attempt in (
            lambda: reader.layers.add("paint", [dab()]),
            lambda: reader.layers.set("1", name="mine"),
            reader.undo,
            lambda: reader.bookmarks.add("b", CAMERA),
        ):
            with pytest.raises(ValueError, match="open elsewhere"):
                attempt()
        with pytest.raises(ValueError, match="open elsewhere"):
            load(path, readonly=False)
        writer.layers.add("paint", [dab(GREEN)])
        assert reader.refresh() and print_of(reader) == print_of(writer) and not reader.refresh()
        reader.files.save_as(path.with_name("mine.splatproj"))
        reader.layers.add("paint", [dab(GREEN)])
    with load(path) as session:
        assert session.read_only == ""
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["mine.splatproj", path.name]


def test_other_processes_are_kept_out_until_this_one_is_gone(path):
    two_layers(path)
    code = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r})
from pathlib import Path
from splatpainter.session.project.lock import ProjectLock
print("free" if ProjectLock.take(Path({str(path)!r})) else "taken")
"""

    def other() -> str:
        return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()

    with load(path):
        assert other() == "taken"
    assert other() == "free"  # and died holding it
    lock = ProjectLock.take(path)
    assert lock is not None and ProjectLock.take(path) is None
    lock.release()


def test_reading_only_touches_nothing(path):
    state = two_layers(path)
    before = path.read_bytes()
    with load(path, readonly=True) as session:
        assert print_of(session) == state and session.read_only == "opened for reading only"
    assert path.read_bytes() == before and len(list(path.parent.iterdir())) == 1


# Other files


@pytest.mark.parametrize(
    ("version", "line"),
    [
        (VERSION + 1, r"was written by a newer splatpainter .*; update splatpainter to open it$"),
        (0, rf"damaged project file \(project version 0, expected {VERSION}\)$"),
    ],
)
def test_a_file_of_another_version_is_refused_and_untouched(path, version, line):
    two_layers(path)
    database = sqlite3.connect(path)
    database.execute(f"PRAGMA user_version={version}")
    database.close()
    before = path.read_bytes()
    for readonly in (None, True, False):
        with pytest.raises(ValueError, match=line):
            load(path, readonly=readonly)
    assert path.read_bytes() == before and len(list(path.parent.iterdir())) == 1


def test_files_that_are_no_projects(path):
    with pytest.raises(ValueError, match="no such file"):
        load(path)
    path.write_bytes(b"ply\n" * 100)
    with pytest.raises(ValueError, match="got another kind of file"):
        load(path)
    path.unlink()
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE t (a)")
    database.close()
    with pytest.raises(ValueError, match="database of another program"):
        load(path)
    assert APPLICATION_ID == int.from_bytes(b"SPLP", "big")


def test_damage_is_one_clear_line_and_leaves_no_lock(path):
    two_layers(path)
    file_data = path.read_bytes()
    cases = {"cut": file_data[: len(file_data) // 2], "head": file_data[:100] + b"\xff" * 4000 + file_data[4100:]}
    for name, data in cases.items():
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"damaged project file \(.*\)$") as message:
            load(path)
        assert "\n" not in str(message.value) and path.read_bytes() == data, name
        assert len(list(path.parent.iterdir())) == 1
    rng = np.random.default_rng(5)
    for _ in range(25):  # anywhere: it opens, or says that it cannot
        broken = bytearray(file_data)
        for at in rng.integers(100, len(file_data), 40):
            broken[at] ^= int(rng.integers(1, 256))
        path.write_bytes(bytes(broken))
        try:
            load(path).close()
        except ValueError as error:
            assert "\n" not in str(error) and str(path) in str(error)
        for leftover in path.parent.iterdir():
            leftover.unlink()


def test_verify_finds_changed_bytes(path):
    two_layers(path)
    for statement, message in (
        ("UPDATE blobs SET bytes = x'00' WHERE rowid = 1", "picture .* is missing or wrong"),
        ("UPDATE deltas SET bytes = x'00' WHERE part = 2", "damaged"),
    ):
        copy = path.with_name("copy.splatproj")
        shutil.copy(path, copy)
        with load(path) as session:
            assert session.verify() == []
        with load(copy) as session:
            session._core.project._db.execute(statement)
            problems = session.verify()
            assert len(problems) >= 1 and any(message.split(" ")[0] in line for line in problems)


# Out of it


def test_export_proves_what_it_wrote(tmp_path, path):
    ply = tmp_path / "vase.ply"
    sp.write(ply, asset(8))
    with flat(ply, path) as session:
        session.layers.add("paint", [dab()])
        for name in ("out.ply", "out.spz"):
            receipt, verification = session.files.export(tmp_path / name)
            assert verification.ok and receipt.asset_sha256 == sp.read(ply).sha256
            stored = sp.Receipt.from_json((tmp_path / f"{name}.receipt.json").read_text())
            assert stored.output_sha256 == sp.read(tmp_path / name).sha256 and stored.mode == "session"
        assert sp.verify(
            ply, tmp_path / "out.ply", sp.Receipt.from_json((tmp_path / "out.ply.receipt.json").read_text())
        ).ok
        for name, message in (
            ("out.ply", "already exists"),
            ("x.ksplat", "name ending in"),
            ("none/x.ply", "no such folder"),
        ):
            with pytest.raises(ValueError, match=message):
                session.files.export(tmp_path / name)
        session.files.export(tmp_path / "out.ply", overwrite=True)
    assert not [entry for entry in tmp_path.iterdir() if entry.name.startswith(".")]


def test_one_layer_travels_alone(tmp_path, path):
    file = tmp_path / "red.splatlayer"
    with flat() as session:
        session.layers.add("paint", [dab(RED)], name="red", opacity=0.5)
        session.layers.add("paint", [dab(BLUE, 19)], name="blue")
        state = print_of(session)
        merged = session.layers.merge(["1", "2"], "both")
        session.files.export_layer(merged.id, file)
        with pytest.raises(ValueError, match="already exists"):
            session.files.export_layer(merged.id, file)
    with flat() as other:
        other.layers.add("paint", [dab(GREEN)])
        other.layers.set("1", visible=False)
        new = other.files.import_layer(file)
        assert new.name == "both" and print_of(other) == state
        assert len({new.id, *(inner.id for inner in new.layers), "1"}) == 4
        assert other.verify() == []
        data = file.read_bytes()
        for wrong in (b"no zip", data[:-30], data.replace(b'"version": 1', b'"version": 7')):
            file.write_bytes(wrong)
            with pytest.raises(ValueError, match=r"red\.splatlayer: expected a \.splatlayer file|damaged"):
                other.files.import_layer(file)


def test_history_is_bounded(path, monkeypatch):
    monkeypatch.setattr("splatpainter.session.project.project_file.MAX_STEPS", 5)
    with flat(project=path) as session:
        for k in range(12):
            session.layers.add("look", look="gain", settings={"gain": [1, 1, 1 + k / 100]})
        assert len(session.history) <= 6 and session.history.cursor == len(session.history) - 1
        session.undo()
        session.redo()
        assert session.verify() == []


def test_undone_work_does_not_pile_up(path):
    with flat(project=path) as session:
        sizes = []
        for k in range(40):
            session.layers.add("paint", [dab(RED, 10 + k % 12)])
            session.undo()
            sizes.append(
                session._core.project.rows("SELECT (SELECT count(*) FROM results), (SELECT count(*) FROM blobs)")[0]
            )
        assert max(sizes) == sizes[0]
    assert path.stat().st_size < 200_000


def test_options_of_layers_are_json(path):
    placed = {"size": 3.5, "seeds": [1, 2]}
    with flat(project=path) as session:
        layer = session.layers.add("paint", [dab()], placed=placed)
        placed["size"] = 4  # of the caller, and nobody else's
        for wrong in ({"when": {1, 2}}, {"size": float("nan")}):
            with pytest.raises(ValueError, match="^layer: expected placed that JSON can hold"):
                session.layers.set(layer.id, placed=wrong)
        with pytest.raises(
            ValueError, match="^layer: expected one of name, visible, opacity, blend, mode, .* to set, got brush$"
        ):
            session.layers.set(layer.id, brush=3)
    with load(path) as session:
        assert session.layers[0].operation.changes()["placed"] == {"size": 3.5, "seeds": [1, 2]}


@pytest.mark.parametrize("ending", [".glb", ".spz"])
def test_an_export_of_rows_that_cannot_be_drawn_proves_itself_in_another_format(tmp_path: Path, ending: str) -> None:
    splats = asset(8)
    splats.means[3], splats.means[4, 1], splats.means[5] = np.nan, 4e37, -np.inf
    splats.sh[6], splats.quats[7] = np.inf, 0
    sp.write(tmp_path / "vase.ply", splats)
    with Session(tmp_path / "vase.ply", painter=Painter()) as session:
        session.layers.add("paint", [dab(RED)], method="lift")
        receipt, verification = session.files.export(tmp_path / f"painted{ending}")
    assert verification.ok and receipt.appended_rows == verification.appended > 0
    back = sp.read(tmp_path / f"painted{ending}")
    assert back.drawable.all() and not back.opacities[3:8].any()
    if ending == ".glb":  # a row that stays hidden stays where it was, and widens no bounds
        assert not set(range(3, 8)) & set(receipt.touched.tolist())
        np.testing.assert_array_equal(back.means[6:8], splats.means[6:8])
        assert not back.means[[3, 5]].any() and back.means[4, 1] == 0
