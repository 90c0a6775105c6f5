"""Folders for a while, and what is left of them, of locks and of half-written files when a process was killed.

A scratch folder holds an open lock (an SQLite lock on an empty file, as in lock.py) as long as its process lives, so
another process can tell whether it is still in use. `sweep_*` remove what nobody uses any more: only names that this
package gives, nothing of another user, no links, and no file that may still be written.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from splatpainter.session.project.database import SUFFIX
from splatpainter.session.project.disk_probe import locks_refused
from splatpainter.session.project.holder import drop_note
from splatpainter.session.project.lock import LOCK_ENDING, ProjectLock

SCRATCH_FOLDER = re.compile(r"splatpainter-(original|session|studio|blobs|verify)-[a-z0-9_]{8}")
"""Names of scratch folders, in the system's folder for temporary files."""
OWNER = f"owner{SUFFIX}"
"""The name whose lock a scratch folder's process holds; there is no such file."""
ATTEMPTS = 20
"""Folders that are made, one after the other, before a scratch folder cannot be had."""
OLD_SECONDS = 24 * 3600.0
"""Age from which files and folders without a lock are left-overs."""
PARTIAL_FILE = re.compile(r"\..+\.[0-9a-f]{8}\.part")
"""Names of files that io.files.writing was killed at."""
PARTIAL_FOLDER = re.compile(r"\..+\.[a-z0-9_]{8}\.part")
"""Names of folders that asset_files.export_asset was killed at."""
PARTIAL_PROJECT = re.compile(rf"\.(.+{re.escape(SUFFIX)})\.part(-wal|-shm|-journal)?")
"""Names of projects that project_file.Project was killed at while it made them."""


class ScratchFolder:
    """A new folder of this process; `close` removes it. Raises ValueError where none can be locked, OSError where none
    can be made."""

    def __init__(self, purpose: str) -> None:
        # Tried again: a sweep of another process may take a new folder for a left-over before it is locked.
        self._lock, failure = None, None
        for _ in range(ATTEMPTS):
            self.path = Path(tempfile.mkdtemp(prefix=f"splatpainter-{purpose}-"))
            try:
                self._lock = ProjectLock.take(self.path / OWNER)
            except ValueError as error:
                failure = error
                if locks_refused(self.path):  # nobody else can lock it either: it is swept once it is old and empty
                    return
            if self._lock is not None:
                return
            # Another process took the new folder for a left-over: it holds the lock, or has removed all of it.
            shutil.rmtree(self.path, ignore_errors=True)
        raise failure or ValueError(f"{self.path}: cannot be locked")

    def close(self) -> None:
        """Remove it and all that is in it. Closing twice does nothing."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None
        shutil.rmtree(self.path, ignore_errors=True)


@contextlib.contextmanager
def scratch_folder(purpose: str) -> Iterator[Path]:
    """A folder for the time of the block."""
    folder = ScratchFolder(purpose)
    try:
        yield folder.path
    finally:
        folder.close()


def sweep_scratch(root: Path | None = None, old_seconds: float = OLD_SECONDS) -> list[str]:
    """Remove scratch folders whose process is gone; the names of those. root: where they lie (default: the system's
    folder for temporary files). Those without a lock are removed when they are old and empty."""
    root, swept = root or Path(tempfile.gettempdir()), []
    for entry in _entries(root):
        if not (SCRATCH_FOLDER.fullmatch(entry.name) and _is_ours(entry) and entry.is_dir(follow_symlinks=False)):
            continue
        # A lock that can be taken says that its process is gone, whatever the age of the folder.
        folder = root / entry.name
        if (folder / (OWNER + LOCK_ENDING)).exists():
            with contextlib.suppress(ValueError, OSError):
                lock = ProjectLock.take(folder / OWNER)
                if lock is None:
                    continue
                lock.release()
                shutil.rmtree(folder, ignore_errors=True)
                swept.append(entry.name)
        elif _is_old(entry, old_seconds):
            with contextlib.suppress(OSError):
                folder.rmdir()
                swept.append(entry.name)
    return swept


def sweep_folder(folder: Path, old_seconds: float = OLD_SECONDS) -> list[str]:
    """Remove what killed processes left in a folder of projects or exports; the names of what was removed. Locks and
    half-made projects go where nobody holds their project's lock; other partial files and folders when they are old."""
    swept = []
    for entry in _entries(folder):
        name, path = entry.name, folder / entry.name
        if not _is_ours(entry):
            continue
        if entry.is_dir(follow_symlinks=False):
            if PARTIAL_FOLDER.fullmatch(name) and _is_old(entry, old_seconds):
                shutil.rmtree(path, ignore_errors=True)
                swept.append(name)
            continue
        if not entry.is_file(follow_symlinks=False):
            continue
        # Under the project's lock, as another process may just be making or opening it.
        half_made = PARTIAL_PROJECT.fullmatch(name)
        if half_made or name.endswith(SUFFIX + LOCK_ENDING):
            project = folder / (half_made[1] if half_made else name.removesuffix(LOCK_ENDING))
            with contextlib.suppress(ValueError, OSError):
                lock = ProjectLock.take(project)
                if lock is not None:
                    try:
                        if half_made:
                            path.unlink(missing_ok=True)
                    finally:
                        drop_note(project)
                        lock.release()  # removes the lock's file
                    swept.append(name)
        elif PARTIAL_FILE.fullmatch(name) and _is_old(entry, old_seconds):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
                swept.append(name)
    return swept


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except OSError:
        return []


def _is_ours(entry: os.DirEntry[str]) -> bool:
    """Whether this user made it; no link."""
    try:
        status = entry.stat(follow_symlinks=False)
    except OSError:
        return False
    user = getattr(os, "getuid", None)  # Windows has none: its folders for temporary files are each user's own
    return not stat.S_ISLNK(status.st_mode) and (user is None or status.st_uid == user())


def _is_old(entry: os.DirEntry[str], seconds: float) -> bool:
    try:
        return time.time() - entry.stat(follow_symlinks=False).st_mtime > seconds
    except OSError:
        return False
