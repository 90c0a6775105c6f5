"""The surface that one view sees: depth, normal and trust at any pixel, from planes on a lattice of pixels.

Knows the asset's surface and one projected view; no picture and no paint.
"""

from __future__ import annotations

from dataclasses import field, fields
from functools import cached_property

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import readonly, set_pixels
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.order_statistics import median
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface, SurfacePoints
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_norm


@dataclass(frozen=True)
class VisibleSurfaceThresholds:
    """Where a view's lattice of surface points lies, and which of them to use. Measured where an entry says on what,
    else taste."""

    stopped_light: float = 0.5
    """A line of sight meets the surface where this much of its light has been stopped."""
    max_step_px: int = 4
    """Largest spacing of the lattice, pixels."""
    step_widths: float = 0.9
    """Spacing of the lattice in widths of the Gaussians that are seen."""
    window_widths: float = 1.3
    """First window in widths of the Gaussian that is seen."""
    min_window_px: float = 1.5
    """First window in pixels, at least."""
    min_trust: float = 0.3
    """Trust from which a height is used. Held-out objects: it keeps 99.5 % of what is seen of clean assets (what it
    drops is off by 1.7 widths in the median), 84 to 90 % of fitted ones (dropped: 0.6 widths) and 93 to 99 % of six
    captures."""
    max_disagreement: float = 0.6
    """Distance between a plane and its neighbour's, in windows, up to which both are one surface."""
    min_agreeing: int = 1
    """How many, of a lattice point's eight neighbours, must lie on its plane."""


VISIBLE = VisibleSurfaceThresholds()


@dataclass(frozen=True)
class VisibleSurface:
    """Planes at L lattice points of a view, in its camera space."""

    camera: Camera
    step: int
    """Pixels between lattice points."""
    index: Ids = field(repr=False)
    """[LH, LW] int32 plane of each block of step x step pixels, -1: none."""
    points: Floats = field(repr=False)
    """[L, 3] float64 on the surface, camera space."""
    normals: Floats = field(repr=False)
    """[L, 3] float64 unit, towards the camera."""
    windows: Floats = field(repr=False)
    """[L] float64 world units."""
    residuals: Floats = field(repr=False)
    """[L] float64 in windows."""
    trusted: Bools = field(repr=False)
    """[L] bool: enough patches, close to one surface that neighbours share."""
    estimates: SightEstimates = field(repr=False)
    """What it was made of."""
    pixels: Bools = field(repr=False)
    """[H, W] bool: pixels that it was made for."""

    def at(self, pixels: Floats) -> PixelSurface:
        """Surface at Q places of the picture. pixels: [Q, 2] float64 x, y (centres at .5)."""
        return PixelSurface.of(self._planes_at(pixels))

    def at_centers(self, ids: Ids) -> PixelSurface:
        """The same at the centres of some pixels ([Q] flat indices). Those that it was made for are asked for again and
        again while a sheet is laid, and are found once."""
        if self.pixels.shape == (self.camera.height, self.camera.width):
            number, planes = self._pixel_planes
            rows = number[ids]
            inside, out = rows >= 0, np.empty((len(ids), 6))
            out[inside], out[~inside] = planes[rows[inside]], self._planes_at(self._centers(ids[~inside]))
            return PixelSurface.of(out)
        return self.at(self._centers(ids))

    @cached_property
    def _pixel_planes(self) -> tuple[np.ndarray, np.ndarray]:
        """([H W] int32 number of each pixel that it was made for, -1: of none, [K, 6] what is there)."""
        ids = np.flatnonzero(self.pixels)
        number = np.full(self.pixels.size, -1, np.int32)
        number[ids] = np.arange(len(ids))
        return number, self._planes_at(self._centers(ids))

    def _centers(self, ids: np.ndarray) -> Floats:
        ys, xs = np.divmod(ids, self.camera.width)
        return np.stack([xs, ys], 1) + 0.5

    def _planes_at(self, pixels: np.ndarray) -> Floats:
        """[Q, 6] columns of a PixelSurface."""
        out = np.zeros((len(pixels), 6))
        if len(pixels) and len(self.points):
            columns = (self.points, self.normals, self.windows, self.residuals)
            planes = [np.ascontiguousarray(column, np.float64) for column in columns]
            lines = [np.ascontiguousarray(a, np.float64) for a in (pixels, self.camera.slopes(pixels))]
            run(kernels.interpolate_planes, self.index, self.step, *planes, self.trusted, *lines, out)
        return out


@dataclass(frozen=True)
class SightEstimates:
    """The surface along L lines of sight through pixels of one camera, at most one each."""

    pixels: Ids = field(repr=False)
    """[L] int64 flat indices."""
    queries: Floats = field(repr=False)
    """[L, 7] float64 of each `Surface.at`: point, direction, width."""
    result: SurfacePoints = field(repr=False)

    @staticmethod
    def of(
        surface: Surface, pixels: np.ndarray, queries: np.ndarray, earlier: SightEstimates | None, size: int
    ) -> SightEstimates:
        """pixels, queries: as the attributes; earlier: of the same surface and camera, from which equal lines are
        taken: the same bits, as lines do not depend on each other; size: number of pixels of the camera."""
        if earlier is None:
            return SightEstimates(pixels, queries, surface.at(queries[:, :3], queries[:, 3:6], queries[:, 6]))
        line = np.full(size, -1)
        line[earlier.pixels] = np.arange(len(earlier.pixels))
        source = line[pixels]
        at = np.flatnonzero(source >= 0)
        # A line counts as the same only if all seven numbers are: then the answer has the same bits.
        source[at[(earlier.queries[source[at]] != queries[at]).any(1)]] = -1
        new = np.flatnonzero(source < 0)
        result = surface.at(queries[new, :3], queries[new, 3:6], queries[new, 6])
        if len(new) < len(pixels):
            result = _merged(result, new, earlier.result, source)
        return SightEstimates(pixels, queries, result)


def _merged(first: SurfacePoints, at: np.ndarray, second: SurfacePoints, source: np.ndarray) -> SurfacePoints:
    """Points at Q queries: `first` at the indices `at`, and `second` where `source` ([Q], its index) is not
    negative."""
    taken, values = np.flatnonzero(source >= 0), {}
    for attribute in fields(SurfacePoints):
        fresh, old = getattr(first, attribute.name), getattr(second, attribute.name)
        out = np.empty((len(source), *fresh.shape[1:]))
        out[at], out[taken] = fresh, old[source[taken]]
        values[attribute.name] = out
    return SurfacePoints(**values)


@dataclass(frozen=True)
class PixelSurface:
    """Depth, normal and trust of the surface at Q pixels."""

    depth: Floats = field(repr=False)
    """[Q] float64 z, 0 where no trusted surface is."""
    normals: Floats = field(repr=False)
    """[Q, 3] float64 unit, camera space."""
    windows: Floats = field(repr=False)
    """[Q] float64 world units."""
    residuals: Floats = field(repr=False)
    """[Q] float64 world units."""

    @staticmethod
    def of(columns: Floats) -> PixelSurface:
        """columns: [Q, 6], in this order."""
        return PixelSurface(columns[:, 0], columns[:, 1:4], columns[:, 4], columns[:, 5])


def visible_surface(
    surface: Surface,
    splats: Splats,
    view: ProjectedView,
    pixels: np.ndarray,
    step: int = 0,
    earlier: SightEstimates | None = None,
) -> VisibleSurface:
    """What a view sees of the surface at some pixels ([H, W] bool, of drawn tiles). splats: what the view was projected
    from (edited or not); surface: of the original; step: spacing of the lattice, pixels
    (0: as fine as the Gaussians that are seen need); earlier: of the same surface and camera, if at hand: what it
    answers is not computed again."""
    camera = view.camera
    # Where a line of sight has lost half of its light, something is there to be a surface.
    entry = np.full(pixels.shape, -1, np.int32)
    lists = (view.projected, view.flatten_ids, view.tile_ids, view.isect_offsets)
    run(kernels.find_front_entries, *lists, np.ascontiguousarray(pixels), VISIBLE.stopped_light, entry)
    step = step or _lattice_step(splats, view, entry)
    # Estimates on a lattice as fine as the Gaussians; planes between them answer for all pixels.
    xs, ys, index = _lattice(entry, step)
    ids = view.gaussian_ids[entry[ys, xs]]
    rays = camera.sight_lines(np.stack([xs, ys], 1) + 0.5)
    depth, width = depths_along(splats, ids, camera, rays)
    rotation = camera.world_to_camera[:3, :3]
    starts = camera.to_world(rays * depth[:, None])
    lengths = row_norm(rays)
    directions = portable.matmul(rays / lengths[:, None], rotation)
    # The window follows the Gaussian that is seen, but never below what a pixel can tell.
    window = np.maximum(VISIBLE.window_widths * width, VISIBLE.min_window_px * depth / camera.fx)
    # An edited Gaussian may be far smaller than the surface's own patches; those decide.
    window = np.maximum(window, 0.25 * surface.typical_width)
    queries = np.concatenate([starts, directions, window[:, None]], 1)
    estimates = SightEstimates.of(surface, ys * camera.width + xs, queries, earlier, camera.width * camera.height)
    result = estimates.result
    local = camera.to_camera(result.points)
    normals = portable.matmul(result.normals, rotation.T)
    # Trusted twice: by the estimate itself, and by a neighbour that sees the same plane.
    valid = (result.trust >= VISIBLE.min_trust) & (local[:, 2] > 0)
    trusted = valid & (_agreeing(index, local, normals, result.windows, valid) >= VISIBLE.min_agreeing)
    planes = (local, normals, result.windows, result.residuals, trusted)
    return VisibleSurface(camera, step, index, *planes, estimates, pixels)


def _lattice_step(splats: Splats, view: ProjectedView, entry: np.ndarray) -> int:
    is_seen = np.zeros(len(view), bool)
    is_seen[entry[entry >= 0]] = True
    seen = np.flatnonzero(is_seen)
    if not len(seen):
        return 1
    scales = np.sort(splats.scales[view.gaussian_ids[seen]], 1)
    widths = np.sqrt(scales[:, 1] * scales[:, 2]) * view.camera.fx / np.maximum(view.depths[seen], 1e-9)
    return int(np.clip(VISIBLE.step_widths * median(widths), 1, VISIBLE.max_step_px))


def _lattice(entry: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(xs [L], ys [L] one pixel with a surface per block, the one nearest to its centre; index [LH, LW] int32)."""
    height, width = entry.shape
    rows, columns = -(-height // step), -(-width // step)
    dy, dx = np.divmod(np.arange(step * step), step)
    # The pixel nearest to the block's centre that has a surface stands for the block.
    order = np.argsort((dy - (step - 1) / 2) ** 2 + (dx - (step - 1) / 2) ** 2, kind="stable")
    first = np.empty((rows, columns), np.int32)
    run(kernels.choose_lattice_pixels, entry, order, step, first)
    y, x = set_pixels(first >= 0)
    index = np.full((rows, columns), -1, np.int32)
    index[y, x] = np.arange(len(y))
    return x * step + dx[first[y, x]], y * step + dy[first[y, x]], index


def depths_along(splats: Splats, ids: Ids, camera: Camera, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([Q] z-depth at which each of the Gaussians ids [Q] is densest along its ray ([Q, 3], camera space), [Q] its
    width sqrt(s1 s2), world units)."""
    out = np.empty((len(ids), 2))
    arrays = (readonly(values, splats.means.dtype) for values in (splats.means, splats.quats, splats.scales))
    lines = (readonly(rays, np.float64), readonly(camera.world_to_camera, np.float64))
    run(kernels.measure_depths_along, *arrays, readonly(ids, np.int64), *lines, out)
    return out[:, 0], out[:, 1]


def _agreeing(index, points, normals, windows, valid) -> np.ndarray:
    """[L] int64 how many of a lattice point's eight neighbours lie on its plane, as it lies on theirs."""
    out = np.zeros(len(points), np.int64)
    planes = [readonly(values, np.float64) for values in (points, normals, windows)]
    run(kernels.count_agreeing, index, *planes, valid, VISIBLE.max_disagreement, out)
    return out
