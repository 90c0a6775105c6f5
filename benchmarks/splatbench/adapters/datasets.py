"""The asset as other systems read it: pictures, cameras, points and voxels, in the layouts of their loaders.

    nerfstudio   transforms.json, images/000.png (on black), points.ply           Instruct-GS2GS, RelitLRM
    colmap       sparse/0/{cameras,images,points3D}.txt, images/000.png (on black)   DGE
    trellis      transforms.json, 000.png (RGBA), voxels.ply, mesh.ply            VoxHammer, VineDresser3D

The loaders are named in docs/ADAPTERS.md.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from splatbench.adapters.coordinate_frames import Cube, Frame
from splatbench.cases import PosedImages
from splatpainter.cameras import Camera, look_at, orbit
from splatpainter.color import base_color, to_display
from splatpainter.image_files import to_uint8
from splatpainter.io import files
from splatpainter.splats import Splats
from splatpainter.transforms import fibonacci_sphere, matrix_to_quat

UP = (0.0, 1.0, 0.0)
CAMERA_RINGS = ((-15.0, 0.25), (15.0, 0.375), (45.0, 0.375))
"""(elevation in degrees, share of the views)."""
RINGS_FOV = 50.0
"""Of their views, degrees."""
RENDERS_AT_ONCE = 8
"""Pictures in memory."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenCV camera axes <-> OpenGL's (y up, z backwards), which Blender and nerfstudio use."""
TRELLIS_VOXELS = 64
TRELLIS_FOV = 40.0
"""Degrees."""
TRELLIS_RADIUS = 2.0
"""Radius of the cameras, in edges of the cube."""
MIN_REGION_DENSITY = 0.05
"""Density (voxels/footprints.py) from which a Gaussian's footprint counts as the region of an edit."""
COLMAP_POINTS = 2000
NERFSTUDIO_POINTS = 50_000
VOXEL_SIDES = (((1, 0, 0), (0, 1, 0), (0, 0, 1)), ((0, 1, 0), (0, 0, 1), (1, 0, 0)), ((0, 0, 1), (1, 0, 0), (0, 1, 0)))
"""Axis of a voxel's side, and the two axes along it, right-handed."""


# ---- renders


@dataclass(frozen=True)
class AssetView:
    """One picture of the asset."""

    camera: Camera
    colors: np.ndarray = field(repr=False)
    """[H, W, 3] float32 display sRGB 0..1, straight (not multiplied by alpha), 0 where alpha is 0."""
    alpha: np.ndarray = field(repr=False)
    """[H, W] float32 0..1."""

    def rgba(self) -> np.ndarray:
        """[H, W, 4] uint8."""
        return to_uint8(np.concatenate([self.colors, self.alpha[..., None]], -1))

    def on_black(self) -> np.ndarray:
        """[H, W, 3] uint8."""
        return to_uint8(self.colors * self.alpha[..., None])


def cameras_on_sphere(cube: Cube, count: int, *, pixels: int, fov: float, radius: float) -> list[Camera]:
    """`count` cameras evenly on a sphere (golden spiral) around a cube, looking at its middle. radius: in edges; fov in
    degrees."""
    eyes = cube.center + radius * cube.extent * fibonacci_sphere(count, 0.0)
    return [look_at(eye, cube.center, UP, width=pixels, height=pixels, fov=fov) for eye in eyes]


def cameras_on_rings(cube: Cube, count: int, *, pixels: int) -> list[Camera]:
    """`count` cameras on three rings around a cube, as a person walks around an object, so far that all of it shows."""
    distance = cube.extent * math.sqrt(3) / 2 / math.sin(math.radians(RINGS_FOV / 2))
    counts = [int(count * share) for _, share in CAMERA_RINGS]
    counts[1] += count - sum(counts)
    cameras: list[Camera] = []
    for k, ((elevation, _), number) in enumerate(zip(CAMERA_RINGS, counts, strict=True)):
        lens = {"width": pixels, "height": pixels, "fov": RINGS_FOV}
        cameras += orbit(cube.center, distance, number, elevation=elevation, start=17.0 * k, up=UP, **lens)
    return cameras


def render_views(splats: Splats, cameras: Sequence[Camera]) -> Iterator[AssetView]:
    """The asset from each camera (all of one size), a few at a time."""
    from splatpainter.rendering import render

    for start in range(0, len(cameras), RENDERS_AT_ONCE):
        batch = [replace(camera, background=(0.0, 0.0, 0.0)) for camera in cameras[start : start + RENDERS_AT_ONCE]]
        renders = render(splats, batch)
        for camera, colors, alphas in zip(batch, renders.colors, renders.alphas, strict=True):
            straight = np.where(alphas > 0, colors / np.maximum(alphas, 1e-6), 0).astype(np.float32)
            straight = np.clip(to_display(straight, splats.color_space), 0, 1)
            yield AssetView(camera, straight, np.clip(alphas[..., 0], 0, 1))


def opengl_pose(camera: Camera) -> np.ndarray:
    """[4, 4] OpenGL camera axes -> world: nerfstudio's and Blender's transform_matrix."""
    return camera.camera_to_world @ OPENGL


# ---- layouts


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


def write_nerfstudio(folder: Path, splats: Splats, cameras: Sequence[Camera]) -> None:
    """A nerfstudio dataset of the asset's renders, with its Gaussians as first points."""
    (folder / "images").mkdir(parents=True)
    names = []
    for k, view in enumerate(render_views(splats, cameras)):
        names.append(f"images/{k:03d}.png")
        save_picture(folder / names[-1], view.on_black())
    means, colors = _points(splats, NERFSTUDIO_POINTS)
    write_ply(folder / "points.ply", means, colors=colors)
    save_text(folder / "transforms.json", json.dumps(transforms(cameras, names) | {"ply_file_path": "points.ply"}))


def write_posed(folder: Path, pictures: PosedImages) -> None:
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
        shot: dict[str, Any] = {"file_path": name, "transform_matrix": opengl_pose(camera).tolist()}
        shot |= {"w": camera.width, "h": camera.height}
        shots.append(shot | {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy})
    return {"camera_model": "OPENCV", "frames": shots}


def write_colmap(folder: Path, splats: Splats, cameras: Sequence[Camera]) -> None:
    """A COLMAP text model of the asset's renders (one PINHOLE camera per picture) and of some Gaussians as points."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (folder / "images").mkdir()
    intrinsics, poses = [], []
    for k, view in enumerate(render_views(splats, cameras)):
        camera, name = view.camera, f"{k:03d}.png"
        save_picture(folder / "images" / name, view.on_black())
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        intrinsics.append(f"{k + 1} PINHOLE {camera.width} {camera.height} {_numbers(lens)}")
        quaternion = matrix_to_quat(camera.world_to_camera[None, :3, :3])[0]
        translation = camera.world_to_camera[:3, 3]
        poses += [f"{k + 1} {_numbers(quaternion)} {_numbers(translation)} {k + 1} {name}", ""]
    means, colors = _points(splats, COLMAP_POINTS)
    pairs = zip(means, colors, strict=True)
    points = [f"{k + 1} {_numbers(mean)} {' '.join(map(str, color))} 0" for k, (mean, color) in enumerate(pairs)]
    for name, lines in (("cameras.txt", intrinsics), ("images.txt", poses), ("points3D.txt", points)):
        save_text(model / name, "\n".join([*lines, ""]))


def write_trellis(folder: Path, splats: Splats, cube: Cube, *, count: int, pixels: int) -> Frame:
    """What TRELLIS's preprocessing leaves of a mesh, made from the asset itself: `count` RGBA renders all around at
    2 edges of the cube, transforms.json, voxels.ply (middles of the occupied of 64^3) and mesh.ply (their hull), all in
    the frame "trellis", which it returns."""
    folder.mkdir(parents=True)
    frame = cube.frame(upright=True)
    cameras = cameras_on_sphere(cube, count, pixels=pixels, fov=TRELLIS_FOV, radius=TRELLIS_RADIUS)
    shots = []
    for k, view in enumerate(render_views(splats, cameras)):
        save_picture(folder / f"{k:03d}.png", view.rgba())
        pose = opengl_pose(view.camera)
        pose[:3, :3] = frame.rotation @ pose[:3, :3]
        pose[:3, 3] = frame.points(view.camera.camera_to_world[:3, 3])
        angle = float(np.radians(TRELLIS_FOV))
        shots.append({"file_path": f"{k:03d}.png", "camera_angle_x": angle, "transform_matrix": pose.tolist()})
    layout = {"aabb": [[-0.5] * 3, [0.5] * 3], "scale": frame.scale, "offset": list(frame.shift), "frames": shots}
    save_text(folder / "transforms.json", json.dumps(layout))
    volume = upright(occupied(splats, cube))
    write_ply(folder / "voxels.ply", (np.argwhere(volume) + 0.5) / TRELLIS_VOXELS - 0.5)
    vertices, faces = voxel_surface(volume)
    write_ply(folder / "mesh.ply", vertices / TRELLIS_VOXELS - 0.5, faces)
    return frame


def occupied(splats: Splats, cube: Cube) -> np.ndarray:
    """[64, 64, 64] bool occupied voxels of the asset's cube, the asset's axes."""
    from splatpainter.voxels.grid import voxelize

    grid = voxelize(splats, TRELLIS_VOXELS)
    assert np.array_equal(grid.min_corner, cube.min_corner) and grid.extent == cube.extent
    return grid.occupancy.astype(bool)


def edit_region(splats: Splats, cube: Cube, edited: PosedImages, masks: np.ndarray) -> np.ndarray:
    """[64, 64, 64] bool voxels, the asset's axes, of the Gaussians that edits of the masked pixels [V, H, W] may reach
    (voxels/raycast.py), by their centres and footprints. Raises ValueError where there is none."""
    from splatpainter.voxels import footprints
    from splatpainter.voxels.grid import voxelize
    from splatpainter.voxels.raycast import editable_gaussians

    grid = voxelize(splats)
    editable = np.zeros(len(splats), bool)
    for camera, mask in zip(edited.cameras, masks, strict=True):
        editable |= editable_gaussians(grid, splats, camera, mask)
    chosen = np.flatnonzero(editable & (grid.index >= 0))
    voxel = cube.extent / TRELLIS_VOXELS
    cells = np.floor((splats.means[chosen].astype(np.float64) - cube.min_corner) / voxel).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < TRELLIS_VOXELS)).all(1)]
    if not len(cells):
        raise ValueError("the mask of the edited view reaches nothing of the asset: there is no region to edit")
    volume = footprints.density(splats, chosen, cube.min_corner, voxel, TRELLIS_VOXELS) > MIN_REGION_DENSITY
    volume[tuple(cells.T)] = True
    return volume


def upright(volume: np.ndarray) -> np.ndarray:
    """A cube's voxels [R, R, R], y up, in z-up order: (x, y, z) -> (x, -z, y)."""
    return volume.transpose(0, 2, 1)[:, ::-1]


def _points(splats: Splats, max_count: int) -> tuple[np.ndarray, np.ndarray]:
    """(means [P, 3] float32, colours [P, 3] uint8) of at most `max_count` Gaussians, the more opaque first."""
    ids = np.flatnonzero(splats.drawable)
    ids = np.sort(ids[np.argsort(-splats.opacities[ids], kind="stable")[:max_count]])
    return splats.means[ids], to_uint8(base_color(splats.sh[ids]))


def _numbers(values: Any) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)


# ---- meshes of voxels


def voxel_surface(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(vertices [P, 3] float64 in voxels from the volume's corner, faces [F, 3] int64, counter-clockwise seen from
    outside) of the sides between set and unset voxels of [X, Y, Z] bool: the closed surface of what is set. Corners are
    shared; faces have no area in common."""
    padded = np.pad(volume.astype(bool), 1)
    quads = []
    for axis, (normal, first, second) in enumerate(VOXEL_SIDES):
        for step in (1, -1):
            exposed = padded & ~np.roll(padded, -step, axis)
            cells = np.argwhere(exposed) - 1
            corner = cells + (np.array(normal) if step > 0 else 0)
            a, b = (np.array(first), np.array(second)) if step > 0 else (np.array(second), np.array(first))
            quads.append(np.stack([corner, corner + a, corner + a + b, corner + b], 1))
    corners = np.concatenate(quads)
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    quad = index.reshape(-1, 4)
    return vertices.astype(np.float64), np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int64)


def write_glb(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """A mesh without material as GLB; vertices [P, 3] as glTF wants them, y up."""
    import trimesh

    data = trimesh.Trimesh(vertices, faces, process=False).export(file_type="glb")
    assert isinstance(data, bytes)
    with files.writing(path) as file:
        file.write(data)


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray | None = None, colors: np.ndarray | None = None):
    """Vertices [P, 3], with triangles [F, 3] or without, with colours [P, 3] uint8 or without, as a binary PLY."""
    columns = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if colors is not None:
        columns += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    table = np.zeros(len(vertices), columns)
    for k, name in enumerate("xyz"):
        table[name] = vertices[:, k]
    if colors is not None:
        for k, name in enumerate(("red", "green", "blue")):
            table[name] = colors[:, k]
    kinds = {"<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property {kinds[kind]} {name}" for name, kind in columns]
    body = table.tobytes()
    if faces is not None:
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        rows = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
        rows["count"], rows["corners"] = 3, faces
        body += rows.tobytes()
    with files.writing(path) as file:
        file.write("\n".join([*head, "end_header\n"]).encode() + body)
