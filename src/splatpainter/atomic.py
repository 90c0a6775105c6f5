"""Files that appear whole or not at all, on Linux, macOS and Windows. Knows no format."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

REPLACE_SECONDS = 2.0
"""How long `replace` waits for other programs of Windows to let go of a file."""
SHARING_ERRORS = (5, 32, 33)
"""Windows: access denied, sharing violation, lock violation."""
RESERVED_NAMES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|com[0-9¹²³]|lpt[0-9¹²³])[ ]*(\.|$)", re.IGNORECASE)
"""Devices of Windows, whatever ending follows the name."""
RESERVED_CHARACTERS = re.compile(r'[<>:"/\\|?*\x00-\x1f]')


@contextlib.contextmanager
def writing(path: Path) -> Iterator[BinaryIO]:
    """A file that appears at `path` complete (flushed, synced, renamed) or, when the block raises, not at all.

    An existing file keeps its permissions; a symbolic link keeps pointing where it points. OSError becomes ValueError.
    """
    check_name(path)
    target = Path(os.path.realpath(path))
    partial = target.with_name(f".{target.name}.{secrets.token_hex(4)}.part")
    try:
        with open(partial, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, partial)
        replace(partial, target)
        sync_folder(target.parent)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        remove(partial)


def write_text(path: Path, text: str) -> None:
    """A UTF-8 file, as `writing` makes it."""
    with writing(path) as file:
        file.write(text.encode())


def replace(source: Path, target: Path) -> None:
    """`os.replace`. On Windows a virus scanner or an indexer holds a new file open for a moment: there it is tried
    again for REPLACE_SECONDS. Raises OSError: the last one."""
    until = time.monotonic() + REPLACE_SECONDS
    while True:
        try:
            os.replace(source, target)
            return
        except PermissionError as error:
            # winerror is absent elsewhere: POSIX renames over open files, so its refusals are final
            if getattr(error, "winerror", None) not in SHARING_ERRORS or time.monotonic() > until:
                raise
        time.sleep(0.02)


def remove(path: Path) -> None:
    """Remove a file that may be missing. Windows removes no file that somebody has open: it stays, without an error."""
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make a rename inside `folder` durable, where the system can do that (Windows opens no folders)."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def check_name(path: Path) -> None:
    """Refuse the name of a new file that this system would take for something else: on Windows NUL.ply is a device that
    swallows what is written, a:b.ply a stream inside the file a, and dots or spaces at the end vanish. Raises
    ValueError."""
    if sys.platform == "win32" and (reason := windows_refuses(path.name)):
        raise ValueError(f"{path}: {reason}; choose another name")


def windows_refuses(name: str) -> str:
    """Why Windows has no ordinary file of this name (without folders), or ""."""
    if RESERVED_NAMES.match(name):
        return "is the name of a device on Windows"
    if match := RESERVED_CHARACTERS.search(name):
        return f"Windows allows no {match.group()!r} in names"
    return "ends in a dot or a space, which Windows drops" if name.endswith((".", " ")) else ""


def clash(a: Path, b: Path) -> bool:
    """Whether two outputs would be one file here or, where they differ in case alone, on Windows and macOS."""
    return os.path.abspath(a).casefold() == os.path.abspath(b).casefold()
