// Means over squares of pixels; as splatpainter/lift/masks.py says.
#pragma once
#include "../lanes.h"

namespace sp { namespace {

// values: [H, W C], pixels of C channels side by side; edges are repeated. rows: [threads, (W + 2 radius) C] space.
// out: as values. Sums go down the columns first, from the second of 2 radius + 1 to the last, then the first; then
// along the rows in the same order.
void mean_over_boxes(Array2<const float> values, i64 channels, i64 radius, Array2<float> rows, Array2<float> out,
                     i64 thread, i64 threads) {
    const i64 height = values.shape[0], width = values.shape[1], size = 2 * radius + 1, margin = radius * channels;
    checked(height - 1, out.shape[0]), checked(width - 1, out.shape[1]), checked(channels - 1, width);
    checked(width + 2 * margin - 1, rows.shape[1]);
    float* const sums = rows.row(thread);
    const float area = (float)(size * size);
    const Share share = share_of(height, thread, threads);
    // Both loops are over chunks that the registers hold, so that a sum is loaded and stored once.
    constexpr i64 CHUNK = 4 * W<float>;
    const auto add = [&](i64 count, auto from, float* to, float divisor, bool divided) {
        i64 i = 0;
        for (; i + CHUNK <= count; i += CHUNK) {
            Wide<float> sum[4] = {};
            for (i64 k = 1; k <= size; ++k) {
                const float* values = from(k < size ? k : 0) + i;
                for (int v = 0; v < 4; ++v) sum[v] += load_unaligned(values + v * W<float>);
            }
            for (int v = 0; v < 4; ++v)
                store_unaligned(to + i + v * W<float>, divided ? sum[v] / divisor : sum[v]);
        }
        for (; i < count; ++i) {
            float sum = 0;
            for (i64 k = 1; k <= size; ++k) sum += from(k < size ? k : 0)[i];
            to[i] = divided ? sum / divisor : sum;
        }
    };
    for (i64 y = share.begin; y < share.end; ++y) {
        const auto row = [&](i64 k) {
            return values.row(max_of(min_of(y + k - radius, height - 1), i64(0)));
        };
        add(width, row, sums + margin, area, false);
        for (i64 i = 0; i < margin; ++i) {
            sums[i] = sums[margin + i % channels];
            sums[margin + width + i] = sums[margin + width - channels + i % channels];
        }
        add(width, [&](i64 k) -> const float* { return sums + k * channels; }, out.row(y), area, true);
    }
}

} }  // namespace sp
