// Gaussians -> `projected` of one view: projected, shaded, and counted per tile.
#pragma once
#include "geometry.h"

namespace sp { namespace {

constexpr i64 GAUSSIANS_PER_BLOCK = 1024, MAX_LOOSE_TILES = 16;

// selected [N]: false for Gaussians that project_gaussians would drop by its first, cheap tests. With margins: dropped
// is only what fails for certain: NaN is left to the tests that know it.
template <class F>
void select_near_window(Rows<const F, 3> means, Rows<const F, 3> scales, Array1<const F> opacities,
                        Array1<const F> camera,
                        Array1<bool> selected, i64 thread, i64 threads) {
    const F near = F(0.999 * NEAR_PLANE), faint = F(0.999 * MIN_ALPHA), eps = F(EPS2D);
    F cam[CAMERA_SIZE];
    __builtin_memcpy(cam, camera.data, sizeof cam);
    const i64 count = means.shape[0];
    const i64 blocks = (count + GAUSSIANS_PER_BLOCK - 1) / GAUSSIANS_PER_BLOCK;
    for (i64 block = thread; block < blocks; block += threads)
        for (i64 n = block * GAUSSIANS_PER_BLOCK; n < min_of(count, (block + 1) * GAUSSIANS_PER_BLOCK); ++n) {
            const F* mean = means.row(n);
            const F* scale = scales.row(n);
            auto [x, y, z] = to_camera(cam, mean[0], mean[1], mean[2]);
            F rz = F(1) / z, u = x * rz, v = y * rz;
            F mx = cam[FX] * u + cam[CX], my = cam[FY] * v + cam[CY];
            Jacobian<F> j = jacobian(cam, u, v, rz);
            F s = max_of(scale[0], max_of(scale[1], scale[2]));
            F gain = j.j00 * j.j00 + j.j02 * j.j02 + j.j11 * j.j11 + j.j12 * j.j12;
            F reach = sqrt_of(F(11.2) * (s * s * gain + eps)) + F(1);
            bool away = (mx + reach < cam[X_MIN]) | (mx - reach > cam[X_MAX]);
            away |= (my + reach < cam[Y_MIN]) | (my - reach > cam[Y_MAX]);
            selected(n) = !(away | (z < near) | (opacities(n) < faint));
        }
}

// Gaussians side by side, as vectors read them: mean (3), quaternion (4), scales (3), opacity.
constexpr int GATHERED = 11;

// What projection finds out about LANES Gaussians at once.
template <class F>
struct Projected {
    alignas(64) F mx[LANES], my[LANES], z[LANES], ca[LANES], cb[LANES], cc[LANES], opacity[LANES], radius[LANES],
        ex[LANES], ey[LANES], basis[25][LANES];
};

// The SH basis in the directions in which the camera sees lanes l .. l + W.
template <class F>
SP_INLINE void store_basis(const F* cam, Wide<F> px, Wide<F> py, Wide<F> pz, i64 degree, int l, F (*out)[LANES]) {
    using V = Wide<F>;
    const V dx = px - cam[EYE_X], dy = py - cam[EYE_Y], dz = pz - cam[EYE_Z];
    const V rn = F(1) / sqrt_of(dx * dx + dy * dy + dz * dz);
    V basis[25];
    sh_basis(dx * rn, dy * rn, dz * rn, degree, basis);
    for (i64 k = 0; k < (degree + 1) * (degree + 1); ++k) store(&out[k][l], basis[k]);
}

// Projects LANES Gaussians; returns those that may be drawn, a bit each. Every test is written so that NaN fails it.
// Ranges are those of Splats.drawable, and are tested where they cost least: what is not drawn anyway needs none.
template <class F>
SP_INLINE u32 project_lanes(const F (*in)[LANES], const F* cam, bool antialiased, i64 degree, Projected<F>& out) {
    using V = Wide<F>;
    const F far = F(MAX_DISTANCE_PX), largest = F(MAX_MAGNITUDE), eps = F(EPS2D), min_alpha = F(MIN_ALPHA);
    u32 drawn = 0;
    SP_LANES(F, l) {
        const V px = load(&in[0][l]), py = load(&in[1][l]), pz = load(&in[2][l]);
        const auto [x, y, z] = to_camera(cam, px, py, pz);
        const V s0 = load(&in[7][l]), s1 = load(&in[8][l]), s2 = load(&in[9][l]), zero = {};
        V opacity = load(&in[10][l]);
        auto visible = (z >= F(NEAR_PLANE)) & (z < F(INFINITE)) & (opacity >= min_alpha) & (opacity <= F(1)) &
                       (s0 > zero) & (s1 > zero) & (s2 > zero);
        const V rz = F(1) / z, u = x * rz, v = y * rz;
        const V mx = cam[FX] * u + cam[CX], my = cam[FY] * v + cam[CY];
        const Jacobian<V> j = jacobian(cam, u, v, rz);
        // Cheap test before the exact one: cov2d is at most |J|^2 max(s)^2, the radius at most sqrt(2 ln 255) sigma.
        const V s = larger_of(s0, larger_of(s1, s2));
        const V gain = j.j00 * j.j00 + j.j02 * j.j02 + j.j11 * j.j11 + j.j12 * j.j12;
        const V reach = sqrt_of(F(11.1) * (s * s * gain + eps));
        visible &= meets_window(cam, mx, my, reach, reach);
        visible &= (magnitude_of(mx) <= far) & (magnitude_of(my) <= far) & (s <= largest);
        u32 here = bits_where(visible);
        if (!here) continue;
        V quat[4], p[6], unit[4], q[9], ab[6];
        for (int k = 0; k < 4; ++k) quat[k] = load(&in[3 + k][l]);
        to_world(cam, j, p);
        unit_quat(quat, unit);
        rotation(unit, q);
        project_axes(p, q, ab);
        const V a0 = ab[0] * s0, a1 = ab[1] * s1, a2 = ab[2] * s2, b0 = ab[3] * s0, b1 = ab[4] * s1, b2 = ab[5] * s2;
        V cxx = a0 * a0 + a1 * a1 + a2 * a2, cyy = b0 * b0 + b1 * b1 + b2 * b2;
        const V cxy = a0 * b0 + a1 * b1 + a2 * b2;
        // det of the 2D covariance as a sum of squared minors (Cauchy-Binet) and of the blurred one from it: cxx cyy -
        // cxy^2 cancels to nothing for the long thin Gaussians of real captures.
        const V m0 = a1 * b2 - a2 * b1, m1 = a2 * b0 - a0 * b2, m2 = a0 * b1 - a1 * b0;
        const V sharp = m0 * m0 + m1 * m1 + m2 * m2, det = sharp + eps * (cxx + cyy) + eps * eps;
        visible &= det < F(INFINITE);
        if (antialiased) {
            opacity *= sqrt_of(sharp / det);
            visible &= opacity >= min_alpha;
        }
        cxx += eps;
        cyy += eps;
        // A little larger than where alpha falls to MIN_ALPHA.
        const V radius = F(2) * log_of_positive(opacity / min_alpha) + F(RADIUS_MARGIN);
        const V ex = sqrt_of(radius * cxx), ey = sqrt_of(radius * cyy);
        visible &= meets_window(cam, mx, my, ex, ey);
        visible &= in_range(px, py, pz, quat);
        here = bits_where(visible);
        if (!here) continue;
        drawn |= here << l;
        store(&out.mx[l], mx), store(&out.my[l], my), store(&out.z[l], z), store(&out.opacity[l], opacity);
        store(&out.ca[l], cyy / det), store(&out.cb[l], -cxy / det), store(&out.cc[l], cxx / det);
        store(&out.radius[l], radius), store(&out.ex[l], ex), store(&out.ey[l], ey);
        store_basis(cam, px, py, pz, degree, l, out.basis);
    }
    return drawn;
}

// Sum of basis[k] c[3 k .. 3 k + 2] over k, and of the magnitudes of all c: in fours, so that no addition waits for the
// one before.
template <class F> struct Shade { F red, green, blue, magnitude; };
template <class F>
SP_INLINE Shade<F> shade(const F* c, i64 coefficients, const F (*basis)[LANES], int lane) {
    typedef F Four __attribute__((vector_size(4 * sizeof(F))));
    Four color[2] = {}, size[2] = {};
    // Four numbers from each coefficient on: the last of these is the next one's.
    for (i64 k = 0; k + 1 < coefficients; ++k) {
        Four v;
        __builtin_memcpy(&v, c + 3 * k, sizeof v);
        color[k & 1] += basis[k][lane] * v;
    }
    const i64 last = coefficients - 1, channels = 3 * coefficients;
    color[last & 1] += basis[last][lane] * Four{c[3 * last], c[3 * last + 1], c[3 * last + 2], F(0)};
    for (i64 k = 0; k + 4 <= channels; k += 4) {
        Four v;
        __builtin_memcpy(&v, c + k, sizeof v);
        size[(k >> 2) & 1] += v < F(0) ? -v : v;
    }
    F magnitude = F(0);
    for (i64 k = channels & ~i64(3); k < channels; ++k) magnitude += abs_of(c[k]);
    const Four total = color[0] + color[1], sizes = size[0] + size[1];
    return {total[0], total[1], total[2], magnitude + ((sizes[0] + sizes[1]) + (sizes[2] + sizes[3]))};
}

template <class F>
SP_INLINE void put_color(const Shade<F>& color, F* out) {
    const F red = F(0.5) + color.red, green = F(0.5) + color.green, blue = F(0.5) + color.blue;
    out[RED] = max_of(red, F(0)), out[GREEN] = max_of(green, F(0)), out[BLUE] = max_of(blue, F(0));
    out[UNCLAMPED_RED] = red, out[UNCLAMPED_GREEN] = green, out[UNCLAMPED_BLUE] = blue;
}

// flat_sh: [N, 3 K]. selected [N], or [0]: all. grid [4]: tile columns and rows in use, x0, x1, y0, y1. tile_slots
// [TH, TW]: index among the tiles in use or -1, or [0, 0]: all are in use. Out, of which each block of
// GAUSSIANS_PER_BLOCK writes the first counts[block]: projected, keys (z), gaussian_ids, tile_counts (tiles touched,
// at most).
template <class F>
void project_gaussians(Rows<const F, 3> means, Rows<const F, 4> quats, Rows<const F, 3> scales,
                       Array1<const F> opacities, Array2<const F> flat_sh, i64 degree, Array1<const bool> selected,
                       Array1<const F> camera, bool antialiased, Array1<const i64> grid, Array2<const i32> tile_slots,
                       Rows<F, COLUMNS> projected, Array1<F> keys, Array1<i32> gaussian_ids, Array1<i32> tile_counts,
                       Array1<i32> counts, i64 thread, i64 threads) {
    const F zero = F(0), largest = F(MAX_MAGNITUDE);
    F cam[CAMERA_SIZE];
    checked(CAMERA_SIZE - 1, camera.shape[0]);
    __builtin_memcpy(cam, camera.data, sizeof cam);
    const i64 coefficients = (degree + 1) * (degree + 1), total = means.shape[0];
    checked(3 * coefficients - 1, flat_sh.shape[1]);
    const i64 gx0 = grid(0), gx1 = grid(1), gy0 = grid(2), gy1 = grid(3);
    const bool some_tiles = tile_slots.shape[0] > 0, all = selected.shape[0] == 0;
    alignas(64) F in[GATHERED][LANES];
    Projected<F> g;
    for (i64 block = thread; block < counts.shape[0]; block += threads) {
        i64 at = block * GAUSSIANS_PER_BLOCK;
        const i64 end = min_of(total, (block + 1) * GAUSSIANS_PER_BLOCK);
        i64 next = at, ids[LANES];
        while (next < end) {
            // The next LANES that are selected; what is left of the last vector has opacity 0 and is not drawn.
            int count = 0;
            for (; next < end && count < LANES; ++next) {
                if (!all && !selected(next)) continue;
                const F *mean = means.row(next), *quat = quats.row(next), *scale = scales.row(next);
                for (int k = 0; k < 3; ++k) in[k][count] = mean[k], in[7 + k][count] = scale[k];
                for (int k = 0; k < 4; ++k) in[3 + k][count] = quat[k];
                in[10][count] = opacities(next);
                ids[count++] = next;
            }
            for (int k = 0; k < GATHERED; ++k)
                for (int l = count; l < LANES; ++l) in[k][l] = zero;
            for (u32 drawn = project_lanes(in, cam, antialiased, degree, g); drawn; drawn &= drawn - 1) {
                const int l = __builtin_ctz(drawn);
                const F mx = g.mx[l], my = g.my[l], ex = g.ex[l], ey = g.ey[l], ca = g.ca[l], cb = g.cb[l];
                const Span rows = tile_span(my, ey, gy0, gy1), columns = tile_span(mx, ex, gx0, gx1);
                i64 touched = (columns.end - columns.begin) * (rows.end - rows.begin);
                if (some_tiles || touched > MAX_LOOSE_TILES) {
                    touched = 0;
                    for (i64 ty = rows.begin; ty < rows.end; ++ty) {
                        const Span span = tile_columns(mx, my, ca, cb, g.radius[l], ex, ey, F(ty) * F(TILE),
                                                       columns.begin, columns.end);
                        if (!some_tiles) touched += max_of(span.end - span.begin, i64(0));
                        else for (i64 tx = span.begin; tx < span.end; ++tx) touched += tile_slots(ty, tx) >= 0;
                    }
                }
                if (touched <= 0) continue;
                const Shade<F> color = shade(flat_sh.row(ids[l]), coefficients, g.basis, l);
                if (!(color.magnitude <= largest)) continue;
                F* out = projected.row(at);
                put_color(color, out);
                out[MEAN_X] = mx, out[MEAN_Y] = my;
                out[CONIC_A] = ca, out[CONIC_B] = cb, out[CONIC_C] = g.cc[l];
                out[OPACITY] = g.opacity[l];
                out[DEPTH] = g.z[l], out[EXTENT_Y] = ey, out[EXTENT_X] = ex, out[SQUARED_RADIUS] = g.radius[l];
                keys(at) = g.z[l];
                gaussian_ids(at) = (i32)ids[l];
                tile_counts(at) = (i32)touched;
                ++at;
            }
        }
        counts(block) = (i32)(at - block * GAUSSIANS_PER_BLOCK);
    }
}

// Colours of the entries of a view that is there (ids [M]), from other SH: into its `projected` [M, 16].
// beyond [share]: set where an entry's are out of range, so that it would not be drawn.
template <class F>
void shade_entries(Rows<const F, 3> means, Array2<const F> flat_sh, i64 degree, Array1<const F> camera,
                   Array1<const i64> ids, Rows<F, COLUMNS> projected, Array1<bool> beyond, i64 thread, i64 threads) {
    const i64 coefficients = (degree + 1) * (degree + 1), m = ids.shape[0], shares = beyond.shape[0];
    checked(CAMERA_SIZE - 1, camera.shape[0]), checked(3 * coefficients - 1, flat_sh.shape[1]);
    alignas(64) F at[3][LANES], basis[25][LANES];
    for (i64 share = thread; share < shares; share += threads)
        for (i64 i = m * share / shares, end = m * (share + 1) / shares; i < end; i += LANES) {
            const int count = (int)min_of<i64>(LANES, end - i);
            for (int l = 0; l < LANES; ++l)
                for (int k = 0; k < 3; ++k) at[k][l] = means.row(ids(i + (l < count ? l : 0)))[k];
            SP_LANES(F, l) {
                store_basis(camera.data, load(&at[0][l]), load(&at[1][l]), load(&at[2][l]), degree, l, basis);
            }
            for (int l = 0; l < count; ++l) {
                const Shade<F> color = shade(flat_sh.row(ids(i + l)), coefficients, basis, l);
                if (!(color.magnitude <= F(MAX_MAGNITUDE))) beyond(share) = true;
                put_color(color, projected.row(i + l));
            }
        }
}

} }  // namespace sp
