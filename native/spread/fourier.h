// Random Fourier features of points, cos(W x + b), and what a classifier makes of them; as
// splatpainter/spread/classifier.py says.
#pragma once
#include "../maths.h"

namespace sp { namespace {

namespace fourier {
constexpr int FEATURES = 192;
constexpr i64 POINTS_PER_BLOCK = 64;  // that a thread takes at a time

// cos(2 pi turns) to 4e-6: sin(2 pi y) by its series for |y| <= 1/4.
SP_INLINE float cosine(float turns) {
    const float part = turns - floor_of(turns + 0.5f), y = 0.25f - abs_of(part), z = y * y;
    float series = -76.705860f + z * 42.058694f;
    series = -41.341702f + z * (81.605249f + z * series);
    return y * (6.2831853f + z * series);
}

SP_INLINE void features_of(Array2<const float> points, i64 i, Rows<const float, FEATURES> directions,
                           Array<const float, 1, FEATURES> phases, float* out) {
    __builtin_memcpy(out, phases.data, FEATURES * sizeof(float));
    for (i64 f = 0; f < points.shape[1]; ++f) {
        const float x = points(i, f);
        const float* direction = directions.row(f);
        for (int d = 0; d < FEATURES; ++d) out[d] += x * direction[d];
    }
    for (int d = 0; d < FEATURES; ++d) out[d] = cosine(out[d]);
}

template <class Each> SP_INLINE void share_out(i64 count, i64 thread, i64 threads, Each each) {
    for (i64 start = thread * POINTS_PER_BLOCK; start < count; start += threads * POINTS_PER_BLOCK)
        for (i64 i = start; i < min_of(count, start + POINTS_PER_BLOCK); ++i) each(i);
}
}  // namespace fourier

// points: [M, F]; directions: [F, FEATURES]; phases: [FEATURES] turns; out: [M, FEATURES].
void take_fourier_features(Array2<const float> points, Rows<const float, fourier::FEATURES> directions,
                           Array<const float, 1, fourier::FEATURES> phases, Rows<float, fourier::FEATURES> out,
                           i64 thread, i64 threads) {
    fourier::share_out(points.shape[0], thread, threads, [&](i64 i) {
        fourier::features_of(points, i, directions, phases, out.row(i));
    });
}

// out: [M] theta [FEATURES] times the features, which are not kept.
void predict_from_features(Array2<const float> points, Rows<const float, fourier::FEATURES> directions,
                           Array<const float, 1, fourier::FEATURES> phases,
                           Array<const float, 1, fourier::FEATURES> theta, Array1<float> out, i64 thread,
                           i64 threads) {
    using namespace fourier;
    alignas(64) float row[FEATURES];
    share_out(points.shape[0], thread, threads, [&](i64 i) {
        features_of(points, i, directions, phases, row);
        // Sums side by side: one alone would wait for itself.
        double sums[LANES] = {};
        for (int d = 0; d < FEATURES; d += LANES)
            for (int l = 0; l < LANES; ++l) sums[l] += (double)(row[d + l] * theta.data[d + l]);
        out(i) = (float)sum_of(sums);
    });
}

} }  // namespace sp
