"""One smooth surface out of the rendered depth of several views, for decals on captures.

Captures are foggy: what one view sees of a surface scatters, and at their edges fog stands out like a burr, on which no
decal finds its way around the corner. Averaged signed distances of all views in a grid of voxels (Curless and Levoy, "A
Volumetric Method for Building Complex Models from Range Images", SIGGRAPH 1996) have no gaps at edges, and what any
other view looks through is cut off.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.portable import cos, exp, power, sin
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import visible_surface
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class FusionThresholds:
    """Views of rough surface, averaged as signed distances in a grid (Curless and Levoy 1996). Source: taste, tried on
    captures."""

    grid_voxels: int = 72
    """Voxels along each edge of the grid."""
    truncation_voxels: float = 4.0
    """Distance from the surface, in voxels, up to which views are averaged."""
    max_depth: float = 3.0
    """How far behind a surface a view still says that this is inside, in truncations."""
    behind_weight: float = 0.1
    """What a view weighs from one truncation behind its surface on."""
    fusion_rounds: int = 3
    """Rounds of fusing, the first one without normals."""
    facing_exponent: int = 3
    """Power of the cosine of the angle at which a view sees the surface, as its weight: the more a line of sight lies
    along foggy surface, the deeper it sees into it."""
    min_cosine: float = 0.15
    """Least cosine in this weight."""
    blur_voxels: float = 1.5
    """Standard deviation of the blur of the distances, voxels."""
    min_weight: float = 0.1
    """Least weight of a voxel after the blur, in views that see it frontally."""
    view_directions_degrees: tuple[tuple[int, int], ...] = (
        (0, 0),
        (45, 0),
        (-45, 0),
        (90, 0),
        (-90, 0),
        (135, 0),
        (-135, 0),
        (0, 50),
        (0, -50),
    )
    """Degrees around and over the normal of the first point from which views look."""
    min_alpha: float = 0.5
    """Least alpha of pixels that show a surface."""


FUSION = FusionThresholds()


def fused_surface(
    splats: Splats,
    surface: Surface,
    start: tuple[np.ndarray, np.ndarray],
    up: np.ndarray,
    radius: float,
    facing: Callable[[np.ndarray, float], Camera],
) -> tuple[np.ndarray, np.ndarray, float]:
    """(points [S, 3], unit normals [S, 3] outwards, edge of a voxel) of the surface in a ball around a point of it,
    world units. surface: of the splats; start: (point [3], unit normal [3]); up: [3] unit tangent; facing(direction [3]
    unit, world units per pixel): a camera that looks at the ball from there."""
    # The ball around the start, in voxels; views from its front half and a little beyond.
    voxel = 2 * radius / FUSION.grid_voxels
    axis = (np.arange(FUSION.grid_voxels) + 0.5) * voxel - radius
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) + start[0]
    right = np.cross(up, start[1])
    views: list[tuple[Camera, np.ndarray]] = []
    for yaw, pitch in np.radians(FUSION.view_directions_degrees):
        direction = cos(pitch) * (cos(yaw) * start[1] + sin(yaw) * right) + sin(pitch) * up
        camera = facing(direction, voxel)
        views.append((camera, _distances(splats, surface, camera, grid, FUSION.truncation_voxels * voxel)))
    # The first average has no normals; the next weigh each view by how frontally it sees the surface so found.
    distance, weight = _averaged(views, grid, None)
    for _ in range(FUSION.fusion_rounds - 1):
        normals = _gradient(distance).reshape(-1, 3)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        distance, weight = _averaged(views, grid, normals)
    # Points on the surface are where the sign changes between neighbouring voxels.
    points, normals = _crossings(distance, weight > FUSION.min_weight)
    points = start[0] - radius + (points + 0.5) * voxel
    near = ((points - start[0]) ** 2).sum(1) < radius**2
    return points[near], normals[near], voxel


def _distances(splats: Splats, surface: Surface, camera: Camera, grid: np.ndarray, unit: float) -> np.ndarray:
    """[G] how far before the surface that a view shows points [G, 3] lie, in `unit` (world units), -1..1; NaN
    beside the picture and far behind what it shows."""
    view = project(splats, camera)
    _, alpha, depth = view.rasterize()
    solid = alpha > FUSION.min_alpha
    ys, xs = np.nonzero(solid)
    # Trusted heights where there are any, the rendered depth in fog.
    trusted = visible_surface(surface, splats, view, solid).at(np.stack([xs, ys], 1) + 0.5).depth
    depth = depth.astype(np.float64)
    depth[ys, xs] = np.where(trusted > 0, trusted, depth[ys, xs])
    depth = np.where(solid, depth, np.inf)
    uv, z = camera.project(grid)
    at = np.flatnonzero((z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height))
    x, y = uv[at].astype(int).T
    before = (depth[y, x] - z[at]) / unit
    out = np.full(len(grid), np.nan)
    # Far behind what a view shows it knows nothing: there may be another surface.
    out[at] = np.where(before > -FUSION.max_depth, np.clip(before, -1, 1), np.nan)
    return out


def _averaged(
    views: list[tuple[Camera, np.ndarray]], grid: np.ndarray, normals: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """(distance, weight), both [FUSION.grid_voxels, FUSION.grid_voxels, FUSION.grid_voxels] and blurred, of views:
    (camera, `_distances` [G] of the grid [G, 3]). normals: [G, 3] unit, of the surface nearest to each point, by which
    views are weighed."""
    total, weight = np.zeros(len(grid)), np.zeros(len(grid))
    for camera, before in views:
        share = np.isfinite(before).astype(float)
        if normals is not None:
            line = camera.position - grid
            cosine = (line * normals).sum(1) / np.linalg.norm(line, axis=1)
            share *= power(np.maximum(cosine, FUSION.min_cosine), FUSION.facing_exponent)
        # A view through a gap says "outside" of what is solid; others behind the surface outvote it only slowly.
        share *= np.where(before <= -1, FUSION.behind_weight, 1)
        total += share * np.nan_to_num(before)
        weight += share
    shape = (FUSION.grid_voxels,) * 3
    weight = _blurred(weight.reshape(shape))
    return _blurred(total.reshape(shape)) / np.maximum(weight, 1e-9), weight


def _blurred(values: np.ndarray) -> np.ndarray:
    """A volume after a Gaussian blur of FUSION.blur_voxels; nothing beyond its faces."""
    reach = int(np.ceil(2.5 * FUSION.blur_voxels))
    kernel = exp(-0.5 * (np.arange(-reach, reach + 1) / FUSION.blur_voxels) ** 2)
    kernel /= kernel.sum()
    for axis in range(3):
        padded = np.pad(values, [(reach, reach) if a == axis else (0, 0) for a in range(3)])
        moved = np.moveaxis(padded, axis, 0)
        count = values.shape[axis]
        out = np.zeros_like(moved[:count])
        for i, share in enumerate(kernel):
            out += share * moved[i : i + count]
        values = np.moveaxis(out, 0, axis)
    return values


def _gradient(values: np.ndarray) -> np.ndarray:
    """[..., 3] of a volume, per voxel."""
    return np.stack([np.gradient(values, axis=axis) for axis in range(3)], -1)


def _crossings(distance: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(points [S, 3] in voxels, unit normals [S, 3]) where a volume changes its sign between neighbours that are seen;
    normals lead where it grows."""
    gradient = _gradient(distance)
    points, normals = [], []
    for axis in range(3):
        low = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        high = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        first, second = distance[low], distance[high]
        at = np.nonzero(seen[low] & seen[high] & ((first > 0) != (second > 0)))
        # Linear between two voxels: finer than the grid.
        share = (first[at] / (first[at] - second[at]))[:, None]
        step = np.eye(3)[axis]
        points.append(np.stack(at, 1) + share * step)
        normals.append((1 - share) * gradient[low][at] + share * gradient[high][at])
    point, normal = np.concatenate(points), np.concatenate(normals)
    length = np.linalg.norm(normal, axis=1)
    valid = length > 1e-6
    return point[valid], normal[valid] / length[valid, None]
