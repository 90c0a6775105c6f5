"""Files that appear whole or not at all, on Linux, macOS and Windows. Knows no format."""

from __future__ import annotations

import contextlib
import contextvars
import errno
import functools
import hashlib
import io
import os
import re
import secrets
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

REPLACE_SECONDS = 2.0
"""How long `replace` waits for other programs to let go of a file."""
SHARING_ERRORS = (5, 32, 33)
"""Windows: access denied, sharing violation, lock violation."""
BUSY_ERRORS = (errno.EBUSY, errno.ETXTBSY, errno.EINTR)
"""The same, as folders of Windows and of virtual machines (SMB, 9p, vboxsf) say it elsewhere."""
RESERVED_NAMES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|com[0-9¹²³]|lpt[0-9¹²³])[ ]*(\.|$)", re.IGNORECASE)
"""Devices of Windows, whatever ending follows the name."""
RESERVED_CHARACTERS = re.compile(r'[<>:"/\\|?*\x00-\x1f]')

EARLY_BYTES = 8 << 20
"""A file of more bytes is carried to the disk while it is written. A million Gaussians (104 MB) waited 46 ms at the
end, and 3 with this."""
SYNC_FILE_RANGE_WRITE = 2
"""Of sync_file_range in Linux's fs.h."""
MAX_NAME_BYTES = 255
"""Bytes of a file name on nearly every file system."""
MAX_BRIEF_BYTES = 100
"""Bytes of a name that temporary names repeat; with all they add they stay below the 143 of the narrowest file systems
(eCryptfs; others take 255)."""
BRIEF_ENDS = 20
"""Characters that a shortened name keeps of a longer one: enough for the longest ending, .compressed.ply."""


def brief_name(name: str, keep_ending: bool = False) -> str:
    """What temporary names repeat of `name`: all of it or, of a long one, its beginning (or its ending, where that says
    the format) and a digest, so that they do not grow with it."""
    data = os.fsencode(name)
    if len(data) <= MAX_BRIEF_BYTES:
        return name
    digest = hashlib.sha256(data).hexdigest()[:8]
    return f"{digest}~{name[-BRIEF_ENDS:]}" if keep_ending else f"{name[:BRIEF_ENDS]}~{digest}"


def is_mounted_read_only(folder: Path) -> bool:
    """Whether the disk that a folder is on can only be read, whatever the rights there."""
    if sys.platform == "win32":  # has no such call
        return False
    try:
        return bool(os.statvfs(folder).f_flag & os.ST_RDONLY)
    except OSError:
        return False


_is_passing: contextvars.ContextVar[bool] = contextvars.ContextVar("passing", default=False)


@contextlib.contextmanager
def passing() -> Iterator[None]:
    """Files that this thread writes inside are read and removed by it: `writing` does not wait until they are on the
    disk, as nobody misses them after a power cut."""
    token = _is_passing.set(True)
    try:
        yield
    finally:
        _is_passing.reset(token)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[BinaryIO]:
    """A file that appears at `path` complete (flushed, synced, renamed) or, when the block raises, not at all.

    An existing file keeps its permissions; a symbolic link keeps pointing where it points. OSError becomes ValueError.
    """
    check_name(path)
    # Beside its target, as a rename is one step only within a file system.
    target = Path(os.path.realpath(path))
    partial = target.with_name(f".{brief_name(target.name)}.{secrets.token_hex(4)}.part")
    try:
        with (
            open(partial, "wb", buffering=0) as raw,
            io.BufferedWriter(_EarlyFile(raw.fileno(), "wb", closefd=False)) as file,
        ):
            yield file
            file.flush()
            if not _is_passing.get():
                os.fsync(file.fileno())
        # A new file has the rights of a temporary one; one that is replaced keeps those that somebody gave it.
        if target.exists():
            copy_mode(target, partial)
        with _held(target):
            replace(partial, target)
        if not _is_passing.get():
            sync_folder(target.parent)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        remove(partial)


class _EarlyFile(io.FileIO):
    """A file that the system begins to carry to the disk while it is written: the sync at its end waits for the last
    megabytes alone, not for all."""

    _behind = 0
    """Bytes that were written since it was told last."""

    def write(self, data: Any, /) -> int:
        count = super().write(data)
        self._behind += count
        if self._behind >= EARLY_BYTES:
            self._behind = 0
            _begin_sync(self.fileno())
        return count


def _begin_sync(handle: int) -> None:
    """Begin to write out what a file has, without waiting; where the system cannot do that, nothing happens."""
    function = _sync_function()
    if function is not None:
        function(handle, 0, 0, SYNC_FILE_RANGE_WRITE)  # of 0 bytes: to its end


@functools.cache
def _sync_function() -> Callable[[int, int, int, int], int] | None:
    if sys.platform != "linux":
        return None
    import ctypes  # of large files alone

    function = getattr(ctypes.CDLL(None), "sync_file_range", None)
    if function is not None:
        function.argtypes = (ctypes.c_int, ctypes.c_int64, ctypes.c_int64, ctypes.c_uint)
    return function


@contextlib.contextmanager
def _held(target: Path) -> Iterator[None]:
    """While a large file is replaced it is kept open, and let go on a thread of its own: freeing its blocks takes as
    long as a quarter of writing them, and nobody needs to wait for that."""
    try:
        # Windows replaces no file that somebody has open.
        large = sys.platform != "win32" and os.stat(target).st_size >= EARLY_BYTES
        handle = os.open(target, os.O_RDONLY) if large else None
    except OSError:
        handle = None
    try:
        yield
    finally:
        if handle is not None:
            threading.Thread(target=os.close, args=(handle,), name="splatpainter lets go of a file").start()


def write_text(path: Path, text: str) -> None:
    """A UTF-8 file, as `writing` makes it."""
    with writing(path) as file:
        file.write(text.encode())


def replace(source: Path, target: Path) -> None:
    """`os.replace`. A virus scanner, an indexer or a program that synchronises folders holds a new file for a moment:
    on Windows, and in folders that another system serves, it is tried again for REPLACE_SECONDS. Raises OSError: the
    last one."""
    until = time.monotonic() + REPLACE_SECONDS
    while True:
        try:
            os.replace(source, target)
            return
        except OSError as error:
            # winerror is absent elsewhere: POSIX renames over open files, so its refusals of rights are final
            busy = getattr(error, "winerror", None) in SHARING_ERRORS or error.errno in BUSY_ERRORS
            if not busy or time.monotonic() > until:
                raise
        time.sleep(0.02)


def copy_mode(source: Path, target: Path) -> None:
    """Give a file the permissions of another one, where its file system has any (vboxsf, 9p and exFAT refuse)."""
    with contextlib.suppress(OSError):
        shutil.copymode(source, target)


def remove(path: Path) -> None:
    """Remove a file that may be missing. Windows removes no file that somebody has open: it stays, without an error."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make a rename inside `folder` durable, where the system can do that (Windows opens no folders)."""
    with contextlib.suppress(OSError):
        # The name is an entry of the folder: until that is on the disk, a power cut takes the file away.
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_name(path: Path) -> None:
    """Refuse the name of a new file that this system has no room for, or would take for something else: on Windows
    NUL.ply is a device that swallows what is written, a:b.ply a stream inside the file a, and dots or spaces at the end
    vanish. Raises ValueError."""
    try:
        os.lstat(path)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            length = len(os.fsencode(path.name))
            raise ValueError(f"{path}: its name of {length} bytes is too long for its folder; shorten it") from None
    except ValueError:
        raise ValueError(f"{str(path)!r}: expected the name of a file") from None
    if sys.platform == "win32" and (reason := windows_refuses(path.name)):
        raise ValueError(f"{path}: {reason}; choose another name")


def windows_refuses(name: str) -> str:
    """Why Windows has no ordinary file of this name (without folders), or ""."""
    # Said of Windows on every system: names are made on one and opened on another.
    if RESERVED_NAMES.match(name):
        return "is the name of a device on Windows"
    if match := RESERVED_CHARACTERS.search(name):
        return f"Windows allows no {match.group()!r} in names"
    return "ends in a dot or a space, which Windows drops" if name.endswith((".", " ")) else ""


def clash(a: Path, b: Path) -> bool:
    """Whether two outputs would be one file here or, where they differ in case alone, on Windows and macOS."""
    return os.path.abspath(a).casefold() == os.path.abspath(b).casefold()
