"""Positions that float32 cannot hold: how coarse they are in sizes of a Gaussian, and the offset that keeps them.

The size of a Gaussian is its largest standard deviation. Knows no format.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.order_statistics import median
from splatpainter.splats import MAX_MAGNITUDE, Splats
from splatpainter.transforms import row_max

MAX_STEP = 1 / 32
"""Distance between neighbouring float32 numbers, in sizes of the median Gaussian, from which positions get an offset:
what is rounded then, at most half of it, can still not be seen."""
MAX_SAMPLE = 1 << 16
"""Gaussians, evenly spread over the rows, whose median is taken."""
Offset = tuple[float, float, float]
NO_OFFSET: Offset = (0.0, 0.0, 0.0)


def float32_step(means: np.ndarray) -> Floats:
    """[N] float64 distance between neighbouring float32 numbers at the largest coordinate of each row of [N, 3]."""
    with np.errstate(all="ignore"):  # what overflows has no neighbour
        return np.spacing(row_max(np.abs(means)).astype(np.float32)).astype(np.float64)


def steps_in_sizes(means: np.ndarray, scales: np.ndarray) -> float:
    """Median of `float32_step` of [N, 3] world positions in sizes of their Gaussians; 0 where none is finite."""
    every = max(1, len(means) // MAX_SAMPLE)
    means, scales = means[::every], scales[::every]
    with np.errstate(all="ignore"):
        reach, sizes = row_max(np.abs(means)), row_max(scales)
        usable = (reach <= MAX_MAGNITUDE) & (sizes > 0) & (sizes <= MAX_MAGNITUDE)
    if not usable.any():
        return 0.0
    return float(median(float32_step(means[usable]) / sizes[usable]))


def is_coarse(means: np.ndarray, scales: np.ndarray) -> bool:
    """Whether float32 holds these world positions [N, 3] too coarsely for Gaussians of scales [N, 3]."""
    return steps_in_sizes(means, scales) > MAX_STEP


def offset_of(means: np.ndarray, scales: np.ndarray) -> Offset:
    """The offset for world positions [N, 3] (float32 or float64) of Gaussians of scales [N, 3]: NO_OFFSET where float32
    holds them to MAX_STEP sizes, else a point amid them, of whole multiples of a power of two about as large as they
    reach, so that it is exact in every notation."""
    if not is_coarse(means, scales):
        return NO_OFFSET
    with np.errstate(all="ignore"):
        finite = means[(np.abs(means) <= MAX_MAGNITUDE).all(1)].astype(np.float64)
    center = median(finite)
    reach = 2 * float(median(np.abs(finite - center)).max())
    quantum = 2.0 ** math.ceil(math.log2(reach)) if reach > 0 else 2.0**-20
    x, y, z = (np.rint(center / quantum) * quantum).tolist()
    return x + 0.0, y + 0.0, z + 0.0


def relative(means: np.ndarray, offset: Offset) -> Floats:
    """[N, 3] float32 world positions less the offset, subtracted in float64; without an offset as they are."""
    if offset == NO_OFFSET:
        with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become inf, as they should
            return np.ascontiguousarray(means, np.float32)
    with np.errstate(all="ignore"):
        return (means.astype(np.float64) - np.array(offset)).astype(np.float32)


def coarseness(splats: Splats) -> float:
    """How far apart neighbouring float32 world positions are amid these Gaussians, in sizes of the median one."""
    every = slice(None, None, max(1, len(splats) // MAX_SAMPLE))
    with np.errstate(invalid="ignore"):  # rows may hold signalling NaN
        means = splats.numpy().means[every].astype(np.float64) + np.array(splats.offset)
    return steps_in_sizes(means, splats.numpy().scales[every])
