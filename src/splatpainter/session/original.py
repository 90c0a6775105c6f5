"""The original asset in and out of a project: the file's own bytes, or the rows where there is no file.

A project that only names its original could name any file of the machine: `OriginalRule` says which of them may be
opened. What is opened is a regular file, or a folder of them.

Facts of a project: name, format ("rows": no file), sha256, path (absolute; empty: the bytes are in the project),
color_space and antialiased (of rows), frame (that was chosen for its numbers; absent: none was).
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.io import files, frame_of, option, read
from splatpainter.session.deltas import Delta, bare, decode, encode
from splatpainter.session.scratch import scratch_folder
from splatpainter.splats import Frame, Splats

if TYPE_CHECKING:
    from splatpainter.session.project import Project

PART = 1 << 20
ROWS = "rows"
"""Format of an original that is no file."""
DEVICE = r"con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9\u00b9\u00b2\u00b3]"
"""Names, up to the first dot, that stand for devices on Windows."""


@dataclass(frozen=True)
class OriginalRule:
    """Which file may be opened as the original of a project that names one instead of holding its bytes."""

    at: Path | None = None
    """The file, said by whoever opens the project: then nothing that the project names is opened."""
    embedded: bool = False
    """None: the project has to hold the bytes."""
    folder: Path | None = None
    """Only what lies in this folder, links followed; None: any file of this machine."""


ANY_FILE = OriginalRule()
"""Of projects that their user opens by name."""


def file_of(splats: Splats) -> Path | None:
    """The file whose rows these still are, if it is still there and the same."""
    if splats.source is None or splats.sha256 != splats.source.sha256:
        return None
    path = Path(splats.source.path)
    try:
        if path.is_dir() or path.name.lower() == "meta.json":
            return path if read(path).sha256 == splats.sha256 else None
        digest = hashlib.sha256()
        with files.reading(path) as file:
            while piece := file.read(PART):
                digest.update(piece)
        return path if digest.hexdigest() == splats.sha256 else None
    except ValueError:
        return None


def describe(splats: Splats, path: Path | None, embed: bool) -> dict[str, str]:
    """The facts of a project about its original. path: its file, if it has one that still holds these rows."""
    facts = {"sha256": splats.sha256, "color_space": splats.color_space, "antialiased": str(int(splats.antialiased))}
    if path is None or splats.source is None:
        return {**facts, "name": "asset", "format": ROWS, "path": ""}
    if frame_of(splats) != "auto":
        facts["frame"] = frame_of(splats)
    name = "meta.json" if path.is_dir() else path.name
    return {**facts, "name": name, "format": splats.source.format, "path": "" if embed else str(path.absolute())}


def pieces(splats: Splats, path: Path | None) -> Iterator[tuple[str, bytes]]:
    """(file name, bytes) to be kept in the project, a piece at a time."""
    if path is None:
        none = np.zeros(0, np.int64)
        empty = bare(splats.take(none))
        whole = Delta(0, none, empty, bare(splats), np.full(len(splats), -1, np.int64))
        yield from ((ROWS, part) for part in encode(whole))
        return
    for file in _members(path):
        with files.reading(file) as source:
            yield file.name, b""  # an empty file is a file too
            while piece := source.read(PART):
                yield file.name, piece


def restore(project: Project, rule: OriginalRule) -> Splats:
    """The original's rows, with `origin`. rule: what may be opened where the project does not hold the bytes.
    Raises ValueError: the file is gone or may not be opened, its bytes are not those that the project was made from,
    none of its rows can be drawn."""
    facts = {name: project.fact(name) or "" for name in ("name", "format", "sha256", "path", "color_space")}
    frame = option(project.fact("frame") or "")
    if facts["format"] == ROWS:
        delta = decode((data for _, data in project.original()), f"{project.path}: the original")
        linear, soft = facts["color_space"] == "linear", project.fact("antialiased") == "1"
        splats = replace(delta.appended, color_space="linear" if linear else "srgb", antialiased=soft)
    elif facts["path"]:
        # Lenient: the project was made when it opened.
        splats = read(_named_file(project.path, facts["path"], rule), frame=frame, lenient=True)
    else:
        splats = _unpacked(project, facts["name"], frame)
    if splats.sha256 != facts["sha256"]:
        raise ValueError(f"{project.path}: the original is not the one that the project was made from (sha256 differs)")
    if not splats.drawable.any():
        raise ValueError(f"{project.path}: none of the {len(splats)} rows of its original can be drawn")
    return numbered(splats)


def _named_file(project: Path, name: str, rule: OriginalRule) -> Path:
    """The original that a project names by `name`. Nothing is looked up before the name has been judged, so that what
    is refused tells nothing about the machine."""
    if rule.at is not None:
        place = rule.at
    elif rule.embedded:
        raise ValueError(
            f"{project}: names a file as its original and does not hold it; save it with embed=True, then send it"
        )
    elif rule.folder is not None:
        place = _inside(project, name, rule.folder)
    elif not is_local_path(name):
        raise ValueError(f"{project}: its original is named by a network or device path; load with original=PATH")
    else:
        place = Path(name)
    try:
        mode = place.stat().st_mode
    except (OSError, ValueError):
        raise ValueError(f"{project}: its original {place} is gone; load with original=PATH if it moved") from None
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise ValueError(f"{project}: its original {place} is neither a file nor a folder; load with original=PATH")
    return place


def _inside(project: Path, name: str, folder: Path) -> Path:
    """What `name` stands for below `folder`. Raises ValueError, the same one whether it exists or not."""
    outside = ValueError(
        f"{project}: its original lies outside the folder {folder.name}; put both into it, or save it with embed=True"
    )
    root = folder.resolve()
    path = Path(name)
    if path.is_absolute():
        if not path.is_relative_to(root):
            raise outside
        path = path.relative_to(root)
    if not path.parts or not all(is_plain_name(part) for part in path.parts):
        raise outside
    try:
        place = (root / path).resolve()
    except (OSError, RuntimeError):  # a circle of links
        raise outside from None
    if not place.is_relative_to(root):
        raise outside
    return place


def is_plain_name(name: str, windows: bool = os.name == "nt") -> bool:
    """Whether a name stands for an entry of its folder and nothing else. windows: also of a folder there, where colons
    name streams and drives, and some words devices."""
    if name in ("", ".", "..") or re.search(r"[/\\\x00-\x1f]", name):
        return False
    if not windows:
        return True
    device = re.fullmatch(DEVICE, name.split(".")[0].rstrip(), re.IGNORECASE)
    return not (":" in name or name[-1] in " ." or device)


def is_local_path(name: str, windows: bool = os.name == "nt") -> bool:
    """Whether a path names a file of this machine: no share of another one (opening it would send that one this user's
    credentials), no device."""
    if not windows:
        return PurePosixPath(name).is_absolute()
    drive = PureWindowsPath(name).drive
    return re.fullmatch(r"[A-Za-z]:", drive) is not None and PureWindowsPath(name).is_absolute()


def numbered(splats: Splats) -> Splats:
    """With `origin`: each row its own."""
    return splats if splats.origin is not None else replace(splats, origin=np.arange(len(splats)))


def _unpacked(project: Project, name: str, frame: Frame) -> Splats:
    if not is_plain_name(name):
        raise ValueError(f"{project.path}: damaged project file (name of the original {name[:40]!r})")
    with scratch_folder("original") as folder:
        try:
            for file, data in project.original():
                if not is_plain_name(file):
                    raise ValueError(f"{project.path}: damaged project file (name of the original {file[:40]!r})")
                with open(folder / file, "ab") as target:
                    target.write(data)
            splats = read(folder / name, frame=frame, lenient=True)
        except OSError as error:
            raise ValueError(f"{project.path}: its original cannot be unpacked ({error.strerror or error})") from None
        except ValueError as error:
            raise ValueError(str(error).replace(f"{folder}{os.sep}", "")) from None
    assert splats.source is not None
    return replace(splats, source=replace(splats.source, path=name))


def _members(path: Path) -> list[Path]:
    """The files of an asset: itself, or meta.json and the planes beside it."""
    if path.is_dir():
        path = path / "meta.json"
    if path.name.lower() != "meta.json":
        return [path]
    return [path, *sorted(own for own in path.parent.iterdir() if own.suffix.lower() == ".webp")]
