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
ROUNDS = 4
"""Of reweighting."""
MIN_SLANT = 0.15
"""Cosine between normal and line of sight below which the step along the latter is bounded."""
QUERY_BLOCK = 64
"""Queries that a thread takes at a time."""
PRECISE_RESIDUAL, CLOUDY_RESIDUAL = 0.12, 0.27
"""rms distance of the patches' centres from their plane, in windows, up to which they lie on the surface, and from which
they are a cloud behind it (an optimised asset shows the front of its Gaussians, not their centres): there the surface
is where light stops. Between the two the height is a mixture."""
RAY_SHARE = 0.25
"""Of the light that has been stopped at the surface of a cloud. On objects fitted from points with noise (density
control, 700 steps) the median error of height is 0.66 widths by centres alone, 0.44, 0.30, 0.28 with 0.5, 0.3, 0.25."""
RAY_RADIUS = 0.5
"""Distance from the query of the six rays around it, in windows."""


@dataclass(frozen=True)
class SurfacePoints:
    """What is known at Q queries."""

    points: np.ndarray = field(repr=False)
    """[Q, 3] float64 on the surface, on the query's line of sight."""
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
        return SurfacePoints(out[:, :3], out[:, 3:6], out[:, 6], out[:, 7], out[:, 8], out[:, 9], out[:, 10])


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
    flat = np.empty(MAX_NEIGHBOURS)
    point, n, eigen = np.empty(3), np.empty(3), np.empty(3)
    for start in range(thread * QUERY_BLOCK, points.shape[0], threads * QUERY_BLOCK):
        for q in range(start, min(start + QUERY_BLOCK, points.shape[0])):
            h = widths[q]
            for k in range(3):
                point[k] = points[q, k]
            if not (h > 0.0 and abs(point[0]) + abs(point[1]) + abs(point[2]) < 1e30):
                continue
            dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
            # --- a window with enough patches in it
            count, shrunk, total, effective = 0, False, 0.0, 0.0
            for growth in range(2 * MAX_GROWTHS + 1):
                count = gather(keys, level_starts, cell_sizes, reaches, corner, means, scales, point, h, SIGMAS, near)
                if count > MAX_NEIGHBOURS:
                    shrunk = True
                    h /= GROWTH
                    count = 0
                    continue
                total, squares = 0.0, 0.0
                for k in range(count):
                    i = near[k]
                    mass[k], flat[k] = _mass(i, means, axes, scales, opacities, point, h)
                    total += mass[k]
                    squares += mass[k] * mass[k]
                effective = total * total / squares if squares > 0.0 else 0.0
                if shrunk or effective >= MIN_PATCHES or growth >= MAX_GROWTHS:
                    break
                h *= GROWTH
            if count < 1 or not total > 0.0:
                continue
            # --- first normal: of the patches, turned to the viewer
            n[0], n[1], n[2] = -1e-3 * dx, -1e-3 * dy, -1e-3 * dz
            for k in range(count):
                i = near[k]
                side = -(axes[i, 2, 0] * dx + axes[i, 2, 1] * dy + axes[i, 2, 2] * dz)
                w = mass[k] * flat[k] / total
                w = w if side >= 0.0 else -w
                for j in range(3):
                    n[j] += w * axes[i, 2, j]
            scale = 1.0 / math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
            for j in range(3):
                n[j] *= scale
            tau, residual, thickness, agreement = 1.0, 1.0, 1.0, 0.0
            height = 0.0
            for turn in range(ROUNDS):
                s0, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
                xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                mx, my, mz, offsets, squares, rr, tt, agree = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for k in range(count):
                    i = near[k]
                    # The patch within the window: mean (ux, uy, uz) from the point, covariance along its axes.
                    ux, uy, uz = 0.0, 0.0, 0.0
                    for a in range(3):
                        ax, ay, az = float(axes[i, a, 0]), float(axes[i, a, 1]), float(axes[i, a, 2])
                        v = float(scales[i, a]) ** 2
                        d = ax * (means[i, 0] - point[0]) + ay * (means[i, 1] - point[1])
                        d = (d + az * (means[i, 2] - point[2])) * (h * h / (v + h * h))
                        ux += d * ax
                        uy += d * ay
                        uz += d * az
                    nx, ny, nz = float(axes[i, 2, 0]), float(axes[i, 2, 1]), float(axes[i, 2, 2])
                    cosine = nx * n[0] + ny * n[1] + nz * n[2]
                    if cosine < 0.0:
                        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
                    r = (ux * n[0] + uy * n[1] + uz * n[2] - height) / (tau * h)
                    w = mass[k] * math.exp(-0.5 * r * r)
                    w *= 1.0 - flat[k] + flat[k] * math.exp(-(1.0 - cosine) / 0.3)
                    if w <= 0.0:
                        continue
                    s0 += w
                    squares += w * w
                    sx += w * ux
                    sy += w * uy
                    sz += w * uz
                    xx += w * ux * ux
                    xy += w * ux * uy
                    xz += w * ux * uz
                    yy += w * uy * uy
                    yz += w * uy * uz
                    zz += w * uz * uz
                    along = 0.0
                    for a in range(3):
                        ax, ay, az = float(axes[i, a, 0]), float(axes[i, a, 1]), float(axes[i, a, 2])
                        v = float(scales[i, a]) ** 2
                        v = w * v * h * h / (v + h * h)
                        xx += v * ax * ax
                        xy += v * ax * ay
                        xz += v * ax * az
                        yy += v * ay * ay
                        yz += v * ay * az
                        zz += v * az * az
                        along += v * (ax * n[0] + ay * n[1] + az * n[2]) ** 2
                    tt += along
                    f = w * flat[k]
                    mx += f * nx
                    my += f * ny
                    mz += f * nz
                    agree += w * cosine
                    # Offset along the mean of both normals, as far as the patch has one.
                    plane = ux * n[0] + uy * n[1] + uz * n[2]
                    tangent = ux * nx + uy * ny + uz * nz
                    offsets += w * (plane + 0.5 * flat[k] * (tangent - plane))
                    rr += w * plane * plane
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
                length = math.sqrt(mx * mx + my * my + mz * mz) / s0
                share = 1.0 if length > 0.0 else 0.0
                bx, by, bz = eigen[0], eigen[1], eigen[2]
                if share > 0.0:
                    bx += share * mx / s0
                    by += share * my / s0
                    bz += share * mz / s0
                scale = 1.0 / max(math.sqrt(bx * bx + by * by + bz * bz), 1e-30)
                n[0], n[1], n[2] = bx * scale, by * scale, bz * scale
                if n[0] * dx + n[1] * dy + n[2] * dz > 0.0:  # turned away: the wall's other side
                    side = n[0] * dx + n[1] * dy + n[2] * dz
                    n[0], n[1], n[2] = n[0] - 1.01 * side * dx, n[1] - 1.01 * side * dy, n[2] - 1.01 * side * dz
                    scale = 1.0 / max(math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), 1e-30)
                    n[0], n[1], n[2] = n[0] * scale, n[1] * scale, n[2] * scale
                slant = -(n[0] * dx + n[1] * dy + n[2] * dz)
                step = -height / max(slant, MIN_SLANT)
                step = min(max(step, -h), h)
                if turn < ROUNDS - 1 or True:
                    point[0] += step * dx
                    point[1] += step * dy
                    point[2] += step * dz
                    height = 0.0
                tau = min(max(2.0 * residual, 0.25), 1.0)
            if not s0 > 0.0:
                continue
            if residual > PRECISE_RESIDUAL:
                share = min((residual - PRECISE_RESIDUAL) / (CLOUDY_RESIDUAL - PRECISE_RESIDUAL), 1.0)
                share = share * share * (3.0 - 2.0 * share)
                front = _front_height(near, count, means, axes, scales, opacities, point, n, h)
                step = -share * front / max(-(n[0] * dx + n[1] * dy + n[2] * dz), MIN_SLANT)
                step = min(max(step, -h), h)
                point[0] += step * dx
                point[1] += step * dy
                point[2] += step * dz
            for j in range(3):
                out[q, j] = point[j]
                out[q, 3 + j] = n[j]
            out[q, 6], out[q, 7], out[q, 8] = h, residual, thickness
            out[q, 9], out[q, 10] = effective, agreement


@njit(nogil=True, cache=True, error_model="numpy")
def _front_height(near, count, means, axes, scales, opacities, point, n, h):
    """Mean height over the plane (point, n), world units, at which rays against n have lost RAY_SHARE of their light to
    the patches near[:count], composited as a renderer does: by the order of their centres, each at the depth where it
    is densest along the ray."""
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
    total, heights = 0.0, 0.0
    for ray in range(7):
        # The hexagon's first corner lies along the first axis.
        angle = math.pi / 3.0 * ray
        u = RAY_RADIUS * h * math.cos(angle) if ray < 6 else 0.0
        v = RAY_RADIUS * h * math.sin(angle) if ray < 6 else 0.0
        ox, oy, oz = point[0] + u * ax + v * bx, point[1] + u * ay + v * by, point[2] + u * az + v * bz
        clear, last = 1.0, 0.0
        for m in range(count):
            k = order[m]
            i = near[k]
            along, across, dot = 0.0, 0.0, 0.0
            for a in range(3):
                s = 1.0 / float(scales[i, a])
                c = axes[i, a, 0] * n[0] + axes[i, a, 1] * n[1] + axes[i, a, 2] * n[2]
                d = axes[i, a, 0] * (means[i, 0] - ox) + axes[i, a, 1] * (means[i, 1] - oy)
                d += axes[i, a, 2] * (means[i, 2] - oz)
                c *= s
                d *= s
                along += c * c
                across += d * d
                dot += c * d
            exponent = across - dot * dot / along
            if exponent > 9.0:
                continue
            last = dot / along
            alpha = opacities[i] * math.exp(-0.5 * exponent)
            clear *= 1.0 - min(alpha, 0.999)
            if 1.0 - clear >= RAY_SHARE:
                heights += min(max(last, -h), h)
                total += 1.0
                break
    return heights / total if total > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def _mass(i, means, axes, scales, opacities, point, h):
    """(what patch i weighs in the window h around a point, 0..1 how far it has a normal)."""
    exponent, area = 0.0, float(opacities[i])
    for a in range(3):
        d = axes[i, a, 0] * (means[i, 0] - point[0]) + axes[i, a, 1] * (means[i, 1] - point[1])
        d += axes[i, a, 2] * (means[i, 2] - point[2])
        v = float(scales[i, a]) ** 2
        t = v + h * h
        exponent += d * d / t
        area *= math.sqrt(v / t) if a < 2 else h / math.sqrt(t)
    flat = 1.0 - scales[i, 2] / scales[i, 1]
    return area * math.exp(-0.5 * exponent), flat * flat
