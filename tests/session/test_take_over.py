"""A project that was open elsewhere is gone on with once its holder has gone: never by two, and nothing is lost."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from splatpainter.io import write
from splatpainter.session.project.lock import LOCK_ENDING, ProjectLock
from tests.support.session_scenes import BLUE, GREEN, asset, dab, flat, load, print_of, two_layers

HOLDER = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r})
from tests.support.session_scenes import GREEN, dab, load
session = load(sys.argv[1])
session.layers.add("paint", [dab(GREEN)], name="theirs")
print(len(session.layers), session.read_only, flush=True)
sys.stdin.read()
"""
"""Opens a project, paints, and keeps it open until it is killed."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    two_layers(tmp_path / "work.splatproj")
    return tmp_path / "work.splatproj"


def test_a_project_that_was_closed_elsewhere_is_gone_on_with(path: Path) -> None:
    writer = load(path)
    with load(path) as reader:
        before = reader.version
        assert not reader.files.can_be_taken_over
        writer.layers.add("paint", [dab(GREEN)], name="theirs")
        now = print_of(writer)
        writer.close()
        assert reader.files.can_be_taken_over and reader.read_only

        reader.files.take_over()
        assert reader.read_only == "" and not reader.files.can_be_taken_over
        assert print_of(reader) == now and reader.layers[-1].name == "theirs" and reader.version > before
        reader.files.take_over()  # does nothing
        reader.layers.add("paint", [dab(BLUE)], name="mine")
        with load(path) as third:
            assert third.read_only.startswith("open elsewhere") and print_of(third) == print_of(reader)
        assert reader.undo() and reader.undo() and reader.redo() and print_of(reader) == now
        assert reader.verify() == []
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]
    with load(path) as session:
        assert print_of(session) == now and len(session.history) == len(reader.history)


def test_while_it_is_open_elsewhere_it_is_refused_and_nothing_changes(path: Path) -> None:
    with load(path) as writer, load(path) as reader:
        with pytest.raises(ValueError, match=r"work\.splatproj: open elsewhere"):
            reader.files.take_over()
        writer.layers.add("paint", [dab(GREEN)])
        assert reader.read_only.startswith("open elsewhere") and reader.refresh()
        assert print_of(reader) == print_of(writer)
        with pytest.raises(ValueError, match="open elsewhere"):
            reader.layers.add("paint", [dab(BLUE)])


def test_whoever_is_first_has_it_and_the_other_may_look(path: Path) -> None:
    writer = load(path)
    with load(path) as one, load(path) as two:
        writer.close()
        assert one.files.can_be_taken_over and two.files.can_be_taken_over
        two.files.take_over()
        assert not one.files.can_be_taken_over
        with pytest.raises(ValueError, match="open elsewhere"):
            one.files.take_over()
        two.layers.add("paint", [dab(BLUE)])
        assert one.refresh() and print_of(one) == print_of(two)


def test_what_a_holder_did_that_was_killed_is_there(path: Path) -> None:
    command = [sys.executable, "-c", HOLDER, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None and holder.stdout.readline().split() == ["3"]
        with load(path) as reader:
            assert reader.read_only.startswith("open elsewhere")
            folder = sorted(path.parent.iterdir())
            assert not any(reader.files.can_be_taken_over for _ in range(50))
            assert sorted(path.parent.iterdir()) == folder, "looking leaves nothing"
            holder.kill()
            holder.wait()
            assert path.with_name(path.name + LOCK_ENDING).exists() and reader.files.can_be_taken_over
            reader.files.take_over()
            assert reader.layers[-1].name == "theirs" and reader.verify() == []
            reader.layers.add("paint", [dab(BLUE)])
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def test_looking_takes_no_lock(path: Path) -> None:
    assert ProjectLock.is_free(path)
    lock = ProjectLock.take(path)
    assert lock is not None and not ProjectLock.is_free(path) and ProjectLock.take(path) is None
    lock.release()
    assert ProjectLock.is_free(path)
    path.with_name(path.name + LOCK_ENDING).touch()  # of a holder that was killed
    assert ProjectLock.is_free(path) and path.with_name(path.name + LOCK_ENDING).exists()
    lock = ProjectLock.take(path)
    assert lock is not None
    lock.release()


def test_another_project_under_its_name_is_not_taken_for_it(path: Path) -> None:
    writer = load(path)
    with load(path) as reader:
        state = print_of(reader)
        writer.close()
        path.unlink()
        assert not reader.files.can_be_taken_over, "it is gone"
        with pytest.raises(ValueError, match="no such file"):
            reader.files.take_over()
        flat(asset().take(range(40)), project=path).close()
        with pytest.raises(ValueError, match=r"another project has this name now; open it anew"):
            reader.files.take_over()
        assert print_of(reader) == state and reader.read_only
        with load(path) as other:
            assert other.read_only == "" and len(other.splats) == 40, "the lock was let go of"


def test_what_is_cancelled_on_the_way_leaves_all_as_it_was(path: Path) -> None:
    writer = load(path)
    with load(path) as reader:
        state = print_of(reader)
        writer.layers.add("paint", [dab(GREEN)])
        writer.close()
        with sqlite3.connect(path) as project:
            project.execute("DELETE FROM results")  # so that there is something to compute
            project.execute("DELETE FROM deltas")

        def cancel(done: int, total: int, name: str) -> None:
            raise KeyboardInterrupt

        reader.progress = cancel
        with pytest.raises(KeyboardInterrupt):
            reader.files.take_over()
        reader.progress = None
        assert print_of(reader) == state and reader.read_only.startswith("open elsewhere")
        assert reader.files.can_be_taken_over, "the lock was let go of"
        with pytest.raises(ValueError, match="open elsewhere"):
            reader.layers.add("paint", [dab(BLUE)])
        reader.files.take_over()
        assert len(reader.layers) == 3 and reader.verify() == []
    with load(path) as session:
        assert "Paint" not in session.painter.calls, "what was computed is stored"  # type: ignore[attr-defined]


def test_an_asset_that_was_added_elsewhere_is_read_when_it_is_shown(path: Path) -> None:
    writer = load(path)
    with load(path) as reader:
        file = path.with_name("right.ply")
        write(file, asset().take(range(50)))
        writer.scene.add(file)
        both = print_of(writer)
        writer.undo()
        writer.close()
        reader.files.take_over()
        assert len(reader.scene.assets) == 1
        assert reader.redo() and len(reader.scene.assets) == 2 and print_of(reader) == both
