"""Which Gaussians lie on the surface under a sheet: each against that at the covered pixel nearest to its centre.

There may be hundreds of thousands, most of them behind the surface, out of sight: one kernel looks at each of them, and
asks for its rotation only where its longest axis leaves a doubt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from splatpainter.cameras import Camera, look_at
from splatpainter.kernels.parallel import run
from splatpainter.lift.fringe import FringedSurface
from splatpainter.lift.nearest import nearest_pixels
from splatpainter.splats import MIN_QUAT, Splats
from splatpainter.surface.visible import PixelSurface, VisibleSurface

NORMAL_SIGMAS = 2.0
"""Standard deviations along the surface's normal within which a Gaussian touches the surface, ..."""
SURFACE_WINDOWS = 0.35
"""... beside this share of the window in which the surface was estimated."""
FAR_WINDOWS = 3.0
"""Windows behind the surface from which a Gaussian is no part of a thick or foggy one."""
BESIDE, TOUCHES, FAR_BEHIND = 0, 1, 2
"""What `NearSurface.sides` says of a Gaussian."""


@dataclass(frozen=True)
class NearSurface:
    """The sheet's surface at each covered pixel, and for those beside at the nearest one."""

    nearest: np.ndarray = field(repr=False)
    """[H, W] int32 flat index of the nearest covered pixel."""
    entry: np.ndarray = field(repr=False)
    """[H, W] int64 entry of `surface` of each covered pixel, -1: not covered."""
    surface: PixelSurface
    camera: Camera

    @staticmethod
    def of(visible: VisibleSurface | FringedSurface, covered: np.ndarray) -> NearSurface:
        """covered: [H, W] bool, some."""
        ys, xs = np.nonzero(covered)
        entry = np.full(covered.shape, -1, np.int64)
        entry[ys, xs] = np.arange(len(ys))
        return NearSurface(nearest_pixels(covered), entry, visible.at(np.stack([xs, ys], 1) + 0.5), visible.camera)

    def sides(self, splats: Splats, ids: np.ndarray) -> np.ndarray:
        """[Q] uint8, of each of some Gaussians ([Q] int64): TOUCHES where it lies on the surface at the covered pixel
        nearest to its centre, FAR_BEHIND where it lies so far behind that it is no part of a thick or foggy one."""
        camera, out = self.camera, np.empty(len(ids), np.uint8)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        surface = (self.surface.depth, self.surface.normals, self.surface.windows, self.surface.residuals)
        tables = (self.nearest, self.entry, *(np.ascontiguousarray(values) for values in surface))
        arrays = (np.ascontiguousarray(values) for values in (splats.means, splats.quats, splats.scales))
        world_to_camera = np.ascontiguousarray(camera.world_to_camera, np.float64)
        run(_sides, *arrays, np.ascontiguousarray(ids, np.int64), world_to_camera, lens, *tables, out)
        return out

    def touches(self, splats: Splats, ids: np.ndarray) -> np.ndarray:
        """[Q] bool, which of some Gaussians ([Q] int64) lie on the surface."""
        return self.sides(splats, ids) == TOUCHES


@njit(nogil=True, cache=True, error_model="numpy")
def _sides(
    means,  # [N, 3]
    quats,  # [N, 4]
    scales,  # [N, 3]
    ids,  # [Q]
    turn,  # [4, 4] world to camera
    lens,  # [4] fx, fy, cx, cy
    nearest,  # [H, W] flat index of the nearest covered pixel
    entry,  # [H, W] entry of the following of each covered pixel
    depths,  # [C]
    normals,  # [C, 3] camera space
    windows,  # [C]
    residuals,  # [C] world units
    out,  # out [Q]
    thread,
    threads,
):
    height, width = nearest.shape
    count = ids.shape[0]
    for q in range(count * thread // threads, count * (thread + 1) // threads):
        out[q] = BESIDE
        i = ids[q]
        mx, my, mz = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
        x = turn[0, 0] * mx + turn[0, 1] * my + turn[0, 2] * mz + turn[0, 3]
        y = turn[1, 0] * mx + turn[1, 1] * my + turn[1, 2] * mz + turn[1, 3]
        z = turn[2, 0] * mx + turn[2, 1] * my + turn[2, 2] * mz + turn[2, 3]
        if not z > 0.0:
            continue
        u, v = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        column = int(u) if 0.0 <= u < width else (width - 1 if u >= width else 0)
        line = int(v) if 0.0 <= v < height else (height - 1 if v >= height else 0)
        line, column = divmod(nearest[line, column], width)
        at = entry[line, column]
        depth, nx, ny, nz = depths[at], normals[at, 0], normals[at, 1], normals[at, 2]
        h = (x - (column + 0.5 - lens[2]) / lens[0] * depth) * nx
        h += (y - (line + 0.5 - lens[3]) / lens[1] * depth) * ny
        h += (z - depth) * nz
        near = SURFACE_WINDOWS * windows[at] + 2.0 * residuals[at]
        if abs(h) < near:
            out[q] = TOUCHES
            continue
        longest = float(max(scales[i, 0], max(scales[i, 1], scales[i, 2])))
        if h > 1.000001 * NORMAL_SIGMAS * longest + near:
            continue
        # The normal in world axes, then along each axis of the Gaussian.
        wx = turn[0, 0] * nx + turn[1, 0] * ny + turn[2, 0] * nz
        wy = turn[0, 1] * nx + turn[1, 1] * ny + turn[2, 1] * nz
        wz = turn[0, 2] * nx + turn[1, 2] * ny + turn[2, 2] * nz
        a, b, c, d = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
        norm = max(math.sqrt(a * a + b * b + c * c + d * d), MIN_QUAT)
        a, b, c, d = a / norm, b / norm, c / norm, d / norm
        first = (1 - 2 * (c * c + d * d)) * wx + 2 * (b * c + a * d) * wy + 2 * (b * d - a * c) * wz
        second = 2 * (b * c - a * d) * wx + (1 - 2 * (b * b + d * d)) * wy + 2 * (c * d + a * b) * wz
        third = 2 * (b * d + a * c) * wx + 2 * (c * d - a * b) * wy + (1 - 2 * (b * b + c * c)) * wz
        first, second, third = first * scales[i, 0], second * scales[i, 1], third * scales[i, 2]
        limit = NORMAL_SIGMAS * math.sqrt(first * first + second * second + third * third) + near
        if abs(h) < limit:
            out[q] = TOUCHES
        elif h < -limit - FAR_WINDOWS * windows[at]:
            out[q] = FAR_BEHIND


def warm() -> None:
    """Compile (or load) the kernels."""
    visible = np.eye(4, dtype=bool)
    entry = np.where(visible, np.arange(4), -1)
    flat = PixelSurface(np.ones(4), np.tile([0.0, 0.0, -1.0], (4, 1)), np.ones(4), np.zeros(4))
    one = np.ones((1, 4), np.float32)
    splats = Splats(one[:, :3], one, one[:, :3], one[:, 0], one[:, None, :3])
    NearSurface(nearest_pixels(visible), entry, flat, look_at((0, 0, -2), (0, 0, 0), width=4, height=4)).touches(
        splats, np.zeros(1, np.int64)
    )
