"""Captures where splats are wanted: which program's a file or folder is, and what to do.

Known by names and first bytes. Of those whose cameras are not read each has a command of nerfstudio's that makes a
transforms.json of it, which is read. The asset was then trained in that one's world: these files' own cameras may stand
in another.
"""

from __future__ import annotations

import itertools
import os
from pathlib import Path

from splatpainter.io.files import read_head

MAX_ENTRIES = 1000
"""Entries of a folder that are looked at."""
HEAD_BYTES = 4096
"""Bytes of a file that are looked at."""
REMEDY = "is not read; `ns-process-data {}` of nerfstudio makes a transforms.json of it, which is"
METASHAPE = "a capture of Metashape", "metashape"
REALITY = "a capture of RealityCapture or RealityScan", "realitycapture"
POLYCAM = "raw data of Polycam", "polycam"
RECORD3D = "a capture of Record3D", "record3d"
DRONE_MAP = "a project of OpenDroneMap", "odm"

NERFSTUDIO_RUN = (
    "a run of nerfstudio, whose splats are in a checkpoint; `ns-export gaussian-splat --load-config {} --output-dir "
    "DIR` makes a splat file of it"
)
NERFSTUDIO_CONFIG, NERFSTUDIO_CHECKPOINTS = "config.yml", "nerfstudio_models"

CAMERA_LISTS = ("cameras.json", "transforms.json", "transforms_train.json", "camera_path.json")
COLMAP_STEMS = ("cameras", "images", "points3D", "rigs", "frames")
COLMAP_IMAGES = ("images.bin", "images.txt")
COLMAP_FOLDERS = ("", "sparse", "sparse/0", "colmap/sparse/0", "distorted/sparse/0", "0")
"""Of cameras that are read here (captures/)."""


def foreign_capture(path: Path) -> str:
    """What a file or folder is and what to do, words for "PATH: is ..."; "" where it is none of these, or cannot be
    looked at."""
    try:
        if run := nerfstudio_run(path):
            return run
        program = _of_folder(path) if os.path.isdir(path) else _of_file(path) if os.path.isfile(path) else None
    except (OSError, ValueError):
        return ""
    return f"{program[0]}, which {REMEDY.format(program[1])}" if program else ""


def cameras_alone(path: Path) -> str:
    """What a file or folder is that holds cameras which are read here and no splats, and what to do with it, words for
    "PATH: ..."; "" of any other."""
    if os.path.isdir(path):
        colmap = any(os.path.isfile(path / inner / name) for inner in COLMAP_FOLDERS for name in COLMAP_IMAGES)
        listed = colmap or any(os.path.isfile(path / name) for name in CAMERA_LISTS)
        verb, folder = "has", path
    else:
        colmap = path.stem in COLMAP_STEMS and path.suffix in (".bin", ".txt")
        listed = colmap or path.name in CAMERA_LISTS
        verb, folder = "is of", path.parent
    if not listed:
        return ""
    whose = "COLMAP's cameras" if colmap else "cameras of a capture"
    return (
        f"{verb} {whose} and no splats; name the splat file, and this as --camera, or make splats of the photographs: "
        f"splatpainter fit {folder} --out NAME.ply"
    )


def nerfstudio_run(path: Path) -> str:
    """What to do with a run of nerfstudio's trainer (its folder, its folder of checkpoints, or its config.yml), words
    for "PATH: is ..."; "" of anything else."""
    run = path.parent if path.name in (NERFSTUDIO_CONFIG, NERFSTUDIO_CHECKPOINTS) else path
    config = run / NERFSTUDIO_CONFIG
    if not os.path.isfile(config) or b"nerfstudio." not in read_head(config, HEAD_BYTES):
        return ""
    return NERFSTUDIO_RUN.format(config)


def _of_file(path: Path) -> tuple[str, str] | None:
    suffix = path.suffix.lower()
    if suffix == ".psx":
        return METASHAPE
    if suffix == ".rcproj":
        return REALITY
    if suffix == ".r3d":
        return RECORD3D
    if suffix not in (".xml", ".csv", ".xmp", ".json", ""):
        return None
    head = read_head(path, HEAD_BYTES)
    if suffix == ".xml":
        return METASHAPE if b"<document" in head and b"<chunk" in head else None
    if suffix == ".xmp":
        return REALITY if b"xcr:" in head else None
    if suffix == ".csv":
        first = head.partition(b"\n")[0].lower()
        return REALITY if first.startswith(b"#") and b"name" in first and b"heading" in first else None
    if suffix == ".json":
        return POLYCAM if b'"t_00"' in head and b'"t_23"' in head else None
    return RECORD3D if path.name == "metadata" and head[:1] == b"{" and b'"' in head and _has_poses(path) else None


def _has_poses(path: Path) -> bool:
    return os.path.isdir(path.parent / "rgbd") or os.path.isdir(path.parent / "rgb")


def _of_folder(path: Path) -> tuple[str, str] | None:
    for folder in (path, path / "keyframes"):
        if any(os.path.isdir(folder / name) for name in ("corrected_cameras", "corrected_images")):
            return POLYCAM
    if os.path.isdir(path / "opensfm") or os.path.isdir(path / "odm_report"):
        return DRONE_MAP
    if os.path.isfile(path / "metadata") and _has_poses(path / "metadata"):
        return RECORD3D
    with os.scandir(path) as entries:
        names = [entry.name for entry in itertools.islice(entries, MAX_ENTRIES)]
    # Of many sidecar files one says it for all.
    for suffix in (".psx", ".rcproj", ".r3d", ".xml", ".csv", ".xmp"):
        first = next((name for name in sorted(names) if name.lower().endswith(suffix)), None)
        program = None if first is None else _of_file(path / first)
        if program is not None:
            return program
    cameras = path / "keyframes" / "cameras"
    first = next(iter(sorted(os.listdir(cameras))), None) if os.path.isdir(cameras) else None
    return None if first is None else _of_file(cameras / first)
