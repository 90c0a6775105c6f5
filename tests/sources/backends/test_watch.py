"""The source `watch`, and the pictures that somebody saves into a folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from splatpainter.image_files import find_camera
from splatpainter.pictures import saved_pictures
from splatpainter.pictures.saved_pictures import SavedPictures
from splatpainter.sources.backends import watch
from splatpainter.sources.picture_source import PictureAnswer, PictureRequest, SourceCancelled, SourceError
from splatpainter.sources.registry import open_source
from tests.support.fake_services import pixels, png
from tests.support.picture_requests import HEIGHT, WIDTH, HastyClock, Progressed, request


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_what_counts_as_saved(tmp_path: Path) -> None:
    (tmp_path / "old.png").write_bytes(b"old")
    clock = Clock()
    saved = SavedPictures(tmp_path, 0.3, clock)
    assert saved.take() == []
    for name in ("new.png", "b.JPG", "notes.txt", ".hidden.png"):
        (tmp_path / name).write_bytes(b"1")
    (tmp_path / "folder.png").mkdir()
    assert saved.take() == []
    clock.now = 0.2
    (tmp_path / "new.png").write_bytes(b"12")  # is still being written
    assert saved.take() == []
    clock.now = 0.4
    assert [path.name for path in saved.take()] == ["b.JPG"]
    clock.now = 0.6
    assert [path.name for path in saved.take()] == ["new.png"] and saved.take() == []
    (tmp_path / "new.png").unlink()
    (tmp_path / "old.png").write_bytes(b"older")
    assert saved.take() == []
    saved.seen(tmp_path / "old.png")
    clock.now = 9
    assert saved.take() == []
    (tmp_path / "new.png").write_bytes(b"12")
    assert saved.take() == []
    clock.now = 10
    assert [path.name for path in saved.take()] == ["new.png"]


def test_folders_in_the_folder_are_watched(tmp_path: Path) -> None:
    """Programs save into folders of their own; what is hidden, too deep, or a link is not looked into."""
    for folder in ("final/web/small/tiny", ".thumbnails", "elsewhere"):
        (tmp_path / "watched" / folder).mkdir(parents=True)
    folder, clock = tmp_path / "watched", Clock()
    (folder / "final" / "old.png").write_bytes(b"old")
    (tmp_path / "other").mkdir()
    (folder / "link").symlink_to(tmp_path / "other", target_is_directory=True)
    (folder / "circle").symlink_to(folder, target_is_directory=True)
    saved = SavedPictures(folder, 0.3, clock)
    names = ["a.png", "final/b.png", "final/web/small/c.png", "new/d.png"]
    (folder / "new").mkdir()
    hidden = [".thumbnails/e.png", "final/web/small/tiny/f.png", "link/g.png"]
    for k, name in enumerate([*names, *hidden]):
        (folder / name).write_bytes(bytes(k))
    assert saved.take() == []
    clock.now = 1
    assert sorted(map(saved.name_of, saved.take())) == names
    (folder / "final" / "old.png").unlink()
    shutil.rmtree(folder / "new")
    assert saved.take() == []


def test_of_a_whole_disk_the_nearest_folders_are_watched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(saved_pictures, "MAX_FOLDERS", 2)
    monkeypatch.setattr(saved_pictures, "MAX_FILES", 3)
    clock = Clock()
    for name in ("a/x", "b", "c"):
        (tmp_path / name).mkdir(parents=True)
    saved = SavedPictures(tmp_path, 0.3, clock)
    for name in ("a/x/1.png", "a/2.png", "b/3.png", "c/4.png", "5.png"):
        (tmp_path / name).write_bytes(b"1")
    saved.take()
    clock.now = 1
    assert sorted(map(saved.name_of, saved.take())) == ["5.png", "a/2.png", "b/3.png"]
    for k in range(9):  # more than may be: of those in the folders in it some are left out, and no word is said
        (tmp_path / "a" / f"many{k}.png").write_bytes(b"1")
    saved.take()
    (tmp_path / "5.png").write_bytes(b"2")
    clock.now = 2
    saved.take()
    clock.now = 3
    assert "5.png" in map(saved.name_of, saved.take())


def test_folders_that_cannot_be_watched(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be watched"):
        SavedPictures(tmp_path / "none")
    saved = SavedPictures(tmp_path)
    tmp_path.rmdir()
    with pytest.raises(ValueError, match="cannot be watched"):
        saved.take()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "SavedPictures", partial(SavedPictures, quiet_seconds=0.02))
    monkeypatch.setattr(watch, "LOOK_SECONDS", 0.01)


class Person(Progressed):
    """Does something once the view lies there, and after each report then."""

    def __init__(self, *actions: Callable[[], object]) -> None:
        super().__init__()
        self.actions = list(actions)

    def __call__(self, share: float, words: str) -> None:
        super().__call__(share, words)
        if self.actions:
            self.actions.pop(0)()


def edit(folder: Path, person: Progressed, query: PictureRequest | None = None, **options: str) -> PictureAnswer:
    source = open_source("watch", {"folder": str(folder), "timeout": "20", **options})
    return source.edit(query or request(), person, person.cancel)


def test_a_view_there_and_a_picture_back(tmp_path: Path) -> None:
    folder = tmp_path / "views"
    person = Person(lambda: (folder / "view_000.png").write_bytes(png(64, 48)))
    answer = edit(folder, person, request("more moss", True, references=1))
    assert answer.image.shape == (48, 64, 3) and answer.model == "saved as view_000.png"
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"view_000.{end}" for end in ("json", "mask.png", "png", "reference_0.png", "txt")]
    assert (folder / "view_000.txt").read_text("utf-8") == "more moss\n"
    camera = request().camera
    assert camera is not None and find_camera(folder / "view_000.png").to_json() == camera.to_json()
    assert pixels((folder / "view_000.mask.png").read_bytes()).shape == (HEIGHT, WIDTH)
    person = Person(lambda: (folder / "view_001-final.jpg").write_bytes(png(8, 8)))
    assert edit(folder, person).model == "saved as view_001-final.jpg"
    assert np.abs(pixels((folder / "view_001.png").read_bytes()) / 255 - request().image).max() < 0.003


def test_an_answer_in_a_folder_of_the_program(tmp_path: Path) -> None:
    (tmp_path / "export").mkdir()
    person = Person(lambda: (tmp_path / "export" / "view_000.png").write_bytes(png(64, 48)))
    assert edit(tmp_path, person).image.shape == (48, 64, 3)


def test_what_is_no_answer_is_waited_on(tmp_path: Path) -> None:
    def save_other_files() -> None:
        (tmp_path / "another.png").write_bytes(png())
        (tmp_path / "view_0001.png").write_bytes(png())
        (tmp_path / "view_000.png").write_bytes(b"half a pict")

    person = Person(save_other_files, lambda: (tmp_path / "view_000.png").write_bytes(png()))
    assert edit(tmp_path, person).image.shape == (HEIGHT, WIDTH, 3)
    assert person.reports[1][1].startswith("view_000.png: expected a PNG")


def test_nobody_saves_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SourceError, match=r"no picture was saved as .*view_000.png within 0.1 seconds$"):
        edit(tmp_path, Progressed(), timeout="0.1")
    clock = HastyClock("expected a PNG")
    monkeypatch.setattr(watch, "time", clock)
    listening, actions = clock.progress(), [lambda: (tmp_path / "view_001.png").write_bytes(b"x")]

    class Listening(Person):
        def __call__(self, share: float, words: str) -> None:
            super().__call__(share, words)
            listening(share, words)

    with pytest.raises(SourceError, match="the last one could not be read: view_001.png: expected a PNG"):
        edit(tmp_path, Listening(*actions), timeout="600")


def test_cancel(tmp_path: Path) -> None:
    with pytest.raises(SourceCancelled):
        edit(tmp_path, Progressed("waiting"))
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".json", ".png", ".txt"]


def test_folders_that_cannot_be(tmp_path: Path) -> None:
    for folder in (tmp_path / "no" / "folder", tmp_path / "file" / "x"):
        (tmp_path / "file").write_bytes(b"")
        with pytest.raises(SourceError, match="cannot be made"):
            open_source("watch", {"folder": str(folder)})
    with pytest.raises(SourceError, match="cannot be made"):
        open_source("watch", {"folder": str(tmp_path / "file")})
