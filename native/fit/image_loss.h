// L1 and SSIM of two pictures, and their gradient: splatpainter/fit/image_loss.py, which has the formulas. Pictures are
// [H, 3 W]: a row of pixels, channel by channel beside each other.
#pragma once
#include "../maths.h"

namespace sp { namespace {

constexpr int SSIM_RADIUS = 5, SSIM_WINDOW = 2 * SSIM_RADIUS + 1;
constexpr double SSIM_C1 = 0.01 * 0.01, SSIM_C2 = 0.03 * 0.03;
constexpr i64 LOSS_STRIPE = 8;  // rows of pixels that a thread takes at a time

// A sum that grows along a row, in 16 lanes.
struct RowSum {
    alignas(64) float lanes[LANES] = {};
    SP_INLINE void add(i64 j, float value) { lanes[j & (LANES - 1)] += value; }
    SP_INLINE float total() const { return sum_of(lanes); }
};

// maps[0..2] [3, H - 10, 3 (W - 10)] = scale w times what F' is taken of in the three terms of dL/da, negated (the loss
// has 1 - SSIM); sums[y] = sum of w S over a row of windows. weights: [H, 3 W]. scratch: [threads, 10, 3 W].
void ssim_maps(Array2<const float> a, Array2<const float> b, Array2<const float> weights, Array1<const float> taps,
               float scale, Array3<float> maps, Array1<double> sums, Array3<float> scratch, i64 thread, i64 threads) {
    const i64 down = maps.shape[1], across = maps.shape[2], full = a.shape[1];
    checked(across + 2 * 3 * SSIM_RADIUS - 1, full);
    const float c1 = (float)SSIM_C1, c2 = (float)SSIM_C2;
    float *line[5], *mean[5];
    for (int m = 0; m < 5; ++m) line[m] = scratch.row(thread, m), mean[m] = scratch.row(thread, 5 + m);
    for (i64 stripe = thread; stripe < (down + LOSS_STRIPE - 1) / LOSS_STRIPE; stripe += threads)
        for (i64 y = stripe * LOSS_STRIPE; y < min_of(down, (stripe + 1) * LOSS_STRIPE); ++y) {
            for (int m = 0; m < 5; ++m) {
                __builtin_memset(line[m], 0, full * sizeof(float));
                __builtin_memset(mean[m], 0, across * sizeof(float));
            }
            for (int k = 0; k < SSIM_WINDOW; ++k) {
                const float t = taps(k);
                const float *u = a.row(y + k), *v = b.row(y + k);
                float* __restrict l0 = line[0];
                float* __restrict l1 = line[1];
                float* __restrict l2 = line[2];
                float* __restrict l3 = line[3];
                float* __restrict l4 = line[4];
                for (i64 j = 0; j < full; ++j) {
                    const float tu = t * u[j], tv = t * v[j];
                    l0[j] += tu;
                    l1[j] += tv;
                    l2[j] += tu * u[j];
                    l3[j] += tv * v[j];
                    l4[j] += tu * v[j];
                }
            }
            for (int m = 0; m < 5; ++m)
                for (int k = 0; k < SSIM_WINDOW; ++k) {
                    const float t = taps(k);
                    const float* from = line[m] + 3 * k;
                    float* __restrict to = mean[m];
                    for (i64 j = 0; j < across; ++j) to[j] += t * from[j];
                }
            const float* w_row = weights.row(y + SSIM_RADIUS) + 3 * SSIM_RADIUS;
            float *map0 = maps.row(0, y), *map1 = maps.row(1, y), *map2 = maps.row(2, y);
            RowSum total;
            for (i64 j = 0; j < across; ++j) {
                const float ma = mean[0][j], mb = mean[1][j], covariance = mean[4][j] - ma * mb;
                const float top1 = 2.0f * ma * mb + c1, top2 = 2.0f * covariance + c2;
                const float low1 = ma * ma + mb * mb + c1;
                const float low2 = mean[2][j] - ma * ma + mean[3][j] - mb * mb + c2;
                const float s = top1 * top2 / (low1 * low2), w = w_row[j];
                total.add(j, w * s);
                const float by_variance = -s / low2, by_covariance = 2.0f * top1 / (low1 * low2);
                const float by_mean = 2.0f * (mb * top2 / (low1 * low2) - ma * s / low1), pull = -w * scale;
                map0[j] = pull * (by_mean - 2.0f * ma * by_variance - mb * by_covariance);
                map1[j] = pull * 2.0f * by_variance;
                map2[j] = pull * by_covariance;
            }
            sums(y) = total.total();
        }
}

// The window's transpose over the maps ([3, 0, 0]: without), and L1. scale: of the L1 term; sums[y] = sum of w |a - b|
// over a row. scratch: [threads, 6, 3 W + 30], zeros.
void loss_gradient(Array2<const float> a, Array2<const float> b, Array2<const float> weights, Array1<const float> taps,
                   float scale, Array3<const float> maps, Array2<float> gradient, Array1<double> sums,
                   Array3<float> scratch, i64 thread, i64 threads) {
    const i64 height = a.shape[0], full = a.shape[1], down = maps.shape[1], across = maps.shape[2];
    const i64 edge = 3 * (SSIM_WINDOW - 1);
    checked(full + edge - 1, scratch.shape[2]);
    for (i64 stripe = thread; stripe < (height + LOSS_STRIPE - 1) / LOSS_STRIPE; stripe += threads)
        for (i64 y = stripe * LOSS_STRIPE; y < min_of(height, (stripe + 1) * LOSS_STRIPE); ++y) {
            const float *u = a.row(y), *v = b.row(y), *w = weights.row(y);
            float* out = gradient.row(y);
            RowSum total;
            for (i64 j = 0; j < full; ++j) {
                const float d = u[j] - v[j];
                total.add(j, w[j] * abs_of(d));
                out[j] = scale * w[j] * (d > 0.0f ? 1.0f : d < 0.0f ? -1.0f : 0.0f);
            }
            sums(y) = total.total();
            if (down == 0) continue;
            const int first = (int)max_of<i64>(0, y - down + 1), last = (int)min_of<i64>(SSIM_WINDOW, y + 1);
            for (int m = 0; m < 3; ++m) {
                float* __restrict line = scratch.row(thread, m);
                float* __restrict spread = scratch.row(thread, 3 + m);
                __builtin_memset(line + edge, 0, across * sizeof(float));
                for (int k = first; k < last; ++k) {
                    const float t = taps(k);
                    const float* from = maps.row(m, y - k);
                    for (i64 j = 0; j < across; ++j) line[edge + j] += t * from[j];
                }
                __builtin_memset(spread, 0, full * sizeof(float));
                for (int k = 0; k < SSIM_WINDOW; ++k) {
                    const float t = taps(k);
                    const float* from = line + edge - 3 * k;
                    for (i64 j = 0; j < full; ++j) spread[j] += t * from[j];
                }
            }
            const float *s0 = scratch.row(thread, 3), *s1 = scratch.row(thread, 4), *s2 = scratch.row(thread, 5);
            for (i64 j = 0; j < full; ++j)
                out[j] += (w[j] > 0.0f ? 1.0f : 0.0f) * (s0[j] + u[j] * s1[j] + v[j] * s2[j]);
        }
}

} }  // namespace sp
