"""Where a Gaussian lies in the voxel cube: a lattice of samples over its ellipsoid.

A Gaussian of peak alpha o has a footprint of 2.5 standard deviations along each axis, less where its alpha falls below
what the renderer draws. The lattice steps at most one voxel along every axis longer than a voxel (farther in huge
ones), and each sample carries the optical thickness of its cell. Sums are kept in fixed point, so that they are the
same for any order of the Gaussians and any number of threads.
"""

from __future__ import annotations

import numpy as np

from splatpainter.kernels import parallel
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.splats import Splats

SIGMAS = 2.5
"""Half-length of a footprint in standard deviations."""
MAX_VOLUMES = 4
"""Threads that sum at once, each into a volume of its own."""
MIN_GAUSSIANS_PER_VOLUME = 2000
"""Fewest Gaussians per volume: to clear and add a volume takes as long as to put this many Gaussians into it."""


def density(
    splats: Splats, gaussian_ids: np.ndarray, min_corner: np.ndarray, voxel: float, resolution: int
) -> np.ndarray:
    """[R, R, R] float32 optical thickness per voxel length that the given Gaussians ([M], all drawable) put into the
    cube of resolution^3 voxels at `min_corner`. A ray along the shortest axis of one, through its middle, picks up
    about its opacity; 3DGS knows no thickness along the others, where this errs to the opaque side."""
    # A volume a thread, added up in fixed point: the sums do not depend on how many there were.
    volumes = max(1, min(parallel.threads(), MAX_VOLUMES, len(gaussian_ids) // MIN_GAUSSIANS_PER_VOLUME))
    totals = np.zeros((volumes, resolution**3), np.int64)
    args = (gaussian_ids.astype(np.int64), min_corner.astype(np.float64), float(voxel), resolution, totals)
    parallel.run(kernels.deposit_thickness, *_arrays(splats), *args)
    result = np.empty(resolution**3, np.float32)
    parallel.run(kernels.sum_thickness, totals, result)
    return result.reshape((resolution,) * 3)


def touching(
    splats: Splats, gaussian_ids: np.ndarray, min_corner: np.ndarray, voxel: float, marked: np.ndarray
) -> np.ndarray:
    """[M] bool: which of the given Gaussians ([M], all drawable) have a footprint sample in a voxel that `marked`
    ([R, R, R] bool or uint8) holds. Those too faint to be drawn have none."""
    out = np.zeros(len(gaussian_ids), bool)
    box = min_corner[:, None] + voxel * index_bounds(marked)
    if len(gaussian_ids):
        flat = np.ascontiguousarray(marked, np.uint8).ravel()
        ids, corner = gaussian_ids.astype(np.int64), min_corner.astype(np.float64)
        parallel.run(kernels.find_touching, *_arrays(splats), ids, corner, float(voxel), len(marked), flat, box, out)
    return out


def index_bounds(volume: np.ndarray) -> np.ndarray:
    """[3, 2] int64 (first, last + 1) index along each axis of what is set in a volume; zeros where nothing is."""
    out = np.zeros((3, 2), np.int64)
    plane = np.any(volume, axis=2)
    for axis, line in enumerate((np.any(plane, axis=1), np.any(plane, axis=0), np.any(volume, axis=(0, 1)))):
        occupied = np.flatnonzero(line)
        if len(occupied):
            out[axis] = occupied[0], occupied[-1] + 1
    return out


def _arrays(splats: Splats) -> tuple[np.ndarray, ...]:
    a = splats.numpy()
    return tuple(readonly(v, np.float32) for v in (a.means, a.quats, a.scales, a.opacities))
