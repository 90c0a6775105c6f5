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
from numba import njit

from splatpainter.kernels import parallel
from splatpainter.splats import Splats
from splatpainter.surface.samples import SurfaceSamples, gather

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
ROUNDS = 4
"""Of reweighting: patches off the surface by one `tau` (in windows) lose 0.4 of their vote."""
FIRST_TAU, TAU_RESIDUALS, MIN_TAU = 0.5, 2.0, 0.25
"""In the first round; afterwards in residuals of the round before, at least, in windows."""
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
"""Of the light that has been stopped at the surface of a cloud. On objects fitted from points with noise (density
control, 700 steps) the median error of height is 0.66 widths by centres alone, 0.44, 0.30, 0.28 with 0.5, 0.3, 0.25."""
RAY_RADIUS = 0.5
"""Distance from the query of the six rays around it, in windows."""


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
    thicknesses: np.ndarray = field(repr=False)
    """[Q] float64 rms extent of the patches themselves along the normal, in windows."""
    patches: np.ndarray = field(repr=False)
    """[Q] float64 effective number of patches behind the estimate; 0: there is no surface."""
    agreement: np.ndarray = field(repr=False)
    """[Q] float64 0..1 mean |cosine| between the patches' normals and the surface's."""
    trust: np.ndarray = field(repr=False)
    """[Q] float64 0..1 probability that the height is off by less than 0.3 widths of the Gaussians seen there."""


@dataclass(frozen=True)
class Surface:
    """Of one asset, as it was before all edits."""

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
        patches = (s.means, s.axes, s.scales, s.opacities)
        queries = [np.ascontiguousarray(a, np.float64) for a in (points, directions, widths)]
        if count and len(s):
            parallel.run(_estimate, *lists, *patches, *queries, out)
        trust = _trust(out, queries[0], queries[1])
        return SurfacePoints(out[:, :3], out[:, 3:6], out[:, 6], out[:, 7], out[:, 8], out[:, 9], out[:, 10], trust)


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
    keys, level_starts, cell_sizes, reaches, corner, means, axes, scales, opacities, points, directions, widths, out,
    thread, threads,
):  # fmt: skip
    near = np.empty(MAX_NEIGHBOURS, np.int64)
    mass = np.empty(MAX_NEIGHBOURS)
    rows = np.empty((MAX_NEIGHBOURS, COLUMNS))
    terms = np.empty((8, MAX_NEIGHBOURS))
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
                count = gather(keys, level_starts, cell_sizes, reaches, corner, means, scales, point, h, SIGMAS, near)
                if count > MAX_NEIGHBOURS:
                    count = 0
                    shrinks += 1
                    h /= GROWTH
                    continue
                total, squares, largest = 0.0, 0.0, 0.0
                _masses(near, count, means, axes, scales, opacities, point, h, terms, mass)
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
                    _patch(near[k], mass[k], means, axes, scales, h, rows[used])
                    used += 1
            # --- first normal: of the patches, turned to the viewer
            n[0], n[1], n[2] = -1e-3 * dx, -1e-3 * dy, -1e-3 * dz
            for k in range(used):
                row = rows[k]
                w = row[MASS] * row[FLATNESS] / total
                w = w if row[NX] * dx + row[NY] * dy + row[NZ] * dz <= 0.0 else -w
                n[0] += w * row[NX]
                n[1] += w * row[NY]
                n[2] += w * row[NZ]
            scale = 1.0 / math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            for j in range(3):
                n[j] *= scale
            tau, residual, thickness, agreement = FIRST_TAU, 1.0, 1.0, 0.0
            height, left, effective, s0 = 0.0, 0.0, 0.0, 0.0
            for turn in range(ROUNDS):
                s0, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
                xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                mx, my, mz, offsets, squares, rr, tt, agree = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                inverse_tau = 1.0 / (tau * h)
                for k in range(used):
                    row = rows[k]
                    # The patch within the window: mean (ux, uy, uz) from the point, covariance h^2 (1 - M).
                    x, y, z = row[X] - point[0], row[Y] - point[1], row[Z] - point[2]
                    ux = row[MXX] * x + row[MXY] * y + row[MXZ] * z
                    uy = row[MXY] * x + row[MYY] * y + row[MYZ] * z
                    uz = row[MXZ] * x + row[MYZ] * y + row[MZZ] * z
                    nx, ny, nz = row[NX], row[NY], row[NZ]
                    cosine = nx * n[0] + ny * n[1] + nz * n[2]
                    if cosine < 0.0:
                        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
                    plane = ux * n[0] + uy * n[1] + uz * n[2]
                    r = plane * inverse_tau
                    flat = row[FLATNESS]
                    w = row[MASS] * math.exp(-0.5 * r * r)
                    w *= 1.0 - flat + flat * math.exp((cosine - 1.0) / 0.3)
                    s0 += w
                    sx += w * ux
                    sy += w * uy
                    sz += w * uz
                    c = w * h * h
                    xx += w * ux * ux + c * (1.0 - row[MXX])
                    xy += w * ux * uy - c * row[MXY]
                    xz += w * ux * uz - c * row[MXZ]
                    yy += w * uy * uy + c * (1.0 - row[MYY])
                    yz += w * uy * uz - c * row[MYZ]
                    zz += w * uz * uz + c * (1.0 - row[MZZ])
                    f = w * flat
                    mx += f * nx
                    my += f * ny
                    mz += f * nz
                    # Offset along the mean of both normals, as far as the patch has one.
                    offsets += w * plane + 0.5 * f * (ux * nx + uy * ny + uz * nz - plane)
                    rr += w * plane * plane
                    if turn < ROUNDS - 1:
                        continue
                    squares += w * w
                    along = row[MXX] * n[0] * n[0] + row[MYY] * n[1] * n[1] + row[MZZ] * n[2] * n[2]
                    along += 2.0 * (row[MXY] * n[0] * n[1] + row[MXZ] * n[0] * n[2] + row[MYZ] * n[1] * n[2])
                    tt += c * (1.0 - along)
                    agree += w * cosine
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
                front = _front_height(near, count, means, axes, scales, opacities, point, n, h, rows)
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
def _front_height(near, count, means, axes, scales, opacities, point, n, h, rows):
    """Mean height over the plane (point, n), world units, at which rays against n have lost RAY_SHARE of their light to
    the patches near[:count], composited as a renderer does: by the order of their centres, each at the depth where it
    is densest along the ray. rows: [count, >= 9] to write on."""
    # Two axes across n.
    if abs(n[0]) < 0.6:
        ax, ay, az = 0.0, n[2], -n[1]
    else:
        ax, ay, az = -n[2], 0.0, n[0]
    scale = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * scale, ay * scale, az * scale
    bx, by, bz = n[1] * az - n[2] * ay, n[2] * ax - n[0] * az, n[0] * ay - n[1] * ax
    centers = np.empty(count)
    for k in range(count):
        i = near[k]
        x, y, z = means[i, 0] - point[0], means[i, 1] - point[1], means[i, 2] - point[2]
        centers[k] = -(x * n[0] + y * n[1] + z * n[2])
    order = np.argsort(centers)
    # Seen along n each patch is an ellipse whose densest depth is a plane: rows hold both, nearest first.
    for m in range(count):
        i = near[order[m]]
        x, y, z = means[i, 0] - point[0], means[i, 1] - point[1], means[i, 2] - point[2]
        nn, na, nb, aa, ab, bb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(3):
            qx, qy, qz = float(axes[i, a, 0]), float(axes[i, a, 1]), float(axes[i, a, 2])
            s = 1.0 / float(scales[i, a])
            cn, ca = (qx * n[0] + qy * n[1] + qz * n[2]) * s, (qx * ax + qy * ay + qz * az) * s
            cb = (qx * bx + qy * by + qz * bz) * s
            nn += cn * cn
            na += cn * ca
            nb += cn * cb
            aa += ca * ca
            ab += ca * cb
            bb += cb * cb
        row = rows[m]
        row[0], row[1] = x * ax + y * ay + z * az, x * bx + y * by + z * bz
        row[2], row[3], row[4] = aa - na * na / nn, ab - na * nb / nn, bb - nb * nb / nn
        row[5], row[6], row[7] = -centers[order[m]], na / nn, nb / nn
        row[8] = opacities[i]
    total, heights = 0.0, 0.0
    for ray in range(7):
        # The hexagon's first corner lies along the first axis.
        u = RAY_RADIUS * h * math.cos(math.pi / 3.0 * ray) if ray < 6 else 0.0
        v = RAY_RADIUS * h * math.sin(math.pi / 3.0 * ray) if ray < 6 else 0.0
        clear = 1.0
        for m in range(count):
            row = rows[m]
            du, dv = row[0] - u, row[1] - v
            exponent = row[2] * du * du + 2.0 * row[3] * du * dv + row[4] * dv * dv
            if exponent > 9.0:
                continue
            clear *= 1.0 - min(row[8] * math.exp(-0.5 * exponent), 0.999)
            if 1.0 - clear >= RAY_SHARE:
                heights += min(max(row[5] + row[6] * du + row[7] * dv, -h), h)
                total += 1.0
                break
    return heights / total if total > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def _masses(near, count, means, axes, scales, opacities, point, h, terms, mass):
    """What the patches near[:count] weigh in the window h around a point, into `mass`. terms: [8, >= count] to write
    on; what is costly (roots and divisions) runs over it in vector instructions."""
    px, py, pz, squared = point[0], point[1], point[2], h * h
    for k in range(count):
        i = near[k]
        x, y, z = means[i, 0] - px, means[i, 1] - py, means[i, 2] - pz
        for a in range(3):
            d = axes[i, a, 0] * x + axes[i, a, 1] * y
            d += axes[i, a, 2] * z
            terms[a, k] = d
            terms[4 + a, k] = float(scales[i, a]) ** 2
        terms[7, k] = opacities[i]
    for a in range(3):
        d, v = terms[a], terms[4 + a]
        for k in range(count):
            t = v[k] + squared
            d[k] = d[k] * d[k] / t
            v[k] = math.sqrt(v[k] / t) if a < 2 else h / math.sqrt(t)
    for k in range(count):
        area = terms[7, k] * terms[4, k] * terms[5, k] * terms[6, k]
        mass[k] = area * math.exp(-0.5 * (terms[0, k] + terms[1, k] + terms[2, k]))


@njit(nogil=True, cache=True, error_model="numpy")
def _patch(i, weight, means, axes, scales, h, row):
    """The columns of patch i in a window h."""
    row[:] = 0.0
    for a in range(3):
        x, y, z = float(axes[i, a, 0]), float(axes[i, a, 1]), float(axes[i, a, 2])
        m = h * h / (float(scales[i, a]) ** 2 + h * h)
        row[MXX] += m * x * x
        row[MXY] += m * x * y
        row[MXZ] += m * x * z
        row[MYY] += m * y * y
        row[MYZ] += m * y * z
        row[MZZ] += m * z * z
        row[X + a] = means[i, a]
        row[NX + a] = axes[i, 2, a]
    flat = 1.0 - scales[i, 2] / scales[i, 1]
    row[MASS], row[FLATNESS] = weight, flat * flat


@njit(nogil=True, cache=True, error_model="numpy")
def _normalize(n):
    scale = 1.0 / max(math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), 1e-30)
    n[0] *= scale
    n[1] *= scale
    n[2] *= scale
