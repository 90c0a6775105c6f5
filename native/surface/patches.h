// Gaussians as the patches that queries read: splatpainter/surface/surface_samples.py. Include after estimate.h, which
// names the columns.
#pragma once
#include "estimate.h"

namespace sp { namespace {
namespace surface {
// Flatter Gaussians count as this flat; no axis is shorter than the second.
constexpr float MIN_FLATNESS = 1e-3f, MIN_LENGTH = 1e-30f;
constexpr float MIN_QUAT_NORM = 1e-15f;
}  // namespace surface

// patches [M, 16] of the Gaussians ids [M]: mean (3), unit axes (9), the longest first, the last one the (unsigned)
// normal, standard deviations along them (3), opacity. Axes of equal length keep their order.
void fill_patches(Array1<const i64> ids, Rows<const float, 3> means, Rows<const float, 4> quats,
                  Rows<const float, 3> scales, Array1<const float> opacities,
                  Rows<float, surface::PATCH_COLUMNS> patches, i64 thread, i64 threads) {
    using namespace surface;
    const Share share = share_of(ids.shape[0], thread, threads);
    for (i64 m = share.begin; m < share.end; ++m) {
        const i64 id = ids(m);
        const float *mean = means.row(id), *quat = quats.row(id), *scale = scales.row(id);
        int order[3] = {0, 1, 2};
        for (int k = 1; k < 3; ++k)
            for (int j = k; j > 0 && scale[order[j]] > scale[order[j - 1]]; --j) {
                const int taken = order[j];
                order[j] = order[j - 1], order[j - 1] = taken;
            }
        float square = quat[0] * quat[0];
        for (int k = 1; k < 4; ++k) square += quat[k] * quat[k];
        const float norm = max_of(sqrt_of(square), MIN_QUAT_NORM);
        const float w = quat[0] / norm, x = quat[1] / norm, y = quat[2] / norm, z = quat[3] / norm;
        const float columns[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
                                     {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
                                     {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
        const float least = max_of(MIN_FLATNESS * scale[order[0]], MIN_LENGTH);
        float* out = patches.row(m);
        for (int k = 0; k < 3; ++k) {
            out[MEAN + k] = mean[k];
            for (int j = 0; j < 3; ++j) out[AXES + 3 * k + j] = columns[order[k]][j];
            out[SCALES + k] = max_of(scale[order[k]], least);
        }
        out[OPACITY_COLUMN] = opacities(id);
    }
}

} }  // namespace sp
