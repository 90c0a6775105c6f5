"""Writing goes wrong, through the real command line: what was there before survives, nothing is left half-written."""

from __future__ import annotations

import errno
import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import splatpainter as sp
from splatpainter.commands import convert
from splatpainter.output_paths import check_folder, check_target
from tests.support.cli_scenes import Capture, ball, ball_and_painted_view, listing, refused, run, saved
from tests.support.systems import posix_only


@pytest.fixture()
def view(tmp_path: Path, capfd: Capture) -> Path:
    """painted.png, beside ball.ply and views/."""
    return ball_and_painted_view(tmp_path, capfd)


def test_outputs_that_exist(view: Path, capfd: Capture) -> None:
    folder = view.parent
    for name in ("out.ply", "out.ply.receipt.json"):
        (folder / name).write_bytes(b"precious")
        assert f"{folder / name}: already exists" in refused(capfd, folder, view)
        (folder / name).unlink()
    assert "is the input itself" in run(capfd, "convert", folder / "ball.ply", folder / "ball.ply").error
    if sys.platform != "win32":
        (folder / "link.ply").symlink_to(folder / "ball.ply")
        assert "is the input itself" in run(capfd, "convert", folder / "ball.ply", folder / "link.ply").error
    line = run(capfd, "render", folder / "ball.ply", "--out", folder / "views").error
    assert "view_000.png: already exists" in line
    for precious in (view, folder / "ball.ply"):
        line = refused(capfd, folder, view, "--receipt", precious, "--overwrite")
        assert f"{precious}: is an input" in line


def test_outputs_that_cannot_be(view: Path, capfd: Capture) -> None:
    folder = view.parent
    before = listing(folder)
    asset = folder / "ball.ply"
    for out, pattern in (
        (folder / "no" / "out.ply", "no such folder"),
        (asset / "out.ply", "ball.ply"),
        (folder / "views.ply", "is a folder"),
    ):
        if out.name == "views.ply":
            out.mkdir()
        assert pattern in run(capfd, "edit", asset, view, "--out", out, "--overwrite").error
        assert pattern in run(capfd, "convert", asset, out, "--overwrite").error
    assert "is a file" in run(capfd, "render", asset, "--out", asset).error
    assert "is a file" in run(capfd, "render", asset, "--out", asset / "below").error
    assert "is a file" in run(capfd, "demo", "--out", asset).error
    if Path("/dev/full").exists():
        line = run(capfd, "edit", asset, view, "--out", folder / "o.ply", "--receipt", "/dev/full", "--overwrite").error
        assert "/dev/full: is no plain file" in line
    assert listing(folder) == before


def test_a_folder_without_permission(view: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Simulated, as root may write everywhere: the question is asked before any work, and the answer is one line."""
    locked = view.parent / "locked"
    locked.mkdir()
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != locked and access(path, mode))
    for words in (["edit", view.parent / "ball.ply", view, "--out", locked / "o.ply"],
                  ["convert", view.parent / "ball.ply", locked / "o.ply"],
                  ["render", view.parent / "ball.ply", "--out", locked]):  # fmt: skip
        assert f"no permission in {locked}" in run(capfd, *words).error
    assert listing(locked) == {}


@pytest.mark.parametrize("when", ["fsync", "write", "rename"])
@pytest.mark.parametrize("command", ["edit", "convert", "render"])
def test_a_full_disk(when: str, command: str, view: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk fills up while the new file is written, synced or renamed: the old one survives, nothing is left."""
    folder = view.parent
    old = saved(folder / "old.ply", ball(50))
    (folder / "old.ply.receipt.json").write_text("{}")
    before = listing(folder)
    words = {
        "edit": ["edit", folder / "ball.ply", view, "--out", old, "--overwrite"],
        "convert": ["convert", folder / "ball.ply", old, "--overwrite"],
        "render": ["render", folder / "ball.ply", "--out", folder / "views", "--size", 32, "--views", 1, "--overwrite"],
    }[command]

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if when == "fsync":
        monkeypatch.setattr(os, "fsync", full)
    elif when == "rename":
        monkeypatch.setattr(os, "replace", full)
        monkeypatch.setattr(Path, "replace", full)
    else:
        real = open

        def opened(path: object, mode: str = "r", *more: object, **options: object):  # noqa: ANN202
            file = real(path, mode, *more, **options)  # type: ignore[call-overload]
            if "w" not in mode:
                return file
            file.close()
            return real("/dev/full", mode, *more, **options)  # type: ignore[call-overload]

        if not Path("/dev/full").exists():
            pytest.skip("needs /dev/full")
        monkeypatch.setattr("builtins.open", opened)
    line = run(capfd, *words).error
    monkeypatch.undo()
    assert "No space left on device" in line
    assert ("view_000.png" if command == "render" else str(old)) in line
    assert listing(folder) == before


def test_a_limit_of_the_system_on_file_size(view: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Writes really fail: the system refuses to let a file grow past it."""
    resource = pytest.importorskip("resource")

    folder = view.parent
    saved(folder / "old.ply", ball(50))
    before, limits = listing(folder), resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # Python would leave the first half of bytecode files
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        line = run(capfd, "edit", folder / "ball.ply", view, "--out", folder / "old.ply", "--overwrite").error
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "old.ply" in line and "too large" in line.lower()
    assert listing(folder) == before


def test_a_reader_that_goes_away_is_no_error(tmp_path: Path) -> None:
    saved(tmp_path / "ball.ply")
    read, written = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "splatpainter", "info", tmp_path / "ball.ply"]
    done = subprocess.run(command, stdout=written, stderr=subprocess.PIPE, text=True)
    os.close(written)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_standard_output_is_one_line(tmp_path: Path) -> None:
    saved(tmp_path / "ball.ply")
    command = [sys.executable, "-m", "splatpainter", "info", tmp_path / "ball.ply", "--json"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("splatpainter: standard output: cannot be written") and done.stderr.count("\n") == 1


@posix_only
@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_in_the_middle_of_writing(sent: signal.Signals, code: int, view: Path) -> None:
    """A real process is stopped while OUT is being written over an older file: that file and the folder stay as they
    were."""
    folder = view.parent
    saved(folder / "out.ply", ball(100))
    before = listing(folder)
    program = (
        "import signal, sys, time\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background jobs ignore it
        "from splatpainter.io import files\n"
        "from splatpainter.io.formats import ply\n"
        "encode = ply._encode\n"
        "def slow(*arguments):\n"
        "    for block in encode(*arguments):\n"
        "        yield block\n"
        "        print('writing', flush=True)\n"
        "        time.sleep(60)\n"
        "ply._encode = slow\n"
        "from splatpainter.cli import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    words = ["edit", folder / "ball.ply", view, "--out", folder / "out.ply", "--overwrite"]
    child = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None and child.stdout.readline() == "writing\n"
    assert len(listing(folder)) > len(before), "the file in the making is there"
    time.sleep(0.1)
    child.send_signal(sent)
    out, errors = child.communicate(timeout=60)
    assert (child.returncode, out) == (code, "")
    assert "Traceback" not in errors and errors.count("\n") <= 1
    assert listing(folder) == before


def test_a_copy_is_not_read_again(tmp_path: Path, capfd: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a file with the bytes of the one that was read everything is known; of any other it is not."""
    read_files = []

    def read(path: Path, **options: Any) -> sp.Splats:
        read_files.append(Path(path).name)
        return sp.read(path, **options)

    monkeypatch.setattr(convert, "read", read)
    asset = saved(tmp_path / "ball.ply", ball(300))
    done = run(capfd, "convert", asset, tmp_path / "copy.ply", "--json").json
    assert (tmp_path / "copy.ply").read_bytes() == asset.read_bytes()
    assert read_files == ["ball.ply"] and done["lost"] == [] and done["losses"]["compared"] == 300
    assert done["output"]["sha256"] == hashlib.sha256(asset.read_bytes()).hexdigest()
    # Fewer bands, and other axes of the same bytes.
    for options in (["--sh-degree", "0"], ["--in-axes", "rub", "--axes", "rdf"]):
        read_files.clear()
        done = run(capfd, "convert", asset, tmp_path / "other.ply", "--overwrite", "--json", *options)
        assert done.code == 0 and len(read_files) == 2, options
        written = (tmp_path / "other.ply").read_bytes()
        assert done.json["output"]["sha256"] == hashlib.sha256(written).hexdigest()
    # The same format and no options, and yet another file.
    assert run(capfd, "convert", asset, tmp_path / "ball.spz").code == 0
    done = run(capfd, "convert", tmp_path / "ball.spz", tmp_path / "turned.spz", "--axes", "rub", "--json").json
    written = (tmp_path / "turned.spz").read_bytes()
    assert written != (tmp_path / "ball.spz").read_bytes()
    assert done["output"]["sha256"] == hashlib.sha256(written).hexdigest()


@posix_only
def test_a_disk_that_is_mounted_read_only_is_called_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """chmod would not help there."""
    assert sys.platform != "win32"
    real = os.statvfs(tmp_path)
    monkeypatch.setattr(os, "access", lambda *_: False)
    for flag, words in ((os.ST_RDONLY, "is on a disk that is mounted read-only"), (0, "no permission in")):
        monkeypatch.setattr(os, "statvfs", lambda _, flag=flag: SimpleNamespace(f_flag=real.f_flag & ~1 | flag))
        for check in (check_folder, lambda path: check_target(path, False)):
            with pytest.raises(ValueError, match=words):
                check(tmp_path / "a.ply")
