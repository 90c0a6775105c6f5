"""Which points a camera sees past the triangles of a mesh: exact, without a depth map's resolution.

Triangles are put into square tiles of the picture, and the line from the camera to a point is cut with those of its
tile (Moeller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection", 1997). Knows no paint.
"""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splattrain.data.meshes import Mesh

TILE_PX = 4
MIN_DEPTH = 1e-3
"""World units; nothing nearer hides anything."""
DEPTH_SLACK = 2e-5
"""Part of a point's distance that a triangle must be in front of it by: float32 vertices leave about 1e-7."""


def projected(points: np.ndarray, camera: Camera) -> np.ndarray:
    """[M, 3] float64: x, y in pixels and depth z of points [M, 3]; x and y mean nothing where z <= MIN_DEPTH."""
    pixels, z = camera.project(points)
    pixels[z <= MIN_DEPTH] = 0
    return np.concatenate([pixels, z[:, None]], 1)


def visible_points(mesh: Mesh, camera: Camera, points: np.ndarray) -> np.ndarray:
    """[M] bool: no triangle lies between the camera and the point [M, 3], which is inside the picture. Points on the
    surface do not hide themselves, whichever way they face; holes of cut-out materials hide nothing."""
    x, y, z = projected(points, camera).T
    inside = (z > MIN_DEPTH) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    across, down = -(-camera.width // TILE_PX), -(-camera.height // TILE_PX)
    column, row = (np.where(inside, v, 0).astype(np.int64) // TILE_PX for v in (x, y))
    tile = np.where(inside, row * across + column, -1)
    visible, targets, vertices = inside.copy(), camera.to_camera(points), camera.to_camera(mesh.vertices)
    solid = np.array([material.alpha is None for material in mesh.materials], bool)[mesh.material_ids]
    groups = [(solid, np.full((1, 1), 255, np.uint8))]
    for k, material in enumerate(mesh.materials):
        if material.alpha is not None:
            groups.append((mesh.material_ids == k, np.ascontiguousarray(material.alpha)))
    for used, alpha in groups:
        faces = mesh.faces[used]
        starts, members = _tiled(projected(mesh.vertices, camera)[faces], across, down)
        uvs = mesh.uvs[faces].astype(np.float64)
        run(
            kernels.hide_points,
            readonly(targets, np.float64),
            tile,
            vertices[faces],
            uvs,
            alpha,
            starts,
            members,
            visible,
        )
    return visible


def _tiled(corners: np.ndarray, across: int, down: int) -> tuple[np.ndarray, np.ndarray]:
    """(starts [tiles + 1], held): the triangles of tile t are held[starts[t] : starts[t + 1]]. corners: [F, 3, 3]
    projected; those that reach behind the camera are in every tile."""
    z = corners[..., 2]
    last = np.array([across - 1, down - 1])
    low = np.floor(corners[..., :2].min(1) / TILE_PX - 1e-6).clip(-1, last + 1).astype(np.int64)
    high = np.floor(corners[..., :2].max(1) / TILE_PX + 1e-6).clip(-1, last + 1).astype(np.int64)
    reaches = (z <= MIN_DEPTH).any(1)
    low[reaches], high[reaches] = 0, last
    low, high = low.clip(0), np.minimum(high, last)
    low[(z <= MIN_DEPTH).all(1)] = last + 1
    counts = np.zeros(across * down, np.int64)
    kernels.count_tile_members(low, high, across, counts, 0, 1)
    starts = np.concatenate([[0], np.cumsum(counts)])
    members = np.empty(starts[-1], np.int64)
    kernels.list_tile_members(low, high, across, starts[:-1].copy(), members, 0, 1)
    return starts, members
