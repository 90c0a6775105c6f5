"""splatpainter watch: pictures that are saved are lifted, the result follows, one bad file is a line."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from PIL import Image

from splatpainter.commands import watch
from splatpainter.pictures.saved_pictures import SavedPictures
from splatpainter.receipts import Receipt
from tests.support.cli_scenes import Capture, ball_and_painted_view, run
from tests.support.fake_services import animated, inks

REFUSED = {"broken.png": "Truncated", "inks.jpg": "got CMYK; save it as RGB", "moving.png": "got PNG with 2 frames"}
"""Files that are saved among the others -> the reason in their line."""


@pytest.fixture()
def painted(tmp_path: Path, capfd: Capture) -> Path:
    """painted.png, beside ball.ply and views/."""
    return ball_and_painted_view(tmp_path, capfd)


@contextmanager
def meanwhile(action: Callable[[], object]) -> Iterator[None]:
    """Does something once the folder is watched, in another thread."""
    errors: list[BaseException] = []

    def act() -> None:
        try:
            assert watching.wait(30)
            action()
        except BaseException as error:
            errors.append(error)

    watching = threading.Event()

    class Watched(SavedPictures):
        def take(self) -> list[Path]:
            watching.set()
            return super().take()

    thread = threading.Thread(target=act)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(watch, "SavedPictures", lambda folder: Watched(folder, 0.02))
        patch.setattr(watch, "LOOK_SECONDS", 0.01)
        thread.start()
        try:
            yield
        finally:
            watching.set()
            thread.join(30)
    assert not errors


def awaited(path: Path, before: bytes | None = None) -> bytes:
    """What a file holds once it holds something else."""
    for _ in range(2000):
        if path.exists() and (data := path.read_bytes()) != before:
            return data
        time.sleep(0.01)
    raise AssertionError(path)


def test_saves_are_lifted_and_bad_files_are_lines(painted: Path, capfd: Capture) -> None:
    folder = painted.parent
    views, out = folder / "views", folder / "out.ply"
    edited, plain = painted.read_bytes(), (views / "view_000.png").read_bytes()

    def person() -> None:
        (views / "broken.png").write_bytes(edited[:200])
        (views / "moving.png").write_bytes(animated())
        (views / "inks.json").write_bytes((views / "view_000.json").read_bytes())
        (views / "inks.jpg").write_bytes(inks())
        (views / "painted.mask.png").write_bytes(edited)
        (views / "notes.txt").write_bytes(b"")
        time.sleep(0.1)
        (views / "painted.png").write_bytes(edited)

    words = ("watch", views, "--asset", folder / "ball.ply", "--out", out)
    with meanwhile(person):
        output = run(capfd, *words, "--once", "--timeout", 60)
    assert output.code == 0, output.err
    lines = sorted(output.err.splitlines())
    for line, (name, reason) in zip(lines, REFUSED.items(), strict=True):
        assert f"{views / name}: " in line and reason in line
    assert output.out.splitlines()[1].startswith(f"painted.png: 1 picture on {out}, ")
    assert output.out.splitlines()[2] == "ended: 1 save lifted, 3 pictures refused"
    receipt = Receipt.from_json((folder / "out.ply.receipt.json").read_text("utf-8"))
    assert len(receipt.touched) and run(capfd, "verify", folder / "ball.ply", out).code == 0
    assert (views / "view_000.png").read_bytes() == plain


def test_a_picture_in_a_folder_of_the_folder_is_lifted(painted: Path, capfd: Capture) -> None:
    """Its camera is that of the view that it was painted on, which lies in the folder itself."""
    folder = painted.parent
    views, out = folder / "views", folder / "out.ply"
    (views / "final").mkdir()
    without_camera = io.BytesIO()
    Image.open(painted).convert("RGB").save(without_camera, "PNG")

    def person() -> None:
        (views / "final" / "view_000 painted.png").write_bytes(without_camera.getvalue())

    words = ("watch", views, "--asset", folder / "ball.ply", "--out", out)
    with meanwhile(person):
        output = run(capfd, *words, "--once", "--timeout", 60)
    assert output.code == 0, output.err
    assert output.out.splitlines()[1].startswith(f"final/view_000 painted.png: 1 picture on {out}, ")


def test_the_result_follows(painted: Path, capfd: Capture) -> None:
    folder = painted.parent
    views, out = folder / "views", folder / "out.ply"
    view, edited = views / "view_000.png", painted.read_bytes()
    plain = view.read_bytes()
    results: list[bytes] = []

    def person() -> None:
        view.write_bytes(edited)
        results.append(awaited(out))
        (views / "again.png").write_bytes(edited)
        results.append(awaited(out, results[0]))
        view.write_bytes(plain)  # its edit is taken back; the other one stays
        raise_in_main()

    def raise_in_main() -> None:
        import _thread

        time.sleep(0.2)
        _thread.interrupt_main()

    with meanwhile(person):
        words = ("watch", views, "--asset", folder / "ball.ply", "--out", out, "--json")
        output = run(capfd, *words)
    assert output.code == 0, output.err
    assert len(results) == 2 and output.json["lifted"] >= 2 and output.json["ended"] == "interrupted"
    assert output.json["pictures"] == ["view_000.png", "again.png"]
    assert run(capfd, "verify", folder / "ball.ply", out).code == 0
    assert not list(folder.glob(".*part*"))


def test_nothing_is_saved(painted: Path, capfd: Capture) -> None:
    folder = painted.parent
    words = ("watch", folder / "views", "--asset", folder / "ball.ply", "--out", folder / "out.ply")
    with meanwhile(lambda: None):
        output = run(capfd, *words, "--timeout", 0.1)
    assert output.code == 2 and "no picture was lifted within 0.1 seconds" in output.err
    assert not (folder / "out.ply").exists()


def test_what_is_refused(painted: Path, capfd: Capture) -> None:
    folder = painted.parent
    asset, out = folder / "ball.ply", folder / "out.ply"

    def error(watched: Path = folder / "views", asset: Path = asset, out: Path = out, *words: object) -> str:
        return run(capfd, "watch", watched, "--asset", asset, "--out", out, *words).error

    assert "no such folder" in error(folder / "none")
    assert "ball.ply: is an input" in error(out=asset)
    assert "unknown format" in error(out=folder / "out.xyz")
    assert "more than 0 seconds" in error(folder / "views", asset, out, "--timeout", 0)
    assert "no such file" in error(asset=folder / "none.ply")
    out.write_bytes(b"precious")
    assert "already exists" in error()
    assert out.read_bytes() == b"precious"
