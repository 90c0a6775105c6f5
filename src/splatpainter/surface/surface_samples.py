"""An asset's Gaussians as samples of its surface, in a grid of several levels in which their neighbours are found.

A Gaussian is a patch, not a point: its level is chosen by its length, so that a cell is at least twice as wide as the
patches in it, and a query visits a few cells of every level whatever mixture of sizes the asset has.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import aligned, readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.order_statistics import distinct, quantile
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max

MIN_OPACITY = 0.02
"""Fainter Gaussians say nothing about the surface."""
MIN_LENGTH = 1e-30
"""World units below which no axis counts as shorter."""
MAX_LEVELS = 24
"""Cell sizes double from level to level: a range of 16 million."""
CELL_BITS = 20
"""Bits of a cell's index along each axis."""
PATCH_COLUMNS = 16
"""Of `SurfaceSamples.patches`."""
SCALES = slice(12, 15)
"""Those of the standard deviations."""


@dataclass(frozen=True)
class SurfaceSamples:
    """M samples, sorted by (level, cell)."""

    patches: Floats = field(repr=False)
    """[M, 16] float32 what queries read of each, in one cache line: mean (3), unit axes (9), the longest first, the
    last one the (unsigned) normal, standard deviations along them (3), opacity; lengths in world units."""
    keys: Ids = field(repr=False)
    """[M] int64 cell of each, ascending within a level: x, y, z of CELL_BITS bits each."""
    level_starts: Ids = field(repr=False)
    """[L + 1] int64: samples of level l are level_starts[l] .. level_starts[l + 1]."""
    cell_sizes: Floats = field(repr=False)
    """[L] float64 edges of the cells, world units."""
    reaches: Floats = field(repr=False)
    """[L] float64 largest standard deviation in each level."""
    min_corner: Floats = field(repr=False)
    """[3] float64."""

    @staticmethod
    def of(splats: Splats) -> SurfaceSamples:
        """Samples of the Gaussians that can be drawn and are not nearly transparent. splats: numpy, float32."""
        arrays = splats.numpy()
        ids = np.flatnonzero(splats.drawable & (arrays.opacities >= MIN_OPACITY))
        means = arrays.means[ids].astype(np.float32, copy=False)
        longest = np.maximum(row_max(arrays.scales[ids]).astype(np.float32, copy=False), np.float32(MIN_LENGTH))
        if not len(ids):
            nothing, no_keys = np.zeros((0, PATCH_COLUMNS), np.float32), np.zeros(0, np.int64)
            return SurfaceSamples(nothing, no_keys, np.zeros(1, np.int64), np.zeros(0), np.zeros(0), np.zeros(3))
        low, high = (quantile(means, np.float64(share)) for share in (0.001, 0.999))
        # No smaller than indices can tell apart over the asset without its outliers.
        smallest = max(2 * float(quantile(longest, 0.1)), float((high - low).max()) / (1 << (CELL_BITS - 1)))
        # Level by length: a cell is at least twice as wide as its patches, so few cells have to be visited.
        doublings = portable.log(np.maximum(2 * longest.astype(np.float64) / smallest, 1)) / portable.LN_2
        level = np.ceil(doublings - 1e-9)
        level = np.clip(level, 0, MAX_LEVELS - 1).astype(np.int64)
        # Far outliers share the outermost cells: indices are clamped, which finds a few neighbours too many there.
        corner = low - smallest * (1 << (CELL_BITS - 2))
        cells = np.floor((means.astype(np.float64) - corner) / (smallest * 2.0**level)[:, None])
        cells = np.clip(cells, 0, (1 << CELL_BITS) - 1).astype(np.int64)
        keys = (cells[:, 0] << 2 * CELL_BITS) | (cells[:, 1] << CELL_BITS) | cells[:, 2]
        # By level, then by cell: a query's neighbours are runs of one array.
        rank = _order_of(level, keys)
        level = level[rank]
        present = distinct(level)
        starts = np.append(np.searchsorted(level, present), len(level))
        patches = aligned((len(ids), PATCH_COLUMNS), np.dtype(np.float32))
        attributes = (arrays.means, arrays.quats, arrays.scales, arrays.opacities)
        run(kernels.fill_patches, ids[rank], *(readonly(values, np.float32) for values in attributes), patches)
        return SurfaceSamples(
            patches=patches,
            keys=keys[rank],
            level_starts=starts.astype(np.int64),
            cell_sizes=smallest * 2.0**present,
            reaches=np.maximum.reduceat(longest[rank], starts[:-1]).astype(np.float64),
            min_corner=corner,
        )

    def __len__(self) -> int:
        return len(self.patches)


def _order_of(level: Ids, keys: Ids) -> Ids:
    """[M] int64 as np.lexsort((keys, level)), of numbers >= 0: by 16 bits after the other, which numpy counts in place
    of comparing, in a quarter of the time. level: [M] below 2^16, M > 0."""
    order = np.arange(len(keys))
    for values in (*(keys >> shift for shift in range(0, 3 * CELL_BITS, 16)), level):
        digits = values.astype(np.uint16)
        if (digits != digits[0]).any():
            order = order[np.argsort(digits[order], kind="stable")]
    return order
