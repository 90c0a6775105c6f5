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
    const auto two = 2;
    v[0] = two * (x * (h[7] - h[5]) + y * (h[2] - h[6]) + z * (h[3] - h[1]));
    v[1] = two * (w * (h[7] - h[5]) + y * (h[1] + h[3]) + z * (h[2] + h[6]) - two * x * (h[4] + h[8]));
    v[2] = two * (w * (h[2] - h[6]) + x * (h[1] + h[3]) + z * (h[5] + h[7]) - two * y * (h[0] + h[8]));
    v[3] = two * (w * (h[3] - h[1]) + x * (h[2] + h[6]) + y * (h[5] + h[7]) - two * z * (h[0] + h[4]));
    const F along = v[0] * w + v[1] * x + v[2] * y + v[3] * z;
    v[0] -= along * w, v[1] -= along * x, v[2] -= along * y, v[3] -= along * z;
}

// Gradient of sum_k v[k] Y_k with respect to (x, y, z), before projection onto the unit sphere.
template <class V>
SP_INLINE Vec3<V> sh_gradient(V x, V y, V z, i64 degree, const V* v) {
    using F = typename ScalarOf<V>::type;
    V gx = {}, gy = {}, gz = {};
    if (degree < 1) return {gx, gy, gz};
    const F k1 = F(0.48860251190292);
    gy -= k1 * v[1];
    gz += k1 * v[2];
    gx -= k1 * v[3];
    if (degree < 2) return {gx, gy, gz};
    const V c1 = x * x - y * y, s1 = F(2) * x * y;
    const F k2 = F(2 * 0.5462742152960395), k3 = F(1.092548430592079);
    gx += k2 * (y * v[4] + x * v[8]) - k3 * z * v[7];
    gy += k2 * (x * v[4] - y * v[8]) - k3 * z * v[5];
    gz += F(2 * 0.9461746957575601) * z * v[6] - k3 * (y * v[5] + x * v[7]);
    if (degree < 3) return {gx, gy, gz};
    const V zz = z * z;
    const F k4 = F(3 * 0.5900435899266435), k5 = F(1.445305721320277);
    const V linear = F(-2.285228997322329) * zz + F(0.4570457994644658);
    const V c2 = x * c1 - y * s1, s2 = x * s1 + y * c1, d12 = F(3 * 1.865881662950577) * zz - F(1.119528997770346);
    gx += F(2) * k5 * z * (y * v[10] + x * v[14]) - k4 * (s1 * v[9] + c1 * v[15]) + linear * v[13];
    gy += F(2) * k5 * z * (x * v[10] - y * v[14]) - k4 * (c1 * v[9] - s1 * v[15]) + linear * v[11];
    gz += k5 * (s1 * v[10] + c1 * v[14]) - F(2 * 2.285228997322329) * z * (y * v[11] + x * v[13]) + d12 * v[12];
    if (degree < 4) return {gx, gy, gz};
    const F k6 = F(4 * 0.6258357354491763), k7 = F(1.770130769779931);
    const V cubic = z * (F(-4.683325804901025) * zz + F(2.007139630671868));
    const V dcubic = F(-3 * 4.683325804901025) * zz + F(2.007139630671868);
    const V square = F(3.31161143515146) * zz - F(0.47308734787878);
    const V b12 = z * (F(1.865881662950577) * zz - F(1.119528997770346));
    const V d20 = F(1.984313483298443) * (b12 + z * d12) - F(2 * 1.006230589874905 * 0.9461746957575601) * z;
    gx += k6 * (s2 * v[16] + c2 * v[24]) - F(3) * k7 * z * (s1 * v[17] + c1 * v[23]);
    gx += F(2) * square * (y * v[18] + x * v[22]) + cubic * v[21];
    gy += k6 * (c2 * v[16] - s2 * v[24]) - F(3) * k7 * z * (c1 * v[17] - s1 * v[23]);
    gy += F(2) * square * (x * v[18] - y * v[22]) + cubic * v[19];
    gz += F(2 * 3.31161143515146) * z * (s1 * v[18] + c1 * v[22]) - k7 * (s2 * v[17] + c2 * v[23]);
    gz += dcubic * (y * v[19] + x * v[21]) + d20 * v[20];
    return {gx, gy, gz};
}

// What LANES Gaussians' gradients are made of, and these: means (3), quaternions (4), scales (3), opacity.
template <class F>
struct GradientLanes {
    alignas(64) F in[GATHERED][LANES], drawn[7][LANES], sums[GRADIENT_FIELDS][LANES], out[GATHERED][LANES];
    alignas(64) F direction[4][LANES], basis[25][LANES], mixed[25][LANES];
};
// Rows of `drawn`: conic, opacity, and the colours before they are clamped.
enum { DRAWN_A, DRAWN_B, DRAWN_C, DRAWN_OPACITY, DRAWN_COLOR };

// All but what comes by way of the colours: `out`, the directions and 1 / distance, the basis.
template <class F>
SP_INLINE void geometry_backward(GradientLanes<F>& w, const F* cam, bool antialiased, i64 degree) {
    using V = Wide<F>;
    const F eps = F(EPS2D), half = F(0.5), two = F(2), one = F(1);
    SP_LANES(F, l) {
        V g[GRADIENT_FIELDS], quat[4];
        for (int c = 0; c < GRADIENT_FIELDS; ++c) g[c] = load(&w.sums[c][l]);
        for (int c = 0; c < 4; ++c) quat[c] = load(&w.in[3 + c][l]);
        const V px = load(&w.in[0][l]), py = load(&w.in[1][l]), pz = load(&w.in[2][l]);
        const V s0 = load(&w.in[7][l]), s1 = load(&w.in[8][l]), s2 = load(&w.in[9][l]);
        const V ca = load(&w.drawn[DRAWN_A][l]), cb = load(&w.drawn[DRAWN_B][l]), cc = load(&w.drawn[DRAWN_C][l]);
        const V opacity = load(&w.drawn[DRAWN_OPACITY][l]);
        store(&w.out[10][l], antialiased ? g[0] * (opacity / load(&w.in[10][l])) : g[0]);
        const V vmx = -opacity * (ca * g[1] + cb * g[2]), vmy = -opacity * (cb * g[1] + cc * g[2]);

        // sigma = d^T X d / 2 with X = cov^-1, so dL/dcov = -X (dL/dX) X
        const V va = -half * opacity * g[3], vb = -half * opacity * g[4], vc = -half * opacity * g[5];
        const V m00 = ca * va + cb * vb, m01 = ca * vb + cb * vc, m10 = cb * va + cc * vb, m11 = cb * vb + cc * vc;
        V w00 = -(m00 * ca + m01 * cb), w01 = -(m00 * cb + m01 * cc), w11 = -(m10 * cb + m11 * cc);

        const auto [x, y, z] = to_camera(cam, px, py, pz);
        const V rz = one / z, u = x * rz, v = y * rz;
        const Jacobian<V> j = jacobian(cam, u, v, rz);
        V p[6], q[9], unit[4], ab[6];
        to_world(cam, j, p);
        const V shrink = unit_quat(quat, unit);
        rotation(unit, q);
        project_axes(p, q, ab);
        const V a0 = ab[0], a1 = ab[1], a2 = ab[2], b0 = ab[3], b1 = ab[4], b2 = ab[5];
        if (antialiased) {
            // opacity = o sqrt(det sharp / det blurred), and d ln det = tr(inverse dcov)
            const V cxx = a0 * a0 * s0 * s0 + a1 * a1 * s1 * s1 + a2 * a2 * s2 * s2;
            const V cxy = a0 * b0 * s0 * s0 + a1 * b1 * s1 * s1 + a2 * b2 * s2 * s2;
            const V cyy = b0 * b0 * s0 * s0 + b1 * b1 * s1 * s1 + b2 * b2 * s2 * s2;
            const V m0 = (a1 * b2 - a2 * b1) * s1 * s2, m1 = (a2 * b0 - a0 * b2) * s2 * s0;
            const V m2 = (a0 * b1 - a1 * b0) * s0 * s1;
            const V sharp = m0 * m0 + m1 * m1 + m2 * m2, det = sharp + eps * (cxx + cyy) + eps * eps;
            const V share = half * opacity * g[0];
            w00 += share * (cyy / sharp - (cyy + eps) / det);
            w01 -= share * (cxy / sharp - cxy / det);
            w11 += share * (cxx / sharp - (cxx + eps) / det);
        }
        // cov = V V^T with V = [a; b] S, so dL/dV = 2 W V; e = dL/dV S^-1, f = dL/d[a; b]
        const V e00 = two * s0 * (w00 * a0 + w01 * b0), e10 = two * s0 * (w01 * a0 + w11 * b0);
        const V e01 = two * s1 * (w00 * a1 + w01 * b1), e11 = two * s1 * (w01 * a1 + w11 * b1);
        const V e02 = two * s2 * (w00 * a2 + w01 * b2), e12 = two * s2 * (w01 * a2 + w11 * b2);
        store(&w.out[7][l], e00 * a0 + e10 * b0);
        store(&w.out[8][l], e01 * a1 + e11 * b1);
        store(&w.out[9][l], e02 * a2 + e12 * b2);
        const V f00 = e00 * s0, f10 = e10 * s0, f01 = e01 * s1, f11 = e11 * s1, f02 = e02 * s2, f12 = e12 * s2;
        const V h[9] = {
            p[0] * f00 + p[3] * f10, p[0] * f01 + p[3] * f11, p[0] * f02 + p[3] * f12,
            p[1] * f00 + p[4] * f10, p[1] * f01 + p[4] * f11, p[1] * f02 + p[4] * f12,
            p[2] * f00 + p[5] * f10, p[2] * f01 + p[5] * f11, p[2] * f02 + p[5] * f12,
        };
        V turn[4];
        quat_backward(unit[0], unit[1], unit[2], unit[3], h, turn);
        for (int c = 0; c < 4; ++c) store(&w.out[3 + c][l], shrink * turn[c]);

        // dL/dP = f R^T, dL/dJ = dL/dP W^T
        const V d00 = f00 * q[0] + f01 * q[1] + f02 * q[2], d01 = f00 * q[3] + f01 * q[4] + f02 * q[5];
        const V d02 = f00 * q[6] + f01 * q[7] + f02 * q[8], d10 = f10 * q[0] + f11 * q[1] + f12 * q[2];
        const V d11 = f10 * q[3] + f11 * q[4] + f12 * q[5], d12 = f10 * q[6] + f11 * q[7] + f12 * q[8];
        const V vj00 = d00 * cam[0] + d01 * cam[1] + d02 * cam[2], vj02 = d00 * cam[6] + d01 * cam[7] + d02 * cam[8];
        const V vj11 = d10 * cam[3] + d11 * cam[4] + d12 * cam[5], vj12 = d10 * cam[6] + d11 * cam[7] + d12 * cam[8];
        // j00 = fx / z, j02 = -j00 clamp(u): the clamp has no slope outside its limits
        V gx = j.j00 * vmx, gy = j.j11 * vmy;
        V gz = g[9] - j.j00 * u * vmx - j.j11 * v * vmy - rz * (j.j00 * vj00 + j.j11 * vj11);
        gz += rz * (j.j00 * j.uc * vj02 + j.j11 * j.vc * vj12);
        const V zero = {}, along_u = j.uc == u ? j.j00 * rz * vj02 : zero;
        const V along_v = j.vc == v ? j.j11 * rz * vj12 : zero;
        gx -= along_u, gz += along_u * u;
        gy -= along_v, gz += along_v * v;
        for (int c = 0; c < 3; ++c) store(&w.out[c][l], cam[c] * gx + cam[3 + c] * gy + cam[6 + c] * gz);

        const V dx = px - cam[EYE_X], dy = py - cam[EYE_Y], dz = pz - cam[EYE_Z];
        const V rn = one / sqrt_of(dx * dx + dy * dy + dz * dz), direction[4] = {dx * rn, dy * rn, dz * rn, rn};
        for (int c = 0; c < 4; ++c) store(&w.direction[c][l], direction[c]);
        V basis[25];
        sh_basis(direction[0], direction[1], direction[2], degree, basis);
        for (i64 k = 0; k < (degree + 1) * (degree + 1); ++k) store(&w.basis[k][l], basis[k]);
    }
}

// What the means get by way of the directions that colours are seen from; w.mixed: sums of the colours' gradients by
// SH.
template <class F>
SP_INLINE void direction_backward(GradientLanes<F>& w, i64 degree) {
    using V = Wide<F>;
    SP_LANES(F, l) {
        V mixed[25], d[4];
        for (i64 k = 0; k < (degree + 1) * (degree + 1); ++k) mixed[k] = load(&w.mixed[k][l]);
        for (int c = 0; c < 4; ++c) d[c] = load(&w.direction[c][l]);
        const auto [ex, ey, ez] = sh_gradient(d[0], d[1], d[2], degree, mixed);
        const V along = ex * d[0] + ey * d[1] + ez * d[2];
        store(&w.out[0][l], load(&w.out[0][l]) + d[3] * (ex - along * d[0]));
        store(&w.out[1][l], load(&w.out[1][l]) + d[3] * (ey - along * d[1]));
        store(&w.out[2][l], load(&w.out[2][l]) + d[3] * (ez - along * d[2]));
    }
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
    F cam[CAMERA_SIZE];
    checked(CAMERA_SIZE - 1, camera.shape[0]);
    __builtin_memcpy(cam, camera.data, sizeof cam);
    const i64 count = means.shape[0], coefficients = (degree + 1) * (degree + 1);
    const i64 blocks = (count + GAUSSIANS_PER_BLOCK - 1) / GAUSSIANS_PER_BLOCK;
    const bool with_sh = v_sh.shape[0] > 0;
    checked(coefficients - 1, sh.shape[1]);
    GradientLanes<F> w;
    for (i64 block = thread; block < blocks; block += threads) {
        const i64 end = min_of(count, (block + 1) * GAUSSIANS_PER_BLOCK);
        i64 next = block * GAUSSIANS_PER_BLOCK, ids[LANES];
        while (next < end) {
            // The next LANES that are drawn; what is left of the last vector is its first one again.
            int lanes = 0;
            for (; next < end && lanes < LANES; ++next) {
                // Entries are in another order than Gaussians: where sums lie has to be read before they are asked for.
                const i32 later = entries(min_of(next + 2 * PREFETCH_GAUSSIANS, count - 1));
                const i32 soon = entries(min_of(next + PREFETCH_GAUSSIANS, count - 1)), i = entries(next);
                if (later >= 0) __builtin_prefetch(&pair_offsets(later), 0, 3);
                if (soon >= 0) {
                    prefetch_row(projected, soon);
                    prefetch_row(sums, pair_offsets(soon));
                    prefetch_row(sums, pair_offsets(soon + 1) - 1);
                }
                if (i < 0) {
                    if (!overwrite) continue;
                    v_opacities(next) = F(0);
                    __builtin_memset(v_means.row(next), 0, 3 * sizeof(F));
                    __builtin_memset(v_scales.row(next), 0, 3 * sizeof(F));
                    __builtin_memset(v_quats.row(next), 0, 4 * sizeof(F));
                    if (with_sh) __builtin_memset(v_sh.row(next, 0), 0, 3 * coefficients * sizeof(F));
                    continue;
                }
                F g[GRADIENT_FIELDS] = {};
                for (i64 pair = pair_offsets(i); pair < pair_offsets(i + 1); ++pair) {
                    const F* s = sums.row(pair);
                    for (int c = 0; c < GRADIENT_FIELDS; ++c) g[c] += s[c];
                }
                const F *from = projected.row(i), *mean = means.row(next), *quat = quats.row(next);
                const F* scale = scales.row(next);
                const int columns[7] = {CONIC_A, CONIC_B, CONIC_C, OPACITY, UNCLAMPED_RED, UNCLAMPED_GREEN,
                                        UNCLAMPED_BLUE};
                for (int c = 0; c < 7; ++c) w.drawn[c][lanes] = from[columns[c]];
                for (int c = 0; c < GRADIENT_FIELDS; ++c) w.sums[c][lanes] = g[c];
                for (int c = 0; c < 3; ++c) w.in[c][lanes] = mean[c], w.in[7 + c][lanes] = scale[c];
                for (int c = 0; c < 4; ++c) w.in[3 + c][lanes] = quat[c];
                w.in[10][lanes] = opacities(next);
                ids[lanes++] = next;
            }
            if (lanes == 0) break;
            for (int l = lanes; l < LANES; ++l) {
                for (int c = 0; c < 7; ++c) w.drawn[c][l] = w.drawn[c][0];
                for (int c = 0; c < GRADIENT_FIELDS; ++c) w.sums[c][l] = w.sums[c][0];
                for (int c = 0; c < GATHERED; ++c) w.in[c][l] = w.in[c][0];
            }
            geometry_backward(w, cam, antialiased, degree);
            for (int l = 0; l < lanes; ++l) {
                F color[3];
                for (int c = 0; c < 3; ++c) color[c] = w.drawn[DRAWN_COLOR + c][l] > F(0) ? w.sums[6 + c][l] : F(0);
                const F* from = sh.row(ids[l], 0);
                for (i64 k = 0; k < coefficients; ++k)
                    w.mixed[k][l] = color[0] * from[3 * k] + color[1] * from[3 * k + 1] + color[2] * from[3 * k + 2];
                if (!with_sh) continue;
                F* to = v_sh.row(ids[l], 0);
                for (i64 k = 0; k < coefficients; ++k)
                    for (int c = 0; c < 3; ++c)
                        to[3 * k + c] = (overwrite ? F(0) : to[3 * k + c]) + w.basis[k][l] * color[c];
            }
            for (int l = lanes; l < LANES; ++l)
                for (i64 k = 0; k < coefficients; ++k) w.mixed[k][l] = F(0);
            direction_backward(w, degree);
            for (int l = 0; l < lanes; ++l) {
                F *mean = v_means.row(ids[l]), *quat = v_quats.row(ids[l]), *scale = v_scales.row(ids[l]);
                F& opacity = v_opacities(ids[l]);
                for (int c = 0; c < 3; ++c) mean[c] = (overwrite ? F(0) : mean[c]) + w.out[c][l];
                for (int c = 0; c < 4; ++c) quat[c] = (overwrite ? F(0) : quat[c]) + w.out[3 + c][l];
                for (int c = 0; c < 3; ++c) scale[c] = (overwrite ? F(0) : scale[c]) + w.out[7 + c][l];
                opacity = (overwrite ? F(0) : opacity) + w.out[10][l];
            }
        }
    }
}

} }  // namespace sp
