"""The visible surface in one view (its smoothed z-depth, its normals, and the Gaussian that makes each pixel), and the
normals of Gaussians: their shortest axes, turned to the side from which they are seen."""

from __future__ import annotations

import numpy as np
from numba import njit

from splatpainter.cameras import Camera, look_at, orbit
from splatpainter.kernels.parallel import run
from splatpainter.rendering.cpu.geometry import (
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    EXTENT_X,
    EXTENT_Y,
    MEAN_X,
    MEAN_Y,
    OPACITY,
)
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix

STOPPED_LIGHT = 0.4
"""The surface is where this much of a pixel's light has been stopped: in front of the expected depth, so that little
lies before it, but not on the first floater."""
SMOOTHING_PX = 3
"""Pixels around each one whose depths are averaged."""
RING_VIEWS = 8
"""Views around the asset that decide which side of a Gaussian is its outside."""
RING_PX = 160
"""Pixels of their edges."""


def surface(view: ProjectedView, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([H, W] float32 smoothed z-depth of the surface, 0 where there is none, [H, W] int32 entry of the view that
    weighs most in the pixel, -1 for none), for the given pixels ([H, W] bool) of drawn tiles."""
    shape = pixels.shape
    raw, host = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
    chosen, share = np.ascontiguousarray(pixels), np.float32(STOPPED_LIGHT)
    run(_stopped_at, view.projected, view.flatten_ids, view.tile_ids, view.isect_offsets, chosen, share, raw, host)
    medians, smooth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    run(_medians, raw, medians)
    run(_means, medians, smooth)
    return smooth, host


def surface_normals(depth: np.ndarray, ys: np.ndarray, xs: np.ndarray, camera: Camera) -> np.ndarray:
    """[A, 3] unit normals in camera space of pixels, from depths [H, W] SMOOTHING_PX away; towards the camera where the
    depth breaks."""
    height, width = depth.shape

    def at(xs: np.ndarray, ys: np.ndarray, z: np.ndarray) -> np.ndarray:
        return camera.sight_lines(np.stack([xs, ys], 1) + 0.5) * z[:, None]

    def slope(dy: int, dx: int) -> tuple[np.ndarray, np.ndarray]:
        y0, y1 = np.clip(ys - dy, 0, height - 1), np.clip(ys + dy, 0, height - 1)
        x0, x1 = np.clip(xs - dx, 0, width - 1), np.clip(xs + dx, 0, width - 1)
        z0, z1 = depth[y0, x0].astype(np.float64), depth[y1, x1].astype(np.float64)
        step = at(x1, y1, z1) - at(x0, y0, z0)
        flat = np.abs(step[:, 1] if dy else step[:, 0])
        return step, (z0 > 0) & (z1 > 0) & (np.abs(step[:, 2]) < 2.5 * flat)

    right, good_x = slope(0, SMOOTHING_PX)
    down, good_y = slope(SMOOTHING_PX, 0)
    right[~good_x], down[~good_y] = (1, 0, 0), (0, 1, 0)
    normal = np.cross(right, down)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def outward_normals(splats: Splats) -> np.ndarray:
    """[N, 3] float32 unit shortest axes, turned towards the side from which a ring of views sees the Gaussian (else
    away from the asset's centre); zeros for those that cannot be drawn. Colours have no part in them. At least one
    Gaussian must be drawable."""
    drawable = splats.drawable
    if not drawable.all():
        return scattered(outward_normals(splats.take(drawable)), drawable)
    n = len(splats)
    normal = quat_to_matrix(splats.quats)[np.arange(n), :, splats.scales.argmin(1)]
    center = np.median(splats.means, 0)
    radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.98))
    towards = 1e-3 * (splats.means - center) / max(radius, 1e-9)  # [N, 3] mean direction to the views that see it
    shape = (RING_PX, RING_PX)
    for k in range(RING_VIEWS):
        tilt = 35.0 if k % 2 else -20.0
        start = 360.0 * k / RING_VIEWS
        camera = orbit(center, 2.8 * radius, 1, elevation=tilt, start=start, width=RING_PX, height=RING_PX)[0]
        projected = project(splats, camera.local)
        sums = projected.backproject(np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))
        away = camera.position.astype(np.float32) - splats.means[projected.gaussian_ids]
        # What shimmers through the far wall is seen from within.
        weight = np.where(sums.weight > 0.1 * sums.alpha, sums.weight, 0)
        towards[projected.gaussian_ids] += weight[:, None] * away / np.linalg.norm(away, axis=1, keepdims=True)
    side = np.einsum("ni,ni->n", normal, towards)
    normal = np.where(side[:, None] < 0, -normal, normal)
    return normal.astype(np.float32)


def scattered(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """values [M, ...] at the M set entries of mask [N] bool, zeros elsewhere."""
    full = np.zeros((len(mask), *values.shape[1:]), values.dtype)
    full[mask] = values
    return full


def warm() -> None:
    """Compile (or load) the kernels of this module."""
    one = np.ones((1, 3), np.float32)
    splats = Splats(one * 0, np.ones((1, 4), np.float32), one, one[:, 0] * 0.9, one[:, None])
    view = project(splats, look_at((0, 0, -3), (0, 0, 0), width=32, height=32))
    surface(view, np.ones((32, 32), bool))


@njit(nogil=True, cache=True, error_model="numpy")
def _stopped_at(projected, flatten_ids, tile_ids, isect_offsets, pixels, share, depth, host, thread, threads):
    """Walk each pixel's Gaussians front to back until `share` of the light is stopped; and note the heaviest."""
    height, width = pixels.shape
    across = (width + 15) // 16
    for k in range(thread, tile_ids.shape[0], threads):
        y0, x0 = (tile_ids[k] // across) * 16, (tile_ids[k] % across) * 16
        for y in range(y0, min(y0 + 16, height)):
            for x in range(x0, min(x0 + 16, width)):
                if not pixels[y, x]:
                    continue
                clear, best = np.float32(1), np.float32(0)
                for p in range(isect_offsets[k], isect_offsets[k + 1]):
                    i = flatten_ids[p]
                    dx = projected[i, MEAN_X] - (np.float32(x) + np.float32(0.5))
                    dy = projected[i, MEAN_Y] - (np.float32(y) + np.float32(0.5))
                    if abs(dy) > projected[i, EXTENT_Y] or abs(dx) > projected[i, EXTENT_X]:  # most Gaussians of a tile
                        continue
                    sigma = projected[i, CONIC_A] * dx * dx + projected[i, CONIC_C] * dy * dy
                    sigma = np.float32(0.5) * sigma + projected[i, CONIC_B] * dx * dy
                    alpha = min(np.float32(0.999), projected[i, OPACITY] * np.exp(-max(sigma, np.float32(0))))
                    if alpha < np.float32(1 / 255):
                        continue
                    weight = alpha * clear
                    if weight > best:
                        best = weight
                        host[y, x] = i
                    clear -= weight
                    if depth[y, x] == 0 and 1 - clear >= share:
                        depth[y, x] = projected[i, DEPTH]
                    if clear < np.float32(1e-3):
                        break


@njit(nogil=True, cache=True, error_model="numpy")
def _medians(depth, out, thread, threads):
    """Median of the depths around each pixel that has one."""
    height, width = depth.shape
    near = np.empty((2 * SMOOTHING_PX + 1) ** 2, np.float32)
    for y in range(thread, height, threads):
        for x in range(width):
            if not depth[y, x] > 0:  # NaN too
                continue
            n = 0
            for v in range(max(y - SMOOTHING_PX, 0), min(y + SMOOTHING_PX + 1, height)):
                for u in range(max(x - SMOOTHING_PX, 0), min(x + SMOOTHING_PX + 1, width)):
                    if depth[v, u] > 0:
                        near[n] = depth[v, u]
                        n += 1
            out[y, x] = _smallest(near, n, n // 2)


@njit(nogil=True, cache=True, error_model="numpy")
def _smallest(values, count, rank):
    """The value that would have a rank (0: the smallest) if the first so many were sorted; puts them into another
    order (Hoare's quickselect)."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]


@njit(nogil=True, cache=True, error_model="numpy")
def _means(depth, out, thread, threads):
    """Mean of the depths around each pixel that has one that lie on the same surface (within 2 %)."""
    height, width = depth.shape
    for y in range(thread, height, threads):
        for x in range(width):
            z = depth[y, x]
            if not z > 0:
                continue
            total, n = np.float32(0), 0
            for v in range(max(y - SMOOTHING_PX, 0), min(y + SMOOTHING_PX + 1, height)):
                for u in range(max(x - SMOOTHING_PX, 0), min(x + SMOOTHING_PX + 1, width)):
                    if depth[v, u] > 0 and abs(depth[v, u] - z) < np.float32(0.02) * z:
                        total += depth[v, u]
                        n += 1
            out[y, x] = total / np.float32(n)
