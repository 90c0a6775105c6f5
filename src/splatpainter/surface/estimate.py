"""Height, normal, window, residual and trust of the surface at any points, seen from any side.

Around a query point p the asset is a mixture of patches. Seen through a Gaussian window of width h, each patch is again
a Gaussian (the product of both), with mean u and covariance P; the moments of their mixture give a plane by moving
least squares (Levin 2003), without stand-ins for long patches. Patches of another layer along the line of sight, and
patches that face elsewhere, lose their vote in a few reweighted rounds (as in Oztireli et al. 2009), so both sides of a
thin wall stay apart and creases stay sharp. On a curved surface a plane through the centres lies inside and the
patches' own tangent planes lie outside; the offset along the mean of both normals is right to second order.

Centres are the surface of clean assets. Optimised ones show the front of a cloud of Gaussians whose centres lie half a
width behind it: where centres scatter about their plane, the height is where rays along the normal lose their light.

Nothing depends on the order of samples or on the number of threads: every query is computed alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numba import carray, njit

from splatpainter.kernels import parallel
from splatpainter.kernels.simd import LANES, scratch
from splatpainter.kernels.vector_exp import exp64
from splatpainter.splats import Splats
from splatpainter.surface.surface_samples import AXES, MEAN, OPACITY, SCALES, SurfaceSamples, gather

MAX_NEIGHBOURS = 768
"""Patches in one window; where there are more the window shrinks."""
SIGMAS = 2.5
"""Standard deviations within which a patch is looked at."""
MIN_PATCHES = 8.0
"""Effective number of patches, (sum w)^2 / sum w^2, below which the window grows, ..."""
MAX_GROWTHS = 4
"""... at most so often, ..."""
GROWTH = 1.4
"""... by this factor."""
MAX_SHRINKS = 24
"""A window with too many patches in it shrinks by GROWTH at most so often, to a three thousandth."""
MIN_MASS = 2e-3
"""Patches that weigh less than this share of the heaviest one are left out."""
REWEIGHTINGS = 4
"""Rounds of reweighting: patches off the surface by one `tau` (in windows) lose 0.4 of their vote."""
FIRST_TAU, TAU_RESIDUALS, MIN_TAU = 0.5, 2.0, 0.25
"""`tau` in the first round; afterwards in residuals of the round before; its least value, in windows."""
MIN_SLANT = 0.35
"""Cosine between normal and line of sight below which the step along the latter is bounded."""
TRUST_WEIGHTS = (3.37, -9.01, 15.02, -5.28, -3.81, -2.40, 2.58, -1.89, -0.49, -0.42)
"""Logistic regression: 1; residual, its square, at most 0.15 of it; thickness; 1 - agreement; cosine between normal and
line of sight, its square; the step from the query to the surface in windows, up to 1 and beyond. Fitted on eight
training objects (clean, and fitted by 3DGS from noisy points or true depths: each kind counts a third), 90,000 queries
as cameras around make them; on five held-out objects AUC 0.85 / 0.61 / 0.68 and 0.83 over all kinds, calibrated to
0.06 in every tenth."""
MAX_TRUST_MOVE = 2.5
FEW_PATCHES = 3.0
"""Effective number of patches below which trust falls in proportion."""
X, Y, Z, MXX, MXY, MXZ, MYY, MYZ, MZZ, NX, NY, NZ, MASS, FLATNESS, COLUMNS = range(15)
"""Columns of a patch: its mean; M, which takes the mean's offset from any point to the mean of the product of patch and
window there (their covariance is h^2 (1 - M)); its unsigned normal; its weight; 0..1 how far it has a normal."""
QUERY_BLOCK = 64
"""Queries that a thread takes at a time."""
PRECISE_RESIDUAL, CLOUDY_RESIDUAL = 0.12, 0.27
"""rms distance of the patches' centres from their plane, in windows: up to the first they lie on the surface, from the
second they are a cloud behind it (an optimised asset shows the front of its Gaussians, not their centres), and the
surface is where light stops. Between the two the height is a mixture."""
RAY_SHARE = 0.25
"""Share of the light that has been stopped at the surface of a cloud. On objects fitted from points with noise (density
control, 700 steps) the median error of height is 0.66 widths by centres alone, 0.44, 0.30, 0.28 with 0.5, 0.3, 0.25."""
RAY_RADIUS = 0.5
"""Distance from the query of the six rays around it, in windows."""
DEPTH_BINS = 128
"""Into which patches are sorted by depth."""
RAY_ROWS = 6
"""Rows that following the seven takes."""


@dataclass(frozen=True)
class SurfacePoints:
    """What is known at Q queries."""

    points: np.ndarray = field(repr=False)
    """[Q, 3] float64 on the surface, on the query's line of sight unless that grazes the surface or misses it."""
    normals: np.ndarray = field(repr=False)
    """[Q, 3] float64 unit, towards the viewer."""
    windows: np.ndarray = field(repr=False)
    """[Q] float64 h, world units."""
    residuals: np.ndarray = field(repr=False)
    """[Q] float64 rms distance of the patches' centres from the surface, in windows."""
    patches: np.ndarray = field(repr=False)
    """[Q] float64 effective number of patches behind the estimate; 0: there is no surface."""
    agreement: np.ndarray = field(repr=False)
    """[Q] float64 0..1 mean |cosine| between the patches' normals and the surface's."""
    trust: np.ndarray = field(repr=False)
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
        scales = self.samples.scales
        return float(np.median(np.sqrt(scales[:, 0] * scales[:, 1]))) if len(scales) else 0.0

    def at(self, points: np.ndarray, directions: np.ndarray, widths: np.ndarray) -> SurfacePoints:
        """The surface on the lines through `points` [Q, 3] along `directions` [Q, 3] (unit, away from the viewer).
        widths: [Q] > 0 first guess of the window, world units (about 1.5 times the width of the patches there)."""
        count = len(points)
        out = np.zeros((count, 11))
        s = self.samples
        lists = (s.keys, s.level_starts, s.cell_sizes, s.reaches, s.min_corner)
        queries = [np.ascontiguousarray(a, np.float64) for a in (points, directions, widths)]
        if count and len(s):
            parallel.run(_estimate, *lists, s.patches, *queries, out)
        trust = _trust(out, queries[0], queries[1])
        return SurfacePoints(out[:, :3], out[:, 3:6], out[:, 6], out[:, 7], out[:, 9], out[:, 10], trust)


def _trust(out: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """[Q] of what `_estimate` wrote (TRUST_WEIGHTS). No surface: 0; few patches: less, in proportion."""
    window = np.where(out[:, 6] > 0, out[:, 6], 1.0)
    with np.errstate(all="ignore"):  # the caller's NaN and infinite queries have no patches
        move = np.abs(((out[:, :3] - points) * directions).sum(1)) / window
        slant = np.clip(-(out[:, 3:6] * directions).sum(1), 0, 1)
    move = np.clip(np.nan_to_num(move, nan=MAX_TRUST_MOVE), 0, MAX_TRUST_MOVE)
    residual, thickness = np.clip(out[:, 7], 0, 1), np.clip(out[:, 8], 0, 1)
    terms = (
        np.ones(len(out)), residual, residual**2, np.minimum(residual, 0.15), thickness, 1 - out[:, 10],
        np.nan_to_num(slant), np.nan_to_num(slant) ** 2, np.minimum(move, 1), np.maximum(move - 1, 0),
    )  # fmt: skip
    odds = np.zeros(len(out))
    for weight, term in zip(TRUST_WEIGHTS, terms, strict=True):  # one by one: equal bits for any number of queries
        odds += weight * term
    return np.minimum(out[:, 9] / FEW_PATCHES, 1) / (1 + np.exp(-odds))


@njit(nogil=True, cache=True, error_model="numpy")
def _smallest_eigenvector(xx, xy, xz, yy, yz, zz, out):
    """Unit eigenvector of the smallest eigenvalue of a symmetric matrix into out [3]; returns the three eigenvalues,
    ascending (Smith 1961; cross products of rows for the vector)."""
    third = (xx + yy + zz) / 3.0
    a, b, c = xx - third, yy - third, zz - third
    p = (a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0
    root = math.sqrt(max(p, 0.0))
    if root <= 0.0:
        out[0], out[1], out[2] = 0.0, 0.0, 1.0
        return third, third, third
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    r = min(max(det / (2.0 * root * root * root), -1.0), 1.0)
    angle = math.acos(r) / 3.0
    largest = third + 2.0 * root * math.cos(angle)
    smallest = third + 2.0 * root * math.cos(angle + 2.0 * math.pi / 3.0)
    middle = 3.0 * third - largest - smallest
    a, b, c = xx - smallest, yy - smallest, zz - smallest
    best = -1.0
    for k in range(3):
        if k == 0:  # row 0 x row 1
            nx, ny, nz = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
        elif k == 1:  # row 0 x row 2
            nx, ny, nz = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
        else:  # row 1 x row 2
            nx, ny, nz = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
        length = nx * nx + ny * ny + nz * nz
        if length > best:
            best = length
            out[0], out[1], out[2] = nx, ny, nz
    if best <= 0.0:
        out[0], out[1], out[2] = 0.0, 0.0, 1.0
    else:
        scale = 1.0 / math.sqrt(best)
        out[0] *= scale
        out[1] *= scale
        out[2] *= scale
    return smallest, middle, largest


@njit(nogil=True, cache=True, error_model="numpy")
def _estimate(
    keys, level_starts, cell_sizes, reaches, corner, patches, points, directions, widths, out, thread, threads
):
    near, order = np.empty(MAX_NEIGHBOURS, np.int64), np.empty(MAX_NEIGHBOURS, np.int64)
    mass = np.empty(MAX_NEIGHBOURS)
    rows = np.zeros((COLUMNS, MAX_NEIGHBOURS + LANES))
    terms, sums = np.empty((8, MAX_NEIGHBOURS)), np.zeros(18)
    point, n, eigen = np.empty(3), np.empty(3), np.empty(3)
    for start in range(thread * QUERY_BLOCK, points.shape[0], threads * QUERY_BLOCK):
        for q in range(start, min(start + QUERY_BLOCK, points.shape[0])):
            h = widths[q]
            for k in range(3):
                point[k] = points[q, k]
            if not (0.0 < h < 1e30 and abs(point[0]) + abs(point[1]) + abs(point[2]) < 1e30):
                continue
            dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
            # --- a window with enough patches in it
            count, shrinks, total, largest = 0, 0, 0.0, 0.0
            for growth in range(MAX_GROWTHS + MAX_SHRINKS + 1):
                count = gather(keys, level_starts, cell_sizes, reaches, corner, patches, point, h, SIGMAS, near)
                if count > MAX_NEIGHBOURS:
                    count = 0
                    shrinks += 1
                    h /= GROWTH
                    continue
                total, squares, largest = 0.0, 0.0, 0.0
                _masses(near, count, patches, point, h, terms, mass)
                for k in range(count):
                    total += mass[k]
                    squares += mass[k] * mass[k]
                    largest = max(largest, mass[k])
                effective = total * total / squares if squares > 0.0 else 0.0
                if shrinks > 0 or effective >= MIN_PATCHES or growth >= MAX_GROWTHS:
                    break
                h *= GROWTH
            if count < 1 or not total > 0.0:
                continue
            # --- what the rounds need of each patch that counts
            used = 0
            for k in range(count):
                if mass[k] >= MIN_MASS * largest:
                    _patch(near[k], mass[k], patches, h, rows, used)
                    used += 1
            # --- first normal: of the patches, turned to the viewer
            n[0], n[1], n[2] = -1e-3 * dx, -1e-3 * dy, -1e-3 * dz
            for k in range(used):
                w = rows[MASS, k] * rows[FLATNESS, k] / total
                w = w if rows[NX, k] * dx + rows[NY, k] * dy + rows[NZ, k] * dz <= 0.0 else -w
                n[0] += w * rows[NX, k]
                n[1] += w * rows[NY, k]
                n[2] += w * rows[NZ, k]
            scale = 1.0 / math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            for j in range(3):
                n[j] *= scale
            tau, residual, thickness, agreement = FIRST_TAU, 1.0, 1.0, 0.0
            height, left, effective, s0 = 0.0, 0.0, 0.0, 0.0
            for _ in range(REWEIGHTINGS):
                _votes(rows, used, point, n, h, tau, sums)
                s0, sx, sy, sz = sums[0], sums[1], sums[2], sums[3]
                xx, xy, xz, yy, yz, zz = sums[4], sums[5], sums[6], sums[7], sums[8], sums[9]
                mx, my, mz, offsets, rr = sums[10], sums[11], sums[12], sums[13], sums[14]
                squares, tt, agree = sums[15], sums[16], sums[17]
                if not s0 > 0.0:
                    break
                effective = s0 * s0 / squares
                cx, cy, cz = sx / s0, sy / s0, sz / s0
                _smallest_eigenvector(
                    xx / s0 - cx * cx, xy / s0 - cx * cy, xz / s0 - cx * cz,
                    yy / s0 - cy * cy, yz / s0 - cy * cz, zz / s0 - cz * cz, eigen,
                )  # fmt: skip
                center = cx * n[0] + cy * n[1] + cz * n[2]
                residual = math.sqrt(max(rr / s0 - center * center, 0.0)) / h
                thickness = math.sqrt(max(tt / s0, 0.0)) / h
                agreement = agree / s0
                height = offsets / s0
                # --- the next normal: of the centres and of the patches
                if eigen[0] * n[0] + eigen[1] * n[1] + eigen[2] * n[2] < 0.0:
                    eigen[0], eigen[1], eigen[2] = -eigen[0], -eigen[1], -eigen[2]
                n[0], n[1], n[2] = eigen[0] + mx / s0, eigen[1] + my / s0, eigen[2] + mz / s0
                _normalize(n)
                side = n[0] * dx + n[1] * dy + n[2] * dz
                if side > 0.0:  # turned away: the wall's other side
                    n[0], n[1], n[2] = n[0] - 1.01 * side * dx, n[1] - 1.01 * side * dy, n[2] - 1.01 * side * dz
                    _normalize(n)
                slant = -(n[0] * dx + n[1] * dy + n[2] * dz)
                step = min(max(-height / max(slant, MIN_SLANT), -h), h)
                point[0] += step * dx
                point[1] += step * dy
                point[2] += step * dz
                # What a line of sight that grazes the surface, or misses it, leaves is made up for along the normal.
                left = height + step * slant
                tau = min(max(TAU_RESIDUALS * residual, MIN_TAU), FIRST_TAU)
            if not s0 > 0.0:
                continue
            if residual > PRECISE_RESIDUAL:
                share = min((residual - PRECISE_RESIDUAL) / (CLOUDY_RESIDUAL - PRECISE_RESIDUAL), 1.0)
                share = share * share * (3.0 - 2.0 * share)
                front = _front_height(near, count, patches, point, n, h, rows, order)
                slant = -(n[0] * dx + n[1] * dy + n[2] * dz)
                step = min(max(-share * front / max(slant, MIN_SLANT), -h), h)
                point[0] += step * dx
                point[1] += step * dy
                point[2] += step * dz
            for j in range(3):
                out[q, j] = point[j] + left * n[j]
                out[q, 3 + j] = n[j]
            out[q, 6], out[q, 7], out[q, 8] = h, residual, thickness
            out[q, 9], out[q, 10] = effective, agreement


@njit(nogil=True, cache=True, error_model="numpy")
def _nearest_first(values, count, order):
    """The order of values[:count], ascending, equal ones as they come: into bins, and by insertion within these."""
    low, high = math.inf, -math.inf
    for k in range(count):
        low, high = min(low, values[k]), max(high, values[k])
    scale = (DEPTH_BINS - 1) / (high - low) if high > low else 0.0
    starts = np.zeros(DEPTH_BINS + 1, np.int64)
    for k in range(count):
        starts[int((values[k] - low) * scale) + 1] += 1
    for b in range(DEPTH_BINS):
        starts[b + 1] += starts[b]
    for k in range(count):
        b = int((values[k] - low) * scale)
        order[starts[b]] = k
        starts[b] += 1
    for k in range(1, count):
        this, at = order[k], k
        while at > 0 and values[order[at - 1]] > values[this]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = this


@njit(nogil=True, cache=True, error_model="numpy")
def _front_height(near, count, patches, point, n, h, rows, order):
    """Mean height over the plane (point, n), world units, at which rays against n have lost RAY_SHARE of their light to
    the patches near[:count], composited as a renderer does: by the order of their centres, each at the depth where it
    is densest along the ray. rows: [>= RAY_ROWS, >= count] to write on, and
    order: [>= count] int64; near: is written on, too."""
    # Two axes across n.
    if abs(n[0]) < 0.6:
        ax, ay, az = 0.0, n[2], -n[1]
    else:
        ax, ay, az = -n[2], 0.0, n[0]
    scale = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * scale, ay * scale, az * scale
    bx, by, bz = n[1] * az - n[2] * ay, n[2] * ax - n[0] * az, n[0] * ay - n[1] * ax
    reached = 0
    centers = rows[RAY_ROWS - 1]
    for k in range(count):
        i = near[k]
        x, y, z = patches[i, MEAN] - point[0], patches[i, MEAN + 1] - point[1], patches[i, MEAN + 2] - point[2]
        # Seen along n no patch is wider than its longest axis, and none counts beyond three of these.
        u, v = x * ax + y * ay + z * az, x * bx + y * by + z * bz
        beyond = math.sqrt(u * u + v * v) - RAY_RADIUS * h
        if not beyond > 3.001 * patches[i, SCALES]:
            near[reached] = i
            centers[reached] = -(x * n[0] + y * n[1] + z * n[2])
            reached += 1
    _nearest_first(centers, reached, order)
    clear, heights, u, v, exponents = rows[0], rows[1], rows[2], rows[3], rows[4]
    u[7], v[7] = 0.0, 0.0
    for ray in range(7):
        # The hexagon's first corner lies along the first axis.
        u[ray] = RAY_RADIUS * h * math.cos(math.pi / 3.0 * ray) if ray < 6 else 0.0
        v[ray] = RAY_RADIUS * h * math.sin(math.pi / 3.0 * ray) if ray < 6 else 0.0
        clear[ray] = 1.0
    left = 7
    # Seen along n each patch is an ellipse whose densest depth is a plane. All rays are followed together, so that
    # patches behind where the last one stops are not looked at.
    for m in range(reached):
        i = near[order[m]]
        x, y, z = patches[i, MEAN] - point[0], patches[i, MEAN + 1] - point[1], patches[i, MEAN + 2] - point[2]
        nn, na, nb, aa, ab, bb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(3):
            qx, qy, qz = (
                float(patches[i, AXES + 3 * a]),
                float(patches[i, AXES + 3 * a + 1]),
                float(patches[i, AXES + 3 * a + 2]),
            )
            s = 1.0 / float(patches[i, SCALES + a])
            cn, ca = (qx * n[0] + qy * n[1] + qz * n[2]) * s, (qx * ax + qy * ay + qz * az) * s
            cb = (qx * bx + qy * by + qz * bz) * s
            nn += cn * cn
            na += cn * ca
            nb += cn * cb
            aa += ca * ca
            ab += ca * cb
            bb += cb * cb
        at, beside = x * ax + y * ay + z * az, x * bx + y * by + z * bz
        aa, ab, bb = aa - na * na / nn, ab - na * nb / nn, bb - nb * nb / nn
        height, na, nb = -centers[order[m]], na / nn, nb / nn
        for ray in range(8):
            du, dv = at - u[ray], beside - v[ray]
            exponents[ray] = aa * du * du + 2.0 * ab * du * dv + bb * dv * dv
        for ray in range(7):
            if exponents[ray] > 9.0 or clear[ray] < 0.0:
                continue
            clear[ray] *= 1.0 - min(patches[i, OPACITY] * math.exp(-0.5 * exponents[ray]), 0.999)
            if 1.0 - clear[ray] >= RAY_SHARE:
                du, dv = at - u[ray], beside - v[ray]
                heights[ray] = min(max(height + na * du + nb * dv, -h), h)
                clear[ray] = -1.0
                left -= 1
        if left == 0:
            break
    total, mean = 0.0, 0.0
    for ray in range(7):
        if clear[ray] < 0.0:
            mean += heights[ray]
            total += 1.0
    return mean / total if total > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def _votes(rows, used, point, n, h, tau, sums):
    """What the first `used` patches say of the surface at a point with normal n, into `sums` [18]: weights, and times
    these: means (3) and second moments (6) of the patches within the window, whose covariances are h^2 (1 - M);
    normals turned to n (3); offsets along the mean of both normals; squared heights; then squared weights, variances
    along n, cosines of normals. LANES patches at a time: arithmetic in vector instructions, sums in the order of
    patches. rows: [COLUMNS, > used + LANES]."""
    px, py, pz = point[0], point[1], point[2]
    n0, n1, n2 = n[0], n[1], n[2]
    inverse_tau = 1.0 / (tau * h)
    weights, creases = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t1, t2 = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t3, t4 = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t5, t6 = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t7, t8 = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t9, t10 = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t11, t12 = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t13, t14 = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t15, t16 = carray(scratch(point, LANES), (LANES,)), carray(scratch(point, LANES), (LANES,))
    t17 = carray(scratch(point, LANES), (LANES,))
    s0, s1, s2, s3, s4, s5, s6, s7, s8 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    s9, s10, s11, s12, s13, s14, s15, s16, s17 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for start in range(0, used, LANES):
        for lane in range(LANES):
            k = start + lane
            x, y, z = rows[X, k] - px, rows[Y, k] - py, rows[Z, k] - pz
            ux = rows[MXX, k] * x + rows[MXY, k] * y + rows[MXZ, k] * z
            uy = rows[MXY, k] * x + rows[MYY, k] * y + rows[MYZ, k] * z
            uz = rows[MXZ, k] * x + rows[MYZ, k] * y + rows[MZZ, k] * z
            nx, ny, nz = rows[NX, k], rows[NY, k], rows[NZ, k]
            cosine = nx * n0 + ny * n1 + nz * n2
            away = cosine < 0.0
            cosine = -cosine if away else cosine
            plane = ux * n0 + uy * n1 + uz * n2
            r = plane * inverse_tau
            t1[lane], t2[lane], t3[lane], t14[lane], t17[lane] = ux, uy, uz, plane, cosine
            t10[lane] = -nx if away else nx
            t11[lane] = -ny if away else ny
            t12[lane] = -nz if away else nz
            weights[lane] = -0.5 * r * r
            creases[lane] = (cosine - 1.0) / 0.3
        for lane in range(LANES):
            weights[lane] = rows[MASS, start + lane] * exp64(weights[lane])
            creases[lane] = exp64(creases[lane])
        for lane in range(LANES):
            k = start + lane
            flat = rows[FLATNESS, k]
            w = weights[lane] * (1.0 - flat + flat * creases[lane])
            weights[lane] = w
            ux, uy, uz, plane, cosine = t1[lane], t2[lane], t3[lane], t14[lane], t17[lane]
            nx, ny, nz = t10[lane], t11[lane], t12[lane]
            c = w * h * h
            f = w * flat
            t1[lane], t2[lane], t3[lane] = w * ux, w * uy, w * uz
            t4[lane] = w * ux * ux + c * (1.0 - rows[MXX, k])
            t5[lane] = w * ux * uy - c * rows[MXY, k]
            t6[lane] = w * ux * uz - c * rows[MXZ, k]
            t7[lane] = w * uy * uy + c * (1.0 - rows[MYY, k])
            t8[lane] = w * uy * uz - c * rows[MYZ, k]
            t9[lane] = w * uz * uz + c * (1.0 - rows[MZZ, k])
            t10[lane], t11[lane], t12[lane] = f * nx, f * ny, f * nz
            # Offset along the mean of both normals, as far as the patch has one.
            t13[lane] = w * plane + 0.5 * f * (ux * nx + uy * ny + uz * nz - plane)
            t14[lane] = w * plane * plane
            t15[lane] = w * w
            along = rows[MXX, k] * n0 * n0 + rows[MYY, k] * n1 * n1 + rows[MZZ, k] * n2 * n2
            along += 2.0 * (rows[MXY, k] * n0 * n1 + rows[MXZ, k] * n0 * n2 + rows[MYZ, k] * n1 * n2)
            t16[lane] = c * (1.0 - along)
            t17[lane] = w * cosine
        for lane in range(min(used - start, LANES)):
            s0 += weights[lane]
            s1 += t1[lane]
            s2 += t2[lane]
            s3 += t3[lane]
            s4 += t4[lane]
            s5 += t5[lane]
            s6 += t6[lane]
            s7 += t7[lane]
            s8 += t8[lane]
            s9 += t9[lane]
            s10 += t10[lane]
            s11 += t11[lane]
            s12 += t12[lane]
            s13 += t13[lane]
            s14 += t14[lane]
            s15 += t15[lane]
            s16 += t16[lane]
            s17 += t17[lane]
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = s0, s1, s2, s3, s4, s5
    sums[6], sums[7], sums[8], sums[9], sums[10], sums[11] = s6, s7, s8, s9, s10, s11
    sums[12], sums[13], sums[14], sums[15], sums[16], sums[17] = s12, s13, s14, s15, s16, s17


@njit(nogil=True, cache=True, error_model="numpy")
def _masses(near, count, patches, point, h, terms, mass):
    """What the patches near[:count] weigh in the window h around a point, into `mass`. terms: [8, >= count] to write
    on; what is costly (roots and divisions) runs over it in vector instructions."""
    px, py, pz, squared = point[0], point[1], point[2], h * h
    for k in range(count):
        i = near[k]
        x, y, z = patches[i, MEAN] - px, patches[i, MEAN + 1] - py, patches[i, MEAN + 2] - pz
        for a in range(3):
            d = patches[i, AXES + 3 * a] * x + patches[i, AXES + 3 * a + 1] * y
            d += patches[i, AXES + 3 * a + 2] * z
            terms[a, k] = d
            terms[4 + a, k] = float(patches[i, SCALES + a]) ** 2
        terms[7, k] = patches[i, OPACITY]
    for a in range(3):
        d, v = terms[a], terms[4 + a]
        for k in range(count):
            t = v[k] + squared
            d[k] = d[k] * d[k] / t
            v[k] = math.sqrt(v[k] / t) if a < 2 else h / math.sqrt(t)
    for k in range(count):
        area = terms[7, k] * terms[4, k] * terms[5, k] * terms[6, k]
        mass[k] = area * exp64(-0.5 * (terms[0, k] + terms[1, k] + terms[2, k]))


@njit(nogil=True, cache=True, error_model="numpy")
def _patch(i, weight, patches, h, rows, k):
    """The columns of patch i in a window h, into rows[:, k]."""
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        x, y, z = (
            float(patches[i, AXES + 3 * a]),
            float(patches[i, AXES + 3 * a + 1]),
            float(patches[i, AXES + 3 * a + 2]),
        )
        m = h * h / (float(patches[i, SCALES + a]) ** 2 + h * h)
        xx += m * x * x
        xy += m * x * y
        xz += m * x * z
        yy += m * y * y
        yz += m * y * z
        zz += m * z * z
        rows[X + a, k] = patches[i, MEAN + a]
        rows[NX + a, k] = patches[i, AXES + 6 + a]
    rows[MXX, k], rows[MXY, k], rows[MXZ, k] = xx, xy, xz
    rows[MYY, k], rows[MYZ, k], rows[MZZ, k] = yy, yz, zz
    flat = 1.0 - patches[i, SCALES + 2] / patches[i, SCALES + 1]
    rows[MASS, k], rows[FLATNESS, k] = weight, flat * flat


@njit(nogil=True, cache=True, error_model="numpy")
def _normalize(n):
    scale = 1.0 / max(math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), 1e-30)
    n[0] *= scale
    n[1] *= scale
    n[2] *= scale
