"""An asset's Gaussians as samples of its surface, in a grid of several levels in which their neighbours are found.

A Gaussian is a patch, not a point: its level is chosen by its length, so that a cell is at least twice as wide as the
patches in it, and a query visits a few cells of every level whatever mixture of sizes the asset has.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import aligned
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix

MIN_OPACITY = 0.02
"""Fainter Gaussians say nothing about the surface."""
MIN_FLATNESS_SCALE = 1e-3
"""Shortest axis over longest, at least: flatter Gaussians count as this flat."""
LN_2 = 0.6931471805599453
MAX_LEVELS = 24
"""Cell sizes double from level to level: a range of 16 million."""
CELL_BITS = 20
"""Bits of a cell's index along each axis."""
PATCH_COLUMNS = 16
"""Of `SurfaceSamples.patches`."""


@dataclass(frozen=True)
class SurfaceSamples:
    """M samples, sorted by (level, cell)."""

    gaussian_ids: Ids = field(repr=False)
    """[M] int64 the asset's Gaussian that each is."""
    means: Floats = field(repr=False)
    """[M, 3] float32, world units."""
    axes: Floats = field(repr=False)
    """[M, 3, 3] float32 unit axes as rows, the longest first, the last one the (unsigned) normal."""
    scales: Floats = field(repr=False)
    """[M, 3] float32 standard deviations along them, world units."""
    opacities: Floats = field(repr=False)
    """[M] float32."""
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
        means = arrays.means[ids].astype(np.float32)
        # The shortest axis is the normal; sorted once here, so that queries need not look.
        order = np.argsort(-arrays.scales[ids], axis=1, kind="stable")
        scales = np.take_along_axis(arrays.scales[ids], order, 1).astype(np.float32)
        scales = np.maximum(scales, np.maximum(MIN_FLATNESS_SCALE * scales[:, :1], np.float32(1e-30)))
        axes = np.take_along_axis(quat_to_matrix(arrays.quats[ids]), order[:, None, :], 2).transpose(0, 2, 1)
        if not len(ids):
            none = np.zeros(0, np.int64)
            return SurfaceSamples(
                ids, means, np.ascontiguousarray(axes, np.float32), scales, np.zeros(0, np.float32), none,
                np.zeros(1, np.int64), np.zeros(0), np.zeros(0), np.zeros(3),
            )  # fmt: skip
        low, high = np.quantile(means, [0.001, 0.999], axis=0).astype(np.float64)
        # No smaller than indices can tell apart over the asset without its outliers.
        smallest = max(2 * float(np.quantile(scales[:, 0], 0.1)), float((high - low).max()) / (1 << (CELL_BITS - 1)))
        # Level by length: a cell is at least twice as wide as its patches, so few cells have to be visited.
        doublings = portable.log(np.maximum(2 * scales[:, 0].astype(np.float64) / smallest, 1)) / LN_2
        level = np.ceil(doublings - 1e-9)
        level = np.clip(level, 0, MAX_LEVELS - 1).astype(np.int64)
        # Far outliers share the outermost cells: indices are clamped, which finds a few neighbours too many there.
        corner = low - smallest * (1 << (CELL_BITS - 2))
        cells = np.floor((means.astype(np.float64) - corner) / (smallest * 2.0**level)[:, None])
        cells = np.clip(cells, 0, (1 << CELL_BITS) - 1).astype(np.int64)
        keys = (cells[:, 0] << 2 * CELL_BITS) | (cells[:, 1] << CELL_BITS) | cells[:, 2]
        # By level, then by cell: a query's neighbours are runs of one array.
        rank = np.lexsort((keys, level))
        level, scales = level[rank], scales[rank]
        present = np.unique(level)
        starts = np.append(np.searchsorted(level, present), len(level))
        return SurfaceSamples(
            gaussian_ids=ids[rank],
            means=means[rank],
            axes=np.ascontiguousarray(axes[rank], np.float32),
            scales=scales,
            opacities=arrays.opacities[ids][rank].astype(np.float32),
            keys=keys[rank],
            level_starts=starts.astype(np.int64),
            cell_sizes=smallest * 2.0**present,
            reaches=np.maximum.reduceat(scales[:, 0], starts[:-1]).astype(np.float64),
            min_corner=corner,
        )

    def __len__(self) -> int:
        return len(self.gaussian_ids)

    @cached_property
    def patches(self) -> Floats:
        """[M, 16] float32 what queries read of each, in one cache line: mean (3), axes (9), scales (3),
        opacity."""
        count = len(self)
        parts = (self.means, self.axes.reshape(count, 9), self.scales, self.opacities[:, None])
        out = aligned((count, PATCH_COLUMNS), np.dtype(np.float32))
        np.concatenate(parts, 1, out=out)
        return out
