// Rounds in the colours of all Gaussians that some views show, as module splatpainter/lift/colors.py says: what each
// view draws, what its picture asks for, and the step after it.
#pragma once
#include "backproject.h"

namespace sp { namespace {

// Columns of one pair's sums: what its pixels ask for, and one that is unused.
enum { STEP_VALUES = 3, STEP_SUMS };

// A tile's weights, as `composite` finds them, to be read again in the same order: much less than to find them again.
template <class F>
struct KeptWeights {
    static constexpr bool RECOLORS = false;
    // weights [capacity]; groups [max_groups]: of each batch the open blocks, then of each vector of pixels the entries
    // that were added.
    F* weights;
    i64* groups;
    i64 capacity, max_groups, count = 0, num_groups = 0, batches = 0;
    bool fits = true;

    SP_INLINE void put(i64 group) {
        fits &= num_groups < max_groups;
        if (fits) groups[num_groups++] = group;
    }
    SP_INLINE void begin_batch(BlockSet open) { put(open); }
    SP_INLINE void begin_pixels(int, int) { put(0); }
    SP_INLINE void add(int j, Wide<F> w) {
        fits &= count < capacity;
        if (!fits) return;
        groups[num_groups - 1] |= (i64)(u64(1) << j);
        store(weights + count, w);
        count += W<F>;
    }
    SP_INLINE void end_batch(i64, i64) { ++batches; }

    template <class To>
    SP_INLINE void tell(i64 begin, i64 end, To& to) const {
        i64 group = 0, at = 0;
        for (i64 batch = 0; batch < batches; ++batch) {
            const BlockSet open = (BlockSet)groups[group++];
            to.begin_batch(open);
            over_blocks(open, [&](int b) {
                SP_LANES(F, l) {
                    to.begin_pixels(b, l);
                    for (u64 rest = (u64)groups[group++]; rest; rest &= rest - 1, at += W<F>)
                        to.add(__builtin_ctzll(rest), load(weights + at));
                }
            });
            const i64 from = begin + batch * BATCH;
            to.end_batch(from, min_of<i64>(BATCH, end - from));
        }
    }
};

// Sums of weights times what is asked for at the pixels (fields MASKED_VALUES of the tile), of each pair.
template <class F>
struct GainSums {
    static constexpr bool RECOLORS = false;
    const Field<F>* state;
    const Array1<const i32>& pair_ids;
    const Rows<F, STEP_SUMS>& out;
    Wide<F> asked[STEP_VALUES];
    int lane;
    alignas(64) F sums[BATCH][STEP_VALUES][LANES];

    SP_INLINE void begin_batch(BlockSet) { __builtin_memset(sums, 0, sizeof sums); }
    SP_INLINE void begin_pixels(int b, int l) {
        for (int c = 0; c < STEP_VALUES; ++c) asked[c] = load(&state[MASKED_VALUES + c][b][l]);
        lane = l;
    }
    SP_INLINE void add(int j, Wide<F> w) {
        for (int c = 0; c < STEP_VALUES; ++c) store(&sums[j][c][lane], fused(w, asked[c], load(&sums[j][c][lane])));
    }
    SP_INLINE void end_batch(i64 from, i64 count) {
        for (i64 j = 0; j < count; ++j) {
            F values[SUMS];
            sums_of<STEP_VALUES, F>(sums[j], values);
            __builtin_memcpy(out.row(pair_ids(from + j)), values, STEP_SUMS * sizeof(F));
        }
    }
};

// Rasterize, subtract and backproject, tile by tile, while the tile is in cache. errors [T]: sum of m |target -
// image|^2; space, groups: of each thread, for the weights of a tile; where they do not fit they are found twice.
template <class F>
void sirt_tiles(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> pair_ids,
                Array1<const i32> tile_ids, Array1<const i64> isect_offsets, Array1<const F> background,
                Pixels<const F, 3> target, Array2<const F> mask, Rows<F, STEP_SUMS> sums, Array1<F> errors,
                Array2<F> space, Array2<i64> groups, i64 thread, i64 threads) {
    const i64 height = mask.shape[0], width = mask.shape[1];
    alignas(64) Field<F> rasterized[SEEN_FIELDS], state[MASKED_FIELDS];
    GainSums<F> gains{state, pair_ids, sums, {}, 0, {}};
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), width, height, state, MASKED_FIELDS);
        open_tile<F>(tile_ids(k), width, height, rasterized, SEEN_FIELDS);
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        errors(k) = F(0);
        const BlockSet masked = load_mask<F>(mask, first, state[MASK]);
        BlockSet open = masked;
        KeptWeights<F> kept{space.row(thread), groups.row(thread), space.shape[1], groups.shape[1]};
        if (open) composite<Profile::inria>(projected, flatten_ids, begin, end, first, rasterized, open, kept);
        for (i64 p = min_of(end, begin + kept.batches * BATCH); p < end; ++p)
            __builtin_memset(sums.row(pair_ids(p)), 0, STEP_SUMS * sizeof(F));
        if (!masked) continue;
        F error = F(0);
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l) {
                const F m = state[MASK][b][l];
                if (!(m > F(0))) continue;
                const auto [x, y] = pixel_of(first.x, first.y, b, l);
                const F T = abs_of(rasterized[TRANSMITTANCE][b][l]);
                for (int c = 0; c < 3; ++c) {
                    const F difference = target(y, x, c) - (rasterized[SEEN + c][b][l] + T * background(c));
                    error += m * difference * difference;
                    state[MASKED_VALUES + c][b][l] = m * difference;
                }
            }
        errors(k) = error;
        if (kept.fits) {
            kept.tell(begin, end, gains);
        } else {
            open_tile<F>(tile_ids(k), width, height, rasterized, SEEN_FIELDS);
            open = masked;
            composite<Profile::inria>(projected, flatten_ids, begin, end, first, rasterized, open, gains);
        }
    }
}

// gain [N, 3] += each entry's sums over its tiles, at its Gaussian: ids [M], no Gaussian twice; not where the weight
// ([N]) of the Gaussian is 0. Without ids at the entry itself, without weights of all.
template <class F>
void add_gains(Array1<const i64> pair_offsets, Rows<const F, STEP_SUMS> sums, Array1<const i64> ids,
               Array1<const F> weight, Rows<F, STEP_VALUES> gain, i64 thread, i64 threads) {
    const Share share = share_of(pair_offsets.shape[0] - 1, thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const i64 to = ids.empty() ? i : ids(i);
        if (!weight.empty() && !(weight(to) > F(0))) continue;
        F total[STEP_VALUES] = {};
        for (i64 pair = pair_offsets(i); pair < pair_offsets(i + 1); ++pair)
            for (int k = 0; k < STEP_VALUES; ++k) total[k] += sums.row(pair)[k];
        for (int k = 0; k < STEP_VALUES; ++k) gain.row(to)[k] += total[k];
    }
}

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
