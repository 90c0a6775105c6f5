"""The look of an asset as a picture on a mesh that stands for it.

Two triangles share a square of the picture, each in its half, with the pixels between them filled from both, so that
no filter takes a neighbour's colour. What a pixel shows is the mean of what views from all around see at its place, by
how they face it; where none sees it (a fold, or surface that the mesh has only closed) it is the mean of the Gaussians
nearby. T triangles.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.cameras import Camera, look_at
from splatpainter.color import to_display
from splatpainter.kernels import portable
from splatpainter.rendering import render
from splatpainter.splats import Splats
from splatpainter.surface.proxy_mesh import ProxyMesh
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere

MIN_SQUARE_PX = 5
"""Edge of a square: below, its halves hold no pixel of their own."""
MAX_TEXTURE_PX = 8192


@dataclass(frozen=True)
class BakingThresholds:
    """Source: taste, tried on the demo asset and captures."""

    views: int = 26
    """Around the asset: with fewer, folds are seen by none."""
    fov: float = 40.0
    """Of these views, degrees."""
    margin: float = 1.1
    """Times the mesh's radius that a view shows."""
    most_view_px: int = 1024
    """Edge of a view, at most; else that of the texture."""
    depth_voxels: float = 2.5
    """By which the asset's depth may differ from the mesh's, where a view counts as seeing it."""
    grazing: float = 0.2
    """Cosine of normal and line of sight from which a view counts."""
    min_alpha: float = 0.5
    points_at_once: int = 1 << 18
    """Pixels of the texture that are looked up together."""


BAKING = BakingThresholds()


@dataclass(frozen=True)
class MeshTexture:
    """A picture and where on it each triangle lies."""

    picture: np.ndarray = field(repr=False)
    """[S, S, 3] uint8 display colours."""
    uv: Floats = field(repr=False)
    """[T, 3, 2] float32 of each corner, 0..1 from the upper left corner, as glTF has it."""


def bake_texture(splats: Splats, mesh: ProxyMesh, size: int) -> MeshTexture:
    """The look of `splats` on a mesh of theirs, on a picture of `size` pixels. Raises ValueError: a size that gives a
    pair of triangles less than MIN_SQUARE_PX."""
    count = len(mesh.triangles)
    across = int(np.ceil(np.sqrt((count + 1) // 2)))
    square = size // across
    if square < MIN_SQUARE_PX or size > MAX_TEXTURE_PX:
        least = across * MIN_SQUARE_PX
        raise ValueError(
            f"mesh: expected a texture of {least} to {MAX_TEXTURE_PX} pixels for {count} triangles, got {size}"
        )
    # Each pixel of a square belongs to one of its triangles, beyond whose edges the plane goes on.
    pixels = across * square
    row, column = (grid.ravel() for grid in np.indices((pixels, pixels)))
    x, y = column % square, row % square
    second = x + y > square - 1
    triangle = 2 * ((row // square) * across + column // square) + second
    inside = np.flatnonzero(triangle < count)
    # Barycentric weights of a corner triangle whose legs are `leg` pixels; the second one is the first turned around.
    leg = square - 3
    u, v = (np.where(second, square - 1 - t, t) / leg for t in (x, y))
    shares = np.stack([1 - u - v, u, v], 1)
    colors = np.empty((len(inside), 3))
    views = _views(splats, mesh, min(max(size, 64), BAKING.most_view_px))
    for first in range(0, len(inside), BAKING.points_at_once):
        chosen = inside[first : first + BAKING.points_at_once]
        corners, share = mesh.triangles[triangle[chosen]], shares[chosen][..., None]
        points, normals, near = (
            (values[corners] * share).sum(1) for values in (mesh.vertices, mesh.normals, mesh.colors)
        )
        colors[first : first + len(chosen)] = _colors(points, normals, near, views, mesh.voxel)
    picture = np.zeros((size, size, 3), np.uint8)
    picture[row[inside], column[inside]] = np.rint(colors.clip(0, 1) * 255)
    return MeshTexture(picture, _corners(count, across, square, size))


def _corners(count: int, across: int, square: int, size: int) -> Floats:
    """[T, 3, 2] float32: centres of pixels."""
    number = np.arange(count)
    start = np.stack([(number // 2) % across, (number // 2) // across], 1) * square
    leg = square - 3
    first = np.array([[0, 0], [leg, 0], [0, leg]])
    corner = np.where((number % 2)[:, None, None] == 0, first, square - 1 - first)
    return ((start[:, None] + corner + 0.5) / size).astype(np.float32)


View = tuple[Camera, np.ndarray, np.ndarray]
"""A camera, [H, W, 3] what it sees of the asset alone, [H, W] its depth, infinite where there is little."""


def _views(splats: Splats, mesh: ProxyMesh, size: int) -> list[View]:
    low, high = mesh.vertices.min(0).astype(np.float64), mesh.vertices.max(0).astype(np.float64)
    center, radius = (low + high) / 2, float(portable.length(high - low)) / 2
    distance = BAKING.margin * radius / float(portable.sin(np.deg2rad(BAKING.fov / 2)))
    views = []
    for away in fibonacci_sphere(BAKING.views):
        up = (0.0, 0.0, 1.0) if abs(away[1]) > 0.9 else (0.0, -1.0, 0.0)
        camera = look_at(center + distance * away, center, up, width=size, height=size, fov=BAKING.fov).local
        drawn = render(splats, [camera])
        alpha = np.asarray(drawn.alphas)[0, ..., 0]
        seen = alpha > BAKING.min_alpha
        colors = np.asarray(drawn.colors)[0] / np.maximum(alpha, BAKING.min_alpha)[..., None]
        depth = np.where(seen, np.asarray(drawn.depths)[0, ..., 0], np.inf)
        views.append((camera, to_display(colors, splats.color_space), depth))
    return views


def _colors(points: np.ndarray, normals: np.ndarray, near: np.ndarray, views: list[View], voxel: float) -> np.ndarray:
    """[M, 3] display colours at points [M, 3] with normals [M, 3]; near: [M, 3] where no view sees them."""
    total, weight = np.zeros((len(points), 3)), np.zeros(len(points))
    normals = normals / np.maximum(np.sqrt((normals * normals).sum(1, keepdims=True)), 1e-9)
    for camera, colors, depth in views:
        away = camera.position - points
        facing = (normals * away).sum(1) / np.maximum(np.sqrt((away * away).sum(1)), 1e-9)
        pixels, z = camera.project(points)
        # What lies behind a camera does not face it, and its pixels mean nothing.
        column, row = np.floor(np.where(z[:, None] > 0, pixels, -1)).astype(np.int64).T
        height, width = depth.shape
        visible = (facing > BAKING.grazing) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        some = np.flatnonzero(visible)
        at = row[some], column[some]
        some = some[np.abs(depth[at] - z[some]) < BAKING.depth_voxels * voxel]
        share = (facing[some] ** 2) ** 2
        total[some] += share[:, None] * colors[row[some], column[some]]
        weight[some] += share
    return np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-9)[:, None], near)
