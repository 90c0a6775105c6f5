"""Derivative of projection and shading: sums of backward.py -> gradients of a view's rows. Recomputes what it needs."""

from __future__ import annotations

import math

from numba import carray

from splatpainter.kernels.simd import EPS2D, device, kernel, prefetch, scratch
from splatpainter.rendering.cpu import geometry as geo
from splatpainter.rendering.cpu.projection import BLOCK
from splatpainter.rendering.cpu.sh import sh_basis, sh_slope

AHEAD = 8


@device
def quat_back(w, x, y, z, h):
    """Gradient of the unit quaternion, made tangent to the sphere, from the nine entries of dL/dR."""
    two = type(w)(2)
    vw = two * (x * (h[7] - h[5]) + y * (h[2] - h[6]) + z * (h[3] - h[1]))
    vx = two * (w * (h[7] - h[5]) + y * (h[1] + h[3]) + z * (h[2] + h[6]) - two * x * (h[4] + h[8]))
    vy = two * (w * (h[2] - h[6]) + x * (h[1] + h[3]) + z * (h[5] + h[7]) - two * y * (h[0] + h[8]))
    vz = two * (w * (h[3] - h[1]) + x * (h[2] + h[6]) + y * (h[5] + h[7]) - two * z * (h[0] + h[4]))
    along = vw * w + vx * x + vy * y + vz * z
    return vw - along * w, vx - along * x, vy - along * y, vz - along * z


@kernel
def project_back(
    means,  # [N, 3]
    quats,  # [N, 4]
    scales,  # [N, 3]
    opacities,  # [N]
    sh,  # [N, K, 3]
    degree,
    cam,  # geometry.camera_vector
    antialiased,
    entries,  # [N] int32 record of each row or -1
    records,  # [M, 16]
    offsets,  # [M + 1]
    sums,  # [P, 16]
    fresh,  # True: outputs are overwritten; False: added to
    v_means,  # out, as the inputs
    v_quats,
    v_scales,
    v_opacities,
    v_sh,
    thread,
    threads,
):
    F = means.dtype.type
    zero = F(0)
    one = F(1)
    half = F(0.5)
    two = F(2)
    eps = F(EPS2D)
    n_rows = means.shape[0]
    coefficients = (degree + 1) * (degree + 1)
    basis = carray(scratch(means, 25), (25,))
    mixed = carray(scratch(means, 25), (25,))
    g = carray(scratch(means, 10), (10,))
    for block in range(thread, (n_rows + BLOCK - 1) // BLOCK, threads):
        for n in range(block * BLOCK, min(n_rows, (block + 1) * BLOCK)):
            soon = entries[min(n + AHEAD, n_rows - 1)]
            if soon >= 0:
                prefetch(records, soon)
                prefetch(sums, offsets[soon])
                prefetch(sums, offsets[soon + 1] - 1)
            if fresh:
                v_opacities[n] = zero
                for c in range(3):
                    v_means[n, c] = zero
                    v_scales[n, c] = zero
                for c in range(4):
                    v_quats[n, c] = zero
                if entries[n] < 0:
                    for k in range(coefficients):
                        for c in range(3):
                            v_sh[n, k, c] = zero
            i = entries[n]
            if i < 0:
                continue
            for c in range(10):
                g[c] = zero
            for pair in range(offsets[i], offsets[i + 1]):
                for c in range(10):
                    g[c] += sums[pair, c]
            ca = records[i, 2]
            cb = records[i, 3]
            cc = records[i, 4]
            opacity = records[i, 5]
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
            vw, vx, vy, vz = quat_back(qw, qx, qy, qz, h)
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

            red = g[6] if records[i, 13] > zero else zero
            green = g[7] if records[i, 14] > zero else zero
            blue = g[8] if records[i, 15] > zero else zero
            dx = means[n, 0] - cam[24]
            dy = means[n, 1] - cam[25]
            dz = means[n, 2] - cam[26]
            rn = one / math.sqrt(dx * dx + dy * dy + dz * dz)
            dx *= rn
            dy *= rn
            dz *= rn
            sh_basis(dx, dy, dz, degree, basis)
            for k in range(coefficients):
                v_sh[n, k, 0] = (zero if fresh else v_sh[n, k, 0]) + basis[k] * red
                v_sh[n, k, 1] = (zero if fresh else v_sh[n, k, 1]) + basis[k] * green
                v_sh[n, k, 2] = (zero if fresh else v_sh[n, k, 2]) + basis[k] * blue
                mixed[k] = red * sh[n, k, 0] + green * sh[n, k, 1] + blue * sh[n, k, 2]
            ex, ey, ez = sh_slope(dx, dy, dz, degree, mixed)
            along = ex * dx + ey * dy + ez * dz
            v_means[n, 0] += gm0 + rn * (ex - along * dx)
            v_means[n, 1] += gm1 + rn * (ey - along * dy)
            v_means[n, 2] += gm2 + rn * (ez - along * dz)
