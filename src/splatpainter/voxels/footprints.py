"""Where a Gaussian lies in the voxel cube: a lattice of samples over its ellipsoid, as numba kernels.

A Gaussian of peak alpha o has a footprint of 2.5 standard deviations along each axis, less where its alpha falls below
what the renderer draws. The lattice steps at most one voxel along every axis longer than a voxel (farther in huge
ones), and each sample carries the optical thickness of its cell. Sums are kept in fixed point, so that they are the
same for any order of the Gaussians and any number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from splatpainter.kernels import parallel, simd
from splatpainter.rendering.profiles import MIN_ALPHA
from splatpainter.splats import Splats

SIGMAS = 2.5
"""Half-length of a footprint in standard deviations."""
MAX_SAMPLES = 4096
"""Most samples of one Gaussian: larger ones are sampled more coarsely, not longer."""
FIXED_POINT_UNIT = float(1 << 20)
"""Fixed-point steps per unit of optical thickness."""
MAX_VOLUMES = 4
"""Threads that sum at once, each into a volume of its own."""
MIN_GAUSSIANS_PER_VOLUME = 2000
"""Fewest Gaussians per volume: to clear and add a volume takes as long as to put this many Gaussians into it."""
MAX_SAMPLE_THICKNESS = 1e4
"""Cap of one sample's thickness, so that sums over a hundred million Gaussians stay below 2^63."""

_FULL_OPACITY = MIN_ALPHA * math.exp(SIGMAS**2 / 2)
_SQRT_TWO_PI = math.sqrt(2 * math.pi)


def density(
    splats: Splats, gaussian_ids: np.ndarray, min_corner: np.ndarray, voxel: float, resolution: int
) -> np.ndarray:
    """[R, R, R] float32 optical thickness per voxel length that the given Gaussians ([M], all drawable) put into the
    cube of resolution^3 voxels at `min_corner`. A ray along the shortest axis of one, through its middle, picks up
    about its opacity; 3DGS knows no thickness along the others, where this errs to the opaque side."""
    volumes = max(1, min(parallel.threads(), MAX_VOLUMES, len(gaussian_ids) // MIN_GAUSSIANS_PER_VOLUME))
    totals = np.zeros((volumes, resolution**3), np.int64)
    args = (gaussian_ids.astype(np.int64), min_corner.astype(np.float64), float(voxel), resolution, totals)
    parallel.run(_deposit, *_arrays(splats), *args)
    result = np.empty(resolution**3, np.float32)
    total = totals[0] if volumes == 1 else totals.sum(0)
    parallel.run(_floats, total, result)
    return result.reshape((resolution,) * 3)


def touching(
    splats: Splats, gaussian_ids: np.ndarray, min_corner: np.ndarray, voxel: float, marked: np.ndarray
) -> np.ndarray:
    """[M] bool: which of the given Gaussians ([M], all drawable) have a footprint sample in a voxel that `marked`
    ([R, R, R] bool or uint8) holds. Those too faint to be drawn have none."""
    out = np.zeros(len(gaussian_ids), np.uint8)
    box = min_corner[:, None] + voxel * index_bounds(marked)
    if len(gaussian_ids):
        flat = np.ascontiguousarray(marked, np.uint8).ravel()
        ids, corner = gaussian_ids.astype(np.int64), min_corner.astype(np.float64)
        parallel.run(_touch, *_arrays(splats), ids, corner, float(voxel), len(marked), flat, box, out)
    return out.astype(bool)


def index_bounds(volume: np.ndarray) -> np.ndarray:
    """[3, 2] int64 (first, last + 1) index along each axis of what is set in a volume; zeros where nothing is."""
    out = np.zeros((3, 2), np.int64)
    plane = np.any(volume, axis=2)
    for axis, line in enumerate((np.any(plane, axis=1), np.any(plane, axis=0), np.any(volume, axis=(0, 1)))):
        occupied = np.flatnonzero(line)
        if len(occupied):
            out[axis] = occupied[0], occupied[-1] + 1
    return out


def warm() -> None:
    """Compile (or load) the kernels."""
    one = np.ones((1, 3), np.float32)
    splats = Splats(one, np.ones((1, 4), np.float32), one, one[:, 0], one[:, None])
    density(splats, np.zeros(1, np.int64), np.zeros(3), 1.0, 2)
    touching(splats, np.zeros(1, np.int64), np.zeros(3), 1.0, np.ones((2, 2, 2), bool))


def _arrays(splats: Splats) -> tuple[np.ndarray, ...]:
    a = splats.numpy()
    return tuple(simd.readonly(v, np.float32) for v in (a.means, a.quats, a.scales, a.opacities))


@njit(nogil=True, cache=True, error_model="numpy")
def _steps(half_a, half_b, half_c):
    """Samples to each side of the middle along the three axes, for half-lengths in voxels."""
    spacing = 1.0
    while True:
        a = math.ceil(half_a / spacing) if half_a >= 0.5 else 0.0
        b = math.ceil(half_b / spacing) if half_b >= 0.5 else 0.0
        c = math.ceil(half_c / spacing) if half_c >= 0.5 else 0.0
        if (2 * a + 1) * (2 * b + 1) * (2 * c + 1) <= MAX_SAMPLES:
            return int(a), int(b), int(c)
        spacing *= 1.1


@njit(nogil=True, cache=True, error_model="numpy")
def _footprint(means, quats, scales, opacities, n, min_corner, voxel, resolution, keys, thickness):
    """Fill keys and thickness with Gaussian n's samples inside the cube; return their number (0 for a faint one)."""
    opacity = min(float(opacities[n]), 1.0)
    if not opacity > MIN_ALPHA:
        return 0
    sigmas = SIGMAS if opacity > _FULL_OPACITY else math.sqrt(2 * math.log(opacity / MIN_ALPHA))
    # Capped: a backdrop many cubes wide is cut, so that some of its samples fall into this one.
    max_scale = 2.0 * resolution / sigmas
    sa, sb = min(float(scales[n, 0]) / voxel, max_scale), min(float(scales[n, 1]) / voxel, max_scale)
    sc = min(float(scales[n, 2]) / voxel, max_scale)
    na, nb, nc = _steps(sa * sigmas, sb * sigmas, sc * sigmas)
    da, db, dc = 1.0 / max(na, 1), 1.0 / max(nb, 1), 1.0 / max(nc, 1)
    la, lb, lc = sa * sigmas * da, sb * sigmas * db, sc * sigmas * dc
    # A sample stands for a cell of the lattice; on an axis without steps, for the Gaussian's whole integral. Across
    # the shortest axis the alpha is what it is, so there the cells' weights sum to one.
    middle = opacity / (_SQRT_TWO_PI * min(sa, sb, sc))
    middle *= la if na > 0 else _SQRT_TWO_PI * sa
    middle *= lb if nb > 0 else _SQRT_TWO_PI * sb
    middle *= lc if nc > 0 else _SQRT_TWO_PI * sc

    w, x, y, z = float(quats[n, 0]), float(quats[n, 1]), float(quats[n, 2]), float(quats[n, 3])
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    ax, ay, az = (1 - 2 * (y * y + z * z)) * la, 2 * (x * y + w * z) * la, 2 * (x * z - w * y) * la
    bx, by, bz = 2 * (x * y - w * z) * lb, (1 - 2 * (x * x + z * z)) * lb, 2 * (y * z + w * x) * lb
    cx, cy, cz = 2 * (x * z + w * y) * lc, 2 * (y * z - w * x) * lc, (1 - 2 * (x * x + y * y)) * lc
    x = (means[n, 0] - min_corner[0]) / voxel
    y = (means[n, 1] - min_corner[1]) / voxel
    z = (means[n, 2] - min_corner[2]) / voxel
    count = 0
    for i in range(-na, na + 1):
        for j in range(-nb, nb + 1):
            for k in range(-nc, nc + 1):
                squared = (i * da) ** 2 + (j * db) ** 2 + (k * dc) ** 2
                if squared > 1.0 + 1e-9:
                    continue
                # Compared as floats: a far outlier would overflow the integer.
                px = math.floor(x + i * ax + j * bx + k * cx)
                py = math.floor(y + i * ay + j * by + k * cy)
                pz = math.floor(z + i * az + j * bz + k * cz)
                if 0 <= px < resolution and 0 <= py < resolution and 0 <= pz < resolution:
                    keys[count] = (int(px) * resolution + int(py)) * resolution + int(pz)
                    thickness[count] = middle * math.exp(-0.5 * squared * sigmas * sigmas)
                    count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def _deposit(means, quats, scales, opacities, gaussian_ids, min_corner, voxel, resolution, totals, thread, threads):
    # Each of the first few threads has a volume of its own; more would cost more memory than they save time.
    threads = min(threads, totals.shape[0])
    if thread >= threads:
        return
    total = totals[thread]
    keys = np.empty(MAX_SAMPLES, np.int64)
    thickness = np.empty(MAX_SAMPLES)
    for m in range(thread, gaussian_ids.shape[0], threads):
        count = _footprint(
            means, quats, scales, opacities, gaussian_ids[m], min_corner, voxel, resolution, keys, thickness
        )
        for s in range(count):
            # In this order NaN becomes 0: casts of NaN are undefined.
            total[keys[s]] += int(min(max(0.0, thickness[s]), MAX_SAMPLE_THICKNESS) * FIXED_POINT_UNIT + 0.5)


@njit(nogil=True, cache=True, error_model="numpy")
def _floats(total, out, thread, threads):
    """Floats from fixed point: np.divide, which casts piece by piece, takes six times as long."""
    for i in range(total.shape[0] * thread // threads, total.shape[0] * (thread + 1) // threads):
        out[i] = np.float32(total[i] / FIXED_POINT_UNIT)


@njit(nogil=True, cache=True, error_model="numpy")
def _touch(
    means, quats, scales, opacities, gaussian_ids, min_corner, voxel, resolution, marked, box, out, thread, threads
):
    keys = np.empty(MAX_SAMPLES, np.int64)
    thickness = np.empty(MAX_SAMPLES)
    for m in range(thread, gaussian_ids.shape[0], threads):
        n = gaussian_ids[m]
        reach = SIGMAS * max(scales[n, 0], scales[n, 1], scales[n, 2])
        near = True
        for axis in range(3):
            mean = means[n, axis]
            near = near and mean + reach >= box[axis, 0] and mean - reach <= box[axis, 1]
        if not near:
            continue
        count = _footprint(means, quats, scales, opacities, n, min_corner, voxel, resolution, keys, thickness)
        for s in range(count):
            if marked[keys[s]]:
                out[m] = 1
                break
