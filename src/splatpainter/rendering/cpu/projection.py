"""Rows -> records of one view: projected, shaded, and counted per tile. Knows no order and no pixels."""

from __future__ import annotations

import math

import numpy as np
from numba import carray

from splatpainter.kernels.simd import EPS2D, FAR_PX, NEAR, THRESHOLD, TILE, kernel, scratch
from splatpainter.rendering.cpu import geometry as geo
from splatpainter.rendering.cpu.sh import sh_basis
from splatpainter.splats import MAX_MAGNITUDE

BLOCK = 1024
"""Rows per unit of work; each block's records are written side by side from the block's start."""
LOOSE = 16
"""Rows whose bounding box has at most this many tiles get room for all of them; others are counted exactly."""


@kernel
def project_rows(
    means,  # [N, 3]
    quats,  # [N, 4]
    scales,  # [N, 3]
    opacities,  # [N]
    sh,  # [N, K, 3]
    flat,  # [N, 3 K] the same
    degree,  # of sh
    keep,  # [N] bool, or [0]: all
    cam,  # geometry.camera_vector
    antialiased,
    grid,  # [4] int64: tile columns and rows in use, x0, x1, y0, y1
    slots,  # [TH, TW] int32 index among the tiles in use or -1, or [0, 0]: all tiles are in use
    records,  # out [blocks * BLOCK, 16]
    keys,  # out [blocks * BLOCK] z
    rows,  # out [blocks * BLOCK] int32
    room,  # out [blocks * BLOCK] int32 tiles touched, at most
    counts,  # out [blocks] int32 records of each block
    thread,
    threads,
):
    F = means.dtype.type
    zero = F(0)
    one = F(1)
    half = F(0.5)
    two = F(2)
    inf = F(np.inf)
    threshold = F(THRESHOLD)
    eps = F(EPS2D)
    far = F(FAR_PX)
    largest = F(MAX_MAGNITUDE)
    coefficients = (degree + 1) * (degree + 1)
    basis = carray(scratch(means, 25), (25,))
    for block in range(thread, counts.shape[0], threads):
        at = block * BLOCK
        for n in range(block * BLOCK, min(means.shape[0], (block + 1) * BLOCK)):
            if keep.shape[0] > 0 and not keep[n]:
                continue
            # Every test is written so that NaN fails it. Ranges are those of Splats.drawable, and are tested where they
            # cost least: what is not drawn anyway needs none.
            x, y, z = geo.to_camera(cam, means[n, 0], means[n, 1], means[n, 2])
            opacity = opacities[n]
            if not (z >= F(NEAR) and z < inf and opacity >= threshold and opacity <= one):
                continue
            s0 = scales[n, 0]
            s1 = scales[n, 1]
            s2 = scales[n, 2]
            if not (s0 > zero and s1 > zero and s2 > zero):
                continue
            rz = one / z
            u = x * rz
            v = y * rz
            mx = cam[12] * u + cam[14]
            my = cam[13] * v + cam[15]
            j00, j02, j11, j12, _, _ = geo.jacobian(cam, u, v, rz)
            # Cheap test before the exact one: cov2d is at most |J|^2 max(s)^2, the radius at most sqrt(2 ln 255) sigma.
            s = max(s0, max(s1, s2))
            bound = F(11.1) * (s * s * (j00 * j00 + j02 * j02 + j11 * j11 + j12 * j12) + eps)
            reach = math.sqrt(bound)
            if not (mx + reach > cam[20] and mx - reach < cam[21] and my + reach > cam[22] and my - reach < cam[23]):
                continue
            if not (abs(mx) <= far and abs(my) <= far and s <= largest):
                continue
            p00, p01, p02, p10, p11, p12 = geo.to_world(cam, j00, j02, j11, j12)
            w, i, j, k, _ = geo.unit_quat(quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
            a0, a1, a2, b0, b1, b2 = geo.project_axes(p00, p01, p02, p10, p11, p12, geo.rotation(w, i, j, k))
            a0 *= s0
            a1 *= s1
            a2 *= s2
            b0 *= s0
            b1 *= s1
            b2 *= s2
            cxx = a0 * a0 + a1 * a1 + a2 * a2
            cxy = a0 * b0 + a1 * b1 + a2 * b2
            cyy = b0 * b0 + b1 * b1 + b2 * b2
            # det of the 2D covariance as a sum of squared minors (Cauchy-Binet) and of the blurred one from it:
            # cxx cyy - cxy^2 cancels to nothing for the long thin rows of real captures.
            m0 = a1 * b2 - a2 * b1
            m1 = a2 * b0 - a0 * b2
            m2 = a0 * b1 - a1 * b0
            sharp = m0 * m0 + m1 * m1 + m2 * m2
            det = sharp + eps * (cxx + cyy) + eps * eps
            if not (det < inf):
                continue
            if antialiased:
                opacity *= math.sqrt(sharp / det)
                if not (opacity >= threshold):
                    continue
            cxx += eps
            cyy += eps
            # A little larger than where alpha falls to the threshold: what is drawn must be decided by alpha alone.
            q = two * math.log(opacity / threshold) + F(1e-3)
            xe = math.sqrt(q * cxx)
            ye = math.sqrt(q * cyy)
            if not (mx + xe > cam[20] and mx - xe < cam[21] and my + ye > cam[22] and my - ye < cam[23]):
                continue
            ca = cyy / det
            cb = -cxy / det
            ty0, ty1 = geo.tile_span(my, ye, grid[2], grid[3])
            tx0, tx1 = geo.tile_span(mx, xe, grid[0], grid[1])
            touched = (tx1 - tx0) * (ty1 - ty0)
            if slots.shape[0] > 0 or touched > LOOSE:
                touched = 0
                for ty in range(ty0, ty1):
                    begin, end = geo.tile_columns(mx, my, ca, cb, q, xe, ye, F(ty) * F(TILE), tx0, tx1)
                    for tx in range(begin, end):
                        touched += slots.shape[0] == 0 or slots[ty, tx] >= 0
            if touched <= 0:
                continue
            dx = means[n, 0] - cam[24]
            dy = means[n, 1] - cam[25]
            dz = means[n, 2] - cam[26]
            rn = one / math.sqrt(dx * dx + dy * dy + dz * dz)
            sh_basis(dx * rn, dy * rn, dz * rn, degree, basis)
            red = half
            green = half
            blue = half
            for c in range(coefficients):
                red += basis[c] * sh[n, c, 0]
                green += basis[c] * sh[n, c, 1]
                blue += basis[c] * sh[n, c, 2]
            if not (geo.within_range(means, quats, n) and geo.magnitude(flat, n) <= largest):
                continue
            records[at, 0] = mx
            records[at, 1] = my
            records[at, 2] = ca
            records[at, 3] = cb
            records[at, 4] = cxx / det
            records[at, 5] = opacity
            records[at, 6] = max(red, zero)
            records[at, 7] = max(green, zero)
            records[at, 8] = max(blue, zero)
            records[at, 9] = z
            records[at, 10] = ye
            records[at, 11] = xe
            records[at, 12] = q
            records[at, 13] = red
            records[at, 14] = green
            records[at, 15] = blue
            keys[at] = z
            rows[at] = n
            room[at] = touched
            at += 1
        counts[block] = at - block * BLOCK
