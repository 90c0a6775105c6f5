"""COLMAP's sparse models: cameras, images and points3D, as .bin or .txt (COLMAP's documentation, "Output Format").

Pixels count from the picture's corner, centres at .5, poses are world to camera in OpenCV's axes: as here.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import BinaryIO

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.captures.captured_view import CapturedView, posed_camera
from splatpainter.captures.lenses import (
    DivisionLens,
    FieldOfViewLens,
    Lens,
    PolynomialLens,
    UnifiedLens,
    lens_or_none,
)
from splatpainter.io import files
from splatpainter.kernels.portable import length
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix

MODEL_FOLDERS = (
    *("", "0", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "distorted/sparse/0", "distorted/sparse"),
    *("dense/0/sparse", "dense/sparse", "dense/0/sparse/0", "0/sparse"),
)
"""Where a model lies in a folder: COLMAP's workspaces, INRIA's and nerfstudio's data; straightened ones (`dense`, of
image_undistorter) only where no other is left."""
MODELS_FOLDERS = ("sparse", "colmap/sparse", "distorted/sparse")
"""Where COLMAP puts the models of photographs that it could not join into one, each in a folder of its number."""
MASKS = "masks"
"""Of the photographs, beside their folder."""
MODEL_FILES = tuple(
    f"{name}.{ending}" for name in ("cameras", "images", "points3D", "rigs", "frames") for ending in ("bin", "txt")
)
"""Of a model; rigs and frames since COLMAP 3.12: the images' own poses say the same."""
MAX_CAMERAS = 1 << 20
MAX_NAME_BYTES = 4096
"""Of a picture's name."""
MAX_LINE_BYTES = 64 << 20
"""Of a text file: an image's line of points can be long."""
POINT_BYTES = 43
"""Of a point without its track."""


@dataclass(frozen=True)
class ColmapModel:
    """One of COLMAP's camera models."""

    name: str
    parameters: int
    lens: Callable[[tuple[float, ...]], Lens | None] | None
    """From the numbers behind the intrinsics; None: no photograph that a pinhole camera could have taken."""
    focals: int = 2
    """1: one focal length for both axes."""


def _none(_: tuple[float, ...]) -> None:
    return None


def _radial(k: tuple[float, ...]) -> Lens | None:
    return lens_or_none(PolynomialLens(k))


def _fisheye(k: tuple[float, ...]) -> Lens | None:
    return PolynomialLens(k, fisheye=True)


def _thin_prism(p: tuple[float, ...]) -> Lens:
    return PolynomialLens((*p[:2], *p[4:6]), (p[2], p[3]), prism=(p[6], 0.0, p[7], 0.0), fisheye=True)


def _aria(p: tuple[float, ...]) -> Lens:
    return PolynomialLens(p[:6], (p[7], p[6]), prism=(p[8], p[9], p[10], p[11]), fisheye=True, radial_first=True)


MODELS: dict[int, ColmapModel] = {
    0: ColmapModel("SIMPLE_PINHOLE", 3, _none, 1),
    1: ColmapModel("PINHOLE", 4, _none),
    2: ColmapModel("SIMPLE_RADIAL", 4, _radial, 1),
    3: ColmapModel("RADIAL", 5, _radial, 1),
    4: ColmapModel("OPENCV", 8, lambda p: lens_or_none(PolynomialLens(p[:2], (p[2], p[3])))),
    5: ColmapModel("OPENCV_FISHEYE", 8, _fisheye),
    6: ColmapModel("FULL_OPENCV", 12, lambda p: lens_or_none(PolynomialLens((*p[:2], p[4]), (p[2], p[3]), p[5:8]))),
    7: ColmapModel("FOV", 5, lambda p: FieldOfViewLens(p[0]) if abs(p[0]) > 1e-6 else None),
    8: ColmapModel("SIMPLE_RADIAL_FISHEYE", 4, _fisheye, 1),
    9: ColmapModel("RADIAL_FISHEYE", 5, _fisheye, 1),
    10: ColmapModel("THIN_PRISM_FISHEYE", 12, _thin_prism),
    11: ColmapModel("RAD_TAN_THIN_PRISM_FISHEYE", 16, _aria),
    12: ColmapModel("SIMPLE_DIVISION", 4, lambda p: DivisionLens(p[0]) if p[0] else None, 1),
    13: ColmapModel("DIVISION", 5, lambda p: DivisionLens(p[0]) if p[0] else None),
    14: ColmapModel("SIMPLE_FISHEYE", 3, _fisheye, 1),
    15: ColmapModel("FISHEYE", 4, _fisheye),
    16: ColmapModel("EUCM", 6, lambda p: UnifiedLens(*p)),
    17: ColmapModel("EQUIRECTANGULAR", 2, None),
}
"""By the number in cameras.bin."""
MODEL_NAMES = {model.name: model for model in MODELS.values()}
_HEAD = struct.Struct("<iiQQ")
_POSE = struct.Struct("<i7di")


@dataclass(frozen=True)
class _Optics:
    """A row of cameras: an intrinsic camera (pose: none), and its lens."""

    camera: Camera
    lens: Lens | None


def model_folder(path: Path) -> Path | None:
    """The folder of a model's files: `path` itself, the folder of one of its files, or one within it; else None. Raises
    ValueError: several models within it, none of them 0."""
    if os.path.isfile(path):
        path = path.parent
    for inner in MODEL_FOLDERS:
        if _holds_model(path / inner):
            return path / inner
    # The first model is often the worse one, and deleted.
    for holder in (path, *(path / inner for inner in MODELS_FOLDERS)):
        models = _numbered(holder) if holder.absolute().name == "sparse" else []
        if len(models) > 1:
            names = ", ".join(model.name for model in models)
            raise ValueError(f"{holder}: expected one model of COLMAP's, found {names}; name the folder of one of them")
        if models:
            return models[0]
    return None


def other_models(folder: Path) -> list[Path]:
    """COLMAP's other models of the same run, in the order of their numbers: of other photographs, in worlds of their
    own."""
    here = folder.absolute()
    siblings = _numbered(here.parent) if here.name.isdigit() and here.parent.name == "sparse" else []
    return [model for model in siblings if model != here]


def photographs_of(folder: Path) -> int:
    """How many photographs a model has; 0 of a damaged one."""
    try:
        return len(read_model(folder))
    except ValueError:
        return 0


def _numbered(holder: Path) -> list[Path]:
    try:
        numbered = [inner for inner in holder.iterdir() if inner.name.isdecimal() and _holds_model(inner)]
    except OSError:
        return []
    return sorted(numbered, key=lambda inner: int(inner.name))


def _holds_model(folder: Path) -> bool:
    return any(os.path.isfile(folder / f"images{ending}") for ending in (".bin", ".txt"))


def read_model(folder: Path) -> list[CapturedView]:
    """The images of a model, in the order of its file. Raises ValueError, one line naming the file: missing, cut off,
    an unknown camera model, one that no pinhole camera replaces."""
    cameras, images = _file(folder, "cameras"), _file(folder, "images")
    optics = dict(_binary_cameras(cameras) if cameras.suffix == ".bin" else _text_cameras(cameras))
    rows = _binary_images(images) if images.suffix == ".bin" else _text_images(images)
    # Distorted models belong to the photographs as they were taken, others to the straightened ones.
    names = ("input", "images", "") if "distorted" in folder.parts else ("images", "input", "")  # as INRIA's convert.py
    folders = tuple(data / name for data in _data_folders(folder) for name in names)
    folders += tuple(folder.absolute().parent / name for name in names if name)  # colmap_text beside images
    views = []
    for name, camera_id, quaternion, translation in rows:
        if camera_id not in optics:
            raise ValueError(f"{images}: {_brief(name)} has camera {camera_id}, which {cameras.name} does not list")
        # COLMAP stores world to camera, as Camera has it.
        matrix = np.eye(4)
        with np.errstate(over="ignore"):  # infinite, and refused
            norm = length(quaternion)
        if not (0 < norm < np.inf and np.isfinite(translation).all()):
            raise ValueError(f"{images}: {_brief(name)} has no finite pose")
        matrix[:3, :3] = quat_to_matrix(quaternion[None])[0]
        matrix[:3, 3] = translation
        row = optics[camera_id]
        posed = replace(row.camera, world_to_camera=matrix)
        views.append(CapturedView(name, posed, row.lens, folders, _mask_of(name, folder)))
    return views


def read_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """([M, 3] float64 points, [M, 3] colours 0..1) of a model; none where it has no points3D file. Raises ValueError:
    cut off."""
    path = next((p for p in (folder / "points3D.bin", folder / "points3D.txt") if p.is_file()), None)
    if path is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rows = list(_binary_points(path) if path.suffix == ".bin" else _text_points(path))
    table = np.array(rows, np.float64).reshape(-1, 6)
    table = table[np.isfinite(table).all(1)]
    return table[:, :3], table[:, 3:] / 255


def _data_folders(folder: Path) -> list[Path]:
    """The folders in which the photographs of a model may be, nearest first: `sparse/0` has them beside `sparse`. No
    others: a picture of the same name elsewhere may be a painted one."""
    # From sparse/0 up to where the photographs are.
    here = folder.absolute()
    if here.name.isdigit():
        here = here.parent
    if here.name != "sparse":
        return [folder.absolute()]
    return [here.parent, here.parent.parent] if here.parent.name in ("colmap", "distorted") else [here.parent]


def _mask_of(name: str, folder: Path) -> str:
    """The mask of a photograph, relative to the data: `masks` has them under the photograph's whole name and .png, as
    COLMAP's --mask_path wants it, or under the name with that ending in place of its own; "" where there is none."""
    picture = PurePosixPath(name.replace("\\", "/"))
    called = dict.fromkeys((f"{picture}.png", str(picture.with_suffix(".png"))))
    for data in _data_folders(folder):
        for mask in called:
            if os.path.isfile(data / MASKS / mask):
                return f"{MASKS}/{mask}"
    return ""


def _file(folder: Path, name: str) -> Path:
    for ending in (".bin", ".txt"):
        if (folder / (name + ending)).is_file():
            return folder / (name + ending)
    raise ValueError(f"{folder}: expected {name}.bin or {name}.txt of a COLMAP model")


def _optics(where: str, model: ColmapModel, width: int, height: int, parameters: tuple[float, ...]) -> _Optics:
    if model.lens is None:
        raise ValueError(f"{where}: model {model.name}, which no pinhole camera replaces; expected pictures of one")
    # Every model begins with one or two focals and the principal point; what follows is its lens.
    focal, rest = parameters[: model.focals], parameters[model.focals :]
    camera = posed_camera(where, (width, height), (focal[0], focal[-1]), (rest[0], rest[1]), np.eye(4))
    if not all(map(np.isfinite, parameters)):
        raise ValueError(f"{where}: expected finite parameters, got {parameters}")
    return _Optics(camera, model.lens(rest[2:]))


# ---- .bin


def _binary_cameras(path: Path) -> Iterator[tuple[int, _Optics]]:
    with files.reading(path) as file:
        for _ in range(_count(file, path)):
            camera_id, model_id, width, height = _HEAD.unpack(_bytes(file, path, _HEAD.size))
            where = f"{path}: camera {camera_id}"
            if model_id not in MODELS:
                raise ValueError(f"{where}: unknown camera model {model_id}; expected one of 0 to {max(MODELS)}")
            model = MODELS[model_id]
            numbers = struct.unpack(f"<{model.parameters}d", _bytes(file, path, 8 * model.parameters))
            yield camera_id, _optics(where, model, width, height, numbers)


def _binary_images(path: Path) -> Iterator[tuple[str, int, np.ndarray, np.ndarray]]:
    with files.reading(path) as file:
        for _ in range(_count(file, path)):
            _, *pose, camera_id = _POSE.unpack(_bytes(file, path, _POSE.size))
            name = bytearray()
            # Names end with a zero byte and say no length: bounded by hand.
            while (byte := _bytes(file, path, 1)) != b"\0":
                name += byte
                if len(name) > MAX_NAME_BYTES:
                    raise ValueError(f"{path}: expected a picture's name, got more than {MAX_NAME_BYTES} bytes")
            # Its observations are not needed: skipped without being read, their count held against the file's size.
            (points,) = struct.unpack("<Q", _bytes(file, path, 8))
            _skip(file, path, 24 * points)
            yield name.decode("utf-8", "replace"), camera_id, np.array(pose[:4]), np.array(pose[4:])


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    with files.reading(path) as file:
        for _ in range(_count(file, path, most=1 << 40)):
            *point, _ = struct.unpack("<Q3d3Bd", _bytes(file, path, POINT_BYTES))
            (track,) = struct.unpack("<Q", _bytes(file, path, 8))
            _skip(file, path, 8 * track)
            yield tuple(point[1:])


def _count(file: BinaryIO, path: Path, most: int = MAX_CAMERAS) -> int:
    (count,) = struct.unpack("<Q", _bytes(file, path, 8))
    if count > most:
        raise ValueError(f"{path}: expected at most {most:,} entries, got {count:,}; it is no file of COLMAP's")
    return count


def _bytes(file: BinaryIO, path: Path, count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise ValueError(f"{path}: truncated, or no file of COLMAP's: {count} bytes needed at byte {file.tell()}")
    return data


def _skip(file: BinaryIO, path: Path, count: int) -> None:
    """Over bytes that have to be there."""
    if count:
        if count > path.stat().st_size - file.tell():
            raise ValueError(f"{path}: truncated, or no file of COLMAP's: {count} bytes needed at byte {file.tell()}")
        file.seek(count, 1)


# ---- .txt


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number, text) of the lines that are no comment, empty ones included."""
    with files.reading(path) as file:
        for number, line in enumerate(iter(lambda: file.readline(MAX_LINE_BYTES), b""), 1):
            text = line.decode("utf-8", "replace").lstrip("\ufeff").strip()  # as Notepad saves
            if not text.startswith("#"):
                yield number, text


def _numbers(path: Path, number: int, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise ValueError(f"{path}: line {number}: expected numbers, got {_brief(' '.join(words))}") from None


def _text_cameras(path: Path) -> Iterator[tuple[int, _Optics]]:
    for number, line in _lines(path):
        words = line.split()
        if not words:
            continue
        where = f"{path}: line {number}"
        if len(words) < 4 or words[1] not in MODEL_NAMES:
            raise ValueError(f"{where}: expected CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS, got {_brief(line)}")
        model, (camera_id, width, height) = MODEL_NAMES[words[1]], _numbers(path, number, [words[0], *words[2:4]])
        parameters = tuple(_numbers(path, number, words[4:]))
        if len(parameters) != model.parameters:
            raise ValueError(f"{where}: expected {model.parameters} parameters of {model.name}, got {len(parameters)}")
        if not all(value == value // 1 and abs(value) < 1 << 53 for value in (camera_id, width, height)):
            raise ValueError(f"{where}: expected whole numbers as CAMERA_ID, WIDTH, HEIGHT, got {_brief(line)}")
        yield int(camera_id), _optics(where, model, int(width), int(height), parameters)


def _text_images(path: Path) -> Iterator[tuple[str, int, np.ndarray, np.ndarray]]:
    """Two lines each; the second (its points) may be empty, and some programs leave it out."""
    lines = _lines(path)
    following = next(lines, None)
    while following is not None:
        (number, line), following = following, next(lines, None)
        words = line.split(maxsplit=9)
        if not words:
            continue
        if len(words) < 10:
            raise ValueError(f"{path}: line {number}: expected ID, QW ... TZ, CAMERA_ID, NAME, got {_brief(line)}")
        values = _numbers(path, number, words[:9])
        if following is not None and not _is_image(following[1]):
            following = next(lines, None)
        yield words[9], _camera_id(values[8]), np.array(values[1:5]), np.array(values[5:8])


def _is_image(line: str) -> bool:
    """Whether a line where an image's points (X, Y, POINT3D_ID each) may stand is the next image: it ends in a name."""
    words = line.split(maxsplit=9)
    if len(words) < 10 or len(words[9]) > MAX_NAME_BYTES:
        return False
    name = words[9].split()
    return len(name) % 3 != 0 or not name[-1].lstrip("-").isdecimal()


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(path):
        words = line.split(maxsplit=8)
        if not words:
            continue
        if len(words) < 8:
            raise ValueError(f"{path}: line {number}: expected POINT3D_ID, X, Y, Z, R, G, B, ERROR, got {_brief(line)}")
        yield tuple(_numbers(path, number, words[1:7]))


def _brief(text: str) -> str:
    return files.printable(text, 60)


def _camera_id(value: float) -> int:
    """-1, which no camera has, where a number is no whole one."""
    return int(value) if abs(value) < 1 << 53 and value == value // 1 else -1
