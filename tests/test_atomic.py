"""Large files on their way to the disk: carried there early, whole all the same, and let go where nobody waits."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

import pytest

from splatpainter.system import atomic

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps no replaced file open")


@pytest.fixture
def early(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Sizes of files at each call that carries them to the disk, where ten bytes are many."""
    monkeypatch.setattr(atomic, "EARLY_BYTES", 10)
    sizes: list[int] = []
    begin = atomic._begin_sync

    def begin_sync(handle: int) -> None:
        sizes.append(os.fstat(handle).st_size)
        begin(handle)

    monkeypatch.setattr(atomic, "_begin_sync", begin_sync)
    return sizes


def write(path: Path, pieces: list[bytes]) -> None:
    with atomic.writing(path) as file:
        for piece in pieces:
            assert file.write(piece) == len(piece)
            file.flush()


def test_a_large_file_is_carried_to_the_disk_while_it_is_written(early: list[int], tmp_path: Path) -> None:
    write(tmp_path / "a", [b"1234", b"56789", b"0", b"1234", b"x" * 25, b"end"])
    assert early == [10, 39]
    assert (tmp_path / "a").read_bytes() == b"12345678901234" + b"x" * 25 + b"end"
    write(tmp_path / "b", [b"12345"])
    assert early == [10, 39] and os.listdir(tmp_path) in (["a", "b"], ["b", "a"])


def test_a_system_that_cannot_do_that_writes_the_same(
    early: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(atomic, "_sync_function", lambda: None)
    write(tmp_path / "a", [b"x" * 25, b"end"])
    assert early == [25] and (tmp_path / "a").read_bytes() == b"x" * 25 + b"end"


@pytest.mark.parametrize(("before", "held"), [(b"y" * 30, True), (b"y", False), (None, False)])
def test_a_large_file_that_is_replaced_is_let_go_beside(
    before: bytes | None, held: bool, early: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, closed = tmp_path / "a", []
    if before is not None:
        path.write_bytes(before)
        inode = path.stat().st_ino
    close, here = os.close, threading.get_ident()

    def closing(handle: int) -> None:
        if threading.get_ident() != here:
            closed.append(os.fstat(handle).st_ino)
        close(handle)

    monkeypatch.setattr(os, "close", closing)
    write(path, [b"new"])
    for thread in threading.enumerate():
        if thread.name == "splatpainter lets go of a file":
            thread.join()
    assert path.read_bytes() == b"new" and closed == ([inode] if held else [])


def test_a_large_file_that_is_not_replaced_is_let_go_too(
    early: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").write_bytes(b"y" * 30)

    def refuse(source: Path, target: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(atomic, "replace", refuse)
    before = set(os.listdir("/dev/fd")) if sys.platform == "linux" else set()
    with pytest.raises(ValueError, match="a: cannot be written"):
        write(tmp_path / "a", [b"new"])
    for thread in threading.enumerate():
        if thread.name == "splatpainter lets go of a file":
            thread.join()
    assert (set(os.listdir("/dev/fd")) if sys.platform == "linux" else set()) == before
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == b"y" * 30
