"""Height, normal, window, residual and trust of the surface at any points, seen from any side.

Around a query point p the asset is a mixture of patches. Seen through a Gaussian window of width h, each patch is again
a Gaussian (the product of both), with mean u and covariance P; the moments of their mixture give a plane by moving
least squares (Levin 2003), without stand-ins for long patches. Patches of another layer along the line of sight, and
patches that face elsewhere, lose their vote in a few reweighted rounds (as in Oztireli et al. 2009), so both sides of a
thin wall stay apart and creases stay sharp. On a curved surface a plane through the centres lies inside and the
patches' own tangent planes lie outside; the offset along the mean of both normals is right to second order.

Centres are the surface of clean assets. Optimised ones show the front of a cloud of Gaussians whose centres lie half a
width behind it: where centres scatter about their plane, the height is where rays along the normal lose their light.

Nothing depends on the order of samples or on the number of threads: every query is computed alone
(native/surface/estimate.h, with the constants of all that).
"""

from __future__ import annotations

from dataclasses import field
from functools import cached_property

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.order_statistics import median
from splatpainter.splats import Splats
from splatpainter.surface.surface_samples import SCALES, SurfaceSamples
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class SurfacePoints:
    """What is known at Q queries."""

    points: Floats = field(repr=False)
    """[Q, 3] float64 on the surface, on the query's line of sight unless that grazes the surface or misses it."""
    normals: Floats = field(repr=False)
    """[Q, 3] float64 unit, towards the viewer."""
    windows: Floats = field(repr=False)
    """[Q] float64 h, world units."""
    residuals: Floats = field(repr=False)
    """[Q] float64 rms distance of the patches' centres from the surface, in windows."""
    patches: Floats = field(repr=False)
    """[Q] float64 effective number of patches behind the estimate; 0: there is no surface."""
    agreement: Floats = field(repr=False)
    """[Q] float64 0..1 mean |cosine| between the patches' normals and the surface's."""
    trust: Floats = field(repr=False)
    """[Q] float64 0..1 probability that the height is off by less than 0.3 widths of the Gaussians seen there."""


@dataclass(frozen=True)
class Surface:
    """The surface of one asset, as it was before all edits."""

    samples: SurfaceSamples

    @staticmethod
    def of(splats: Splats) -> Surface:
        """Only sorts the Gaussians; everything else is computed where it is asked for."""
        return Surface(SurfaceSamples.of(splats))

    @cached_property
    def typical_width(self) -> float:
        """Median width sqrt(s0 s1) of the patches, world units; 0 where there are none."""
        scales = self.samples.patches[:, SCALES]
        return float(median(np.sqrt(scales[:, 0] * scales[:, 1]))) if len(scales) else 0.0

    def at(self, points: np.ndarray, directions: np.ndarray, widths: np.ndarray) -> SurfacePoints:
        """The surface on the lines through `points` [Q, 3] along `directions` [Q, 3] (unit, away from the viewer).
        widths: [Q] > 0 first guess of the window, world units (about 1.5 times the width of the patches there)."""
        count = len(points)
        out = np.zeros((count, 12))
        s = self.samples
        # One kernel call for all queries; its columns are SurfacePoints' fields (column 8, thickness, goes into trust
        # alone).
        lists = (s.keys, s.level_starts, s.cell_sizes, s.reaches, s.min_corner)
        queries = [np.ascontiguousarray(a, np.float64) for a in (points, directions, widths)]
        if count and len(s):
            run(kernels.estimate_surface, *lists, s.patches, *queries, out)
        return SurfacePoints(out[:, :3], out[:, 3:6], out[:, 6], out[:, 7], out[:, 9], out[:, 10], out[:, 11])
