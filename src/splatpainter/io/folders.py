"""Folders that mean one asset: what INRIA's and gsplat's trainers and `ns-export` leave. Knows no format."""

from __future__ import annotations

import os
import re
from pathlib import Path

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


def iterations(folder: Path) -> dict[int, Path]:
    """Iteration -> its PLY, in rising order, of a folder of INRIA's trainer (or its point_cloud) or gsplat's (or its
    ply); {} of any other."""
    for inner, name, below in (
        (POINT_CLOUD, r"iteration_(\d{1,12})", PLY),
        ("ply", r"point_cloud_(\d{1,12})\.ply", ""),
    ):
        holder = folder / inner if os.path.isdir(folder / inner) else folder
        try:
            numbered = [(re.fullmatch(name, path.name), path / below) for path in holder.iterdir()]
        except OSError:
            return {}
        files = sorted((int(match[1]), file) for match, file in numbered if match and os.path.isfile(file))
        if files:
            return dict(files)
    return {}


def asset_file(path: Path) -> Path:
    """The file that a path means: itself; of a trainer's folder the PLY of the last iteration, of an export's its PLY.
    A SOG folder stays one. Raises ValueError: a folder of something else, with what it holds."""
    if not os.path.isdir(path) or os.path.isfile(path / SOG_META):  # Path.is_dir raises where it may not look
        return path
    numbered = iterations(path)
    if numbered:
        return numbered[max(numbered)]
    for name in EXPORTED:
        if os.path.isfile(path / name):
            return path / name
    splats = _splats_in(path)
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
