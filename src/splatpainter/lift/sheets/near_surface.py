"""Which Gaussians lie on the surface under a sheet: each against that at the covered pixel nearest to its centre.

There may be hundreds of thousands, most of them behind the surface, out of sight: one kernel looks at each of them, and
asks for its rotation only where its longest axis leaves a doubt.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Bools, Bytes, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels.arrays import filled
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.lift.nearest import nearest_pixels
from splatpainter.lift.sheets.fringe import FringedSurface
from splatpainter.splats import Splats
from splatpainter.surface.visible import PixelSurface, VisibleSurface
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class NearSurfaceThresholds:
    """Which Gaussians are part of a surface. Source: taste."""

    normal_sigmas: float = 2.0
    """Standard deviations along the surface's normal within which a Gaussian touches the surface."""
    surface_windows: float = 0.35
    """Distance within which it touches as well, as a share of the window in which the surface was estimated."""
    far_windows: float = 3.0
    """Windows behind the surface from which a Gaussian is no part of a thick or foggy one."""


NEAR_SURFACE = NearSurfaceThresholds()


BESIDE, TOUCHES, FAR_BEHIND = 0, 1, 2
"""What `NearSurface.sides` says of a Gaussian."""


@dataclass(frozen=True)
class NearSurface:
    """The sheet's surface at each covered pixel, and for those beside at the nearest one."""

    nearest: Ids = field(repr=False)
    """[H, W] int32 flat index of the nearest covered pixel."""
    entry: Ids = field(repr=False)
    """[H, W] int64 entry of `surface` of each covered pixel, -1: not covered."""
    surface: PixelSurface
    camera: Camera

    @staticmethod
    def of(visible: VisibleSurface | FringedSurface, covered: Bools) -> NearSurface:
        """covered: [H, W] bool, some."""
        at, entry = np.flatnonzero(covered), filled(covered.shape, -1, np.dtype(np.int64))
        # Surface values are stored for covered pixels alone; others look them up through `nearest`.
        entry.ravel()[at] = np.arange(len(at))
        return NearSurface(nearest_pixels(covered), entry, visible.at_centers(at), visible.camera)

    def sides(self, splats: Splats, ids: np.ndarray) -> Bytes:
        """[Q] uint8, of each of some Gaussians ([Q] int64): TOUCHES where it lies on the surface at the covered pixel
        nearest to its centre, FAR_BEHIND where it lies so far behind that it is no part of a thick or foggy one."""
        return self._sides(splats, ids, touching=False)

    def touches(self, splats: Splats, ids: np.ndarray) -> Bools:
        """[Q] bool, which of some Gaussians ([Q] int64) lie on the surface."""
        return self._sides(splats, ids, touching=True) == TOUCHES

    def _sides(self, splats: Splats, ids: np.ndarray, *, touching: bool) -> Bytes:
        """touching: FAR_BEHIND is not told from BESIDE, which takes half of the time where most lie there."""
        camera, out = self.camera, np.empty(len(ids), np.uint8)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        surface = (self.surface.depth, self.surface.normals, self.surface.windows, self.surface.residuals)
        tables = (self.nearest, self.entry, *(np.ascontiguousarray(values) for values in surface))
        arrays = (np.ascontiguousarray(values) for values in (splats.means, splats.quats, splats.scales))
        world_to_camera = np.ascontiguousarray(camera.world_to_camera, np.float64)
        where = (np.ascontiguousarray(ids, np.int64), world_to_camera, lens, *tables)
        run(kernels.classify_sides, *arrays, *where, touching, out)
        return out
