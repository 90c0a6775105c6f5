"""The detail layer: pixel-sized rows on the painted surface, only where split rows cannot follow the picture.

Splitting alone needs a row per pixel *and layer* of a capture's fog for a sharp edge; once the fog has been painted
coarsely, one thin row per wrong pixel does the rest, and from other sides what it misses is painted too. Spawned on an
unpainted surface the same rows are crisp in the edited view and wrong elsewhere (docs/LOG.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from splatpainter.cameras import Camera
from splatpainter.kernels.parallel import run
from splatpainter.lift.colors import recolor
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.splats import MAX_MAGNITUDE, Splats

DEPTH = 0.4
"""The surface is where this much of a pixel's light has been stopped: in front of the expected depth, so that little
lies before the new rows, but not on the first floater."""
WIDTH = 0.45
"""Standard deviation of a detail row across the line of sight, in pixels. Against 0.6 on 8 painted training meshes:
32.8 dB in the edited view, not 32.1, and 26.3 beside it, not 26.2; 0.2 to 0.5 dB on captures. Narrower ones would leave
holes in views from nearer."""
THIN = 0.15
"""Thickness / width."""
OPACITY = 0.9
STEEPEST = 3.0
"""A row is stretched along a slanted surface at most this much."""
_SMOOTH = 3
"""Pixels around each one whose depths are averaged."""


@dataclass(frozen=True)
class Detail:
    """Rows for some pixels."""

    splats: Splats
    host: np.ndarray
    """[A] entries of the frame (0..M) that gave those pixels most of their colour."""


def detail_rows(splats: Splats, frame: ProjectedView, pixels: np.ndarray, wanted: np.ndarray) -> Detail | None:
    """One row per wanted pixel, of the wanted colour and the host's SH bands >= 1. pixels: [H, W] bool; wanted:
    [H, W, 3]; frame: of `splats`. None when no pixel has a surface."""
    camera = frame.camera
    depth, host = surface(frame, grown(pixels, 2 * _SMOOTH))
    ys, xs = np.nonzero(pixels & (depth > 0) & (host >= 0))
    if not len(ys):
        return None
    z = depth[ys, xs].astype(np.float64)
    normal = _normals(depth, ys, xs, camera)
    # Axes in the surface whose projections are about one pixel's width along x and y of the picture.
    facing = np.where(np.abs(normal[:, 2]) > 0.25, normal[:, 2], np.where(normal[:, 2] < 0, -0.25, 0.25))
    along = np.stack([np.ones(len(z)), np.zeros(len(z)), -normal[:, 0] / facing], 1)
    stretch = np.linalg.norm(along, axis=1)
    along /= stretch[:, None]
    across = np.cross(normal, along)
    tall = 1 / np.maximum(np.abs(across[:, 1]), 0.25)
    turn = camera.world_to_camera[:3, :3]
    rotation = np.einsum("ji,njk->nik", turn, np.stack([along, across, np.cross(along, across)], 2))
    width = WIDTH * z / camera.fx
    scales = np.stack([width * np.minimum(stretch, STEEPEST), width * np.minimum(tall, STEEPEST), width * THIN], 1)
    means = (_points(z, ys, xs, camera) - camera.world_to_camera[:3, 3]) @ turn
    if not max(np.abs(means).max(), scales.max()) <= MAX_MAGNITUDE:  # seen through a lens beyond all measure
        return None
    entries = host[ys, xs]
    hosts = splats.take(frame.gaussian_ids[entries])
    sh = recolor(hosts.sh, frame.unclamped_colors[entries], wanted[ys, xs], 1.0)
    kind = splats.means.dtype
    rows = Splats(
        means.astype(kind),
        _quaternions(rotation).astype(kind),
        scales.astype(kind),
        np.full(len(z), OPACITY, kind),
        sh.astype(kind),
        splats.antialiased,
        splats.color_space,
        hosts.source,
        hosts.origin,
    )
    return Detail(rows, entries)


def surface(frame: ProjectedView, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([H, W] float32 smoothed z-depth of the surface, 0 where there is none, [H, W] int32 entry of the frame that
    weighs most in the pixel, -1 for none), for the given pixels ([H, W] bool) of drawn tiles."""
    shape = pixels.shape
    raw, host = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
    chosen = np.ascontiguousarray(pixels)
    run(
        _stopped_at,
        frame.projected,
        frame.flatten_ids,
        frame.tile_ids,
        frame.isect_offsets,
        chosen,
        np.float32(DEPTH),
        raw,
        host,
    )
    middle, smooth = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    run(_medians, raw, middle)
    run(_means, middle, smooth)
    return smooth, host


def warm() -> None:
    """Compile (or load) the kernels of this module."""
    from splatpainter.cameras import look_at
    from splatpainter.rendering.cpu.projected_view import project

    one = np.ones((1, 3), np.float32)
    splats = Splats(one * 0, np.ones((1, 4), np.float32), one, one[:, 0] * 0.9, one[:, None])
    frame = project(splats, look_at((0, 0, -3), (0, 0, 0), width=32, height=32))
    surface(frame, np.ones((32, 32), bool))


@njit(nogil=True, cache=True, error_model="numpy")
def _stopped_at(records, members, tiles, starts, pixels, share, depth, host, thread, threads):
    """Walk each pixel's rows front to back until `share` of the light is stopped; and note the heaviest row."""
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
                    if abs(dy) > records[i, 10] or abs(dx) > records[i, 11]:  # most rows of a tile
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
    """Median of the known depths around each known one."""
    height, width = depth.shape
    near = np.empty((2 * _SMOOTH + 1) ** 2, np.float32)
    for y in range(thread, height, threads):
        for x in range(width):
            if not depth[y, x] > 0:  # NaN too
                continue
            n = 0
            for v in range(max(y - _SMOOTH, 0), min(y + _SMOOTH + 1, height)):
                for u in range(max(x - _SMOOTH, 0), min(x + _SMOOTH + 1, width)):
                    if depth[v, u] > 0:
                        near[n] = depth[v, u]
                        n += 1
            part = np.sort(near[:n])
            out[y, x] = part[n // 2]


@njit(nogil=True, cache=True, error_model="numpy")
def _means(depth, out, thread, threads):
    """Mean of the known depths around each known one that lie on the same surface (within 2 %)."""
    height, width = depth.shape
    for y in range(thread, height, threads):
        for x in range(width):
            z = depth[y, x]
            if not z > 0:
                continue
            total, n = np.float32(0), 0
            for v in range(max(y - _SMOOTH, 0), min(y + _SMOOTH + 1, height)):
                for u in range(max(x - _SMOOTH, 0), min(x + _SMOOTH + 1, width)):
                    if depth[v, u] > 0 and abs(depth[v, u] - z) < np.float32(0.02) * z:
                        total += depth[v, u]
                        n += 1
            out[y, x] = total / np.float32(n)


def _points(z: np.ndarray, ys: np.ndarray, xs: np.ndarray, camera: Camera) -> np.ndarray:
    """[A, 3] camera-space points of pixels at z-depth z."""
    return np.stack([(xs + 0.5 - camera.cx) / camera.fx * z, (ys + 0.5 - camera.cy) / camera.fy * z, z], 1)


def _normals(depth: np.ndarray, ys: np.ndarray, xs: np.ndarray, camera: Camera) -> np.ndarray:
    """[A, 3] unit normals in camera space from depths three pixels away; towards the camera where the depth breaks."""
    height, width = depth.shape

    def slope(dy: int, dx: int) -> tuple[np.ndarray, np.ndarray]:
        y0, y1 = np.clip(ys - dy, 0, height - 1), np.clip(ys + dy, 0, height - 1)
        x0, x1 = np.clip(xs - dx, 0, width - 1), np.clip(xs + dx, 0, width - 1)
        z0, z1 = depth[y0, x0].astype(np.float64), depth[y1, x1].astype(np.float64)
        step = _points(z1, y1, x1, camera) - _points(z0, y0, x0, camera)
        flat = np.abs(step[:, 1] if dy else step[:, 0])
        return step, (z0 > 0) & (z1 > 0) & (np.abs(step[:, 2]) < 2.5 * flat)

    right, good_x = slope(0, _SMOOTH)
    down, good_y = slope(_SMOOTH, 0)
    right[~good_x], down[~good_y] = (1, 0, 0), (0, 1, 0)
    normal = np.cross(right, down)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def _quaternions(rotation: np.ndarray) -> np.ndarray:
    """[A, 3, 3] rotation matrices -> [A, 4] w, x, y, z, by the largest of the four diagonals (Shepperd 1978)."""
    m = rotation
    squares = np.stack(
        [
            1 + m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2],
            1 + m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2],
            1 - m[:, 0, 0] + m[:, 1, 1] - m[:, 2, 2],
            1 - m[:, 0, 0] - m[:, 1, 1] + m[:, 2, 2],
        ],
        1,
    )
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    choices = np.stack(
        [
            np.stack([squares[:, 0], wx, wy, wz], 1),
            np.stack([wx, squares[:, 1], xy, xz], 1),
            np.stack([wy, xy, squares[:, 2], yz], 1),
            np.stack([wz, xz, yz, squares[:, 3]], 1),
        ],
        1,
    )
    quats = choices[np.arange(len(m)), squares.argmax(1)]
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def grown(mask: np.ndarray, reach: int) -> np.ndarray:
    """[H, W] bool: pixels within `reach` of a set one along x and y."""
    out = mask.copy()
    for axis in (0, 1):
        source, target = np.moveaxis(out.copy(), axis, 0), np.moveaxis(out, axis, 0)
        for step in range(1, min(reach, len(source) - 1) + 1):
            target[step:] |= source[:-step]
            target[:-step] |= source[step:]
    return out
