"""Folders as INRIA's trainer, nerfstudio and COLMAP leave them, written from cameras by the formats' own definitions
(columns, quaternions, struct layouts), and photographs through lenses that bend lines."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from splatpainter.cameras import Camera

Bend = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Slopes x, y of directions -> slopes of their pixels."""


def opengl_pose(camera: Camera) -> np.ndarray:
    """[4, 4] camera to world: columns right, up, backward, eye."""
    right, down, forward = camera.world_to_camera[:3, :3]
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, -down, -forward, camera.position], 1)
    return matrix


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w, x, y, z of a [3, 3] rotation: the eigenvector of Bar-Itzhack's matrix (2000)."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k / 3)[1][:, -1]
    return np.array([w, x, y, z])


def write_inria(
    folder: Path, cameras: Sequence[Camera], names: Sequence[str], arguments: str = "", iterations: Sequence[int] = ()
) -> Path:
    """cameras.json and cfg_args; the folders of iterations are made, their PLYs are the caller's."""
    entries = [
        {
            "id": k,
            "img_name": name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.position.tolist(),
            "rotation": camera.world_to_camera[:3, :3].T.tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
        }
        for k, (camera, name) in enumerate(zip(cameras, names, strict=True))
    ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.json").write_text(json.dumps(entries))
    if arguments:
        (folder / "cfg_args").write_text(f"Namespace({arguments})")
    for iteration in iterations:
        (folder / "point_cloud" / f"iteration_{iteration}").mkdir(parents=True)
    return folder


def write_table(folder: Path, cameras: Sequence[Camera], names: Sequence[str], **shared: object) -> Path:
    """A transforms.json of equal intrinsics; shared: further keys of it."""
    first = cameras[0]
    lens = {"fl_x": first.fx, "fl_y": first.fy, "cx": first.cx, "cy": first.cy, "w": first.width, "h": first.height}
    frames = [
        {"file_path": name, "transform_matrix": opengl_pose(camera).tolist()}
        for camera, name in zip(cameras, names, strict=True)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps({**lens, **shared, "frames": frames}))
    return folder / "transforms.json"


def write_colmap(
    folder: Path,
    cameras: Sequence[Camera],
    names: Sequence[str],
    *,
    ending: str,
    model: tuple[int, str] = (1, "PINHOLE"),
    bend: Sequence[float] = (),
    points: np.ndarray | None = None,
) -> Path:
    """cameras, images and points3D (points: [M, 6], place and colour 0..255) of one lens, as .bin or .txt."""
    folder.mkdir(parents=True, exist_ok=True)
    first, table = cameras[0], np.zeros((0, 6)) if points is None else points
    parameters = [first.fx, first.fy, first.cx, first.cy, *bend]
    poses = [(quaternion(camera.world_to_camera[:3, :3]), camera.world_to_camera[:3, 3]) for camera in cameras]
    if ending == "bin":
        head = struct.pack("<QiiQQ", 1, 7, model[0], first.width, first.height)
        (folder / "cameras.bin").write_bytes(head + struct.pack(f"<{len(parameters)}d", *parameters))
        rows = [
            struct.pack("<i7di", k + 1, *turn, *shift, 7)
            + name.encode()
            + b"\0"
            + struct.pack("<Q", 2)
            + struct.pack("<ddq", 1.0, 2.0, -1) * 2
            for k, ((turn, shift), name) in enumerate(zip(poses, names, strict=True))
        ]
        (folder / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
        cloud = [struct.pack("<Q3d3BdQii", k, *p[:3], *map(int, p[3:]), 0.5, 1, 1, 0) for k, p in enumerate(table)]
        (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(cloud)) + b"".join(cloud))
        return folder
    words = " ".join(map(repr, map(float, parameters)))
    (folder / "cameras.txt").write_text(f"# Camera list\n7 {model[1]} {first.width} {first.height} {words}\n")
    lines = ["# Image list with two lines of data per image:"]
    for k, ((turn, shift), name) in enumerate(zip(poses, names, strict=True)):
        lines += [
            f"{k + 1} {' '.join(repr(float(v)) for v in (*turn, *shift))} 7 {name}",
            "1.0 2.0 -1" if k % 2 else "",
        ]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    cloud = [
        f"{k} {p[0]!r} {p[1]!r} {p[2]!r} {p[3]:.0f} {p[4]:.0f} {p[5]:.0f} 0.5 1 0" for k, p in enumerate(table.tolist())
    ]
    (folder / "points3D.txt").write_text("\n".join(["# 3D point list", *cloud]) + "\n")
    return folder


def photograph(
    draw: Callable[[Camera], np.ndarray], camera: Camera, bend: Bend, *, enlarged: int = 3, field: float = 1.5
) -> np.ndarray:
    """[H, W, 3] what a camera sees through a lens: each of its pixels is looked up in a pinhole picture (drawn
    `enlarged` times as fine, `field` times as wide), whose slopes Newton's method finds for the bent ones."""
    wide = Camera(
        round(camera.width * field) * enlarged,
        round(camera.height * field) * enlarged,
        camera.fx * enlarged,
        camera.fy * enlarged,
        (camera.cx + (round(camera.width * field) - camera.width) / 2) * enlarged,
        (camera.cy + (round(camera.height * field) - camera.height) / 2) * enlarged,
        camera.world_to_camera,
        camera.background,
    )
    fine = draw(wide)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    u, v = unbent((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, bend)
    return _bilinear(fine, u * wide.fx + wide.cx, v * wide.fy + wide.cy)


def unbent(x: np.ndarray, y: np.ndarray, bend: Bend) -> tuple[np.ndarray, np.ndarray]:
    """Slopes that a lens bends to (x, y): Newton's method with differences of the lens itself."""
    u, v, h = x.copy(), y.copy(), 1e-6
    for _ in range(30):
        fx, fy = bend(u, v)
        (ax, ay), (bx, by) = bend(u + h, v), bend(u, v + h)
        a, b, c, d = (ax - fx) / h, (bx - fx) / h, (ay - fy) / h, (by - fy) / h
        det = a * d - b * c
        ex, ey = fx - x, fy - y
        u, v = u - (d * ex - b * ey) / det, v - (a * ey - c * ex) / det
    return u, v


def brown(k1: float, k2: float, p1: float = 0.0, p2: float = 0.0) -> Bend:
    """OpenCV's documentation, "Camera Calibration and 3D Reconstruction"."""

    def bend(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )

    return bend


def fisheye(k1: float, k2: float = 0.0) -> Bend:
    """Likewise, "Fisheye camera model"."""

    def bend(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.maximum(np.hypot(x, y), 1e-12)
        theta = np.arctan(r)
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4)
        return x * bent / r, y * bent / r

    return bend


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    x, y = np.clip(x - 0.5, 0, width - 1.001), np.clip(y - 0.5, 0, height - 1.001)
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    s, t = (x - j)[..., None], (y - i)[..., None]
    upper = (1 - s) * image[i, j] + s * image[i, j + 1]
    lower = (1 - s) * image[i + 1, j] + s * image[i + 1, j + 1]
    return (1 - t) * upper + t * lower


def save_turned(path: Path, pixels: np.ndarray, orientation: int, quality: int = 95) -> None:
    """A JPEG of uint8 [H, W, 3] as stored, with an EXIF orientation."""
    image = Image.fromarray(pixels)
    exif = image.getexif()
    exif[274] = orientation
    image.save(path, exif=exif, quality=quality)


def angle_of(focal: float, side: int) -> float:
    """Radians that a side covers."""
    return 2 * math.atan(side / 2 / focal)
