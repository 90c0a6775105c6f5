// What a global lift regresses a change of colour on: splatpainter/lift/global_edit.py.
#pragma once
#include "../algebra/products.h"

namespace sp { namespace {

constexpr int FEATURES = 36;

// features [N, 36]: nine real spherical harmonics of the normal [N, 3], each times (r, g, b, 1) of the colour [N, 3].
void fill_regression_features(Rows<const float, 3> colors, Rows<const float, 3> normals, Rows<float, FEATURES> features,
                              i64 thread, i64 threads) {
    const Share share = share_of(features.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const float *n = normals.row(i), *c = colors.row(i), x = n[0], y = n[1], z = n[2];
        const float basis[9] = {1, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y};
        float* out = features.row(i);
        for (int k = 0; k < 9; ++k) {
            for (int j = 0; j < 3; ++j) out[4 * k + j] = basis[k] * c[j];
            out[4 * k + 3] = basis[k];
        }
    }
}

// SH bands >= 1 of sh [N, K, 3] turned by the derivative of a regression's new colour by the old one: the sum over the
// nine harmonics of the normal (each row's features that multiply 1) times linear [9, 9], out and in, and the identity;
// 0 to 2 on the diagonal.
void turn_bands(Rows<const float, FEATURES> features, Rows<const float, 9> linear, Pixels<float, 3> sh, i64 thread,
                i64 threads) {
    checked(8, linear.shape[0]), checked(features.shape[0] - 1, sh.shape[0]);
    const i64 bands = sh.shape[1];
    const Share share = share_of(features.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        float basis[9], matrix[9];
        for (int k = 0; k < 9; ++k) basis[k] = features.row(i)[4 * k + 3];
        products::multiply(basis, linear.data, 9, 0, 9, matrix);
        for (int k = 0; k < 9; ++k) {
            const double value = (double)matrix[k] + (k % 4 == 0 ? 1.0 : 0.0);
            matrix[k] = (float)(k % 4 == 0 ? min_of(max_of(value, 0.0), 2.0) : value);
        }
        for (i64 band = 1; band < bands; ++band) {
            float* c = sh.row(i, band);
            const float r = c[0], g = c[1], b = c[2];
            for (int k = 0; k < 3; ++k) c[k] = r * matrix[3 * k] + g * matrix[3 * k + 1] + b * matrix[3 * k + 2];
        }
    }
}

// out [N]: f^T M f of features f [N, 36] and a matrix M [36, 36], how far each is from what a regression knows. Its
// terms are added as numpy adds them: eight sums, every eighth term each, then what is left over.
void measure_leverage(Rows<const float, FEATURES> features, Rows<const float, FEATURES> matrix, Array1<float> out,
                      i64 thread, i64 threads) {
    checked(FEATURES - 1, matrix.shape[0]), checked(features.shape[0] - 1, out.shape[0]);
    const Share share = share_of(features.shape[0], thread, threads);
    float turned[products::ROWS_AT_ONCE * FEATURES];
    for (i64 i = share.begin; i < share.end;) {
        const float* rows = features.row(i);
        const i64 count = i + products::ROWS_AT_ONCE <= share.end ? products::ROWS_AT_ONCE : 1;
        if (count == 1) {
            products::multiply(rows, matrix.data, FEATURES, 0, FEATURES, turned);
        } else {
            for (i64 j = 0; j < FEATURES; j += LANES)
                products::multiply_block(rows, matrix.data, FEATURES, min_of<i64>(j, FEATURES - LANES), FEATURES,
                                         turned);
        }
        for (i64 r = 0; r < count; ++r) {
            const float *one = rows + r * FEATURES, *other = turned + r * FEATURES;
            float sums[8];
            for (int k = 0; k < 8; ++k) sums[k] = other[k] * one[k];
            int at = 8;
            for (; at + 8 <= FEATURES; at += 8)
                for (int k = 0; k < 8; ++k) sums[k] += other[at + k] * one[at + k];
            float total = ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]));
            for (; at < FEATURES; ++at) total += other[at] * one[at];
            out(i + r) = total;
        }
        i += count;
    }
}

} }  // namespace sp
