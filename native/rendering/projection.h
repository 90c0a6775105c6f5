// Gaussians -> `projected` of one view: projected, shaded, and counted per tile.
#pragma once
#include "geometry.h"

namespace sp { namespace {

constexpr i64 GAUSSIANS_PER_BLOCK = 1024, MAX_LOOSE_TILES = 16;

template <class F>
void select_near_window(Rows<const F, 3> means, Rows<const F, 3> scales, Array1<const F> opacities, Array1<const F> camera,
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

template <class F>
void project_gaussians(Rows<const F, 3> means, Rows<const F, 4> quats, Rows<const F, 3> scales, Array1<const F> opacities,
                       Array3<const F> /*sh*/, Array2<const F> flat_sh, i64 degree, Array1<const bool> selected,
                       Array1<const F> camera, bool antialiased, Array1<const i64> grid, Array2<const i32> tile_slots,
                       Rows<F, COLUMNS> projected, Array1<F> keys, Array1<i32> gaussian_ids, Array1<i32> tile_counts,
                       Array1<i32> counts, i64 thread, i64 threads) {
    const F zero = F(0), one = F(1), inf = F(INFINITE), min_alpha = F(MIN_ALPHA), eps = F(EPS2D);
    const F far = F(MAX_DISTANCE_PX), largest = F(MAX_MAGNITUDE);
    F cam[CAMERA_SIZE];
    checked(CAMERA_SIZE - 1, camera.shape[0]);
    __builtin_memcpy(cam, camera.data, sizeof cam);
    const i64 coefficients = (degree + 1) * (degree + 1), channels = flat_sh.shape[1], total = means.shape[0];
    const i64 gx0 = grid(0), gx1 = grid(1), gy0 = grid(2), gy1 = grid(3);
    const bool some_tiles = tile_slots.shape[0] > 0, all = selected.shape[0] == 0;
    F basis[25];
    for (i64 block = thread; block < counts.shape[0]; block += threads) {
        i64 at = block * GAUSSIANS_PER_BLOCK;
        const i64 end = min_of(total, (block + 1) * GAUSSIANS_PER_BLOCK);
        for (i64 n = block * GAUSSIANS_PER_BLOCK; n < end; ++n) {
            if (!all && !selected(n)) continue;
            // Every test is written so that NaN fails it.
            const F* mean = means.row(n);
            const F* scale = scales.row(n);
            auto [x, y, z] = to_camera(cam, mean[0], mean[1], mean[2]);
            F opacity = opacities(n);
            if (!(z >= F(NEAR_PLANE) && z < inf && opacity >= min_alpha && opacity <= one)) continue;
            const F s0 = scale[0], s1 = scale[1], s2 = scale[2];
            if (!(s0 > zero && s1 > zero && s2 > zero)) continue;
            F rz = one / z, u = x * rz, v = y * rz;
            F mx = cam[FX] * u + cam[CX], my = cam[FY] * v + cam[CY];
            const Jacobian<F> j = jacobian(cam, u, v, rz);
            // Cheap test before the exact one: cov2d is at most |J|^2 max(s)^2, the radius at most sqrt(2 ln 255) sigma.
            F s = max_of(s0, max_of(s1, s2));
            F gain = j.j00 * j.j00 + j.j02 * j.j02 + j.j11 * j.j11 + j.j12 * j.j12;
            F reach = sqrt_of(F(11.1) * (s * s * gain + eps));
            if (!meets_window(cam, mx, my, reach, reach)) continue;
            if (!(abs_of(mx) <= far && abs_of(my) <= far && s <= largest)) continue;
            F p[6], unit[4], q[9], ab[6];
            to_world(cam, j, p);
            unit_quat(quats.row(n), unit);
            rotation(unit, q);
            project_axes(p, q, ab);
            const F a0 = ab[0] * s0, a1 = ab[1] * s1, a2 = ab[2] * s2;
            const F b0 = ab[3] * s0, b1 = ab[4] * s1, b2 = ab[5] * s2;
            F cxx = a0 * a0 + a1 * a1 + a2 * a2;
            F cxy = a0 * b0 + a1 * b1 + a2 * b2;
            F cyy = b0 * b0 + b1 * b1 + b2 * b2;
            // The determinant as a sum of squared minors: cxx cyy - cxy^2 cancels for long thin Gaussians.
            F m0 = a1 * b2 - a2 * b1, m1 = a2 * b0 - a0 * b2, m2 = a0 * b1 - a1 * b0;
            F sharp = m0 * m0 + m1 * m1 + m2 * m2;
            F det = sharp + eps * (cxx + cyy) + eps * eps;
            if (!(det < inf)) continue;
            if (antialiased) {
                opacity *= sqrt_of(sharp / det);
                if (!(opacity >= min_alpha)) continue;
            }
            cxx += eps;
            cyy += eps;
            F radius = F(2) * log_of(opacity / min_alpha) + F(RADIUS_MARGIN);
            F ex = sqrt_of(radius * cxx), ey = sqrt_of(radius * cyy);
            if (!meets_window(cam, mx, my, ex, ey)) continue;
            F ca = cyy / det, cb = -cxy / det;
            Span rows = tile_span(my, ey, gy0, gy1), columns = tile_span(mx, ex, gx0, gx1);
            i64 touched = (columns.end - columns.begin) * (rows.end - rows.begin);
            if (some_tiles || touched > MAX_LOOSE_TILES) {
                touched = 0;
                for (i64 ty = rows.begin; ty < rows.end; ++ty) {
                    Span span = tile_columns(mx, my, ca, cb, radius, ex, ey, F(ty) * F(TILE), columns.begin, columns.end);
                    if (!some_tiles) touched += max_of(span.end - span.begin, i64(0));
                    else for (i64 tx = span.begin; tx < span.end; ++tx) touched += tile_slots(ty, tx) >= 0;
                }
            }
            if (touched <= 0) continue;
            F dx = mean[0] - cam[EYE_X], dy = mean[1] - cam[EYE_Y], dz = mean[2] - cam[EYE_Z];
            F rn = one / sqrt_of(dx * dx + dy * dy + dz * dz);
            sh_basis(dx * rn, dy * rn, dz * rn, degree, basis);
            F red = F(0.5), green = F(0.5), blue = F(0.5), magnitudes[8] = {};
            const F* c = &flat_sh(n, 0);
            for (i64 k = 0; k < coefficients; ++k) {
                red += basis[k] * c[3 * k];
                green += basis[k] * c[3 * k + 1];
                blue += basis[k] * c[3 * k + 2];
            }
            // Eight sums at a time, so that no addition waits for the one before.
            for (i64 k = 0; k + 8 <= channels; k += 8)
                for (int l = 0; l < 8; ++l) magnitudes[l] += abs_of(c[k + l]);
            for (i64 k = channels & ~i64(7); k < channels; ++k) magnitudes[k & 7] += abs_of(c[k]);
            F magnitude = zero;
            for (int l = 0; l < 8; ++l) magnitude += magnitudes[l];
            if (!(within_range(mean, quats.row(n)) && magnitude <= largest)) continue;
            F* out = projected.row(at);
            out[MEAN_X] = mx, out[MEAN_Y] = my;
            out[CONIC_A] = ca, out[CONIC_B] = cb, out[CONIC_C] = cxx / det;
            out[OPACITY] = opacity;
            out[RED] = max_of(red, zero), out[GREEN] = max_of(green, zero), out[BLUE] = max_of(blue, zero);
            out[DEPTH] = z, out[EXTENT_Y] = ey, out[EXTENT_X] = ex, out[SQUARED_RADIUS] = radius;
            out[UNCLAMPED_RED] = red, out[UNCLAMPED_GREEN] = green, out[UNCLAMPED_BLUE] = blue;
            keys(at) = z;
            gaussian_ids(at) = (i32)n;
            tile_counts(at) = (i32)touched;
            ++at;
        }
        counts(block) = (i32)(at - block * GAUSSIANS_PER_BLOCK);
    }
}

} }  // namespace sp
