"""The visible surface in one view: its smoothed z-depth, its normals, and the Gaussian that makes each pixel."""

from __future__ import annotations

import numpy as np
from numba import njit

from splatpainter.cameras import Camera
from splatpainter.kernels.parallel import run
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.splats import Splats

STOPPED_LIGHT = 0.4
"""The surface is where this much of a pixel's light has been stopped: in front of the expected depth, so that little
lies before it, but not on the first floater."""
SMOOTHING_PX = 3
"""Pixels around each one whose depths are averaged."""


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

    def slope(dy: int, dx: int) -> tuple[np.ndarray, np.ndarray]:
        y0, y1 = np.clip(ys - dy, 0, height - 1), np.clip(ys + dy, 0, height - 1)
        x0, x1 = np.clip(xs - dx, 0, width - 1), np.clip(xs + dx, 0, width - 1)
        z0, z1 = depth[y0, x0].astype(np.float64), depth[y1, x1].astype(np.float64)
        step = _camera_points(z1, y1, x1, camera) - _camera_points(z0, y0, x0, camera)
        flat = np.abs(step[:, 1] if dy else step[:, 0])
        return step, (z0 > 0) & (z1 > 0) & (np.abs(step[:, 2]) < 2.5 * flat)

    right, good_x = slope(0, SMOOTHING_PX)
    down, good_y = slope(SMOOTHING_PX, 0)
    right[~good_x], down[~good_y] = (1, 0, 0), (0, 1, 0)
    normal = np.cross(right, down)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def warm() -> None:
    """Compile (or load) the kernels of this module."""
    from splatpainter.cameras import look_at
    from splatpainter.rendering.cpu.projected_view import project

    one = np.ones((1, 3), np.float32)
    splats = Splats(one * 0, np.ones((1, 4), np.float32), one, one[:, 0] * 0.9, one[:, None])
    view = project(splats, look_at((0, 0, -3), (0, 0, 0), width=32, height=32))
    surface(view, np.ones((32, 32), bool))


def _camera_points(z: np.ndarray, ys: np.ndarray, xs: np.ndarray, camera: Camera) -> np.ndarray:
    """[A, 3] camera-space points of pixels at z-depth z."""
    return np.stack([(xs + 0.5 - camera.cx) / camera.fx * z, (ys + 0.5 - camera.cy) / camera.fy * z, z], 1)


@njit(nogil=True, cache=True, error_model="numpy")
def _stopped_at(records, members, tiles, starts, pixels, share, depth, host, thread, threads):
    """Walk each pixel's Gaussians front to back until `share` of the light is stopped; and note the heaviest."""
    height, width = pixels.shape
    across = (width + 15) // 16
    for k in range(thread, tiles.shape[0], threads):
        y0, x0 = (tiles[k] // across) * 16, (tiles[k] % across) * 16
        for y in range(y0, min(y0 + 16, height)):
            for x in range(x0, min(x0 + 16, width)):
                if not pixels[y, x]:
                    continue
                clear, best = np.float32(1), np.float32(0)
                for p in range(starts[k], starts[k + 1]):
                    i = members[p]
                    dx = records[i, 0] - (np.float32(x) + np.float32(0.5))
                    dy = records[i, 1] - (np.float32(y) + np.float32(0.5))
                    if abs(dy) > records[i, 10] or abs(dx) > records[i, 11]:  # most Gaussians of a tile
                        continue
                    sigma = records[i, 2] * dx * dx + records[i, 4] * dy * dy
                    sigma = np.float32(0.5) * sigma + records[i, 3] * dx * dy
                    alpha = min(np.float32(0.999), records[i, 5] * np.exp(-max(sigma, np.float32(0))))
                    if alpha < np.float32(1 / 255):
                        continue
                    weight = alpha * clear
                    if weight > best:
                        best = weight
                        host[y, x] = i
                    clear -= weight
                    if depth[y, x] == 0 and 1 - clear >= share:
                        depth[y, x] = records[i, 9]
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
            part = np.sort(near[:n])
            out[y, x] = part[n // 2]


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
