"""One project on two computers whose locks do not reach each other: network folders without a lock daemon, folders that
are synchronised."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from splatpainter.session.project import holder
from splatpainter.session.project.database import UnwritableError
from splatpainter.session.project.holder import Computer, note_of, other_holder
from splatpainter.session.project.scratch import sweep_folder
from tests.support.session_scenes import BLUE, RED, dab, flat, load, print_of, two_layers
from tests.support.systems import posix_only

OTHER = Computer("studio-2", "another start of another system")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "work.splatproj"


def note(path: Path, computer: Computer) -> None:
    note_of(path).write_text(json.dumps({"name": computer.name, "boot": computer.boot}))


def test_what_another_computer_has_open_is_read_only(path: Path) -> None:
    state = two_layers(path)
    assert not note_of(path).exists(), "it was closed"
    data = path.read_bytes()
    note(path, OTHER)
    with load(path) as session:
        assert session.read_only.startswith("open on studio-2, or was not closed there: this copy is read-only")
        assert "remove work.splatproj-host" in session.read_only and print_of(session) == state
        assert not session.files.can_be_taken_over
        with pytest.raises(ValueError, match="studio-2"):
            session.undo()
        with pytest.raises(ValueError, match="studio-2"):
            session.files.take_over()
        note_of(path).unlink()  # its user knows that it is not open there
        session.files.take_over()
        session.layers.add("paint", [dab(BLUE)])
    for write in (lambda: load(path, readonly=False), lambda: flat(project=path, overwrite=True)):
        note(path, OTHER)
        before = path.read_bytes()
        with pytest.raises(ValueError, match=r"work.splatproj: (is )?open on studio-2, or was not closed there"):
            write()
        assert path.read_bytes() == before != data
        assert other_holder(path) == "studio-2", "the other one's note stays"
    assert sorted(entry.name for entry in path.parent.iterdir()) == [path.name, f"{path.name}-host"]


def test_nothing_but_its_name_is_asked_of_this_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    """`platform.node()` asks Windows for its version as well, through a service that may answer late or never."""
    name = platform.node()
    monkeypatch.setattr(platform, "uname", lambda: pytest.fail("more was asked"))
    assert holder.this_computer().name == name


def test_who_knows_better_takes_it_over_despite_the_note(path: Path) -> None:
    """A computer that left a note may be gone for good; where it does have the project open it sees who took it."""
    state = two_layers(path)
    note(path, OTHER)
    with load(path) as session:
        assert session.files.noted_computer == "studio-2"
        with load(path, readonly=True) as looking:
            assert looking.files.noted_computer == "", "it was to be read only"
        session.files.take_over(despite_note=True)
        assert session.read_only == session.files.noted_computer == "" and print_of(session) == state
        assert json.loads(note_of(path).read_text())["name"] == holder.this_computer().name
        session.layers.add("paint", [dab(BLUE)])
        with load(path) as second, pytest.raises(ValueError, match="open elsewhere"):
            second.files.take_over(despite_note=True)  # a lock is no note
    assert not note_of(path).exists()


def test_what_another_computer_closed_can_be_taken_over(path: Path) -> None:
    two_layers(path)
    note(path, OTHER)
    with load(path) as session:
        assert not session.files.can_be_taken_over
        note_of(path).unlink()
        assert session.files.can_be_taken_over and session.files.noted_computer == ""


@posix_only
@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_a_note_is_written_into_nothing_that_has_its_name(path: Path, kind: str) -> None:
    """A folder of strangers may have a link there to any file of this user."""
    two_layers(path)
    other = path.with_name("other")
    other.write_text("dear")
    if kind == "link":
        note_of(path).symlink_to(other)
    elif kind == "pipe":
        assert sys.platform != "win32"  # for the checker of types
        os.mkfifo(note_of(path))  # writing to it would wait for a reader
    else:
        note_of(path).mkdir()
    with load(path) as session:
        assert session.read_only == "" and session.undo()
    assert other.read_text() == "dear" and note_of(path).is_dir() == (kind == "folder")


def test_two_that_opened_it_at_once(path: Path) -> None:
    """A synchronised folder brings the other's note later: nothing more is acknowledged."""
    with flat(project=path) as session:
        assert other_holder(path) == "" and note_of(path).is_file()
        session.layers.add("paint", [dab(RED)])
        state = print_of(session)
        note(path, OTHER)
        with pytest.raises(UnwritableError, match="was opened on studio-2 too, and nothing was changed; save_as"):
            session.layers.add("paint", [dab(BLUE)])
        assert print_of(session) == state
        session.files.save_as(path.with_name("mine.splatproj"))
        session.layers.add("paint", [dab(BLUE)])
    assert other_holder(path) == "studio-2"
    with load(path.with_name("mine.splatproj")) as session:
        assert len(session.layers) == 2 and session.verify() == []


@pytest.mark.parametrize("same", ["name", "boot"])
def test_what_this_computer_did_not_close_is_opened(path: Path, same: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It was killed; containers have another name each time, and the system's start in common."""
    monkeypatch.setattr(holder, "this_computer", lambda: Computer("here", "this start"))
    two_layers(path)
    note(path, Computer("here", "a start before") if same == "name" else Computer("a container", "this start"))
    with load(path) as session:
        assert session.read_only == ""
        session.undo()
    assert not note_of(path).exists()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"name": 1, "boot": ""}', '"' * 5000])
def test_a_note_that_says_nothing_is_none(path: Path, text: str) -> None:
    two_layers(path)
    note_of(path).write_text(text)
    with load(path) as session:
        assert session.read_only == ""
    assert not note_of(path).exists()


@posix_only
def test_a_script_that_closes_nothing_leaves_no_note(path: Path) -> None:
    """Other computers would find the project open here. A fork that ends leaves its parent's note."""
    two_layers(path)
    script = f"""
import os, sys; sys.path.insert(0, {str(Path(__file__).parents[2])!r})
from pathlib import Path
from splatpainter.session.project.holder import note_of
from tests.support.session_scenes import BLUE, dab, load
session = load(Path(sys.argv[1]))
session.layers.add("paint", [dab(BLUE)])
if os.fork() == 0:
    sys.exit()
os.wait()
print(note_of(Path(sys.argv[1])).is_file())
"""
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n" and not note_of(path).exists()
    session = load(path)
    assert note_of(path).is_file() and len(session.layers) == 3
    session.close()


def test_notes_of_killed_processes_are_swept_with_their_locks(path: Path) -> None:
    two_layers(path)
    for computer, left in ((holder.this_computer(), [path.name]), (OTHER, [path.name, f"{path.name}-host"])):
        note(path, computer)
        path.with_name(path.name + "-lock").touch()
        os.utime(path.with_name(path.name + "-lock"), (1, 1))
        sweep_folder(path.parent)
        assert sorted(entry.name for entry in path.parent.iterdir()) == left
