"""The visible surface in one view (its smoothed z-depth, its normals, and the Gaussian that makes each pixel), and the
normals of Gaussians: their shortest axes, turned to the side from which they are seen."""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.cameras import Camera, orbit
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import quat_to_matrix, row_norm


@dataclass(frozen=True)
class VisibleNormalThresholds:
    """Where a view's surface is taken to be, and the ring of views that tells outside from inside. Source: taste."""

    stopped_light: float = 0.4
    """The surface is where this much of a pixel's light has been stopped: in front of the expected depth, so that
    little lies before it, but not on the first floater."""
    smoothing_px: int = 3
    """Pixels around each one whose depths are averaged."""
    ring_views: int = 8
    """Views around the asset that decide which side of a Gaussian is its outside."""
    ring_px: int = 160
    """Pixels of their edges."""


VISIBLE_NORMALS = VisibleNormalThresholds()


def surface(view: ProjectedView, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([H, W] float32 smoothed z-depth of the surface, 0 where there is none, [H, W] int32 entry of the view that
    weighs most in the pixel, -1 for none), for the given pixels ([H, W] bool) of drawn tiles."""
    shape = pixels.shape
    raw, host = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
    chosen, share = np.ascontiguousarray(pixels), np.float32(VISIBLE_NORMALS.stopped_light)
    run(
        kernels.find_stopping_depths,
        view.projected,
        view.flatten_ids,
        view.tile_ids,
        view.isect_offsets,
        chosen,
        share,
        raw,
        host,
    )
    # Medians first take out single wrong depths at edges; means then smooth what is left without smearing those.
    medians, smooth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    run(kernels.take_depth_medians, raw, medians)
    run(kernels.take_depth_means, medians, smooth)
    return smooth, host


def surface_normals(depth: np.ndarray, ys: np.ndarray, xs: np.ndarray, camera: Camera) -> np.ndarray:
    """[A, 3] unit normals in camera space of pixels, from depths [H, W] VISIBLE_NORMALS.smoothing_px away; towards the
    camera where the depth breaks."""
    height, width = depth.shape

    def at(xs: np.ndarray, ys: np.ndarray, z: np.ndarray) -> np.ndarray:
        return camera.sight_lines(np.stack([xs, ys], 1) + 0.5) * z[:, None]

    def slope(dy: int, dx: int) -> tuple[np.ndarray, np.ndarray]:
        y0, y1 = np.clip(ys - dy, 0, height - 1), np.clip(ys + dy, 0, height - 1)
        x0, x1 = np.clip(xs - dx, 0, width - 1), np.clip(xs + dx, 0, width - 1)
        z0, z1 = depth[y0, x0].astype(np.float64), depth[y1, x1].astype(np.float64)
        step = at(x1, y1, z1) - at(x0, y0, z0)
        # Steeper than 2.5 to 1 is a break in depth: a difference across it says nothing of the surface.
        flat = np.abs(step[:, 1] if dy else step[:, 0])
        return step, (z0 > 0) & (z1 > 0) & (np.abs(step[:, 2]) < 2.5 * flat)

    right, good_x = slope(0, VISIBLE_NORMALS.smoothing_px)
    down, good_y = slope(VISIBLE_NORMALS.smoothing_px, 0)
    # Without a slope along an axis the surface counts as facing the camera along it.
    right[~good_x], down[~good_y] = (1, 0, 0), (0, 1, 0)
    normal = np.cross(right, down)
    return normal / np.maximum(row_norm(normal)[:, None], 1e-12)


def outward_normals(splats: Splats) -> Floats:
    """[N, 3] float32 unit shortest axes, turned towards the side from which a ring of views sees the Gaussian (else
    away from the asset's centre); zeros for those that cannot be drawn. Colours have no part in them. At least one
    Gaussian must be drawable."""
    drawable = splats.drawable
    if not drawable.all():
        return scattered(outward_normals(splats.take(drawable)), drawable)
    n = len(splats)
    # The shortest axis is the normal, up to its sign: the views say which side is outside.
    normal = quat_to_matrix(splats.quats)[np.arange(n), :, splats.scales.argmin(1)]
    # Median and quantile, not mean and maximum: floaters far away must not move the ring.
    center = np.median(splats.means, 0)
    radius = float(np.quantile(row_norm(splats.means - center), 0.98))
    towards = 1e-3 * (splats.means - center) / max(radius, 1e-9)  # [N, 3] mean direction to the views that see it
    shape = (VISIBLE_NORMALS.ring_px, VISIBLE_NORMALS.ring_px)
    for k in range(VISIBLE_NORMALS.ring_views):
        # From above and from below in turn, so that lids and undersides are seen as well.
        tilt = 35.0 if k % 2 else -20.0
        start = 360.0 * k / VISIBLE_NORMALS.ring_views
        camera = orbit(
            center,
            2.8 * radius,
            1,
            elevation=tilt,
            start=start,
            width=VISIBLE_NORMALS.ring_px,
            height=VISIBLE_NORMALS.ring_px,
        )[0]
        projected = project(splats, camera.local)
        # How many pixels show each Gaussian, and how many would if nothing hid it.
        sums = projected.backproject(np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))
        away = camera.position.astype(np.float32) - splats.means[projected.gaussian_ids]
        # What shimmers through the far wall is seen from within.
        weight = np.where(sums.weight > 0.1 * sums.alpha, sums.weight, 0)
        towards[projected.gaussian_ids] += weight[:, None] * away / row_norm(away)[:, None]
    side = (normal * towards).sum(1)
    normal = np.where(side[:, None] < 0, -normal, normal)
    return normal.astype(np.float32)


def scattered(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """values [M, ...] at the M set entries of mask [N] bool, zeros elsewhere."""
    full = np.zeros((len(mask), *values.shape[1:]), values.dtype)
    full[mask] = values
    return full
