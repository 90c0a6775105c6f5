"""Bytes in and out: whole files and bounded slices in, all-or-nothing files out. Knows no format."""

from __future__ import annotations

import contextlib
import contextvars
import hashlib
import os
import stat
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from splatpainter.kernels.parallel import each
from splatpainter.system.atomic import passing, remove, replace, sync_folder, writing

__all__ = [
    "file_sha256",
    "holds",
    "is_same",
    "passing",
    "read_all",
    "read_array",
    "read_head",
    "reading",
    "remove",
    "replace",
    "sha256",
    "sync_folder",
    "take",
    "watched",
    "writing",
]

BOM = b"\xef\xbb\xbf"
"""Mark of UTF-8 that editors put ahead of a text."""
MAX_HEADER_BYTES = 1 << 20
"""Bytes; no honest text header is longer, and a hostile one must not be searched to its end."""
PIECE_BYTES = 1 << 20
"""Read at a time of a file that is hashed."""
SHARED_BYTES = 1 << 22
"""Read at a time by each of several threads."""
COMPARED_BYTES = 1 << 18
"""Read at a time of a file that is compared."""


_watcher: contextvars.ContextVar[Callable[[int], None] | None] = contextvars.ContextVar("watcher", default=None)


@contextlib.contextmanager
def watched(note: Callable[[int], None]) -> Iterator[None]:
    """`read_all` and `read_array` within call note(bytes) after every piece of a large file, from the thread that read
    it; what it raises ends the reading."""
    before = _watcher.set(note)
    try:
        yield
    finally:
        _watcher.reset(before)


@contextlib.contextmanager
def reading(path: Path) -> Iterator[BinaryIO]:
    """The file at `path`, open for reading. Missing, not a regular file, no permission: a one-line ValueError.

    A pipe or a device is never opened: that alone may block for ever.
    """
    try:
        _check_regular(path)
        with open(path, "rb") as file:
            yield file
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror or error})") from None


def _check_regular(path: Path) -> None:
    try:
        mode = path.stat().st_mode
    except ValueError:  # a NUL in the name
        raise ValueError(f"{str(path)!r}: expected the name of a file") from None
    if stat.S_ISDIR(mode):
        raise ValueError(f"{path}: is a folder; expected a file")
    if not stat.S_ISREG(mode):
        raise ValueError(f"{path}: is a pipe or device; expected a file")


def read_head(path: Path, count: int) -> bytes:
    """The first `count` bytes, or fewer where the file is shorter."""
    with reading(path) as file:
        return file.read(count)


def begins_as_ply(head: bytes) -> bool:
    """Whether a file of these first bytes is a PLY file: a line 'ply', behind a mark of UTF-8 if there is one."""
    text = head.removeprefix(BOM)
    return text[:3] == b"ply" and text[3:4] in (b"\n", b"\r")


def read_all(path: Path) -> bytes:
    """The whole file."""
    note = _watcher.get()
    with reading(path) as file:
        if note is None:
            return file.read()
        pieces = []
        while piece := file.read(SHARED_BYTES):
            pieces.append(piece)
            note(len(piece))
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)


def read_array(file: BinaryIO, dtype: np.dtype, count: int) -> np.ndarray:
    """[count] of `dtype` from where the file stands, or fewer where it ends; the file then stands behind them. As
    np.fromfile, by all threads: what takes long is that the system clears the new memory."""
    out = np.empty(count, dtype)
    data = out.view(np.uint8).data if out.nbytes else memoryview(b"")
    start, fill = file.tell(), getattr(os, "preadv", None)  # Windows has none
    note = _watcher.get()
    if fill is None or len(data) <= SHARED_BYTES:
        done = file.readinto(data) if len(data) else 0  # pyright: ignore[reportAttributeAccessIssue]
        if note is not None:
            note(done)
    else:

        def read(first: int) -> int:
            part, size = data[first : first + SHARED_BYTES], 0
            while size < len(part) and (more := fill(file.fileno(), [part[size:]], start + first + size)):
                size += more
            if note is not None:
                note(size)
            return size

        done = sum(each(read, range(0, len(data), SHARED_BYTES)))
    file.seek(start + done)
    return out if done == len(data) else out[: done // dtype.itemsize]


def holds(path: Path, pieces: Sequence[bytes | memoryview]) -> bool:
    """Whether a file holds these bytes, one piece after the other, and no others. Raises ValueError: as `reading`."""
    starts = [0]
    for piece in pieces:
        starts.append(starts[-1] + len(piece))
    with reading(path) as file:
        if os.fstat(file.fileno()).st_size != starts[-1]:
            return False

    def is_equal(part: tuple[int, memoryview]) -> bool:
        with reading(path) as file:
            file.seek(part[0])
            # Through a buffer that stays in the cache: the system clears new memory, which takes as long as reading.
            values, buffer = np.frombuffer(part[1], np.uint8), np.empty(COMPARED_BYTES, np.uint8)
            for first in range(0, len(values), COMPARED_BYTES):
                piece = values[first : first + COMPARED_BYTES]
                count = file.readinto(buffer[: len(piece)].data)  # pyright: ignore[reportAttributeAccessIssue]
                if not np.array_equal(buffer[:count], piece):
                    return False
            return True

    parts = [
        (start + first, memoryview(piece)[first : first + SHARED_BYTES])
        for start, piece in zip(starts, pieces, strict=False)
        for first in range(0, len(piece), SHARED_BYTES)
    ]
    return all(each(is_equal, parts))


def is_same(one: Path, other: Path) -> bool:
    """Whether two names are those of one file or folder: also in other capitals, where the disk does not tell these
    apart, and through links."""
    try:
        return one.resolve() == other.resolve() or os.path.samefile(one, other)
    except OSError:
        return False


def sha256(data: bytes | memoryview) -> str:
    """Hex SHA-256 of `data`."""
    return hashlib.sha256(data).hexdigest()


def file_sha256(path: Path) -> str:
    """Hex SHA-256 of a file, which need not fit into memory. Raises ValueError: as `reading`."""
    digest = hashlib.sha256()
    with reading(path) as file:
        while piece := file.read(PIECE_BYTES):
            digest.update(piece)
    return digest.hexdigest()


def take(data: bytes | memoryview, offset: int, count: int, where: Path | str, what: str) -> memoryview:
    """data[offset : offset + count] without a copy, checked before anything is allocated.

    where: the file, what: the thing wanted, both for the error. Raises ValueError when the bytes are not all there.
    """
    if count < 0 or offset < 0:
        raise ValueError(f"{where}: {what} has a negative size or place ({count} bytes at {offset})")
    if offset + count > len(data):
        raise ValueError(f"{where}: truncated: {what} needs {count} bytes at byte {offset}, the file has {len(data)}")
    return memoryview(data)[offset : offset + count]


def printable(text: str, limit: int = 80) -> str:
    """Text of a file for an error or a report: at most `limit` characters, in one line, without control characters."""
    return "".join(c if c.isprintable() else "?" for c in text[:limit])
