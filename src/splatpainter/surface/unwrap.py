"""Unwrapping a surface around one of its points: how far right and up of it, along the surface, every other point lies.

This is the exponential map, computed as in Schmidt, Grimm and Wyvill, "Interactive Decal Compositing with Discrete
Exponential Maps" (SIGGRAPH 2006): samples are reached in the order of their distance, and each takes its place, and the
directions of right and up, from the samples that were reached before it. Averaging over all of these, not only the
nearest, is upwind averaging (Schmidt 2013). A step turns with the normals, as an arc, or around the line where both
tangent planes meet where they meet at a crease; so planes, cylinders and boxes unfold without distortion.

Two samples are neighbours if they are near to each other and each lies where the other's normal says the surface goes.
So nothing steps through a thin wall, or across a gap in depth (native/surface/unwrap.h has the limits).
"""

from __future__ import annotations

import math
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.kernels import portable
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.system.quick_dataclass import dataclass

MIN_DISTANCE = 0.7
"""Least distance between samples, in spacings."""
NEIGHBOUR_SPACINGS = 2.2
"""Distance up to which samples are neighbours, in spacings."""
CELL_BITS = 21
"""Bits of a cell's index along each axis."""
READ_AT_ONCE = 8
"""Points of `PointCells.sorted_rows` that kernels read at a time: as many may be read behind the last one."""
MAX_HEAP_ENTRIES = 64
"""Of each sample, in the heap of those that are to be reached."""


@dataclass(frozen=True)
class Unwrapped:
    """S samples of a surface around its sample 0, of which some were reached."""

    points: Floats = field(repr=False)
    """[S, 3] float64, at least MIN_DISTANCE spacings apart."""
    normals: Floats = field(repr=False)
    """[S, 3] float64 unit, outwards."""
    spacing: float
    """World units."""
    uv: Floats = field(repr=False)
    """[S, 2] float64 world units right and up of sample 0 along the surface; NaN where it was not reached."""
    right: Floats = field(repr=False)
    """[S, 3] float64 unit tangents in which u grows."""
    distances: Floats = field(repr=False)
    """[S] float64 length of the way to each sample, world units; infinite where it was not reached."""
    rims: Floats = field(repr=False)
    """[S, 3] float64 mean way to the neighbours, in the tangent plane, over their reach: about 0 where they lie all
    around, 0.4 long at a straight rim of the samples, pointing inwards."""
    cells: PointCells = field(repr=False)

    @property
    def reached(self) -> Bools:
        """[S] bool."""
        return np.isfinite(self.distances)

    def without(self, chosen: np.ndarray) -> Unwrapped:
        """The samples as if some ([S] bool) had not been reached."""
        uv, distances = self.uv.copy(), self.distances.copy()
        uv[chosen], distances[chosen] = np.nan, np.inf
        return replace(self, uv=uv, distances=distances)

    def at(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(uv [Q, 2], nearest [Q] int64 the sample that each point took most from) at other points of the surface,
        with their normals ([Q, 3] each); NaN and -1 where no reached sample is a neighbour."""
        uv, nearest = np.full((len(points), 2), np.nan), np.full(len(points), -1, np.int64)
        samples = (self.points, self.normals, self.right, self.uv, self.distances)
        queries = [np.ascontiguousarray(a, np.float64) for a in (points, normals)]
        if len(points):
            reach = NEIGHBOUR_SPACINGS * self.spacing
            run(kernels.interpolate_map, *samples, self.spacing, reach, *self.cells.arrays, *queries, uv, nearest)
        return uv, nearest


@dataclass(frozen=True)
class PointCells:
    """Points in cubes, found by binary search. Those that lie together are neighbours in memory."""

    keys: Ids = field(repr=False)
    """[S] int64 ascending."""
    order: Ids = field(repr=False)
    """[S] int64 the point of each key."""
    corner: Floats = field(repr=False)
    """[3] float64."""
    size: float
    """Edge of a cell, world units."""

    @staticmethod
    def of(points: np.ndarray, size: float) -> PointCells:
        """points: [S, 3] finite, spread over fewer than 2^CELL_BITS cells along each axis."""
        corner = points.min(0) - size if len(points) else np.zeros(3)
        cell = ((points - corner) / size).astype(np.int64)
        keys = (cell[:, 0] << 2 * CELL_BITS) | (cell[:, 1] << CELL_BITS) | cell[:, 2]
        order = np.argsort(keys, kind="stable")
        return PointCells(keys[order], order, corner, size)

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        return self.keys, self.order, self.corner, self.size

    def sorted_rows(self, points: np.ndarray, normals: np.ndarray) -> Floats:
        """[6, S + 8] float64 of the points and their normals, in the order of `keys`: a coordinate of those that lie
        together is read at once."""
        out = np.zeros((6, len(points) + READ_AT_ONCE))
        for axis in range(3):
            out[axis, : len(points)], out[3 + axis, : len(points)] = points[self.order, axis], normals[self.order, axis]
        return out


def thinned(points: np.ndarray, normals: np.ndarray, spacing: float) -> Ids:
    """[S] int64 ascending: points that keep MIN_DISTANCE spacings between each other, the first of them first. Points
    whose normals part by more than 90 degrees are on two sides of something and may be nearer.
    points, normals: [N, 3]."""
    # Greedy in the given order: earlier points have the right of way.
    cells = PointCells.of(points, MIN_DISTANCE * spacing)
    chosen = np.zeros(len(points), np.bool_)
    if len(points):
        arrays = [np.ascontiguousarray(a, np.float64) for a in (points, normals)]
        kernels.thin_points(*arrays, *cells.arrays, (MIN_DISTANCE * spacing) ** 2, chosen, 0, 1)
    return np.flatnonzero(chosen)


def smoothed(
    samples: tuple[np.ndarray, np.ndarray], queries: tuple[np.ndarray, np.ndarray], radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """(points [Q, 3], unit normals [Q, 3]) of queries on rough surface, as samples within `radius` (world units) say:
    the mean of their normals, and along it the mean of their heights. Samples that face elsewhere than the query weigh
    less, so creases stay. samples, queries: (points, unit normals); a query without samples is as it was."""
    arrays = [np.ascontiguousarray(a, np.float64) for a in (*samples, *queries)]
    points, normals = arrays[2].copy(), arrays[3].copy()
    if len(points) and len(arrays[0]):
        cells = PointCells.of(arrays[0], radius)
        lists = (cells.sorted_rows(arrays[0], arrays[1]), cells.keys, cells.corner)
        run(kernels.smooth_points, *lists, radius, arrays[2], arrays[3], points, normals)
    return points, normals


def unwrap(
    points: np.ndarray,
    normals: np.ndarray,
    up: np.ndarray,
    spacing: float,
    half_size: tuple[float, float],
    max_turn: float = math.pi,
) -> Unwrapped:
    """The exponential map around points[0]. points, normals: [S, 3], thinned to `spacing` (world units); up: [3] the
    direction in which v grows there, made tangent; half_size: the rectangle (u, v) beyond which nothing is reached but
    a margin of NEIGHBOUR_SPACINGS; max_turn: radians by which a normal may have turned from the first one. Raises
    ValueError where `up` is along the normal, and for a normal that is not finite or not unit."""
    points, normals = (np.ascontiguousarray(a, np.float64) for a in (points, normals))
    if not (np.isfinite(points).all() and np.allclose((normals**2).sum(1), 1, atol=1e-3)):
        raise ValueError("unwrap: expected finite points and unit normals")
    # The picture's up, made tangent: sample 0 gets the first frame, all others get theirs from neighbours.
    forward = up - (up * normals[0]).sum() * normals[0]
    length = portable.length(forward)
    if not length > 1e-6 * portable.length(up):
        raise ValueError("unwrap: expected an up direction that is not along the normal")
    count = len(points)
    uv, right = np.full((count, 2), np.nan), np.zeros((count, 3))
    distances, rims = np.full(count, np.inf), np.zeros((count, 3))
    uv[0], right[0] = 0, np.cross(forward / length, normals[0])
    cells = PointCells.of(points, NEIGHBOUR_SPACINGS * spacing)
    # A margin beyond the rectangle, so that samples at its side have neighbours on both sides.
    margin = NEIGHBOUR_SPACINGS * spacing
    limits = (half_size[0] + margin, half_size[1] + margin, portable.cos(min(max_turn, math.pi)) - 1e-12)
    # Scratch is allocated here: kernels allocate nothing.
    heap = MAX_HEAP_ENTRIES * (count + 1)
    scratch = (np.empty(count), np.empty(count, np.bool_), np.empty(heap), np.empty(heap, np.int64))
    results = (uv, right, distances, rims)
    kernels.spread_map(points, normals, spacing, margin, *cells.arrays, *limits, *results, *scratch, 0, 1)
    return Unwrapped(points, normals, spacing, uv, right, distances, rims, cells)
