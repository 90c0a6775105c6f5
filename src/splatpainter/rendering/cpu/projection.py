"""Gaussians -> `projected` of one view: projected, shaded, and counted per tile; and the derivative. Knows no order and
no pixels."""

from __future__ import annotations

import math

import numpy as np
from numba import carray

from splatpainter.kernels.simd import device, kernel, prefetch, scratch
from splatpainter.rendering.cpu import geometry as geo
from splatpainter.rendering.cpu.geometry import (
    BLUE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    CX,
    CY,
    DEPTH,
    EXTENT_X,
    EXTENT_Y,
    EYE_X,
    EYE_Y,
    EYE_Z,
    FX,
    FY,
    GREEN,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    RED,
    SQUARED_RADIUS,
    TILE,
    UNCLAMPED_BLUE,
    UNCLAMPED_GREEN,
    UNCLAMPED_RED,
    X_MAX,
    X_MIN,
    Y_MAX,
    Y_MIN,
)
from splatpainter.rendering.profiles import EPS2D, MAX_DISTANCE_PX, MIN_ALPHA, NEAR_PLANE
from splatpainter.splats import MAX_MAGNITUDE

GAUSSIANS_PER_BLOCK = 1024
"""Gaussians per unit of work; each block's results are written side by side from the block's start."""
MAX_LOOSE_TILES = 16
"""Gaussians whose bounding box has at most this many tiles get room for all of them; others are counted exactly."""
PREFETCH_GAUSSIANS = 8
"""The derivative asks for what it reads this many Gaussians before it is used."""


@device
def meets_window(cam, mx, my, ex, ey):
    """Whether the box of half extents ex, ey around (mx, my) meets the camera's window; not for NaN."""
    return mx + ex > cam[X_MIN] and mx - ex < cam[X_MAX] and my + ey > cam[Y_MIN] and my - ey < cam[Y_MAX]


@kernel
def select_near_window(means, scales, opacities, cam, selected, thread, threads):
    """selected [N] bool: False for Gaussians that project_gaussians would drop by its first, cheap tests. With margins,
    and without jumps, so that LLVM takes many at a time; those that are left are tested as ever."""
    F = means.dtype.type
    near = F(0.999 * NEAR_PLANE)
    faint = F(0.999 * MIN_ALPHA)
    one = F(1)
    margin = F(1)
    eps = F(EPS2D)
    blocks = (means.shape[0] + GAUSSIANS_PER_BLOCK - 1) // GAUSSIANS_PER_BLOCK
    for block in range(thread, blocks, threads):
        for n in range(block * GAUSSIANS_PER_BLOCK, min(means.shape[0], (block + 1) * GAUSSIANS_PER_BLOCK)):
            x, y, z = geo.to_camera(cam, means[n, 0], means[n, 1], means[n, 2])
            rz = one / z
            u = x * rz
            v = y * rz
            mx = cam[FX] * u + cam[CX]
            my = cam[FY] * v + cam[CY]
            j00, j02, j11, j12, _, _ = geo.jacobian(cam, u, v, rz)
            s = max(scales[n, 0], max(scales[n, 1], scales[n, 2]))
            reach = math.sqrt(F(11.2) * (s * s * (j00 * j00 + j02 * j02 + j11 * j11 + j12 * j12) + eps)) + margin
            # Dropped is only what fails for certain: NaN is left to the tests that know it.
            away = (mx + reach < cam[X_MIN]) | (mx - reach > cam[X_MAX])
            away |= (my + reach < cam[Y_MIN]) | (my - reach > cam[Y_MAX])
            selected[n] = not (away | (z < near) | (opacities[n] < faint))


@kernel
def project_gaussians(
    means,  # [N, 3]
    quats,  # [N, 4]
    scales,  # [N, 3]
    opacities,  # [N]
    sh,  # [N, K, 3]
    flat_sh,  # [N, 3 K] the same
    degree,  # of sh
    selected,  # [N] bool, or [0]: all
    cam,  # geometry.camera_vector
    antialiased,
    grid,  # [4] int64: tile columns and rows in use, x0, x1, y0, y1
    tile_slots,  # [TH, TW] int32 index among the tiles in use or -1, or [0, 0]: all tiles are in use
    projected,  # out [blocks * GAUSSIANS_PER_BLOCK, 16]
    keys,  # out [blocks * GAUSSIANS_PER_BLOCK] z
    gaussian_ids,  # out [blocks * GAUSSIANS_PER_BLOCK] int32
    tile_counts,  # out [blocks * GAUSSIANS_PER_BLOCK] int32 tiles touched, at most
    counts,  # out [blocks] int32 Gaussians that each block wrote
    thread,
    threads,
):
    F = means.dtype.type
    zero = F(0)
    one = F(1)
    half = F(0.5)
    two = F(2)
    inf = F(np.inf)
    min_alpha = F(MIN_ALPHA)
    eps = F(EPS2D)
    far = F(MAX_DISTANCE_PX)
    largest = F(MAX_MAGNITUDE)
    coefficients = (degree + 1) * (degree + 1)
    basis = carray(scratch(means, 25), (25,))
    for block in range(thread, counts.shape[0], threads):
        at = block * GAUSSIANS_PER_BLOCK
        for n in range(block * GAUSSIANS_PER_BLOCK, min(means.shape[0], (block + 1) * GAUSSIANS_PER_BLOCK)):
            if selected.shape[0] > 0 and not selected[n]:
                continue
            # Every test is written so that NaN fails it. Ranges are those of Splats.drawable, and are tested where they
            # cost least: what is not drawn anyway needs none.
            x, y, z = geo.to_camera(cam, means[n, 0], means[n, 1], means[n, 2])
            opacity = opacities[n]
            if not (z >= F(NEAR_PLANE) and z < inf and opacity >= min_alpha and opacity <= one):
                continue
            s0 = scales[n, 0]
            s1 = scales[n, 1]
            s2 = scales[n, 2]
            if not (s0 > zero and s1 > zero and s2 > zero):
                continue
            rz = one / z
            u = x * rz
            v = y * rz
            mx = cam[FX] * u + cam[CX]
            my = cam[FY] * v + cam[CY]
            j00, j02, j11, j12, _, _ = geo.jacobian(cam, u, v, rz)
            # Cheap test before the exact one: cov2d is at most |J|^2 max(s)^2, the radius at most sqrt(2 ln 255) sigma.
            s = max(s0, max(s1, s2))
            bound = F(11.1) * (s * s * (j00 * j00 + j02 * j02 + j11 * j11 + j12 * j12) + eps)
            reach = math.sqrt(bound)
            if not meets_window(cam, mx, my, reach, reach):
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
            # cxx cyy - cxy^2 cancels to nothing for the long thin Gaussians of real captures.
            m0 = a1 * b2 - a2 * b1
            m1 = a2 * b0 - a0 * b2
            m2 = a0 * b1 - a1 * b0
            sharp = m0 * m0 + m1 * m1 + m2 * m2
            det = sharp + eps * (cxx + cyy) + eps * eps
            if not (det < inf):
                continue
            if antialiased:
                opacity *= math.sqrt(sharp / det)
                if not (opacity >= min_alpha):
                    continue
            cxx += eps
            cyy += eps
            # A little larger than where alpha falls to MIN_ALPHA: what is drawn must be decided by alpha alone.
            q = two * math.log(opacity / min_alpha) + F(1e-3)
            ex = math.sqrt(q * cxx)
            ey = math.sqrt(q * cyy)
            if not meets_window(cam, mx, my, ex, ey):
                continue
            ca = cyy / det
            cb = -cxy / det
            ty0, ty1 = geo.tile_span(my, ey, grid[2], grid[3])
            tx0, tx1 = geo.tile_span(mx, ex, grid[0], grid[1])
            touched = (tx1 - tx0) * (ty1 - ty0)
            if tile_slots.shape[0] > 0 or touched > MAX_LOOSE_TILES:
                touched = 0
                for ty in range(ty0, ty1):
                    begin, end = geo.tile_columns(mx, my, ca, cb, q, ex, ey, F(ty) * F(TILE), tx0, tx1)
                    for tx in range(begin, end):
                        touched += tile_slots.shape[0] == 0 or tile_slots[ty, tx] >= 0
            if touched <= 0:
                continue
            dx = means[n, 0] - cam[EYE_X]
            dy = means[n, 1] - cam[EYE_Y]
            dz = means[n, 2] - cam[EYE_Z]
            rn = one / math.sqrt(dx * dx + dy * dy + dz * dz)
            geo.sh_basis(dx * rn, dy * rn, dz * rn, degree, basis)
            red = half
            green = half
            blue = half
            for c in range(coefficients):
                red += basis[c] * sh[n, c, 0]
                green += basis[c] * sh[n, c, 1]
                blue += basis[c] * sh[n, c, 2]
            if not (geo.within_range(means, quats, n) and geo.magnitude(flat_sh, n) <= largest):
                continue
            projected[at, MEAN_X] = mx
            projected[at, MEAN_Y] = my
            projected[at, CONIC_A] = ca
            projected[at, CONIC_B] = cb
            projected[at, CONIC_C] = cxx / det
            projected[at, OPACITY] = opacity
            projected[at, RED] = max(red, zero)
            projected[at, GREEN] = max(green, zero)
            projected[at, BLUE] = max(blue, zero)
            projected[at, DEPTH] = z
            projected[at, EXTENT_Y] = ey
            projected[at, EXTENT_X] = ex
            projected[at, SQUARED_RADIUS] = q
            projected[at, UNCLAMPED_RED] = red
            projected[at, UNCLAMPED_GREEN] = green
            projected[at, UNCLAMPED_BLUE] = blue
            keys[at] = z
            gaussian_ids[at] = n
            tile_counts[at] = touched
            at += 1
        counts[block] = at - block * GAUSSIANS_PER_BLOCK


@device
def quat_backward(w, x, y, z, h):
    """Gradient of the unit quaternion, made tangent to the sphere, from the nine entries of dL/dR."""
    two = type(w)(2)
    vw = two * (x * (h[7] - h[5]) + y * (h[2] - h[6]) + z * (h[3] - h[1]))
    vx = two * (w * (h[7] - h[5]) + y * (h[1] + h[3]) + z * (h[2] + h[6]) - two * x * (h[4] + h[8]))
    vy = two * (w * (h[2] - h[6]) + x * (h[1] + h[3]) + z * (h[5] + h[7]) - two * y * (h[0] + h[8]))
    vz = two * (w * (h[3] - h[1]) + x * (h[2] + h[6]) + y * (h[5] + h[7]) - two * z * (h[0] + h[4]))
    along = vw * w + vx * x + vy * y + vz * z
    return vw - along * w, vx - along * x, vy - along * y, vz - along * z


@kernel
def project_gaussians_backward(
    means,  # [N, 3]
    quats,  # [N, 4]
    scales,  # [N, 3]
    opacities,  # [N]
    sh,  # [N, K, 3]
    degree,
    cam,  # geometry.camera_vector
    antialiased,
    entries,  # [N] int32 entry of `projected` of each Gaussian or -1
    projected,  # [M, 16]
    pair_offsets,  # [M + 1]
    sums,  # [P, 16] of rasterize_backward_tiles
    overwrite,  # True: outputs are overwritten; False: added to
    v_means,  # out, as the inputs
    v_quats,
    v_scales,
    v_opacities,
    v_sh,  # or [0, K, 3]: not wanted
    thread,
    threads,
):
    F = means.dtype.type
    zero = F(0)
    one = F(1)
    half = F(0.5)
    two = F(2)
    eps = F(EPS2D)
    count = means.shape[0]
    coefficients = (degree + 1) * (degree + 1)
    basis = carray(scratch(means, 25), (25,))
    mixed = carray(scratch(means, 25), (25,))
    g = carray(scratch(means, 10), (10,))
    for block in range(thread, (count + GAUSSIANS_PER_BLOCK - 1) // GAUSSIANS_PER_BLOCK, threads):
        for n in range(block * GAUSSIANS_PER_BLOCK, min(count, (block + 1) * GAUSSIANS_PER_BLOCK)):
            soon = entries[min(n + PREFETCH_GAUSSIANS, count - 1)]
            if soon >= 0:
                prefetch(projected, soon)
                prefetch(sums, pair_offsets[soon])
                prefetch(sums, pair_offsets[soon + 1] - 1)
            if overwrite:
                v_opacities[n] = zero
                for c in range(3):
                    v_means[n, c] = zero
                    v_scales[n, c] = zero
                for c in range(4):
                    v_quats[n, c] = zero
                if entries[n] < 0 and v_sh.shape[0] > 0:
                    for k in range(coefficients):
                        for c in range(3):
                            v_sh[n, k, c] = zero
            i = entries[n]
            if i < 0:
                continue
            for c in range(10):
                g[c] = zero
            for pair in range(pair_offsets[i], pair_offsets[i + 1]):
                for c in range(10):
                    g[c] += sums[pair, c]
            ca = projected[i, CONIC_A]
            cb = projected[i, CONIC_B]
            cc = projected[i, CONIC_C]
            opacity = projected[i, OPACITY]
            v_opacities[n] += g[0] * (opacity / opacities[n] if antialiased else one)
            vmx = -opacity * (ca * g[1] + cb * g[2])
            vmy = -opacity * (cb * g[1] + cc * g[2])

            # sigma = d^T X d / 2 with X = cov^-1, so dL/dcov = -X (dL/dX) X
            va = -half * opacity * g[3]
            vb = -half * opacity * g[4]
            vc = -half * opacity * g[5]
            m00 = ca * va + cb * vb
            m01 = ca * vb + cb * vc
            m10 = cb * va + cc * vb
            m11 = cb * vb + cc * vc
            w00 = -(m00 * ca + m01 * cb)
            w01 = -(m00 * cb + m01 * cc)
            w11 = -(m10 * cb + m11 * cc)

            x, y, z = geo.to_camera(cam, means[n, 0], means[n, 1], means[n, 2])
            rz = one / z
            u = x * rz
            v = y * rz
            j00, j02, j11, j12, uc, vc_ = geo.jacobian(cam, u, v, rz)
            p00, p01, p02, p10, p11, p12 = geo.to_world(cam, j00, j02, j11, j12)
            qw, qx, qy, qz, qn = geo.unit_quat(quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
            q = geo.rotation(qw, qx, qy, qz)
            a0, a1, a2, b0, b1, b2 = geo.project_axes(p00, p01, p02, p10, p11, p12, q)
            s0 = scales[n, 0]
            s1 = scales[n, 1]
            s2 = scales[n, 2]
            if antialiased:
                # opacity = o sqrt(det sharp / det blurred), and d ln det = tr(inverse dcov)
                cxx = a0 * a0 * s0 * s0 + a1 * a1 * s1 * s1 + a2 * a2 * s2 * s2
                cxy = a0 * b0 * s0 * s0 + a1 * b1 * s1 * s1 + a2 * b2 * s2 * s2
                cyy = b0 * b0 * s0 * s0 + b1 * b1 * s1 * s1 + b2 * b2 * s2 * s2
                m0 = (a1 * b2 - a2 * b1) * s1 * s2
                m1 = (a2 * b0 - a0 * b2) * s2 * s0
                m2 = (a0 * b1 - a1 * b0) * s0 * s1
                sharp = m0 * m0 + m1 * m1 + m2 * m2
                det = sharp + eps * (cxx + cyy) + eps * eps
                scale = half * opacity * g[0]
                w00 += scale * (cyy / sharp - (cyy + eps) / det)
                w01 -= scale * (cxy / sharp - cxy / det)
                w11 += scale * (cxx / sharp - (cxx + eps) / det)

            # cov = V V^T with V = [a; b] S, so dL/dV = 2 W V; e = dL/dV S^-1, f = dL/d[a; b]
            e00 = two * s0 * (w00 * a0 + w01 * b0)
            e10 = two * s0 * (w01 * a0 + w11 * b0)
            e01 = two * s1 * (w00 * a1 + w01 * b1)
            e11 = two * s1 * (w01 * a1 + w11 * b1)
            e02 = two * s2 * (w00 * a2 + w01 * b2)
            e12 = two * s2 * (w01 * a2 + w11 * b2)
            v_scales[n, 0] += e00 * a0 + e10 * b0
            v_scales[n, 1] += e01 * a1 + e11 * b1
            v_scales[n, 2] += e02 * a2 + e12 * b2
            f00 = e00 * s0
            f10 = e10 * s0
            f01 = e01 * s1
            f11 = e11 * s1
            f02 = e02 * s2
            f12 = e12 * s2
            h = (
                p00 * f00 + p10 * f10,
                p00 * f01 + p10 * f11,
                p00 * f02 + p10 * f12,
                p01 * f00 + p11 * f10,
                p01 * f01 + p11 * f11,
                p01 * f02 + p11 * f12,
                p02 * f00 + p12 * f10,
                p02 * f01 + p12 * f11,
                p02 * f02 + p12 * f12,
            )
            vw, vx, vy, vz = quat_backward(qw, qx, qy, qz, h)
            v_quats[n, 0] += qn * vw
            v_quats[n, 1] += qn * vx
            v_quats[n, 2] += qn * vy
            v_quats[n, 3] += qn * vz

            # dL/dP = f R^T, dL/dJ = dL/dP W^T
            d00 = f00 * q[0] + f01 * q[1] + f02 * q[2]
            d01 = f00 * q[3] + f01 * q[4] + f02 * q[5]
            d02 = f00 * q[6] + f01 * q[7] + f02 * q[8]
            d10 = f10 * q[0] + f11 * q[1] + f12 * q[2]
            d11 = f10 * q[3] + f11 * q[4] + f12 * q[5]
            d12 = f10 * q[6] + f11 * q[7] + f12 * q[8]
            vj00 = d00 * cam[0] + d01 * cam[1] + d02 * cam[2]
            vj02 = d00 * cam[6] + d01 * cam[7] + d02 * cam[8]
            vj11 = d10 * cam[3] + d11 * cam[4] + d12 * cam[5]
            vj12 = d10 * cam[6] + d11 * cam[7] + d12 * cam[8]
            # j00 = fx / z, j02 = -j00 clamp(u): the clamp has no slope outside its limits
            gx = j00 * vmx
            gy = j11 * vmy
            gz = g[9] - j00 * u * vmx - j11 * v * vmy - rz * (j00 * vj00 + j11 * vj11)
            gz += rz * (j00 * uc * vj02 + j11 * vc_ * vj12)
            if uc == u:
                gx -= j00 * rz * vj02
                gz += j00 * rz * u * vj02
            if vc_ == v:
                gy -= j11 * rz * vj12
                gz += j11 * rz * v * vj12
            gm0 = cam[0] * gx + cam[3] * gy + cam[6] * gz
            gm1 = cam[1] * gx + cam[4] * gy + cam[7] * gz
            gm2 = cam[2] * gx + cam[5] * gy + cam[8] * gz

            red = g[6] if projected[i, UNCLAMPED_RED] > zero else zero
            green = g[7] if projected[i, UNCLAMPED_GREEN] > zero else zero
            blue = g[8] if projected[i, UNCLAMPED_BLUE] > zero else zero
            dx = means[n, 0] - cam[EYE_X]
            dy = means[n, 1] - cam[EYE_Y]
            dz = means[n, 2] - cam[EYE_Z]
            rn = one / math.sqrt(dx * dx + dy * dy + dz * dz)
            dx *= rn
            dy *= rn
            dz *= rn
            geo.sh_basis(dx, dy, dz, degree, basis)
            for k in range(coefficients):
                if v_sh.shape[0] > 0:
                    v_sh[n, k, 0] = (zero if overwrite else v_sh[n, k, 0]) + basis[k] * red
                    v_sh[n, k, 1] = (zero if overwrite else v_sh[n, k, 1]) + basis[k] * green
                    v_sh[n, k, 2] = (zero if overwrite else v_sh[n, k, 2]) + basis[k] * blue
                mixed[k] = red * sh[n, k, 0] + green * sh[n, k, 1] + blue * sh[n, k, 2]
            ex, ey, ez = geo.sh_gradient(dx, dy, dz, degree, mixed)
            along = ex * dx + ey * dy + ez * dz
            v_means[n, 0] += gm0 + rn * (ex - along * dx)
            v_means[n, 1] += gm1 + rn * (ey - along * dy)
            v_means[n, 2] += gm2 + rn * (ez - along * dz)
