// Between the SH bands of all Gaussians and the colours of those that one picture shows (ids [C]), as module
// splatpainter/lift/local/joint_colors.py says. A view shows each Gaussian once: threads never write to the same.
#pragma once
#include "../lanes.h"

namespace sp { namespace {

namespace joint_colors {
constexpr i64 GAUSSIANS_PER_BLOCK = 1024;  // that a thread takes at a time

// Calls with each of a thread's Gaussians.
template <class Each> SP_INLINE void share_out(i64 count, i64 thread, i64 threads, Each each) {
    for (i64 start = thread * GAUSSIANS_PER_BLOCK; start < count; start += threads * GAUSSIANS_PER_BLOCK)
        for (i64 c = start; c < min_of(count, start + GAUSSIANS_PER_BLOCK); ++c) each(c);
}
}  // namespace joint_colors

// out [C, 3]: `before` with bands changed by change [N, B, 3], 0 to the ceiling (or as far above it as before). basis:
// [C, B].
void change_colors(Array1<const i64> ids, Array2<const float> basis, Pixels<const float, 3> change,
                          Rows<const float, 3> before, float ceiling, Rows<float, 3> out, i64 thread, i64 threads) {
    const i64 bands = basis.shape[1];
    joint_colors::share_out(basis.shape[0], thread, threads, [&](i64 c) {
        for (int k = 0; k < 3; ++k) {
            float sum_of_bands = 0;
            for (i64 b = 0; b < bands; ++b) sum_of_bands += basis(c, b) * change(ids(c), b, k);
            const float value = before(c, k) + sum_of_bands;
            out(c, k) = min_of(max_of(value, 0.0f), max_of(before(c, k), ceiling));
        }
    });
}

// gain [N, B, 3] += y r^T of each of the view's Gaussians. basis: [C, B] y; residual: [C, 3] r.
void add_residual(Array1<const i64> ids, Array2<const float> basis, Rows<const float, 3> residual,
                         Pixels<float, 3> gain, i64 thread, i64 threads) {
    const i64 bands = basis.shape[1];
    joint_colors::share_out(basis.shape[0], thread, threads, [&](i64 c) {
        for (i64 b = 0; b < bands; ++b)
            for (int k = 0; k < 3; ++k) gain(ids(c), b, k) += basis(c, b) * residual(c, k);
    });
}

// divisor [N, B, B] += w y y^T of each of the view's Gaussians. weight: [C] w.
void add_squares(Array1<const i64> ids, Array2<const float> basis, Array1<const float> weight,
                        Array3<float> divisor, i64 thread, i64 threads) {
    const i64 bands = basis.shape[1];
    joint_colors::share_out(basis.shape[0], thread, threads, [&](i64 c) {
        for (i64 a = 0; a < bands; ++a)
            for (i64 b = 0; b < bands; ++b) divisor(ids(c), a, b) += weight(c) * basis(c, a) * basis(c, b);
    });
}

} }  // namespace sp
