"""The original asset in and out of a project: the file's own bytes, or the rows where there is no file.

Facts of a project: name, format ("rows": no file), sha256, path (absolute; empty: the bytes are in the project),
color_space and antialiased (of rows), frame (that was chosen for its numbers; absent: none was).
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.io import files, frame_of, option, read
from splatpainter.session.deltas import Delta, bare, decode, encode
from splatpainter.splats import Frame, Splats

if TYPE_CHECKING:
    from splatpainter.session.project import Project

PART = 1 << 20
ROWS = "rows"
"""Format of an original that is no file."""


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


def restore(project: Project, at: Path | None = None) -> Splats:
    """The original's rows, with `origin`. at: where the file is now, for projects that hold a path only.
    Raises ValueError: the file is gone, or its bytes are not those that the project was made from."""
    facts = {name: project.fact(name) or "" for name in ("name", "format", "sha256", "path", "color_space")}
    frame = option(project.fact("frame") or "")
    if facts["format"] == ROWS:
        delta = decode((data for _, data in project.original()), f"{project.path}: the original")
        linear, soft = facts["color_space"] == "linear", project.fact("antialiased") == "1"
        splats = replace(delta.appended, color_space="linear" if linear else "srgb", antialiased=soft)
    elif facts["path"]:
        place = at or Path(facts["path"])
        if not place.exists():
            raise ValueError(f"{project.path}: its original {place} is gone; load with original=PATH if it moved")
        splats = read(place, frame=frame, lenient=True)  # the project was made when it opened
    else:
        splats = _unpacked(project, facts["name"], frame)
    if splats.sha256 != facts["sha256"]:
        raise ValueError(f"{project.path}: the original is not the one that the project was made from (sha256 differs)")
    return numbered(splats)


def numbered(splats: Splats) -> Splats:
    """With `origin`: each row its own."""
    return splats if splats.origin is not None else replace(splats, origin=np.arange(len(splats)))


def _unpacked(project: Project, name: str, frame: Frame) -> Splats:
    with tempfile.TemporaryDirectory() as folder:
        for file, data in project.original():
            place = Path(folder) / Path(file).name  # never outside the folder, whatever the project says
            with open(place, "ab") as target:
                target.write(data)
        splats = read(Path(folder) / Path(name).name, frame=frame, lenient=True)
    assert splats.source is not None
    return replace(splats, source=replace(splats.source, path=name))


def _members(path: Path) -> list[Path]:
    """The files of an asset: itself, or meta.json and the planes beside it."""
    if path.is_dir():
        path = path / "meta.json"
    if path.name.lower() != "meta.json":
        return [path]
    return [path, *sorted(own for own in path.parent.iterdir() if own.suffix.lower() == ".webp")]
