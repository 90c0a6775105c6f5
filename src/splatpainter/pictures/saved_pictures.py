"""Pictures that somebody saves into a folder or one in it, found by looking every moment: nothing is installed for it,
and network folders, which send no events, work as well."""

from __future__ import annotations

import contextlib
import stat
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

from splatpainter.pictures.picture_reader import PICTURE_SUFFIXES

QUIET_SECONDS = 0.3
"""Without a change, after which a file counts as saved."""
LOOK_SECONDS = 0.1
"""Seconds between looks at a folder."""
MAX_FILES = 10_000
"""Most files of a folder that is watched."""
MAX_LEVELS, MAX_FOLDERS = 3, 100
"""How deep folders in it are looked into, and how many: programs save into one of their own (export, final/web);
somebody may have a whole disk watched."""
Signature: TypeAlias = tuple[int, int, int]
"""(nanoseconds of its last change, bytes, inode) of a file."""


class SavedPictures:
    """What was saved in a folder, or in the first MAX_FOLDERS in it, since this was made, or since `seen`."""

    def __init__(
        self,
        folder: Path,
        quiet_seconds: float = QUIET_SECONDS,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Raises ValueError: no folder, or one that cannot be read."""
        self.folder = folder
        self._quiet_seconds, self._clock = quiet_seconds, clock
        # What is there already was not saved since.
        self._seen = self._signatures()
        self._changing: dict[str, tuple[Signature, float]] = {}

    def seen(self, path: Path) -> None:
        """What that file holds now was not saved by somebody else."""
        if (signature := _signature(path)) is not None:
            self._seen[self.name_of(path)] = signature

    def name_of(self, path: Path) -> str:
        """A file's name in the folder, with those of the folders between."""
        return path.relative_to(self.folder).as_posix()

    def take(self) -> list[Path]:
        """Files that were saved and are quiet since, in order of their change; each once per save. Raises ValueError as
        `__init__`."""
        now, saved = self._clock(), []
        current = self._signatures()
        for name in [name for name in self._changing if name not in current]:
            del self._changing[name]
        for name, signature in current.items():
            if self._seen.get(name) == signature:
                self._changing.pop(name, None)
                continue
            # Programs write in several steps: a file counts once it has been quiet for a while.
            before, since = self._changing.get(name, (None, now))
            if before != signature:
                self._changing[name] = (signature, now)
            elif now - since >= self._quiet_seconds:
                self._seen[name] = signature
                del self._changing[name]
                saved.append((signature, self.folder / name))
        # A file that went and comes back under its name is a new save.
        self._seen = {name: signature for name, signature in self._seen.items() if name in current}
        return [path for _, path in sorted(saved)]

    def _signatures(self) -> dict[str, Signature]:
        signatures: dict[str, Signature] = {}
        try:
            inner = self._look(self.folder, signatures)
        except OSError as error:
            raise ValueError(f"{self.folder}: cannot be watched ({error.strerror or error})") from None
        if len(signatures) > MAX_FILES:
            raise ValueError(f"{self.folder}: expected at most {MAX_FILES:,} pictures in a folder to watch")
        # Folder by folder outwards, so that those nearby are looked into first; one that cannot be is none.
        left = MAX_FOLDERS
        for _ in range(MAX_LEVELS):
            level, inner = inner[:left], []
            left -= len(level)
            for folder in level:
                with contextlib.suppress(OSError):
                    inner += self._look(folder, signatures)
        return signatures

    def _look(self, folder: Path, signatures: dict[str, Signature]) -> list[Path]:
        """Add the pictures of a folder; returns the folders in it. Links lead elsewhere, or in circles. Raises OSError:
        it cannot be read."""
        inner = []
        for path in folder.iterdir():
            if path.name.startswith(".") or len(signatures) > MAX_FILES:
                continue
            if path.suffix.lower() in PICTURE_SUFFIXES:
                if (signature := _signature(path)) is not None:
                    signatures[self.name_of(path)] = signature
            elif path.is_dir() and not path.is_symlink():
                inner.append(path)
        return sorted(inner)


def _signature(path: Path) -> Signature | None:
    """None for what is gone or no regular file."""
    try:
        status = path.stat()
    except OSError:
        return None
    return (status.st_mtime_ns, status.st_size, status.st_ino) if stat.S_ISREG(status.st_mode) else None
