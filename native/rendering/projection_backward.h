// The derivative of projection: gradients of one view's entries -> of the Gaussians' attributes.
#pragma once
#include "backward.h"
#include "projection.h"

namespace sp { namespace {

// What is read is asked for this many Gaussians before it is used.
constexpr i64 PREFETCH_GAUSSIANS = 8;

// Gradient of the unit quaternion, made tangent to the sphere, from the nine entries of dL/dR.
template <class F>
SP_INLINE void quat_backward(F w, F x, F y, F z, const F* h, F* v) {
    const F two = F(2);
    v[0] = two * (x * (h[7] - h[5]) + y * (h[2] - h[6]) + z * (h[3] - h[1]));
    v[1] = two * (w * (h[7] - h[5]) + y * (h[1] + h[3]) + z * (h[2] + h[6]) - two * x * (h[4] + h[8]));
    v[2] = two * (w * (h[2] - h[6]) + x * (h[1] + h[3]) + z * (h[5] + h[7]) - two * y * (h[0] + h[8]));
    v[3] = two * (w * (h[3] - h[1]) + x * (h[2] + h[6]) + y * (h[5] + h[7]) - two * z * (h[0] + h[4]));
    const F along = v[0] * w + v[1] * x + v[2] * y + v[3] * z;
    v[0] -= along * w, v[1] -= along * x, v[2] -= along * y, v[3] -= along * z;
}

// Gradient of sum_k v[k] Y_k with respect to (x, y, z), before projection onto the unit sphere.
template <class F>
SP_INLINE Vec3<F> sh_gradient(F x, F y, F z, i64 degree, const F* v) {
    F gx = F(0), gy = F(0), gz = F(0);
    if (degree < 1) return {gx, gy, gz};
    const F k1 = F(0.48860251190292);
    gy -= k1 * v[1];
    gz += k1 * v[2];
    gx -= k1 * v[3];
    if (degree < 2) return {gx, gy, gz};
    const F c1 = x * x - y * y, s1 = F(2) * x * y, k2 = F(2 * 0.5462742152960395), k3 = F(1.092548430592079);
    gx += k2 * (y * v[4] + x * v[8]) - k3 * z * v[7];
    gy += k2 * (x * v[4] - y * v[8]) - k3 * z * v[5];
    gz += F(2 * 0.9461746957575601) * z * v[6] - k3 * (y * v[5] + x * v[7]);
    if (degree < 3) return {gx, gy, gz};
    const F zz = z * z, k4 = F(3 * 0.5900435899266435), k5 = F(1.445305721320277);
    const F linear = F(-2.285228997322329) * zz + F(0.4570457994644658);
    const F c2 = x * c1 - y * s1, s2 = x * s1 + y * c1, d12 = F(3 * 1.865881662950577) * zz - F(1.119528997770346);
    gx += F(2) * k5 * z * (y * v[10] + x * v[14]) - k4 * (s1 * v[9] + c1 * v[15]) + linear * v[13];
    gy += F(2) * k5 * z * (x * v[10] - y * v[14]) - k4 * (c1 * v[9] - s1 * v[15]) + linear * v[11];
    gz += k5 * (s1 * v[10] + c1 * v[14]) - F(2 * 2.285228997322329) * z * (y * v[11] + x * v[13]) + d12 * v[12];
    if (degree < 4) return {gx, gy, gz};
    const F k6 = F(4 * 0.6258357354491763), k7 = F(1.770130769779931);
    const F cubic = z * (F(-4.683325804901025) * zz + F(2.007139630671868));
    const F dcubic = F(-3 * 4.683325804901025) * zz + F(2.007139630671868);
    const F square = F(3.31161143515146) * zz - F(0.47308734787878);
    const F b12 = z * (F(1.865881662950577) * zz - F(1.119528997770346));
    const F d20 = F(1.984313483298443) * (b12 + z * d12) - F(2 * 1.006230589874905 * 0.9461746957575601) * z;
    gx += k6 * (s2 * v[16] + c2 * v[24]) - F(3) * k7 * z * (s1 * v[17] + c1 * v[23]);
    gx += F(2) * square * (y * v[18] + x * v[22]) + cubic * v[21];
    gy += k6 * (c2 * v[16] - s2 * v[24]) - F(3) * k7 * z * (c1 * v[17] - s1 * v[23]);
    gy += F(2) * square * (x * v[18] - y * v[22]) + cubic * v[19];
    gz += F(2 * 3.31161143515146) * z * (s1 * v[18] + c1 * v[22]) - k7 * (s2 * v[17] + c2 * v[23]);
    gz += dcubic * (y * v[19] + x * v[21]) + d20 * v[20];
    return {gx, gy, gz};
}

// entries [N]: the entry of `projected` of each Gaussian, or -1. sums: of rasterize_backward_tiles. overwrite: outputs
// are overwritten, otherwise added to. v_sh may be [0, K, 3]: not wanted.
template <class F>
void project_gaussians_backward(Rows<const F, 3> means, Rows<const F, 4> quats, Rows<const F, 3> scales,
                                Array1<const F> opacities, Pixels<const F, 3> sh, i64 degree, Array1<const F> camera,
                                bool antialiased, Array1<const i32> entries, Rows<const F, COLUMNS> projected,
                                Array1<const i64> pair_offsets, Rows<const F, COLUMNS> sums, bool overwrite,
                                Rows<F, 3> v_means, Rows<F, 4> v_quats, Rows<F, 3> v_scales, Array1<F> v_opacities,
                                Pixels<F, 3> v_sh, i64 thread, i64 threads) {
    const F zero = F(0), one = F(1), half = F(0.5), two = F(2), eps = F(EPS2D);
    F cam[CAMERA_SIZE];
    checked(CAMERA_SIZE - 1, camera.shape[0]);
    __builtin_memcpy(cam, camera.data, sizeof cam);
    const i64 count = means.shape[0], coefficients = (degree + 1) * (degree + 1);
    const i64 blocks = (count + GAUSSIANS_PER_BLOCK - 1) / GAUSSIANS_PER_BLOCK;
    const bool with_sh = v_sh.shape[0] > 0;
    F basis[25], mixed[25];
    for (i64 block = thread; block < blocks; block += threads)
        for (i64 n = block * GAUSSIANS_PER_BLOCK; n < min_of(count, (block + 1) * GAUSSIANS_PER_BLOCK); ++n) {
            const i32 soon = entries(min_of(n + PREFETCH_GAUSSIANS, count - 1));
            if (soon >= 0) {
                prefetch_row(projected, soon);
                prefetch_row(sums, pair_offsets(soon));
                prefetch_row(sums, pair_offsets(soon + 1) - 1);
            }
            F *v_mean = v_means.row(n), *v_quat = v_quats.row(n), *v_scale = v_scales.row(n);
            const i32 i = entries(n);
            if (overwrite) {
                v_opacities(n) = zero;
                for (int c = 0; c < 3; ++c) v_mean[c] = zero, v_scale[c] = zero;
                for (int c = 0; c < 4; ++c) v_quat[c] = zero;
                if (i < 0 && with_sh) __builtin_memset(v_sh.row(n, 0), 0, 3 * coefficients * sizeof(F));
            }
            if (i < 0) continue;
            F g[GRADIENT_FIELDS] = {};
            for (i64 pair = pair_offsets(i); pair < pair_offsets(i + 1); ++pair) {
                const F* s = sums.row(pair);
                for (int c = 0; c < GRADIENT_FIELDS; ++c) g[c] += s[c];
            }
            const F* drawn = projected.row(i);
            const F ca = drawn[CONIC_A], cb = drawn[CONIC_B], cc = drawn[CONIC_C], opacity = drawn[OPACITY];
            v_opacities(n) += g[0] * (antialiased ? opacity / opacities(n) : one);
            const F vmx = -opacity * (ca * g[1] + cb * g[2]), vmy = -opacity * (cb * g[1] + cc * g[2]);

            // sigma = d^T X d / 2 with X = cov^-1, so dL/dcov = -X (dL/dX) X
            const F va = -half * opacity * g[3], vb = -half * opacity * g[4], vc = -half * opacity * g[5];
            const F m00 = ca * va + cb * vb, m01 = ca * vb + cb * vc, m10 = cb * va + cc * vb, m11 = cb * vb + cc * vc;
            F w00 = -(m00 * ca + m01 * cb), w01 = -(m00 * cb + m01 * cc), w11 = -(m10 * cb + m11 * cc);

            const F *mean = means.row(n), *scale = scales.row(n);
            const auto [x, y, z] = to_camera(cam, mean[0], mean[1], mean[2]);
            const F rz = one / z, u = x * rz, v = y * rz;
            const Jacobian<F> j = jacobian(cam, u, v, rz);
            F p[6], q[9], unit[4], ab[6];
            to_world(cam, j, p);
            const F shrink = unit_quat(quats.row(n), unit);
            rotation(unit, q);
            project_axes(p, q, ab);
            const F a0 = ab[0], a1 = ab[1], a2 = ab[2], b0 = ab[3], b1 = ab[4], b2 = ab[5];
            const F s0 = scale[0], s1 = scale[1], s2 = scale[2];
            if (antialiased) {
                // opacity = o sqrt(det sharp / det blurred), and d ln det = tr(inverse dcov)
                const F cxx = a0 * a0 * s0 * s0 + a1 * a1 * s1 * s1 + a2 * a2 * s2 * s2;
                const F cxy = a0 * b0 * s0 * s0 + a1 * b1 * s1 * s1 + a2 * b2 * s2 * s2;
                const F cyy = b0 * b0 * s0 * s0 + b1 * b1 * s1 * s1 + b2 * b2 * s2 * s2;
                const F m0 = (a1 * b2 - a2 * b1) * s1 * s2, m1 = (a2 * b0 - a0 * b2) * s2 * s0;
                const F m2 = (a0 * b1 - a1 * b0) * s0 * s1;
                const F sharp = m0 * m0 + m1 * m1 + m2 * m2, det = sharp + eps * (cxx + cyy) + eps * eps;
                const F share = half * opacity * g[0];
                w00 += share * (cyy / sharp - (cyy + eps) / det);
                w01 -= share * (cxy / sharp - cxy / det);
                w11 += share * (cxx / sharp - (cxx + eps) / det);
            }
            // cov = V V^T with V = [a; b] S, so dL/dV = 2 W V; e = dL/dV S^-1, f = dL/d[a; b]
            const F e00 = two * s0 * (w00 * a0 + w01 * b0), e10 = two * s0 * (w01 * a0 + w11 * b0);
            const F e01 = two * s1 * (w00 * a1 + w01 * b1), e11 = two * s1 * (w01 * a1 + w11 * b1);
            const F e02 = two * s2 * (w00 * a2 + w01 * b2), e12 = two * s2 * (w01 * a2 + w11 * b2);
            v_scale[0] += e00 * a0 + e10 * b0;
            v_scale[1] += e01 * a1 + e11 * b1;
            v_scale[2] += e02 * a2 + e12 * b2;
            const F f00 = e00 * s0, f10 = e10 * s0, f01 = e01 * s1, f11 = e11 * s1, f02 = e02 * s2, f12 = e12 * s2;
            const F h[9] = {
                p[0] * f00 + p[3] * f10, p[0] * f01 + p[3] * f11, p[0] * f02 + p[3] * f12,
                p[1] * f00 + p[4] * f10, p[1] * f01 + p[4] * f11, p[1] * f02 + p[4] * f12,
                p[2] * f00 + p[5] * f10, p[2] * f01 + p[5] * f11, p[2] * f02 + p[5] * f12,
            };
            F turn[4];
            quat_backward(unit[0], unit[1], unit[2], unit[3], h, turn);
            for (int c = 0; c < 4; ++c) v_quat[c] += shrink * turn[c];

            // dL/dP = f R^T, dL/dJ = dL/dP W^T
            const F d00 = f00 * q[0] + f01 * q[1] + f02 * q[2], d01 = f00 * q[3] + f01 * q[4] + f02 * q[5];
            const F d02 = f00 * q[6] + f01 * q[7] + f02 * q[8], d10 = f10 * q[0] + f11 * q[1] + f12 * q[2];
            const F d11 = f10 * q[3] + f11 * q[4] + f12 * q[5], d12 = f10 * q[6] + f11 * q[7] + f12 * q[8];
            const F vj00 = d00 * cam[0] + d01 * cam[1] + d02 * cam[2], vj02 = d00 * cam[6] + d01 * cam[7] + d02 * cam[8];
            const F vj11 = d10 * cam[3] + d11 * cam[4] + d12 * cam[5], vj12 = d10 * cam[6] + d11 * cam[7] + d12 * cam[8];
            // j00 = fx / z, j02 = -j00 clamp(u): the clamp has no slope outside its limits
            F gx = j.j00 * vmx, gy = j.j11 * vmy;
            F gz = g[9] - j.j00 * u * vmx - j.j11 * v * vmy - rz * (j.j00 * vj00 + j.j11 * vj11);
            gz += rz * (j.j00 * j.uc * vj02 + j.j11 * j.vc * vj12);
            if (j.uc == u) {
                gx -= j.j00 * rz * vj02;
                gz += j.j00 * rz * u * vj02;
            }
            if (j.vc == v) {
                gy -= j.j11 * rz * vj12;
                gz += j.j11 * rz * v * vj12;
            }
            const F gm0 = cam[0] * gx + cam[3] * gy + cam[6] * gz, gm1 = cam[1] * gx + cam[4] * gy + cam[7] * gz;
            const F gm2 = cam[2] * gx + cam[5] * gy + cam[8] * gz;

            // Colour: the SH themselves, and the direction that they are seen from.
            const F red = drawn[UNCLAMPED_RED] > zero ? g[6] : zero;
            const F green = drawn[UNCLAMPED_GREEN] > zero ? g[7] : zero;
            const F blue = drawn[UNCLAMPED_BLUE] > zero ? g[8] : zero;
            F dx = mean[0] - cam[EYE_X], dy = mean[1] - cam[EYE_Y], dz = mean[2] - cam[EYE_Z];
            const F rn = one / sqrt_of(dx * dx + dy * dy + dz * dz);
            dx *= rn, dy *= rn, dz *= rn;
            sh_basis(dx, dy, dz, degree, basis);
            checked(coefficients - 1, sh.shape[1]);
            const F* from = sh.row(n, 0);
            if (with_sh) {
                F* to = v_sh.row(n, 0);
                for (i64 k = 0; k < coefficients; ++k) {
                    to[3 * k] = (overwrite ? zero : to[3 * k]) + basis[k] * red;
                    to[3 * k + 1] = (overwrite ? zero : to[3 * k + 1]) + basis[k] * green;
                    to[3 * k + 2] = (overwrite ? zero : to[3 * k + 2]) + basis[k] * blue;
                }
            }
            for (i64 k = 0; k < coefficients; ++k)
                mixed[k] = red * from[3 * k] + green * from[3 * k + 1] + blue * from[3 * k + 2];
            const auto [ex, ey, ez] = sh_gradient(dx, dy, dz, degree, mixed);
            const F along = ex * dx + ey * dy + ez * dz;
            v_mean[0] += gm0 + rn * (ex - along * dx);
            v_mean[1] += gm1 + rn * (ey - along * dy);
            v_mean[2] += gm2 + rn * (ez - along * dz);
        }
}

} }  // namespace sp
