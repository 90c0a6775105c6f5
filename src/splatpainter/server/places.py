"""Where the studio reads and writes: the one folder given at start, its own folder of projects, and a scratch folder.

Names from clients are plain file names, looked up in these folders; what they resolve to must lie inside.
"""

from __future__ import annotations

import os
import re
import secrets
import time
from collections import OrderedDict
from dataclasses import dataclass, field
from pathlib import Path

from splatpainter.io import files, format_of_name

PROJECT = ".splatproj"
DOWNLOADS = 16
"""Exported files that are kept for their download."""


class Folder:
    """A folder whose files clients may name."""

    def __init__(self, root: Path) -> None:
        """Raises ValueError where it is no folder."""
        if not root.is_dir():
            raise ValueError(f"{root}: no such folder; make it first, or give another --folder")
        self.root = root.resolve()

    def file(self, name: str, *, new: bool = False) -> Path:
        """The file of that name. Raises ValueError: no plain name, hidden, outside (a link), missing."""
        if not name or name.startswith(".") or Path(name).name != name or re.search(r"[/\\:\x00-\x1f]", name):
            raise ValueError(f"{name!r}: expected a plain file name")
        try:
            place = (self.root / name).resolve()
        except (OSError, RuntimeError):  # a circle of links
            raise ValueError(f"{name}: leads nowhere") from None
        if place.parent != self.root:
            raise ValueError(f"{name}: lies outside the studio's folder")
        if not new and not place.is_file():
            raise ValueError(f"{name}: no such file in the studio's folder {self.root.name}")
        return place

    def names(self) -> list[str]:
        """Assets and projects in it, by name."""
        found = [entry.name for entry in os.scandir(self.root) if entry.is_file() and not entry.name.startswith(".")]
        found = [name for name in found if name.isprintable()]  # others are no text that could be sent
        return sorted(name for name in found if name.lower().endswith(PROJECT) or format_of_name(Path(name)))


@dataclass(frozen=True)
class Kept:
    """A project in the studio's own folder."""

    id: str
    name: str
    path: Path
    changed: float


class Projects:
    """Projects that have no place of their own yet: everything is always saved, wherever it is."""

    def __init__(self, root: Path) -> None:
        """Raises ValueError where it cannot be made."""
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"{root}: cannot be made ({error.strerror or error})") from None
        self.root = root

    def fresh(self, name: str) -> Path:
        """A file name for a new project about something called `name`."""
        stem = re.sub(r"[^\w-]+", "-", Path(name).name.split(".")[0]).strip("-")[:40] or "asset"
        stamp = time.strftime("%Y%m%d-%H%M%S")
        return self.root / f"{stem}_{stamp}-{secrets.token_hex(2)}{PROJECT}"

    def kept(self) -> list[Kept]:
        """Newest first."""
        out = []
        for path in self.root.glob(f"*{PROJECT}"):
            if not path.name.startswith(".") and path.is_file():
                out.append(Kept(path.stem, path.stem.rsplit("_", 1)[0], path, path.stat().st_mtime))
        return sorted(out, key=lambda kept: -kept.changed)

    def find(self, id: str) -> Path:
        """Raises ValueError for an unknown one."""
        for kept in self.kept():
            if kept.id == id:
                return kept.path
        raise ValueError(f"project {id!r}: not among the recent ones (any more)")


@dataclass
class Downloads:
    """Files made for a download, by a secret key."""

    root: Path
    _files: OrderedDict[str, Path] = field(default_factory=OrderedDict)

    def folder(self) -> Path:
        """A new folder for one export."""
        place = self.root / secrets.token_hex(8)
        place.mkdir(parents=True)
        return place

    def add(self, path: Path) -> str:
        """The address to download it from; the oldest goes where there are too many."""
        key = secrets.token_urlsafe(16)
        self._files[key] = path
        while len(self._files) > DOWNLOADS:
            _, oldest = self._files.popitem(last=False)
            files.remove(oldest)  # Windows: not while it is sent
        return f"/api/files/{key}/{path.name}"

    def find(self, key: str, name: str) -> Path:
        """Raises ValueError for an unknown one."""
        path = self._files.get(key)
        if path is None or path.name != name or not path.is_file():
            raise ValueError("download: not here (any more); export it again")
        return path
