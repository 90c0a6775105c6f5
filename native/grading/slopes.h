// Spherical harmonics after a function of colours: the constant band by the function, the others by its slopes at the
// base colour (grading/color_grading.py).
#pragma once
#include "../lanes.h"

namespace sp { namespace {

namespace slopes {
constexpr float UNCHANGED = 1e-5f;  // entries of a matrix that differ less from one that changes nothing do not count
// Towards the farther end, so that what moves stays inside 0 to 1.
SP_INLINE float step_at(float base, float step) { return base > 0.5f ? -step : step; }
}  // namespace slopes

// ends: the base colours within 0 to 1 (0 for NaN), and these with every channel moved by a step. y00: the constant
// band's basis function.
SP_SMALL void take_base_colors(Pixels<const float, 3> sh, float y00, float step, Pixels<float, 3> ends, i64 thread,
                               i64 threads) {
    checked(1, ends.shape[0]), checked(sh.shape[0] - 1, ends.shape[1]);
    const Share share = share_of(sh.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const float* from = sh.row(i, 0);
        float *base = ends.row(0, i), *moved = ends.row(1, i);
        for (int c = 0; c < 3; ++c) {
            const float value = 0.5f + y00 * from[c];
            base[c] = value > 0.0f ? min_of(value, 1.0f) : 0.0f;
            moved[c] = base[c] + slopes::step_at(base[c], step);
        }
    }
}

// base: as above; graded: [1 or 4, n, 3] the function of it and, for the bands beyond the constant one, of it with red,
// green and blue moved. limit: the largest entry of a matrix. Coefficients that do not change keep their bits.
void grade_bands(Pixels<const float, 3> sh, Rows<const float, 3> base, Pixels<const float, 3> graded, float y00,
                 float step, float limit, Pixels<float, 3> out, i64 thread, i64 threads) {
    const i64 count = sh.shape[0], bands = sh.shape[1];
    checked(count - 1, base.shape[0]), checked(count - 1, graded.shape[1]), checked(count - 1, out.shape[0]);
    checked(bands - 1, out.shape[1]), checked(bands > 1 ? 3 : 0, graded.shape[0]);
    const Share share = share_of(count, thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const float *from = sh.row(i, 0), *old = base.row(i), *now = graded.row(0, i);
        float* to = out.row(i, 0);
        for (int c = 0; c < 3; ++c) {
            const float change = (now[c] - old[c]) / y00;
            to[c] = change != 0 ? from[c] + change : from[c];
        }
        if (bands == 1) continue;
        float matrix[9];  // in, out
        bool differs = false, known = true;
        for (int k = 0; k < 3; ++k) {
            const float* moved = graded.row(1 + k, i);
            const float along = slopes::step_at(old[k], step);
            for (int c = 0; c < 3; ++c) {
                const float slope = (moved[c] - now[c]) / along, held = min_of(max_of(slope, -limit), limit);
                matrix[3 * k + c] = held;
                differs |= abs_of(held - (k == c ? 1.0f : 0.0f)) > slopes::UNCHANGED, known &= held == held;
            }
        }
        if (!differs || !known) {
            __builtin_memcpy(to + 3, from + 3, (bands - 1) * 3 * sizeof(float));
            continue;
        }
        for (i64 j = 3; j < 3 * bands; j += 3)
            for (int c = 0; c < 3; ++c)
                to[j + c] = fused(from[j + 2], matrix[6 + c],
                                  fused(from[j + 1], matrix[3 + c], from[j] * matrix[c] + 0.0f));  // no -0
    }
}

} }  // namespace sp
