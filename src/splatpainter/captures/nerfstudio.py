"""Nerfstudio's files, and NeRF's from which they come: transforms.json, dataparser_transforms.json, camera_path.json.

Poses are camera to world in OpenGL's axes. A trained asset lies in the frame of the data parser: the scale times the
transform of what the capture's program said (docs.nerf.studio, "Data conventions"; nerfstudio_dataparser.py).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.captures.captured_view import OPENGL_TO_OPENCV, CapturedView, posed_camera, rigid
from splatpainter.captures.lenses import Lens, PolynomialLens, lens_or_none
from splatpainter.image_files import picture_header
from splatpainter.io import files
from splatpainter.kernels.portable import inverse, matmul, tan
from splatpainter.system.jsonio import brief, finite_numbers, load_object, objects_at
from splatpainter.system.quick_dataclass import dataclass

TABLES = ("transforms.json", "transforms_train.json")
FRAME = "dataparser_transforms.json"
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
OTHER_LENSES = ("is_fisheye", "latlong", "equirectangular", "orthographic", "ftheta_p0")
"""Keys by which instant-ngp says that a camera is none of a pinhole; of the first there is a model."""
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
RATIONAL = ("k5", "k6")
MAX_TABLE_BYTES = 64 << 20
"""Of a table: 500 bytes a frame."""


@dataclass(frozen=True)
class ParserFrame:
    """Where a trained asset lies in its capture's world: p' = scale * (rotation p + shift)."""

    transform: np.ndarray
    """[4, 4] float64, a rotation and a shift, from the world of the capture's program."""
    scale: float

    def moved(self, view: CapturedView) -> CapturedView:
        """A view of the capture's world, in the asset's."""
        rotation, shift = self.transform[:3, :3], self.transform[:3, 3]
        # The asset lies in the data parser's frame, cameras in the capture's: cameras are moved, not Gaussians.
        matrix = view.camera.world_to_camera.copy()
        # x = R p + t of p = rotation^T (p' / scale - shift), times scale: depths grow with the world
        matrix[:3, :3] = matmul(matrix[:3, :3], rotation.T)
        matrix[:3, 3] = self.scale * (matrix[:3, 3] - matmul(matrix[:3, :3], shift))
        return replace(view, camera=replace(view.camera, world_to_camera=matrix))

    def after(self, applied: np.ndarray, scale: float) -> ParserFrame:
        """The frame seen from a table whose poses were moved by `applied` [4, 4] and then scaled."""
        undone = np.eye(4)
        undone[:3, :3] = inverse(applied[:3, :3])
        undone[:3, 3] = -matmul(undone[:3, :3], applied[:3, 3])
        return ParserFrame(matmul(self.transform, undone), self.scale / scale)


def splat_frame(*folders: Path | None) -> ParserFrame | None:
    """What the dataparser_transforms.json in the first of these folders that has one says; None where none has. Raises
    ValueError: it cannot be understood."""
    for folder in filter(None, folders):
        path = folder / FRAME
        if path.is_file():
            record = load_object(files.read_all(path), path, "the data parser's frame")
            transform = _matrix(record.get("transform"), f"{path}: transform")
            (scale,) = finite_numbers([record.get("scale")], path, "scale")
            if not scale > 0:
                raise ValueError(f"{path}: expected a scale above 0, got {scale:g}")
            return ParserFrame(transform, float(scale))
    return None


def read_table(path: Path, record: dict[str, Any], frame: ParserFrame | None = None) -> list[CapturedView]:
    """The views of a transforms.json, in its order. frame: in which its asset lies; None: the table's own world. Raises
    ValueError naming the frame and the key: missing, not finite, a camera model that no pinhole camera replaces."""
    if frame is not None:
        # The table may have been moved already; only what the parser did beyond that is left to do.
        applied, scale = np.eye(4), 1.0
        if record.get("applied_transform") is not None:
            applied = _matrix(record["applied_transform"], f"{path}: applied_transform")
        if record.get("applied_scale") is not None:
            (scale,) = finite_numbers([record["applied_scale"]], path, "applied_scale")
        if not scale > 0:
            raise ValueError(f"{path}: expected applied_scale above 0, got {scale:g}")
        frame = frame.after(applied, float(scale))
    if "frames" not in record:
        raise ValueError(f"{path}: expected a NeRF-style table of cameras, it has no 'frames'")
    frames = objects_at(record, "frames", path)
    # Intrinsics stand at the top or in a frame; the frame's own win.
    shared = {key: value for key, value in record.items() if key != "frames"}
    views = [_view(f"{path}: frame {k}", {**shared, **entry}, path.parent) for k, entry in enumerate(frames)]
    return views if frame is None else [frame.moved(view) for view in views]


def _view(where: str, record: dict[str, Any], folder: Path) -> CapturedView:
    name = record.get("file_path")
    if not isinstance(name, str) or not name:
        raise ValueError(f"{where}: has no file_path")
    where = f"{where} ({files.printable(name, 60)})"
    mask = record.get("mask_path") or ""
    if not isinstance(mask, str):
        raise ValueError(f"{where}: expected the name of a picture as mask_path, got {brief(mask)}")
    if "transform_matrix" not in record:
        raise ValueError(f"{where}: has no transform_matrix")
    # The size may only be known from the picture, so the lens and the picture's place come first.
    pose = _matrix(record["transform_matrix"], f"{where}: transform_matrix", rotation=False)
    view = CapturedView(name, UNKNOWN_SIZE, _lens(where, record), (folder,), mask)
    width, height = _size(where, record, view)
    focals = _focals(where, record, width, height)
    cx, cy = (_number(where, record, key, side / 2) for key, side in (("cx", width), ("cy", height)))
    matrix = rigid(matmul(pose, OPENGL_TO_OPENCV), where)
    return replace(view, camera=posed_camera(where, (width, height), focals, (cx, cy), matrix))


UNKNOWN_SIZE = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, np.eye(4))
"""Of a view until its picture was looked at."""


def _size(where: str, record: dict[str, Any], view: CapturedView) -> tuple[int, int]:
    """(width, height) for which the table's numbers are: what it says, else of the photograph as its file stores it, of
    which a header is all that is read."""
    width, height = (_side(where, record, key) for key in ("w", "h"))
    if width is not None and height is not None:
        return width, height
    path = view.picture()
    if path is None:
        raise ValueError(f"{where}: the table says no w and h, and the picture is not there; expected one or the other")
    across, along = picture_header(path)[0]
    if width is not None:
        return width, max(1, round(width * along / across))
    return (across, along) if height is None else (max(1, round(height * across / along)), height)


def _focals(where: str, record: dict[str, Any], width: int, height: int) -> tuple[float, float]:
    # Focals or fields of view, for one axis or both; one stands for the other where it is missing.
    angles = {"fl_x": ("camera_angle_x", width), "fl_y": ("camera_angle_y", height)}
    focals: dict[str, float] = {}
    for key, (angle, side) in angles.items():
        if record.get(key) is not None:
            focals[key] = _number(where, record, key, 0.0)
        elif record.get(angle) is not None:
            radians = _number(where, record, angle, 0.0)
            if not 0 < radians < math.pi:
                raise ValueError(f"{where}: expected {angle} between 0 and pi radians, got {radians:g}")
            focals[key] = side / 2 / tan(radians / 2)
    if not focals:
        raise ValueError(f"{where}: has neither fl_x nor camera_angle_x")
    either = next(iter(focals.values()))
    return focals.get("fl_x", either), focals.get("fl_y", either)


def _lens(where: str, record: dict[str, Any]) -> Lens | None:
    model = record.get("camera_model") or "OPENCV"
    if not isinstance(model, str):
        raise ValueError(f"{where}: expected a name as camera_model, got {brief(model)}")
    # instant-ngp marks other lenses by keys of their own; anything that no pinhole replaces is refused by name.
    ngp = next((key for key in OTHER_LENSES if record.get(key)), "")
    fisheye = model.upper() in FISHEYE or ngp == "is_fisheye"
    if (ngp and ngp != "is_fisheye") or not (fisheye or model.upper() in PERSPECTIVE):
        named = f"{ngp} is set" if ngp else f"camera_model is {files.printable(model, 40)}"
        raise ValueError(
            f"{where}: {named}, which no pinhole camera replaces; expected {', '.join((*PERSPECTIVE[:2], FISHEYE[0]))}"
        )
    # Of OpenCV's rational lens, which nerfstudio does not have: left out it would bend every line.
    beyond = next((key for key in RATIONAL if _number(where, record, key, 0.0)), "")
    if beyond:
        raise ValueError(f"{where}: expected a lens of {', '.join(DISTORTION)}, got {beyond}; undistort the pictures")
    k1, k2, k3, k4, p1, p2 = (_number(where, record, key, 0.0) for key in DISTORTION)
    listed = record.get("distortion_params")
    if listed is not None:  # nerfstudio takes the list before the single numbers
        values = finite_numbers(listed, where, "distortion_params")
        if len(values) != len(DISTORTION):
            raise ValueError(f"{where}: expected {len(DISTORTION)} numbers as distortion_params, got {len(values)}")
        k1, k2, k3, k4, p1, p2 = map(float, values)
    if fisheye:
        return PolynomialLens((k1, k2, k3, k4), fisheye=True)
    return lens_or_none(PolynomialLens((k1, k2, k3, k4), (p1, p2)))


def read_path(path: Path, record: dict[str, Any]) -> list[CapturedView]:
    """The cameras of a camera_path.json, which nerfstudio's viewer exports: in the asset's frame already. Raises
    ValueError naming the camera and the key."""
    kind = record.get("camera_type", "perspective")
    if kind != "perspective":
        raise ValueError(f"{path}: expected camera_type perspective, got {brief(kind)}")
    width, height = (_side(str(path), record, key) for key in ("render_width", "render_height"))
    if width is None or height is None:
        raise ValueError(f"{path}: has no render_width and render_height")
    out = []
    for k, entry in enumerate(objects_at(record, "camera_path", path)):
        where = f"{path}: camera {k}"
        fov = _number(where, entry, "fov", math.nan)
        values = finite_numbers(entry.get("camera_to_world"), where, "camera_to_world")
        if values.size != 16 or not 0 < fov < 180:
            raise ValueError(f"{where}: expected 16 numbers as camera_to_world and a fov between 0 and 180 degrees")
        focal = height / 2 / tan(math.radians(fov) / 2)
        matrix = rigid(matmul(values.reshape(4, 4), OPENGL_TO_OPENCV), where)
        center = width / 2, height / 2
        out.append(CapturedView("", posed_camera(where, (width, height), (focal, focal), center, matrix)))
    return out


def _matrix(value: Any, where: str, rotation: bool = True) -> np.ndarray:
    """[4, 4] float64 of three or four rows of four numbers. rotation: what has to stand in it."""
    listed = isinstance(value, list) and all(isinstance(row, list) for row in value)
    rows = [finite_numbers(row, where, "a row") for row in value] if listed else []
    if len(rows) not in (3, 4) or {len(row) for row in rows} != {4}:
        raise ValueError(f"{where}: expected a 4x4 or 3x4 matrix, got {brief(value)}")
    out = np.eye(4)
    out[:3] = rows[:3]
    if rotation and abs(matmul(out[:3, :3], out[:3, :3].T) - np.eye(3)).max() > 1e-4:
        raise ValueError(f"{where}: expected a rotation and a shift")
    return out


def _number(where: str, record: dict[str, Any], key: str, default: float) -> float:
    value = record.get(key)
    return default if value is None else float(finite_numbers([value], where, key)[0])


def _side(where: str, record: dict[str, Any], key: str) -> int | None:
    """Pixels of a picture's side; None where nothing is said."""
    if record.get(key) is None:
        return None
    value = _number(where, record, key, 0.0)
    if value != int(value) or value < 1:
        raise ValueError(f"{where}: expected whole pixels as {key}, got {value:g}")
    return int(value)
