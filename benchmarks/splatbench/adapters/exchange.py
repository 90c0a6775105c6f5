"""Pictures, cameras and points of the asset as the loaders of other systems read them.

    nerfstudio   transforms.json, images/000.png (on black), points.ply           Instruct-GS2GS, RelitLRM
    colmap       sparse/0/{cameras,images,points3D}.txt, images/000.png (on black)   DGE
    trellis      transforms.json, 000.png (RGBA), voxels.ply, mesh.ply            VoxHammer, VineDresser3D

The layouts are those of the loaders named in docs/ADAPTERS.md.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from splatbench.adapters import alignment, hull, views
from splatbench.cases import Pictures
from splatpainter.cameras import Camera, to_uint8
from splatpainter.io import files
from splatpainter.splats import SH_C0, Splats

TRELLIS_VOXELS = 64
TRELLIS_FOV = 40.0
"""Degrees."""
TRELLIS_RADIUS = 2.0
"""Of the cameras, in edges of the cube."""
FAINT = 0.05
"""Density (voxels.py) from which a row's footprint counts as the region of an edit."""
COLMAP_POINTS = 2000
POINTS = 50_000


@dataclass(frozen=True)
class Cube:
    """Where an asset is (voxels.bounding_cube)."""

    lo: np.ndarray
    """[3] lowest corner, the asset's frame."""
    size: float

    @staticmethod
    def of(splats: Splats) -> Cube:
        """Raises ValueError where no row can be drawn."""
        from splatpainter.voxels.grid import bounding_cube

        return Cube(*bounding_cube(splats))


def save_picture(path: Path, picture: np.ndarray) -> None:
    """[H, W, 3 or 4] uint8 (or float 0..1), or [H, W] bool (255 where set), as PNG."""
    from PIL import Image

    pixels = picture.astype(np.uint8) * 255 if picture.dtype == bool else to_uint8(picture)
    data = BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    with files.writing(path) as file:
        file.write(data.getvalue())


def save_text(path: Path, text: str) -> None:
    with files.writing(path) as file:
        file.write(text.encode())


def nerfstudio(folder: Path, splats: Splats, cameras: Sequence[Camera]) -> None:
    """A nerfstudio dataset of the asset's renders, with its rows as first points."""
    (folder / "images").mkdir(parents=True)
    names = []
    for k, view in enumerate(views.drawn(splats, cameras)):
        names.append(f"images/{k:03d}.png")
        save_picture(folder / names[-1], view.on_black())
    means, colors = _points(splats, POINTS)
    hull.write_ply(folder / "points.ply", means, colors=colors)
    save_text(folder / "transforms.json", json.dumps(transforms(cameras, names) | {"ply_file_path": "points.ply"}))


def posed(folder: Path, pictures: Pictures) -> None:
    """A nerfstudio dataset of pictures as they are."""
    (folder / "images").mkdir(parents=True)
    names = [f"images/{k:03d}.png" for k in range(len(pictures))]
    for name, picture in zip(names, pictures.colors, strict=True):
        save_picture(folder / name, picture)
    save_text(folder / "transforms.json", json.dumps(transforms(pictures.cameras, names)))


def transforms(cameras: Sequence[Camera], names: Sequence[str]) -> dict[str, Any]:
    """The object of a transforms.json, intrinsics per frame."""
    shots = []
    for camera, name in zip(cameras, names, strict=True):
        shot: dict[str, Any] = {"file_path": name, "transform_matrix": views.camera_to_world(camera).tolist()}
        shot |= {"w": camera.width, "h": camera.height}
        shots.append(shot | {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy})
    return {"camera_model": "OPENCV", "frames": shots}


def colmap(folder: Path, splats: Splats, cameras: Sequence[Camera]) -> None:
    """A COLMAP text model of the asset's renders (one PINHOLE camera per picture) and some of its rows as points."""
    from splatpainter.io.frames import quaternion_of

    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (folder / "images").mkdir()
    intrinsics, poses = [], []
    for k, view in enumerate(views.drawn(splats, cameras)):
        camera, name = view.camera, f"{k:03d}.png"
        save_picture(folder / "images" / name, view.on_black())
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        intrinsics.append(f"{k + 1} PINHOLE {camera.width} {camera.height} {_numbers(lens)}")
        quaternion = quaternion_of(camera.world_to_camera[:3, :3])
        shift = camera.world_to_camera[:3, 3]
        poses += [f"{k + 1} {_numbers(quaternion)} {_numbers(shift)} {k + 1} {name}", ""]
    means, colors = _points(splats, COLMAP_POINTS)
    rows = zip(means, colors, strict=True)
    points = [f"{k + 1} {_numbers(mean)} {' '.join(map(str, color))} 0" for k, (mean, color) in enumerate(rows)]
    for name, lines in (("cameras.txt", intrinsics), ("images.txt", poses), ("points3D.txt", points)):
        save_text(model / name, "\n".join([*lines, ""]))


def trellis(folder: Path, splats: Splats, cube: Cube, *, count: int, pixels: int) -> alignment.Frame:
    """What TRELLIS's preprocessing leaves of a mesh, made from the asset itself: `count` RGBA renders all around at
    2 edges of the cube, transforms.json, voxels.ply (middles of the occupied of 64^3) and mesh.ply (their hull), all in
    the frame "trellis", which it returns."""
    folder.mkdir(parents=True)
    frame = alignment.cube(cube.lo, cube.size, upright=True)
    cameras = views.sphere(cube.lo, cube.size, count, pixels=pixels, fov=TRELLIS_FOV, radius=TRELLIS_RADIUS)
    shots = []
    for k, view in enumerate(views.drawn(splats, cameras)):
        save_picture(folder / f"{k:03d}.png", view.rgba())
        pose = views.camera_to_world(view.camera)
        pose[:3, :3] = frame.turn @ pose[:3, :3]
        pose[:3, 3] = frame.points(np.linalg.inv(view.camera.world_to_camera)[:3, 3])
        angle = float(np.radians(TRELLIS_FOV))
        shots.append({"file_path": f"{k:03d}.png", "camera_angle_x": angle, "transform_matrix": pose.tolist()})
    told = {"aabb": [[-0.5] * 3, [0.5] * 3], "scale": frame.scale, "offset": list(frame.shift), "frames": shots}
    save_text(folder / "transforms.json", json.dumps(told))
    volume = upright(occupied(splats, cube))
    hull.write_ply(folder / "voxels.ply", (np.argwhere(volume) + 0.5) / TRELLIS_VOXELS - 0.5)
    vertices, faces = hull.surface(volume)
    hull.write_ply(folder / "mesh.ply", vertices / TRELLIS_VOXELS - 0.5, faces)
    return frame


def occupied(splats: Splats, cube: Cube) -> np.ndarray:
    """[64, 64, 64] bool occupied voxels of the asset's cube, the asset's axes."""
    from splatpainter.voxels.grid import voxelize

    grid = voxelize(splats, TRELLIS_VOXELS)
    assert np.array_equal(grid.lo, cube.lo) and grid.size == cube.size
    return grid.occupancy.astype(bool)


def reached(splats: Splats, cube: Cube, edited: Pictures, masks: np.ndarray) -> np.ndarray:
    """[64, 64, 64] bool voxels of the rows that edits of the masked pixels ([V, H, W]) may touch (raycast.py), by their
    middles and footprints, the asset's axes. Raises ValueError where there is none."""
    from splatpainter.voxels import footprints
    from splatpainter.voxels.grid import voxelize
    from splatpainter.voxels.raycast import editable_rows

    grid = voxelize(splats)
    rows = np.zeros(len(splats), bool)
    for camera, mask in zip(edited.cameras, masks, strict=True):
        rows |= editable_rows(grid, splats, camera, mask)
    chosen = np.flatnonzero(rows & (grid.index >= 0))
    voxel = cube.size / TRELLIS_VOXELS
    cells = np.floor((splats.means[chosen].astype(np.float64) - cube.lo) / voxel).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < TRELLIS_VOXELS)).all(1)]
    if not len(cells):
        raise ValueError("the mask of the edited view reaches no row of the asset: there is no region to edit")
    volume = footprints.density(splats, chosen, cube.lo, voxel, TRELLIS_VOXELS) > FAINT
    volume[tuple(cells.T)] = True
    return volume


def upright(volume: np.ndarray) -> np.ndarray:
    """A cube's voxels [R, R, R], y up, in z-up order: (x, y, z) -> (x, -z, y)."""
    return volume.transpose(0, 2, 1)[:, ::-1]


def _points(splats: Splats, most: int) -> tuple[np.ndarray, np.ndarray]:
    """(means [P, 3] float32, colours [P, 3] uint8) of at most `most` rows, the more opaque first."""
    rows = np.flatnonzero(splats.drawable)
    rows = np.sort(rows[np.argsort(-splats.opacities[rows], kind="stable")[:most]])
    return splats.means[rows], to_uint8(0.5 + SH_C0 * splats.sh[rows, 0])


def _numbers(values: Any) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)
