"""A studio whose home, or whose folder, lies on a disk that is not as others are."""

from __future__ import annotations

import asyncio
import errno
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import pytest

from splatpainter.io import write
from splatpainter.pictures import saved_pictures
from splatpainter.server.hub import Hub, problem_of
from splatpainter.server.launch import open_session
from splatpainter.server.protocol import PictureEvent, ToastEvent
from splatpainter.server.studio import Studio, StudioOptions
from splatpainter.server.uploads import storage, watched_folder
from splatpainter.server.uploads.storage import usable_projects
from splatpainter.session import Session
from splatpainter.session.project.database import UnwritableError
from splatpainter.system.user_folders import PROJECTS_VARIABLE
from tests.support.fake_services import png
from tests.support.studio_scenes import Browser, ball, live, make_studio

PATIENCE = 60.0


def toast(browser: Browser) -> dict[str, str]:
    """The next line that the page is to show."""
    while True:
        toasts = [event for event in browser.events if event["event"] == "toast"]
        if toasts:
            return toasts[-1]
        browser.receive()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder of projects; temporary files have one of their own."""
    monkeypatch.delenv(PROJECTS_VARIABLE, raising=False)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setattr(storage, "projects_folder", lambda: tmp_path / "home" / "projects")
    return tmp_path / "home" / "projects"


def no_locks(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    monkeypatch.setattr(storage, "locks_refused", lambda folder: folder.is_relative_to(home))


def no_home(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    home.parent.write_bytes(b"")  # a file where the folder should be


def full(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    real = open

    def opened(path, *words, **how):
        if Path(path).is_relative_to(home):
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(path, *words, **how)

    monkeypatch.setattr(storage, "open", opened, raising=False)


@pytest.mark.parametrize(
    ("harm", "why"),
    [(no_locks, "refuses file locks"), (no_home, "Not a directory|File exists|cannot find"), (full, "No space left")],
)
def test_the_studio_starts_whatever_its_home_is(
    home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, harm, why: str
) -> None:
    harm(monkeypatch, home)
    folder, note = usable_projects()
    assert folder.parent == tmp_path / "temporary" and usable_projects() == (folder, note)  # the next one finds them
    assert note.startswith(f"{home}: ") and f"set {PROJECTS_VARIABLE} to" in note and str(folder) in note
    assert any(reason in note for reason in why.split("|")) and not list(folder.iterdir())
    if os.name == "posix":
        assert folder.stat().st_mode & 0o077 == 0
    session, name = open_session(ball(), folder)
    studio = Studio(session, name, StudioOptions(projects=folder, note=note))
    with live(studio) as served, served.greeted() as browser:
        line = toast(browser)
        assert line["level"] == "warning" and PROJECTS_VARIABLE in line["message"]


@pytest.mark.parametrize("by_variable", [False, True])
def test_a_folder_that_was_asked_for_is_the_one_or_an_error(
    home: Path, monkeypatch: pytest.MonkeyPatch, by_variable: bool
) -> None:
    no_locks(monkeypatch, home)
    if by_variable:
        monkeypatch.setenv(PROJECTS_VARIABLE, str(home))
    with pytest.raises(ValueError, match=f"projects cannot be saved here .*file locks.*; set {PROJECTS_VARIABLE} to"):
        usable_projects(None if by_variable else home)


def test_a_sound_home_is_used_and_left_clean(home: Path) -> None:
    assert usable_projects() == (home, "") and not list(home.iterdir())


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="on Windows the temporary folder is the user's own")
def test_somebody_elses_temporary_folder_is_not_used(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    no_locks(monkeypatch, home)
    first, _ = usable_projects()
    first.chmod(0o777)
    assert usable_projects()[0] not in (first, home)
    shutil.rmtree(first)
    first.symlink_to(home.parent)
    assert usable_projects()[0] not in (first, home)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows lets nobody delete an open file")
def test_a_project_that_was_deleted_is_an_offer_to_save_it(tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    with live(make_studio(tmp_path, shared=tmp_path / "shared")) as served:
        served.studio.session.path.unlink()  # type: ignore[union-attr]
        failed = served.http.post("/api/do/look.commit", json={"look": {"exposure": 1.0}})
        error = failed.json()["error"]
        assert failed.status_code == 507 and error["kind"] == "storage" and "save_as" in error["hint"], error
        assert "was deleted or moved while it was open, and nothing was changed" in error["message"]
        assert str(tmp_path) not in error["message"]
        assert "studio" in [entry["key"] for entry in served.post("project.folders")["folders"]]
        served.post("project.move", folder="studio")
        served.post("look.commit", look={"exposure": 1.0})
    with Session(tmp_path / "shared" / "own.splatproj") as session:
        assert len(session.layers) == 1
    assert problem_of(UnwritableError("x: y; z")).hint == "z"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows lets nobody delete an open file")
def test_the_layers_of_a_project_that_was_deleted_are_named(tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    write(tmp_path / "shared" / "x.ply", ball(50))
    with live(make_studio(tmp_path, shared=tmp_path / "shared")) as served, served.greeted() as browser:
        browser.do("look.commit", look={"exposure": 1.0})
        (tmp_path / "own.splatproj").unlink()
        with pytest.warns(UserWarning, match="was deleted or moved"):
            browser.do("asset.open", file="x.ply")
            assert toast(browser)["message"].endswith("; what was done in it is in own.rescued.splatproj")
    with Session(tmp_path / "own.rescued.splatproj") as session:
        assert len(session.layers) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="Windows lets nobody replace an open file")
@pytest.mark.parametrize("saves", [False, True])
def test_a_file_that_took_the_place_of_a_project_stays(tmp_path: Path, saves: bool) -> None:
    """Projects of the studio's own folder go when they are left untouched, or saved elsewhere: but only they."""
    projects, shared = tmp_path / "projects", tmp_path / "shared"
    projects.mkdir()
    shared.mkdir()
    session = Session(ball(50), projects / "x.splatproj")
    with live(Studio(session, "x", StudioOptions(shared, projects))) as served:
        (tmp_path / "other").write_bytes(b"somebody's")
        os.replace(tmp_path / "other", projects / "x.splatproj")
        if saves:
            served.post("project.save_as", file="y.splatproj")
    assert (projects / "x.splatproj").read_bytes() == b"somebody's"
    assert [entry.name for entry in shared.iterdir()] == (["y.splatproj"] if saves else [])


def test_a_log_that_is_not_used_is_said(tmp_path: Path) -> None:
    (tmp_path / "shared").mkdir()
    write(tmp_path / "x.ply", ball(50))
    path = tmp_path / "shared" / "x.splatproj"
    Session(tmp_path / "x.ply", path).close()
    path.with_name("x.splatproj-wal").write_bytes(b"of another state")
    with live(make_studio(tmp_path, shared=tmp_path / "shared")) as served, served.greeted() as browser:
        browser.do("project.open", file="x.splatproj")
        assert "is now x.splatproj-wal.unused" in toast(browser)["message"]


def test_pictures_are_found_where_no_events_arrive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "shared").mkdir()
    folder = tmp_path / "shared"
    (folder / "before.png").write_bytes(png(8))
    monkeypatch.setattr(watched_folder, "LOOK_SECONDS", 0.01)
    monkeypatch.setattr(saved_pictures, "QUIET_SECONDS", 0.05)
    hosted = make_studio(tmp_path, shared=folder)
    hub, seen = Hub(hosted), []
    hub.publish = seen.append  # type: ignore[method-assign]

    async def until(count: int) -> None:
        ends = time.monotonic() + PATIENCE
        while len(seen) < count and time.monotonic() < ends:
            await asyncio.sleep(0.01)

    async def run() -> None:
        task = asyncio.create_task(watched_folder.watch(hub, 0.01))
        await asyncio.sleep(0.2)
        (folder / "new.png").write_bytes(png(9))
        await until(1)
        (folder / "before.png").write_bytes(png(10))
        await until(2)
        folder.rename(tmp_path / "away")  # a share that is gone for a while
        await until(3)
        (tmp_path / "away").rename(folder)
        (folder / "new.png").write_bytes(png(11))
        await until(4)
        task.cancel()
        await asyncio.wait([task])

    asyncio.run(run())
    hosted.close()
    kinds = [type(message) for message in seen]
    assert kinds == [PictureEvent, PictureEvent, ToastEvent, PictureEvent]
    assert [message.name for message in seen if isinstance(message, PictureEvent)] == [
        "new.png",
        "before.png",
        "new.png",
    ]
