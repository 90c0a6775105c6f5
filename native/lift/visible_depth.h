// Smoothed z-depth of the visible surface in one view, and the Gaussian that makes each pixel; as
// splatpainter/lift/depth_normals.py says.
#pragma once

#include "../rendering/compositing.h"

namespace sp { namespace {

namespace visible_depth {
template <class F> struct EntryOf { using type = i32; };  // as wide as F: one mask serves both
template <> struct EntryOf<double> { using type = i64; };

constexpr int SMOOTHING_PX = 3, NEAR = (2 * SMOOTHING_PX + 1) * (2 * SMOOTHING_PX + 1);
constexpr double MIN_LIGHT = 1e-3;  // light left below which a pixel is finished
constexpr float SAME_SURFACE = 0.02f;

// The value that would have a rank (0: the smallest) if values[:count] were sorted; puts them into another order
// (Hoare's quickselect).
inline float ranked(float* values, int count, int rank) {
    int low = 0, high = count - 1;
    while (low < high) {
        const float pivot = values[(low + high) / 2];
        int i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot) ++i;
            while (values[j] > pivot) --j;
            if (i <= j) {
                const float moved = values[i];
                values[i++] = values[j];
                values[j--] = moved;
            }
        }
        if (rank <= j) high = j;
        else if (rank >= i) low = i;
        else break;
    }
    return values[rank];
}
}  // namespace visible_depth

// Walks the Gaussians of each of some pixels ([H, W] bool) front to back until `share` of the light is stopped, which
// gives its depth ([H, W] 0), and notes the entry that weighs most (host: [H, W] -1).
template <class F>
void find_stopping_depths(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> tile_ids,
                          Array1<const i64> isect_offsets, Array2<const bool> pixels, float share,
                          Array2<float> depth, Array2<i32> host, i64 thread, i64 threads) {
    using Entry = typename visible_depth::EntryOf<F>::type;
    const i64 height = pixels.shape[0], width = pixels.shape[1];
    alignas(64) Field<F> state[3];  // light left, negated where a pixel takes no more; heaviest weight; depth
    alignas(64) Field<Entry> heaviest;
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), width, height, state, 3);
        BlockSet open = 0;
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l) {
                const Pixel p = pixel_of(first.x, first.y, b, l);
                const bool used = p.y < height && p.x < width && pixels(p.y, p.x);
                if (!used) state[0][b][l] = F(-1);
                heaviest[b][l] = -1;
                open |= (u32)used << b;
            }
        const BlockSet shown = open;
        EachFootprint<F> drawn;
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        for (i64 p = begin; p < end && open; ++p) {
            const i32 i = flatten_ids(p);
            const F* row = projected.row(i);
            const Footprint<F> g = drawn.at(projected, flatten_ids, p, end, first);
            over_blocks(g.blocks & open, [&](int b) {
                SP_LANES(F, l) {
                    const Wide<F> alpha = alpha_of<Profile::inria>(g, b, l), light = load(&state[0][b][l]);
                    const Wide<F> weight = alpha * light, left = light - weight;
                    const Wide<F> best = load(&state[1][b][l]), z = load(&state[2][b][l]);
                    const auto heavier = weight > best;  // not where the light is negative: best is at least 0
                    store(&state[1][b][l], heavier ? weight : best);
                    store(&heaviest[b][l], heavier ? all((Entry)i) : load(&heaviest[b][l]));
                    const auto stops = (light > F(0)) & (z == F(0)) & (F(1) - left >= F(share));
                    store(&state[2][b][l], stops ? all(row[DEPTH]) : z);
                    const auto finished = (light > F(0)) & (left < F(visible_depth::MIN_LIGHT));
                    store(&state[0][b][l], finished ? -left : left);
                }
            });
            if (((p - begin) & 7) == 7) open = still_open<F>(state[0], open);
        }
        over_blocks(shown, [&](int b) {
            for (int l = 0; l < LANES; ++l) {
                const Pixel p = pixel_of(first.x, first.y, b, l);
                if (p.y >= height || p.x >= width || !pixels(p.y, p.x)) continue;
                depth(p.y, p.x) = (float)state[2][b][l];
                host(p.y, p.x) = (i32)heaviest[b][l];
            }
        });
    }
}

// Median of the depths around each pixel that has one. out: [H, W] 0.
void take_depth_medians(Array2<const float> depth, Array2<float> out, i64 thread, i64 threads) {
    using namespace visible_depth;
    const i64 height = depth.shape[0], width = depth.shape[1];
    float near[NEAR];
    for (i64 y = thread; y < height; y += threads)
        for (i64 x = 0; x < width; ++x) {
            if (!(depth(y, x) > 0)) continue;  // NaN too
            int n = 0;
            for (i64 v = max_of<i64>(y - SMOOTHING_PX, 0); v < min_of(y + SMOOTHING_PX + 1, height); ++v)
                for (i64 u = max_of<i64>(x - SMOOTHING_PX, 0); u < min_of(x + SMOOTHING_PX + 1, width); ++u) {
                    near[n] = depth(v, u);
                    n += near[n] > 0;
                }
            out(y, x) = ranked(near, n, n / 2);
        }
}

// Mean of the depths around each pixel that has one that lie on the same surface (within SAME_SURFACE of its own). out:
// [H, W] 0.
void take_depth_means(Array2<const float> depth, Array2<float> out, i64 thread, i64 threads) {
    using namespace visible_depth;
    const i64 height = depth.shape[0], width = depth.shape[1];
    for (i64 y = thread; y < height; y += threads)
        for (i64 x = 0; x < width; ++x) {
            const float z = depth(y, x);
            if (!(z > 0)) continue;
            float total = 0;
            int n = 0;
            for (i64 v = max_of<i64>(y - SMOOTHING_PX, 0); v < min_of(y + SMOOTHING_PX + 1, height); ++v)
                for (i64 u = max_of<i64>(x - SMOOTHING_PX, 0); u < min_of(x + SMOOTHING_PX + 1, width); ++u) {
                    const float other = depth(v, u);
                    if (other > 0 && abs_of(other - z) < SAME_SURFACE * z) total += other, ++n;
                }
            out(y, x) = total / (float)n;
        }
}

} }  // namespace sp
