"""Unwrapping a surface around one of its points: how far right and up of it, along the surface, every other point lies.

This is the exponential map, computed as in Schmidt, Grimm and Wyvill, "Interactive Decal Compositing with Discrete
Exponential Maps" (SIGGRAPH 2006): samples are reached in the order of their distance, and each takes its place, and the
directions of right and up, from the samples that were reached before it. Averaging over all of these, not only the
nearest, is upwind averaging (Schmidt 2013). A step turns with the normals, as an arc, or around the line where both
tangent planes meet where they meet at a crease; so planes, cylinders and boxes unfold without distortion.

Two samples are neighbours if they are near to each other and each lies where the other's normal says the surface goes.
So nothing steps through a thin wall, or across a gap in depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import carray, njit

from splatpainter.kernels.parallel import run
from splatpainter.kernels.search import first_not_below
from splatpainter.kernels.simd import LANES, scratch
from splatpainter.kernels.vector_exp import exp64

MIN_DISTANCE = 0.7
"""Least distance between samples, in spacings."""
NEIGHBOUR_SPACINGS = 2.2
"""Distance up to which samples are neighbours, in spacings."""
MAX_NEIGHBOURS = 256
"""Most neighbours of a sample; beyond them it has none."""
MAX_CREASE = math.radians(120.0)
"""Angle between the normals of neighbours, at most."""
MIN_HINGE_RADIANS = math.radians(20.0)
"""... from which a step turns around the line where both tangent planes meet."""
MAX_LIFT = 0.35
"""Sine of the angle at which a neighbour may lie above or below the tangent plane, where the normals agree."""
SAME_SHEET = 1.5
"""Spacings by which neighbours may disagree about a point and still be averaged: behind a bump, ways around it meet."""
WEIGHT_WIDTH = 0.8
"""Spacings: standard deviation of the weights of neighbours."""
MIN_CHORD_RATIO = 1 - 1e-6
"""No way is shorter than so many straight lines: where that is too long already, the way need not be measured."""
MIN_AGREEING_COSINE = 0.2
"""Cosine between the normals of a query and of a sample that smooths it."""
SMOOTHED_TURN = 0.4
"""Amount by which this cosine is below 1 where a sample's weight has fallen to 1/e."""
CELL_BITS = 21
"""Bits of a cell's index along each axis."""
POINTS_PER_BLOCK = 256
"""Points that a thread takes at a time."""


@dataclass(frozen=True)
class Unwrapped:
    """S samples of a surface around its sample 0, of which some were reached."""

    points: np.ndarray = field(repr=False)
    """[S, 3] float64, at least MIN_DISTANCE spacings apart."""
    normals: np.ndarray = field(repr=False)
    """[S, 3] float64 unit, outwards."""
    spacing: float
    """World units."""
    uv: np.ndarray = field(repr=False)
    """[S, 2] float64 world units right and up of sample 0 along the surface; NaN where it was not reached."""
    right: np.ndarray = field(repr=False)
    """[S, 3] float64 unit tangents in which u grows."""
    distances: np.ndarray = field(repr=False)
    """[S] float64 length of the way to each sample, world units; infinite where it was not reached."""
    rims: np.ndarray = field(repr=False)
    """[S, 3] float64 mean way to the neighbours, in the tangent plane, over their reach: about 0 where they lie all
    around, 0.4 long at a straight rim of the samples, pointing inwards."""
    cells: PointCells = field(repr=False)

    @property
    def reached(self) -> np.ndarray:
        """[S] bool."""
        return np.isfinite(self.distances)

    def at(self, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(uv [Q, 2], nearest [Q] int64 the sample that each point took most from) at other points of the surface,
        with their normals ([Q, 3] each); NaN and -1 where no reached sample is a neighbour."""
        uv, nearest = np.full((len(points), 2), np.nan), np.full(len(points), -1, np.int64)
        samples = (self.points, self.normals, self.right, self.uv, self.distances, self.spacing)
        queries = [np.ascontiguousarray(a, np.float64) for a in (points, normals)]
        if len(points):
            run(_interpolate, *samples, *self.cells.arrays, *queries, uv, nearest)
        return uv, nearest


@dataclass(frozen=True)
class PointCells:
    """Points in cubes, found by binary search. Those that lie together are neighbours in memory."""

    keys: np.ndarray = field(repr=False)
    """[S] int64 ascending."""
    order: np.ndarray = field(repr=False)
    """[S] int64 the point of each key."""
    corner: np.ndarray = field(repr=False)
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


def thinned(points: np.ndarray, normals: np.ndarray, spacing: float) -> np.ndarray:
    """[S] int64 ascending: points that keep MIN_DISTANCE spacings between each other, the first of them first. Points
    whose normals part by more than 90 degrees are on two sides of something and may be nearer.
    points, normals: [N, 3]."""
    cells = PointCells.of(points, MIN_DISTANCE * spacing)
    rank = np.empty(len(points), np.int64)
    rank[cells.order] = np.arange(len(points))
    chosen = np.zeros(len(points), np.bool_)
    if len(points):
        _thin(points, normals, *cells.arrays, (MIN_DISTANCE * spacing) ** 2, chosen)
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
        sorted_samples = np.zeros((6, len(arrays[0]) + LANES))
        sorted_samples[:, : len(arrays[0])] = np.concatenate([arrays[0], arrays[1]], 1)[cells.order].T
        run(_smooth, sorted_samples, cells.keys, cells.corner, radius, arrays[2], arrays[3], points, normals)
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
    forward = up - (up @ normals[0]) * normals[0]
    length = np.linalg.norm(forward)
    if not length > 1e-6 * np.linalg.norm(up):
        raise ValueError("unwrap: expected an up direction that is not along the normal")
    count = len(points)
    uv, right = np.full((count, 2), np.nan), np.zeros((count, 3))
    distances, rims = np.full(count, np.inf), np.zeros((count, 3))
    uv[0], right[0] = 0, np.cross(forward / length, normals[0])
    cells = PointCells.of(points, NEIGHBOUR_SPACINGS * spacing)
    margin = NEIGHBOUR_SPACINGS * spacing
    limits = (half_size[0] + margin, half_size[1] + margin, math.cos(min(max_turn, math.pi)) - 1e-12)
    _spread(points, normals, spacing, *cells.arrays, *limits, uv, right, distances, rims)
    return Unwrapped(points, normals, spacing, uv, right, distances, rims, cells)


@njit(nogil=True, cache=True, error_model="numpy")
def _thin(points, normals, keys, order, corner, size, nearest, chosen):
    for i in range(points.shape[0]):
        cx = int((points[i, 0] - corner[0]) / size)
        cy = int((points[i, 1] - corner[1]) / size)
        cz = int((points[i, 2] - corner[2]) / size)
        free = True
        for x in range(cx - 1, cx + 2):
            for y in range(cy - 1, cy + 2):
                row = (x << 42) | (y << 21)
                k = first_not_below(keys, 0, keys.shape[0], row | max(cz - 1, 0))
                while free and k < keys.shape[0] and keys[k] <= row | (cz + 1):
                    j = order[k]
                    if chosen[j]:
                        dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                        dz = points[j, 2] - points[i, 2]
                        side = normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1]
                        side += normals[i, 2] * normals[j, 2]
                        if side > 0.0 and dx * dx + dy * dy + dz * dz < nearest:
                            free = False
                    k += 1
        chosen[i] = free


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth(samples, keys, corner, radius, points, normals, out, out_normals, thread, threads):
    """samples: [6, S + LANES] points and normals, in the order of `keys` [S] (cells of `radius`). LANES samples at a
    time, sums in their order; those that do not count have weight 0."""
    count = keys.shape[0]
    weights = carray(scratch(corner, LANES), (LANES,))
    wx, wy, wz = (
        carray(scratch(corner, LANES), (LANES,)),
        carray(scratch(corner, LANES), (LANES,)),
        carray(scratch(corner, LANES), (LANES,)),
    )
    vx, vy, vz = (
        carray(scratch(corner, LANES), (LANES,)),
        carray(scratch(corner, LANES), (LANES,)),
        carray(scratch(corner, LANES), (LANES,)),
    )
    squared = radius * radius
    for start in range(thread * POINTS_PER_BLOCK, points.shape[0], threads * POINTS_PER_BLOCK):
        for q in range(start, min(start + POINTS_PER_BLOCK, points.shape[0])):
            px, py, pz = points[q, 0], points[q, 1], points[q, 2]
            nx, ny, nz = normals[q, 0], normals[q, 1], normals[q, 2]
            if not abs(px) + abs(py) + abs(pz) + abs(nx) + abs(ny) + abs(nz) < 1e30:
                continue
            for _ in range(2):  # the second time by the first mean
                total, sx, sy, sz, mx, my, mz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                cx, cy = int(math.floor((px - corner[0]) / radius)), int(math.floor((py - corner[1]) / radius))
                cz = int(math.floor((pz - corner[2]) / radius))
                if cx < 0 or cy < 0 or cz < 0:
                    break
                for x in range(max(cx - 1, 0), cx + 2):
                    for y in range(max(cy - 1, 0), cy + 2):
                        row = (x << 42) | (y << 21)
                        first = first_not_below(keys, 0, count, row | max(cz - 1, 0))
                        last = first_not_below(keys, first, count, (row | (cz + 1)) + 1)
                        for begin in range(first, last, LANES):
                            used = min(last - begin, LANES)
                            for lane in range(LANES):
                                j = begin + lane
                                dx, dy, dz = samples[0, j] - px, samples[1, j] - py, samples[2, j] - pz
                                fx, fy, fz = samples[3, j], samples[4, j], samples[5, j]
                                square = (dx * dx + dy * dy + dz * dz) / squared
                                cosine = fx * nx + fy * ny + fz * nz
                                w = exp64(-2.0 * square + (cosine - 1.0) / SMOOTHED_TURN)
                                w = 0.0 if (square > 1.0) | (cosine < MIN_AGREEING_COSINE) else w
                                weights[lane] = w
                                wx[lane], wy[lane], wz[lane] = w * dx, w * dy, w * dz
                                vx[lane], vy[lane], vz[lane] = w * fx, w * fy, w * fz
                            for lane in range(used):
                                total += weights[lane]
                                sx += wx[lane]
                                sy += wy[lane]
                                sz += wz[lane]
                                mx += vx[lane]
                                my += vy[lane]
                                mz += vz[lane]
                length = math.sqrt(mx * mx + my * my + mz * mz)
                if not (total > 0.0 and length > 1e-9 * total):
                    break
                nx, ny, nz = mx / length, my / length, mz / length
                height = (sx * nx + sy * ny + sz * nz) / total
                px, py, pz = px + height * nx, py + height * ny, pz + height * nz
            out[q, 0], out[q, 1], out[q, 2] = px, py, pz
            out_normals[q, 0], out_normals[q, 1], out_normals[q, 2] = nx, ny, nz


@njit(nogil=True, cache=True, error_model="numpy")
def _neighbours(points, normals, i, px, py, pz, nx, ny, nz, reach, keys, order, corner, size, out):
    """Samples that are neighbours of a point with a normal, into `out`; returns how many. i: the point itself, or
    -1."""
    count = 0
    cx, cy, cz = int((px - corner[0]) / size), int((py - corner[1]) / size), int((pz - corner[2]) / size)
    if not (cx >= 0 and cy >= 0 and cz >= 0):
        return 0
    for x in range(max(cx - 1, 0), cx + 2):
        for y in range(max(cy - 1, 0), cy + 2):
            row = (x << 42) | (y << 21)
            k = first_not_below(keys, 0, keys.shape[0], row | max(cz - 1, 0))
            while k < keys.shape[0] and keys[k] <= row | (cz + 1):
                j = order[k]
                k += 1
                if j == i:
                    continue
                dx, dy, dz = points[j, 0] - px, points[j, 1] - py, points[j, 2] - pz
                square = dx * dx + dy * dy + dz * dz
                if square > reach * reach:
                    continue
                cosine = normals[j, 0] * nx + normals[j, 1] * ny + normals[j, 2] * nz
                if cosine < math.cos(MAX_CREASE):
                    continue
                # Along the mean normal a neighbour lies at most so high, more where the normals part.
                mx, my, mz = normals[j, 0] + nx, normals[j, 1] + ny, normals[j, 2] + nz
                height = abs(dx * mx + dy * my + dz * mz) / math.sqrt(mx * mx + my * my + mz * mz)
                half_sine = math.sqrt(max(0.5 - 0.5 * cosine, 0.0))
                if height > (MAX_LIFT + 0.55 * half_sine) * math.sqrt(square) + 1e-12:
                    continue
                if count < out.shape[0]:
                    out[count] = j
                    count += 1
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def _step(point, normal, right, qx, qy, qz, mx, my, mz, out):
    """The step from a sample to a neighbour (qx, qy, qz) with normal (mx, my, mz): out = (u, v) of the way, and the
    direction of right there [5]; returns the way's length."""
    dx, dy, dz = qx - point[0], qy - point[1], qz - point[2]
    nx, ny, nz = normal[0], normal[1], normal[2]
    # --- right, turned with the normal by the smallest rotation: v - (v.(n + m)) / (1 + n.m) (n + m), for v.n = 0
    cosine = nx * mx + ny * my + nz * mz
    scale = (right[0] * mx + right[1] * my + right[2] * mz) / max(1.0 + cosine, 1e-9)
    rx, ry, rz = right[0] - scale * (nx + mx), right[1] - scale * (ny + my), right[2] - scale * (nz + mz)
    # exactly tangent, exactly unit
    scale = rx * mx + ry * my + rz * mz
    rx, ry, rz = rx - scale * mx, ry - scale * my, rz - scale * mz
    scale = 1.0 / max(math.sqrt(rx * rx + ry * ry + rz * rz), 1e-30)
    rx, ry, rz = rx * scale, ry * scale, rz * scale
    out[2], out[3], out[4] = rx, ry, rz
    ux, uy, uz = ny * right[2] - nz * right[1], nz * right[0] - nx * right[2], nx * right[1] - ny * right[0]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if length <= 0.0:
        out[0], out[1] = 0.0, 0.0
        return 0.0
    hx, hy, hz = ny * mz - nz * my, nz * mx - nx * mz, nx * my - ny * mx
    sine = math.sqrt(hx * hx + hy * hy + hz * hz)
    if cosine < math.cos(MIN_HINGE_RADIANS) and sine > 1e-6:
        # --- around the line where the planes meet: along it, then across it in both planes
        hx, hy, hz = hx / sine, hy / sine, hz / sine
        tx, ty, tz = hy * nz - hz * ny, hz * nx - hx * nz, hx * ny - hy * nx  # across, in the first plane
        second = -(dx * nx + dy * ny + dz * nz) / sine
        first = dx * tx + dy * ty + dz * tz - second * cosine
        if first * second >= 0.0:
            across, along = first + second, dx * hx + dy * hy + dz * hz
            wx, wy, wz = across * tx + along * hx, across * ty + along * hy, across * tz + along * hz
            out[0] = wx * right[0] + wy * right[1] + wz * right[2]
            out[1] = wx * ux + wy * uy + wz * uz
            return math.sqrt(across * across + along * along)
    # --- as an arc: its chord lies half-way between both tangent planes
    a0 = dx * right[0] + dy * right[1] + dz * right[2]
    a1 = dx * ux + dy * uy + dz * uz
    vx, vy, vz = my * rz - mz * ry, mz * rx - mx * rz, mx * ry - my * rx
    b0 = dx * rx + dy * ry + dz * rz
    b1 = dx * vx + dy * vy + dz * vz
    c0, c1 = a0 + b0, a1 + b1
    scale = math.sqrt(c0 * c0 + c1 * c1)
    if scale <= 1e-12 * length:
        out[0], out[1] = 0.0, 0.0
        return length
    turn = 0.5 * math.atan2(sine, cosine) * abs((dx * hy - dy * hx) ** 2 + (dy * hz - dz * hy) ** 2
        + (dz * hx - dx * hz) ** 2) ** 0.5 / max(sine * length, 1e-30)  # fmt: skip
    length *= turn / math.sin(turn) if turn > 1e-4 else 1.0
    out[0], out[1] = length * c0 / scale, length * c1 / scale
    return length


@njit(nogil=True, cache=True, error_model="numpy")
def _average(points, normals, right, uv, distances, near, count, px, py, pz, nx, ny, nz, spacing, step, ways, out):
    """Where the reached ones of some neighbours see a point: out = (u, v, right) [5]. Returns the one with the
    shortest way to it, -1 where none is reached. step [5] and ways [MAX_NEIGHBOURS, 6] are written to."""
    best, shortest, reached = -1, math.inf, 0
    bu, bv = 0.0, 0.0
    for k in range(count):
        j = near[k]
        if not distances[j] < math.inf:
            continue
        way = _step(points[j], normals[j], right[j], px, py, pz, nx, ny, nz, step)
        length, ju, jv = distances[j] + way, uv[j, 0] + step[0], uv[j, 1] + step[1]
        if length < shortest:
            best, shortest = j, length
            bu, bv = ju, jv
        ways[reached, 0], ways[reached, 1], ways[reached, 2] = way, ju, jv
        ways[reached, 3], ways[reached, 4], ways[reached, 5] = step[2], step[3], step[4]
        reached += 1
    if best < 0:
        return -1
    total, u, v, rx, ry, rz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(reached):
        length, ju, jv = ways[k, 0] / (WEIGHT_WIDTH * spacing), ways[k, 1], ways[k, 2]
        if (ju - bu) ** 2 + (jv - bv) ** 2 > (SAME_SHEET * spacing) ** 2:
            continue
        w = math.exp(-0.5 * length * length) + 1e-9
        total += w
        u += w * ju
        v += w * jv
        rx += w * ways[k, 3]
        ry += w * ways[k, 4]
        rz += w * ways[k, 5]
    out[0], out[1] = u / total, v / total
    scale = rx * nx + ry * ny + rz * nz
    rx, ry, rz = rx - scale * nx, ry - scale * ny, rz - scale * nz
    scale = 1.0 / max(math.sqrt(rx * rx + ry * ry + rz * rz), 1e-30)
    out[2], out[3], out[4] = rx * scale, ry * scale, rz * scale
    return best


@njit(nogil=True, cache=True, error_model="numpy")
def _spread(
    points, normals, spacing, keys, order, corner, size, limit_u, limit_v, limit_cosine, uv, right, distances, rims
):
    """Dijkstra's order over the samples, from sample 0. A heap of (distance, sample); older entries are skipped."""
    total = points.shape[0]
    tentative = np.full(total, math.inf)
    settled = np.zeros(total, np.bool_)
    near, ways = np.empty(MAX_NEIGHBOURS, np.int64), np.empty((MAX_NEIGHBOURS, 6))
    step, out = np.empty(5), np.empty(5)
    heap_key, heap_id = np.empty(64 * total + 64), np.empty(64 * total + 64, np.int64)
    heap_key[0], heap_id[0], filled = 0.0, 0, 1
    tentative[0] = 0.0
    reach = NEIGHBOUR_SPACINGS * spacing
    while filled > 0:
        key, i = heap_key[0], heap_id[0]
        # --- remove the first
        filled -= 1
        last_key, last_id = heap_key[filled], heap_id[filled]
        at = 0
        while True:
            child = 2 * at + 1
            if child >= filled:
                break
            if child + 1 < filled and (
                heap_key[child + 1] < heap_key[child]
                or (heap_key[child + 1] == heap_key[child] and heap_id[child + 1] < heap_id[child])
            ):
                child += 1
            if heap_key[child] > last_key or (heap_key[child] == last_key and heap_id[child] >= last_id):
                break
            heap_key[at], heap_id[at] = heap_key[child], heap_id[child]
            at = child
        heap_key[at], heap_id[at] = last_key, last_id
        if settled[i]:
            continue
        settled[i] = True
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        count = _neighbours(points, normals, i, px, py, pz, nx, ny, nz, reach, keys, order, corner, size, near)
        if i > 0:
            if _average(
                points, normals, right, uv, distances, near, count, px, py, pz, nx, ny, nz, spacing, step, ways, out
            ) < 0:  # fmt: skip
                continue
            uv[i, 0], uv[i, 1] = out[0], out[1]
            right[i, 0], right[i, 1], right[i, 2] = out[2], out[3], out[4]
        distances[i] = key
        inwards = np.zeros(3)
        for k in range(count):
            j = near[k]
            inwards[0] += points[j, 0] - px
            inwards[1] += points[j, 1] - py
            inwards[2] += points[j, 2] - pz
        off = inwards[0] * nx + inwards[1] * ny + inwards[2] * nz
        for a in range(3):
            rims[i, a] = (inwards[a] - off * normals[i, a]) / (max(count, 1) * reach)
        turn = nx * normals[0, 0] + ny * normals[0, 1] + nz * normals[0, 2]
        if abs(uv[i, 0]) > limit_u or abs(uv[i, 1]) > limit_v or turn < limit_cosine:
            continue
        for k in range(count):
            j = near[k]
            if settled[j]:
                continue
            dx, dy, dz = points[j, 0] - px, points[j, 1] - py, points[j, 2] - pz
            if key + MIN_CHORD_RATIO * math.sqrt(dx * dx + dy * dy + dz * dz) >= tentative[j]:
                continue
            length = key + _step(
                points[i], normals[i], right[i], points[j, 0], points[j, 1], points[j, 2],
                normals[j, 0], normals[j, 1], normals[j, 2], step,
            )  # fmt: skip
            if length < tentative[j] and filled < heap_key.shape[0]:
                tentative[j] = length
                at = filled
                filled += 1
                while at > 0:
                    parent = (at - 1) // 2
                    if heap_key[parent] < length or (heap_key[parent] == length and heap_id[parent] <= j):
                        break
                    heap_key[at], heap_id[at] = heap_key[parent], heap_id[parent]
                    at = parent
                heap_key[at], heap_id[at] = length, j


@njit(nogil=True, cache=True, error_model="numpy")
def _interpolate(
    points, normals, right, uv, distances, spacing, keys, order, corner, size, queries, query_normals, out, nearest,
    thread, threads,
):  # fmt: skip
    near, ways = np.empty(MAX_NEIGHBOURS, np.int64), np.empty((MAX_NEIGHBOURS, 6))
    step, value = np.empty(5), np.empty(5)
    for start in range(thread * POINTS_PER_BLOCK, queries.shape[0], threads * POINTS_PER_BLOCK):
        for q in range(start, min(start + POINTS_PER_BLOCK, queries.shape[0])):
            px, py, pz = queries[q, 0], queries[q, 1], queries[q, 2]
            nx, ny, nz = query_normals[q, 0], query_normals[q, 1], query_normals[q, 2]
            if not abs(px) + abs(py) + abs(pz) + abs(nx) + abs(ny) + abs(nz) < 1e30:
                continue
            count = _neighbours(
                points,
                normals,
                -1,
                px,
                py,
                pz,
                nx,
                ny,
                nz,
                NEIGHBOUR_SPACINGS * spacing,
                keys,
                order,
                corner,
                size,
                near,
            )
            if count == 0:
                continue
            best = _average(
                points, normals, right, uv, distances, near, count, px, py, pz, nx, ny, nz, spacing, step, ways, value
            )
            if best < 0:
                continue
            out[q, 0], out[q, 1] = value[0], value[1]
            closest, square = best, math.inf
            for k in range(count):
                j = near[k]
                if not distances[j] < math.inf:
                    continue
                d = (points[j, 0] - px) ** 2 + (points[j, 1] - py) ** 2 + (points[j, 2] - pz) ** 2
                if d < square:
                    closest, square = j, d
            nearest[q] = closest
