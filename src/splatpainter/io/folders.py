"""Folders that mean one asset: what INRIA's and gsplat's trainers and `ns-export` leave. Knows no format."""

from __future__ import annotations

import os
import re
from pathlib import Path

from splatpainter.io.foreign_captures import cameras_alone, foreign_capture
from splatpainter.system.quick_dataclass import dataclass

SOG_META = "meta.json"
POINT_CLOUD = "point_cloud"
PLY = "point_cloud.ply"
EXPORTED = ("splat.ply", PLY)
"""Names of an asset that lies in a folder by itself: `ns-export gaussian-splat`, an iteration's folder."""
SPLAT_SUFFIXES = (".ply", ".splat", ".ksplat", ".spz", ".sog", ".glb")


@dataclass(frozen=True)
class FolderLimits:
    """How assets are looked for in a folder that means none. Source: taste."""

    names: int = 3
    """Files that an error names."""
    levels: int = 3
    """How deep they are looked for."""
    folders: int = 200
    """In how many folders."""


FOLDERS = FolderLimits()


def inside(folder: Path, name: str) -> Path:
    """The file or folder of that name, where there is none the only one that is called so but for capitals (as disks of
    Windows and Macs take it); the path under the name itself where there is neither."""
    path = folder / name
    if not os.path.exists(path) and os.path.isdir(folder):
        alike = [entry for entry in os.listdir(folder) if entry.lower() == name.lower()]
        if len(alike) == 1:
            return folder / alike[0]
    return path


def iterations(folder: Path) -> dict[int, Path]:
    """Iteration -> its PLY, in rising order, of a folder of INRIA's trainer (or its point_cloud) or gsplat's (or its
    ply); {} of any other."""
    for inner, name, below in (
        (POINT_CLOUD, r"iteration_(\d{1,12})", PLY),
        ("ply", r"point_cloud_(\d{1,12})\.ply", ""),
    ):
        try:
            holder = inside(folder, inner) if os.path.isdir(inside(folder, inner)) else folder
            numbered = [(re.fullmatch(name, path.name, re.IGNORECASE), path) for path in holder.iterdir()]
            candidates = [(int(match[1]), inside(path, below) if below else path) for match, path in numbered if match]
        except OSError:
            return {}
        files = sorted((number, file) for number, file in candidates if os.path.isfile(file))
        if files:
            return dict(files)
    return {}


def trained_file(folder: Path) -> Path | None:
    """The PLY that a trainer's folder means: of the last iteration; where none has a number, of the only one
    (`iteration_best`, as some trainers call theirs). None of any other folder."""
    numbered = iterations(folder)
    if numbered:
        return numbered[max(numbered)]
    holder = inside(folder, POINT_CLOUD)
    try:
        named = [inside(path, PLY) for path in holder.iterdir() if path.name.lower().startswith("iteration_")]
    except OSError:
        return None
    files = [file for file in named if os.path.isfile(file)]
    return files[0] if len(files) == 1 else None


def asset_file(path: Path) -> Path:
    """The file that a path means: itself; of a trainer's folder the PLY of the last iteration, of an export's its PLY.
    A SOG folder stays one (by its file, where that is not called as the format says). Raises ValueError: a folder of
    something else, with what it holds."""
    if not os.path.isdir(path) or os.path.isfile(path / SOG_META):  # Path.is_dir raises where it may not look
        return path
    meta = inside(path, SOG_META)
    trained = meta if os.path.isfile(meta) else trained_file(path)
    if trained is not None:
        return trained
    for name in EXPORTED:
        if os.path.isfile(inside(path, name)):
            return inside(path, name)
    splats = _splats_in(path)
    if not splats and (foreign := foreign_capture(path)):
        raise ValueError(f"{path}: is {foreign}; expected a splat file, or a folder of INRIA's trainer")
    if not splats and (cameras := cameras_alone(path)):
        raise ValueError(f"{path}: {cameras}")
    listed = ", ".join(splats[: FOLDERS.names])
    more = f"; it holds {listed}{', ...' if len(splats) > FOLDERS.names else ''}: name one of them" if splats else ""
    raise ValueError(
        f"{path}: is a folder without {SOG_META}, {POINT_CLOUD}/iteration_N/{PLY} or {EXPORTED[0]}; expected a splat "
        f"file, a SOG folder, or a folder of INRIA's trainer{more}"
    )


def _splats_in(path: Path) -> list[str]:
    """Names of what could be meant by a folder: splat files in it; without any, those in the folders below it, and SOG
    folders."""
    names_below: list[str] = []
    for looked, (folder, inner, names) in enumerate(os.walk(path)):
        below = Path(folder).relative_to(path)
        if looked >= FOLDERS.folders:
            break
        names_below += [
            (below / name).as_posix() for name in sorted(names) if Path(name).suffix.lower() in SPLAT_SUFFIXES
        ]
        names_below += [below.as_posix()] if SOG_META in names else []
        if names_below and not below.parts:
            break
        inner.sort()
        if len(below.parts) >= FOLDERS.levels:
            inner.clear()
    return names_below
