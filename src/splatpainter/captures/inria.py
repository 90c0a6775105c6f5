"""The folder that INRIA's trainer (and those made from it) leaves: cameras.json, cfg_args; where the asset lies in it
is for io/folders.py to say."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.captures.captured_view import CapturedView, posed_camera, rigid
from splatpainter.io import files
from splatpainter.kernels.portable import determinant
from splatpainter.system.jsonio import brief, finite_numbers, load_object
from splatpainter.system.quick_dataclass import dataclass

CAMERAS = "cameras.json"
ARGUMENTS = "cfg_args"
INPUT_POINTS = "input.ply"
"""The points that the trainer started from, in the cameras' world."""
EXPOSURES = "exposure.json"
MAX_ARGUMENT_BYTES = 1 << 16
"""Of cfg_args; it is one line."""
MAX_EXPOSURE_BYTES = 64 << 20
"""Of exposure.json: 300 bytes a photograph."""
MIN_EXPOSURE = 1e-3
"""Least determinant of an exposure's colours that is undone: a tenth in each channel."""


@dataclass(frozen=True)
class TrainingArguments:
    """What cfg_args says that matters here."""

    source: Path | None = None
    """The folder that was trained on, as it was called on the machine that did."""
    images: str = "images"
    """The folder of pictures in it."""
    white: bool = False
    """Whether the background was white; else black."""


def training_arguments(folder: Path) -> TrainingArguments:
    """What a folder's cfg_args says; the trainer's defaults where there is none or it cannot be read. It is Python
    text, `Namespace(name=value, ...)`, of which literals are taken and nothing is run."""
    try:
        text = files.read_head(folder / ARGUMENTS, MAX_ARGUMENT_BYTES).decode("utf-8")
        # The repr of a Namespace: parsed as syntax, never evaluated.
        call = ast.parse(text.strip(), mode="eval").body
        keywords = call.keywords if isinstance(call, ast.Call) else []
        values = {word.arg: word.value.value for word in keywords if isinstance(word.value, ast.Constant)}
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        return TrainingArguments()
    source, images = values.get("source_path"), values.get("images")
    return TrainingArguments(
        _folder(source) if isinstance(source, str) and source else None,
        _folder(images).as_posix() if isinstance(images, str) and images else "images",
        values.get("white_background") is True,
    )


def _folder(text: str) -> Path:
    """A folder as the trainer's machine called it; Windows's name for one has parts on other systems, too."""
    return Path(text.replace("\\", "/"))


def read_cameras(path: Path, entries: list[Any]) -> list[CapturedView]:
    """The views of a cameras.json, which is a list of objects. Positions are the cameras' centres and rotations camera
    to world, in OpenCV's axes; the principal point is the middle, but where cx and cy say it, as forks of the trainer
    write. Raises ValueError naming the entry and the key."""
    arguments = training_arguments(path.parent)
    folders = [path.parent]
    if arguments.source is not None:
        # The path of the machine that trained; the same folder nearer by, where it was moved; one that was named from
        # the trainer's own folder, in which outputs lie.
        above = path.absolute().parents[:3]
        sources = [arguments.source, *(one / arguments.source.name for one in above)]
        sources += [one / arguments.source for one in above] if not arguments.source.is_absolute() else []
        names = dict.fromkeys((arguments.images, "images", ""))
        folders = [source / name for source in sources for name in names]
    background = (1.0, 1.0, 1.0) if arguments.white else (0.0, 0.0, 0.0)
    return [_view(f"{path}: camera {k}", entry, tuple(folders), background) for k, entry in enumerate(entries)]


def read_exposures(path: Path) -> dict[str, np.ndarray]:
    """Photograph -> [3, 4] e of an exposure.json, as the trainer writes it beside cameras.json: colours of the
    photograph are the asset's @ e[:, :3] + e[:, 3]. {} where there is none; those that change nothing are left out.
    Raises ValueError naming the entry: no 3x4 matrix of finite numbers, one that cannot be undone."""
    if not path.is_file():
        return {}
    record = load_object(files.read_all(path), path, "the photographs' exposures", MAX_EXPOSURE_BYTES)
    out: dict[str, np.ndarray] = {}
    for name, value in record.items():
        where = f"{path}: {files.printable(name, 60)}"
        listed = isinstance(value, list) and len(value) == 3 and all(isinstance(row, list) for row in value)
        rows = [finite_numbers(row, where, "a row") for row in value] if listed else []
        if {len(row) for row in rows} != {4}:
            raise ValueError(f"{where}: expected a 3x4 matrix of its exposure, got {brief(value)}")
        exposure = np.array(rows, np.float64)
        if not determinant(exposure[:, :3]) > MIN_EXPOSURE:
            raise ValueError(f"{where}: expected an exposure that keeps colours apart, got {brief(value)}")
        if not np.array_equal(exposure, np.eye(3, 4)):
            out[name] = exposure
    return out


def _view(where: str, entry: Any, folders: tuple[Path, ...], background: tuple[float, float, float]) -> CapturedView:
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: expected an object, got {brief(entry)}")
    missing = [key for key in ("width", "height", "fx", "fy", "position", "rotation") if key not in entry]
    if missing:
        raise ValueError(f"{where}: has no {', '.join(missing)}; expected cameras.json as INRIA's trainer writes it")
    width, height, fx, fy = finite_numbers([entry[key] for key in ("width", "height", "fx", "fy")], where, "its size")
    rotation = entry["rotation"]
    if not isinstance(rotation, list) or len(rotation) != 3:
        raise ValueError(f"{where}: expected a 3x3 rotation, got {brief(rotation)}")
    rows = [finite_numbers(row, where, "rotation") for row in rotation]
    position = finite_numbers(entry["position"], where, "position")
    if {len(row) for row in rows} != {3} or len(position) != 3:
        raise ValueError(f"{where}: expected a 3x3 rotation and a position of 3 numbers")
    # cameras.json holds camera to world: rotation's columns are the camera's axes.
    pose = np.concatenate([np.array(rows), position[:, None]], 1)
    size = int(width), int(height)
    center = [
        entry.get(key) if entry.get(key) is not None else side / 2 for key, side in zip(("cx", "cy"), size, strict=True)
    ]
    cx, cy = finite_numbers(center, where, "its principal point")
    camera = posed_camera(where, size, (fx, fy), (cx, cy), rigid(pose, where), background)
    name = entry.get("img_name")
    return CapturedView(name if isinstance(name, str) else "", camera, None, folders)
