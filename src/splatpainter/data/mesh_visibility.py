"""Which points a camera sees past the triangles of a mesh: exact, without a depth map's resolution.

Triangles are put into square tiles of the picture, and the line from the camera to a point is cut with those of its
tile (Moeller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection", 1997). Knows no paint.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from splatpainter.cameras import Camera
from splatpainter.data.meshes import Mesh

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
        _hide(targets, tile, vertices[faces], mesh.uvs[faces].astype(np.float64), alpha, starts, members, visible)
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
    return _fill(low, high, across, across * down)


@njit(nogil=True, cache=True, error_model="numpy")
def _fill(low, high, across, tiles):
    starts = np.zeros(tiles + 1, np.int64)
    for f in range(len(low)):
        for row in range(low[f, 1], high[f, 1] + 1):
            for column in range(low[f, 0], high[f, 0] + 1):
                starts[row * across + column + 1] += 1
    for t in range(tiles):
        starts[t + 1] += starts[t]
    members = np.empty(starts[tiles], np.int64)
    used = np.zeros(tiles, np.int64)
    for f in range(len(low)):
        for row in range(low[f, 1], high[f, 1] + 1):
            for column in range(low[f, 0], high[f, 0] + 1):
                t = row * across + column
                members[starts[t] + used[t]] = f
                used[t] += 1
    return starts, members


@njit(nogil=True, cache=True, error_model="numpy")
def _hide(points, tile, corners, uvs, alpha, starts, members, visible):
    """Sets visible [M] to False where a triangle cuts the line from the origin to points [M, 3]."""
    h, w = alpha.shape
    for i in range(len(points)):
        if not visible[i]:
            continue
        px, py, pz = points[i]
        for k in range(starts[tile[i]], starts[tile[i] + 1]):
            f = members[k]
            ax, ay, az = corners[f, 0]
            ux, uy, uz = corners[f, 1, 0] - ax, corners[f, 1, 1] - ay, corners[f, 1, 2] - az
            vx, vy, vz = corners[f, 2, 0] - ax, corners[f, 2, 1] - ay, corners[f, 2, 2] - az
            cx, cy, cz = py * vz - pz * vy, pz * vx - px * vz, px * vy - py * vx  # point x second edge
            det = ux * cx + uy * cy + uz * cz
            if det == 0:
                continue
            b = -(ax * cx + ay * cy + az * cz) / det
            if b < 0 or b > 1:
                continue
            qx, qy, qz = -ay * uz + az * uy, -az * ux + ax * uz, -ax * uy + ay * ux  # -corner x first edge
            c = (px * qx + py * qy + pz * qz) / det
            if c < 0 or b + c > 1:
                continue
            t = (vx * qx + vy * qy + vz * qz) / det
            if t <= 0 or t >= 1 - DEPTH_SLACK:
                continue
            if h > 1 or w > 1:
                u = (1 - b - c) * uvs[f, 0, 0] + b * uvs[f, 1, 0] + c * uvs[f, 2, 0]
                v = 1 - ((1 - b - c) * uvs[f, 0, 1] + b * uvs[f, 1, 1] + c * uvs[f, 2, 1])
                column = min(int((u - np.floor(u)) * w), w - 1)
                row = min(int((v - np.floor(v)) * h), h - 1)
                if alpha[row, column] < 128:
                    continue
            visible[i] = False
            break
