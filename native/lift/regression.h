// What a global lift regresses a change of colour on: splatpainter/lift/global_edit.py.
#pragma once
#include "../lanes.h"

namespace sp { namespace {

// features [N, 36]: nine real spherical harmonics of the normal [N, 3], each times (r, g, b, 1) of the colour [N, 3].
void fill_regression_features(Rows<const float, 3> colors, Rows<const float, 3> normals, Rows<float, 36> features,
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

} }  // namespace sp
