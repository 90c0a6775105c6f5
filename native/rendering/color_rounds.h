// Rounds in the colours of all Gaussians that some views show, as module splatpainter/lift/colors.py says: what each
// view draws, and the step after it.
#pragma once
#include "geometry.h"

namespace sp { namespace {

// Colours that a view draws, into its `projected` [M, 16]: the unclamped ones moved by the change [N, 3] of each
// entry's Gaussian (ids [M]), 0 to the ceiling (or as far above it as before).
void set_changed_colors(Array1<const i64> ids, Rows<const float, 3> change, float ceiling,
                        Rows<float, COLUMNS> projected, i64 thread, i64 threads) {
    const Share share = share_of(ids.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        float* p = projected.row(i);
        const float* moved = change.row(ids(i));
        for (int k = 0; k < 3; ++k) {
            const float before = p[UNCLAMPED_RED + k];
            p[RED + k] = min_of(max_of(before + moved[k], 0.0f), max_of(before, ceiling));
        }
    }
}

// change [N, 3] += (gain - hold change) / (weight + hold), within the limit; gain [N, 3] is 0 afterwards. weight: [N]
// pixels that show each.
void step_changes(Rows<float, 3> gain, Array1<const float> weight, float hold, float limit, Rows<float, 3> change,
                  i64 thread, i64 threads) {
    const Share share = share_of(weight.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        float *g = gain.row(i), *c = change.row(i);
        const float divisor = max_of(weight(i) + hold, 1e-6f);
        for (int k = 0; k < 3; ++k) {
            const float value = c[k] + (g[k] - hold * c[k]) / divisor;
            c[k] = min_of(max_of(value, -limit), limit);
            g[k] = 0.0f;
        }
    }
}

} }  // namespace sp
