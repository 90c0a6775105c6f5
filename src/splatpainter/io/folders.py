"""Folders that mean one asset: what INRIA's trainer and `ns-export` leave. Knows no format."""

from __future__ import annotations

import os
import re
from pathlib import Path

SOG_META = "meta.json"
POINT_CLOUD = "point_cloud"
PLY = "point_cloud.ply"
EXPORTED = ("splat.ply", PLY)
"""Names of an asset that lies in a folder by itself: `ns-export gaussian-splat`, an iteration's folder."""
SPLAT_SUFFIXES = (".ply", ".splat", ".ksplat", ".spz", ".sog", ".glb")
MAX_NAMES_LISTED = 3
"""Files that an error names."""


def iterations(folder: Path) -> dict[int, Path]:
    """Iteration -> its PLY, in rising order, of a folder of INRIA's trainer (or its point_cloud); {} of any other."""
    inner = folder / POINT_CLOUD if os.path.isdir(folder / POINT_CLOUD) else folder
    try:
        numbered = [(re.fullmatch(r"iteration_(\d{1,12})", path.name), path / PLY) for path in inner.iterdir()]
    except OSError:
        return {}
    return dict(sorted((int(match[1]), file) for match, file in numbered if match and os.path.isfile(file)))


def asset_file(path: Path) -> Path:
    """The file that a path means: itself; of a folder of INRIA's trainer the PLY of the last iteration, of an export's
    folder its PLY. A SOG folder stays one. Raises ValueError: a folder of something else, with what it holds."""
    if not os.path.isdir(path) or os.path.isfile(path / SOG_META):  # Path.is_dir raises where it may not look
        return path
    numbered = iterations(path)
    if numbered:
        return numbered[max(numbered)]
    for name in EXPORTED:
        if os.path.isfile(path / name):
            return path / name
    try:
        splats = sorted(file.name for file in path.iterdir() if file.suffix.lower() in SPLAT_SUFFIXES)
    except OSError:
        splats = []
    listed = ", ".join(splats[:MAX_NAMES_LISTED])
    more = f"; it holds {listed}{', ...' if len(splats) > MAX_NAMES_LISTED else ''}: name one of them" if splats else ""
    raise ValueError(
        f"{path}: is a folder without {SOG_META}, {POINT_CLOUD}/iteration_N/{PLY} or {EXPORTED[0]}; expected a splat "
        f"file, a SOG folder, or a folder of INRIA's trainer{more}"
    )
