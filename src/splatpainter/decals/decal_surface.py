"""The surface under a decal as one view sees it, and the camera that faces a point of it. Pure."""

from __future__ import annotations

import math
from dataclasses import field

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.kernels.portable import hypot, length, matmul, symmetric_axes
from splatpainter.painter import Asset
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import VisibleSurface, visible_surface
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere
from splatpainter.voxels.raycast import first_hits, inside


@dataclass(frozen=True)
class DecalSurfaceThresholds:
    """The surface under a decal as one camera sees it. Source: taste, tried on captures."""

    min_alpha: float = 0.5
    """Alpha of a pixel from which the surface is seen there."""
    rough_residual: float = 0.2
    """rms distance of Gaussians from the surface, in its windows, from which its points and normals are smoothed: those
    of captures scatter by about half a Gaussian."""
    max_fit_px: int = 3
    """Reach of planes fitted to rendered depth where the surface is not trusted, pixels."""
    max_fit_residual: float = 1.0
    """The rms distance of the depths from such a plane, in pixels, up to which it is used."""
    mean_px: int = 48
    """Side of the picture in which the mean normal around a point is measured, at most."""
    same_side: float = 0.3
    """Cosine between a normal and that of the point from which it is one of the same side."""
    sizes_away: float = 2.5
    """Distance of a camera from a patch, in the patch's diameters: nearly parallel rays."""
    max_approaches: int = 4
    """How often a camera comes nearer where something else stands in between, at most."""
    approach: float = 0.6
    """Factor of its distance each time."""
    open_directions: int = 128
    """Directions in which a place is asked whether something stands there."""
    min_open: float = 0.02
    """Share of them without anything, up to which a place is shut in. Cameras of six places of the demo's tea set: 0.30
    to 0.98, two that stood inside the pot and looked at the back of its wall: none."""
    open_voxels: tuple[float, ...] = (2.0, 4.0, 8.0)
    """Distances before a decal's middle, voxels, of which one must be open for the decal to lie outdoors."""
    lean_steps: int = 4
    """Steps in which a camera whose sight stays blocked leans towards where its target is known to be seen from."""


DECAL_SURFACE = DecalSurfaceThresholds()


@dataclass(frozen=True)
class SurfacePixels:
    """Q pixels of a view that see the surface."""

    ys: np.ndarray = field(repr=False)
    """[Q] int64."""
    xs: np.ndarray = field(repr=False)
    """[Q] int64."""
    points: np.ndarray = field(repr=False)
    """[Q, 3] float64 world units."""
    normals: np.ndarray = field(repr=False)
    """[Q, 3] float64 unit, towards the camera."""
    rough: np.ndarray = field(repr=False)
    """[Q] bool where points and normals scatter, or come from rendered depth: to be smoothed."""
    visible: VisibleSurface | None = field(default=None, repr=False)
    """What they come from, if not from rendered depth alone."""


def surface_pixels(
    asset: Asset, surface: Surface, view: ProjectedView, pixels: np.ndarray, depth: np.ndarray
) -> SurfacePixels:
    """The surface under some pixels ([H, W] bool, of drawn tiles) of a view of the asset; where it is not trusted,
    planes through the rendered depth ([H, W] z). Pixels with neither are left out."""
    camera = view.camera
    ys, xs = np.nonzero(pixels)
    seen = visible_surface(surface, asset.splats, view, pixels)
    at = seen.at(np.stack([xs, ys], 1) + 0.5)
    trusted = at.depth > 0
    z = np.where(trusted, at.depth, depth[ys, xs])
    points = camera.unproject(z, np.stack([xs, ys], 1) + 0.5)
    normals = matmul(at.normals, camera.world_to_camera[:3, :3])
    # Rough surface is used as it is here and smoothed by the caller, who knows the decal's size.
    rough = ~trusted | (at.residuals > DECAL_SURFACE.rough_residual * at.windows)
    position = np.full((*pixels.shape, 3), np.nan)
    position[ys, xs] = points
    normals[~trusted], fitted = _fitted_normals(position, ys[~trusted], xs[~trusted], camera, z[~trusted])
    valid = trusted.copy()
    valid[~trusted] = fitted
    return SurfacePixels(ys[valid], xs[valid], points[valid], normals[valid], rough[valid], seen)


def rough_pixels(
    asset: Asset, surface: Surface, view: ProjectedView, pixels: np.ndarray, depth: np.ndarray
) -> SurfacePixels:
    """Some pixels ([H, W] bool) as if they faced the camera: where the surface is trusted, at its depth, else (rough)
    at the rendered one ([H, W] z), into which all fog before and behind it goes."""
    camera = view.camera
    ys, xs = np.nonzero(pixels)
    trusted = visible_surface(surface, asset.splats, view, pixels).at(np.stack([xs, ys], 1) + 0.5).depth
    points = camera.unproject(np.where(trusted > 0, trusted, depth[ys, xs]), np.stack([xs, ys], 1) + 0.5)
    line = camera.position - points
    return SurfacePixels(ys, xs, points, line / np.linalg.norm(line, axis=1, keepdims=True), trusted <= 0)


def _fitted_normals(
    position: np.ndarray, ys: np.ndarray, xs: np.ndarray, camera: Camera, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(normals [F, 3] towards the camera, [F] bool whether a plane fits) at F pixels of a picture of points ([H, W, 3],
    NaN: none), of z-depth [F] there, by their neighbours that are near in depth."""
    steps = np.arange(-DECAL_SURFACE.max_fit_px, DECAL_SURFACE.max_fit_px + 1)
    dy, dx = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    padded = np.pad(
        position, [(DECAL_SURFACE.max_fit_px, DECAL_SURFACE.max_fit_px)] * 2 + [(0, 0)], constant_values=np.nan
    )
    near = (
        padded[ys[:, None] + dy + DECAL_SURFACE.max_fit_px, xs[:, None] + dx + DECAL_SURFACE.max_fit_px]
        - position[ys, xs][:, None]
    )
    pixel = z / camera.fx
    reach = 2 * pixel[:, None] * (1 + hypot(dx, dy))
    weight = (np.linalg.norm(near, axis=2) < reach).astype(float)  # NaN is not near
    # Covariance of the neighbours that are near in depth; its least axis is the normal.
    near = np.nan_to_num(near) * weight[..., None]
    total = np.maximum(weight.sum(1), 1)[:, None]
    near = (near - (near.sum(1) / total)[:, None]) * weight[..., None]
    values, vectors = symmetric_axes(matmul(near.transpose(0, 2, 1), near) / total[..., None])
    normals = vectors[:, :, 0]
    line = camera.position - position[ys, xs]
    cosine = (normals * line).sum(1) / np.maximum(np.linalg.norm(line, axis=1), 1e-30)
    normals = np.where(cosine[:, None] < 0, -normals, normals)
    flat = np.sqrt(np.maximum(values[:, 0], 0)) < DECAL_SURFACE.max_fit_residual * pixel
    return normals, flat & (np.abs(cosine) > 0.3) & (total[:, 0] >= 0.5 * len(dx)) & (z > 0)


def surface_under(
    asset: Asset, surface: Surface, camera: Camera, at: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """([3] point, [3] unit normal) of the surface under a pixel (x, y). Raises ValueError where there is none."""
    x, y = at
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise ValueError(f"decal: expected a pixel of the camera's {camera.width}x{camera.height}, got {x:g},{y:g}")
    reach = 12
    left, top = max(int(x) - reach, 0), max(int(y) - reach, 0)
    # A few pixels around the click: rendering the whole view would take as long as an edit.
    window = camera.cropped(
        left, top, min(int(x) + reach, camera.width) - left, min(int(y) + reach, camera.height) - top
    )
    view = project(asset.splats, window)
    _, alpha, depth = view.rasterize()
    visible_part = surface_pixels(asset, surface, view, alpha > DECAL_SURFACE.min_alpha, depth)
    away = hypot(visible_part.xs + 0.5 - (x - left), visible_part.ys + 0.5 - (y - top))
    if not len(away) or away.min() > 2:
        # No plane fits what is scattered there: it lies at its depth, facing the camera, as the preview shows it.
        clicked = np.zeros(alpha.shape, bool)
        clicked[int(y) - top, int(x) - left] = True
        rough = rough_pixels(asset, surface, view, clicked & (alpha > DECAL_SURFACE.min_alpha), depth)
        if len(rough.points):
            return rough.points[0], rough.normals[0]
        raise ValueError(f"decal: there is no surface under pixel {x:g},{y:g}; choose one on the asset")
    first = int(away.argmin())
    # The normal is a mean over those beside it that face the same way: one pixel is noise.
    near = away < away.min() + 2
    normal = visible_part.normals[near & (matmul(visible_part.normals, visible_part.normals[first]) > 0.5)].mean(0)
    return visible_part.points[first], normal / length(normal)


def mean_normal(
    asset: Asset, surface: Surface, camera: Camera, start: tuple[np.ndarray, np.ndarray], radius: float
) -> np.ndarray:
    """[3] unit: where the surface faces around a start (point, normal), as a view sees it, the nearer the more: over a
    radius (world units) a picture does not follow every fold."""
    point, normal = start
    (pixel,), (z,) = camera.project(point[None])
    reach = radius * camera.fx / max(float(z), 1e-9)
    window = camera.cropped(int(pixel[0] - reach), int(pixel[1] - reach), int(2 * reach) + 1, int(2 * reach) + 1)
    side = min(window.width, DECAL_SURFACE.mean_px)
    window = window.resized(side, side)
    view = project(asset.splats, window)
    _, alpha, depth = view.rasterize()
    seen = surface_pixels(asset, surface, view, alpha > DECAL_SURFACE.min_alpha, depth)
    # Nearer parts count more; those of another side not at all.
    weights = np.maximum(1 - np.linalg.norm(seen.points - point, axis=1) / radius, 0)
    weights *= matmul(seen.normals, normal) > DECAL_SURFACE.same_side
    mean = (weights[:, None] * seen.normals).sum(0) + 1e-3 * normal
    return mean / length(mean)


def is_open(asset: Asset, position: np.ndarray) -> bool:
    """Whether there is a way out of the asset along some lines of sight from a position ([3]): there is none in a room,
    and none in the hollow of a pot."""
    _, hits = first_hits(asset.grid.occupancy, asset.grid, position, fibonacci_sphere(DECAL_SURFACE.open_directions))
    return bool((hits < 0).mean() > DECAL_SURFACE.min_open)


def lies_outdoors(asset: Asset, point: np.ndarray, seen_from: np.ndarray) -> bool:
    """Whether a point of the surface ([3]) is seen from a place that is open. seen_from: [3] unit, towards it."""
    return any(is_open(asset, point + n * asset.grid.voxel * seen_from) for n in DECAL_SURFACE.open_voxels)


def stands_free(asset: Asset, position: np.ndarray, outdoors: bool) -> bool:
    """Whether a camera at a position ([3]) sees what a decal lies on: not from inside something solid, and where it
    lies `outdoors` not from a hollow, which shows the back of its walls."""
    solid = inside(asset.grid, asset.grid.occupancy, position)
    return not solid and (not outdoors or is_open(asset, position))


def facing_camera(
    asset: Asset,
    target: np.ndarray,
    direction: np.ndarray,
    up: np.ndarray,
    radius: float,
    pixel: float,
    *,
    outdoors: bool,
    nearer: bool = True,
    seen_from: np.ndarray | None = None,
) -> Camera:
    """A square camera that looks at `target` ([3]) from `direction` ([3] unit, from there to the camera), with room for
    a ball of `radius` (world units) around it at `pixel` world units per pixel. It stands nearer where something is in
    between; where that does not help, it leans towards `seen_from` ([3] unit: a direction from which the target is
    seen), and where that does not either, or it must not come nearer (`nearer`), it stands at the first distance
    outside the asset. outdoors: as of `stands_free`."""
    distance, clear = _standing(asset, target, direction, radius, outdoors, nearer=nearer)
    if seen_from is None or not nearer:
        seen_from, clear = direction, True  # nowhere to lean to
    # In a crease the surface may face what stands before it, and a camera beyond that shows another body.
    for step in range(1, 1 if clear else DECAL_SURFACE.lean_steps + 1):
        share = step / DECAL_SURFACE.lean_steps
        leaning = (1 - share) * direction + share * seen_from
        if length(leaning) < 1e-6:
            continue
        leaning /= length(leaning)
        away, clear = _standing(asset, target, leaning, radius, outdoors)
        if clear:
            distance, direction = away, leaning
            break
    half = min(radius / math.sqrt(max(distance**2 - radius**2, (0.5 * distance) ** 2)), 1.5)
    size = max(int(np.ceil(2 * half * distance / pixel)), 8)
    camera = look_at(target + distance * direction, target, up, width=size, height=size)
    focal = distance / pixel
    return Camera(size, size, focal, focal, size / 2, size / 2, camera.world_to_camera, offset=None)


def _standing(
    asset: Asset, target: np.ndarray, direction: np.ndarray, radius: float, outdoors: bool, *, nearer: bool = True
) -> tuple[float, bool]:
    """(how far from a target along a direction a camera stands best, whether its sight from there is clear)."""
    # As far as is good for parallel rays, nearer if a wall or another part stands in between.
    distance, outside = DECAL_SURFACE.sizes_away * 2 * radius, 0.0
    for _ in range(DECAL_SURFACE.max_approaches):
        if stands_free(asset, target + distance * direction, outdoors):
            if not nearer or _clear(asset, target, direction, distance, radius):
                return distance, True
            outside = outside or distance
        distance *= DECAL_SURFACE.approach
    return outside or distance, False


def _clear(asset: Asset, target: np.ndarray, direction: np.ndarray, distance: float, radius: float) -> bool:
    """Whether a ray back to the target meets nothing before it."""
    grid = asset.grid
    _, hits = first_hits(grid.occupancy, grid, target + distance * direction, -direction[None])
    return bool(hits[0] < 0 or hits[0] > distance - 0.25 * radius - 3 * grid.voxel)
