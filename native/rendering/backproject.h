// The adjoint of compositing: what pixels give back to Gaussians, by weight. See rasterize.h for the lists.
//
// Sums are stored per pair of a Gaussian and a tile, those of one Gaussian beside each other, and added in tile order
// afterwards: no atomics, so results are the same bits for any number of threads.
#pragma once
#include "rasterize.h"

namespace sp { namespace {

// Columns of one pair's sums over the pixels of a mask m with values v; the last two of the 8 are unused.
enum { W_VALUES, W_MASK = W_VALUES + 3, ALPHA_MASK, PEAK, GATHERED_COLUMNS };
// Those of a second mask n, which stand in place of the values.
enum { W_SECOND = W_VALUES, ALPHA_SECOND, PEAK_SECOND };
constexpr int SUMS = 8;
// Fields of a tile's state after T: m v, or n in place of the first of them, and m.
enum { MASKED_VALUES = TRANSMITTANCE + 1, SECOND_MASK = MASKED_VALUES, MASK = MASKED_VALUES + 3, MASKED_FIELDS };

// values: sums of one mask with values; masks: of two masks.
enum class Gathered { values, masks };
// After so many list entries a tile's blocks are asked again whether they are open.
constexpr i64 OPEN_ENTRIES = 32;

template <Gathered gathered>
SP_INLINE constexpr bool is_peak(int column) {
    return column == PEAK || (gathered == Gathered::masks && column == PEAK_SECOND);
}

// sums[pair_ids[p]] for list entries [begin, end) from the fields of the tile; Gaussians behind the point where all
// pixels stop have no weight, and the alpha of every one is counted.
template <Profile profile, Gathered gathered, class F>
SP_INLINE void backproject_tile(const Rows<const F, COLUMNS>& projected, const Array1<const i32>& flatten_ids,
                                const Array1<const i32>& pair_ids, i64 begin, i64 end, Pixel first,
                                Field<F>* __restrict state, BlockSet masked, const Rows<F, SUMS>& sums) {
    alignas(64) F lanes[GATHERED_COLUMNS][LANES];
    BlockSet open = masked;  // in the others no pixel accepts more: what is drawn there is hidden
    i64 asked = begin;
    walk<Walk::through>(projected, flatten_ids, begin, end, first, state, masked, [&](i64 p, Footprint<F> g) {
        const i64 ahead = min_of(p + PREFETCH_ENTRIES, end - 1);
        prefetch_row(sums, pair_ids(ahead));
        F* out = sums.row(pair_ids(p));
        const BlockSet drawn = g.blocks & masked;
        // Of what is hidden the alpha alone is counted, where large edits wait for it.
        if constexpr (gathered == Gathered::masks && sizeof(F) == 4 && !FUSED_IS_EMULATED) {
            if (open && p - asked >= OPEN_ENTRIES) open = still_open<F>(state[TRANSMITTANCE], open), asked = p;
            if (!(drawn & open)) {
                SP_LANES(F, l) {
                    Wide<F> s[PEAK] = {};
                    over_blocks(drawn, [&](int b) {
                        const Wide<F> alpha = alpha_of<profile>(g, b, l);
                        s[ALPHA_SECOND] = fused(alpha, load(&state[SECOND_MASK][b][l]), s[ALPHA_SECOND]);
                        s[ALPHA_MASK] = fused(alpha, load(&state[MASK][b][l]), s[ALPHA_MASK]);
                    });
                    for (int c = 0; c < PEAK; ++c) store(&lanes[c][l], s[c]);
                }
                sums_of<PEAK, F>(lanes, out);
                return;
            }
        }
        SP_LANES(F, l) {
            Wide<F> s[GATHERED_COLUMNS] = {};
            over_blocks(drawn, [&](int b) {
                const Wide<F> alpha = alpha_of<profile>(g, b, l), zero = {};
                const Wide<F> w = accept<profile>(&state[TRANSMITTANCE][b][l], alpha), m = load(&state[MASK][b][l]);
                if constexpr (gathered == Gathered::values) {
                    for (int c = 0; c < 3; ++c)
                        s[W_VALUES + c] = fused(w, load(&state[MASKED_VALUES + c][b][l]), s[W_VALUES + c]);
                } else {
                    const Wide<F> n = load(&state[SECOND_MASK][b][l]), counted = n > F(0) ? w : zero;
                    s[W_SECOND] = fused(w, n, s[W_SECOND]);
                    s[ALPHA_SECOND] = fused(alpha, n, s[ALPHA_SECOND]);
                    s[PEAK_SECOND] = counted > s[PEAK_SECOND] ? counted : s[PEAK_SECOND];
                }
                s[W_MASK] = fused(w, m, s[W_MASK]);
                s[ALPHA_MASK] = fused(alpha, m, s[ALPHA_MASK]);
                const Wide<F> counted = m > F(0) ? w : zero;
                s[PEAK] = counted > s[PEAK] ? counted : s[PEAK];
            });
            for (int c = 0; c < GATHERED_COLUMNS; ++c) store(&lanes[c][l], s[c]);
        }
        // All but the last are sums over the lanes; what is a peak is put right after.
        sums_of<PEAK, F>(lanes, out);
        for (int c = 0; c < GATHERED_COLUMNS; ++c)
            if (is_peak<gathered>(c)) out[c] = largest_of(lanes[c]);
    });
}

// A field = m; the blocks with any.
template <class F>
SP_INLINE BlockSet load_mask(const Array2<const F>& mask, Pixel first, Field<F>& field) {
    BlockSet some = 0;
    for (int b = 0; b < BLOCKS; ++b)
        for (int l = 0; l < LANES; ++l) {
            const auto [x, y] = pixel_of(first.x, first.y, b, l);
            const bool inside = y < mask.shape[0] && x < mask.shape[1] && mask(y, x) > F(0);
            field[b][l] = inside ? mask(y, x) : F(0);
            some |= (u32)inside << b;
        }
    return some;
}

template <class F>
SP_INLINE void clear(const Array1<const i32>& pair_ids, i64 begin, i64 end, const Rows<F, SUMS>& sums) {
    for (i64 p = begin; p < end; ++p) __builtin_memset(sums.row(pair_ids(p)), 0, SUMS * sizeof(F));
}

template <Profile profile, class F>
void backproject_tiles_as(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> pair_ids,
                          Array1<const i32> tile_ids, Array1<const i64> isect_offsets, Pixels<const F, 3> values,
                          Array2<const F> mask, Rows<F, SUMS> sums, i64 thread, i64 threads) {
    const i64 height = mask.shape[0], width = mask.shape[1];
    alignas(64) Field<F> state[MASKED_FIELDS];
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), width, height, state, MASKED_FIELDS);
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        const BlockSet masked = load_mask<F>(mask, first, state[MASK]);
        if (!masked) {
            clear(pair_ids, begin, end, sums);
            continue;
        }
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l) {
                const F m = state[MASK][b][l];
                const auto [x, y] = pixel_of(first.x, first.y, b, l);
                if (m > F(0))
                    for (int c = 0; c < 3; ++c) state[MASKED_VALUES + c][b][l] = m * values(y, x, c);
            }
        backproject_tile<profile, Gathered::values>(projected, flatten_ids, pair_ids, begin, end, first, state, masked,
                                                    sums);
    }
}

// values [H, W, 3], mask [H, W] >= 0 -> sums [P, 8]. profile: 0 inria, 1 playcanvas.
template <class F>
void backproject_tiles(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> pair_ids,
                       Array1<const i32> tile_ids, Array1<const i64> isect_offsets, Pixels<const F, 3> values,
                       Array2<const F> mask, Rows<F, SUMS> sums, i64 profile, i64 thread, i64 threads) {
    auto kernel = profile == 0 ? backproject_tiles_as<Profile::inria, F> : backproject_tiles_as<Profile::playcanvas, F>;
    kernel(projected, flatten_ids, pair_ids, tile_ids, isect_offsets, values, mask, sums, thread, threads);
}

// Two masks [H, W] >= 0 in one walk, without values.
template <class F>
void mask_sums_tiles(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> pair_ids,
                     Array1<const i32> tile_ids, Array1<const i64> isect_offsets, Array2<const F> mask,
                     Array2<const F> mask2, Rows<F, SUMS> sums, i64 thread, i64 threads) {
    alignas(64) Field<F> state[MASKED_FIELDS];
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), mask.shape[1], mask.shape[0], state, MASKED_FIELDS);
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        const BlockSet masked =
            load_mask<F>(mask, first, state[MASK]) | load_mask<F>(mask2, first, state[SECOND_MASK]);
        if (!masked) {
            clear(pair_ids, begin, end, sums);
            continue;
        }
        backproject_tile<Profile::inria, Gathered::masks>(projected, flatten_ids, pair_ids, begin, end, first, state,
                                                          masked, sums);
    }
}

template <Gathered gathered, class F>
SP_INLINE void reduce(const Array1<const i64>& pair_offsets, const Rows<const F, SUMS>& sums,
                      const Rows<F, GATHERED_COLUMNS>& out, i64 thread, i64 threads) {
    const Share share = share_of(out.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        F total[GATHERED_COLUMNS] = {};
        for (i64 pair = pair_offsets(i); pair < pair_offsets(i + 1); ++pair) {
            const F* s = sums.row(pair);
            for (int k = 0; k < GATHERED_COLUMNS; ++k) {
                total[k] = is_peak<gathered>(k) ? max_of(total[k], s[k]) : total[k] + s[k];
            }
        }
        __builtin_memcpy(out.row(i), total, sizeof total);
    }
}

// out [M, 6]: each Gaussian's sums over its tiles, the sixth their maximum.
template <class F>
void reduce_pairs(Array1<const i64> pair_offsets, Rows<const F, SUMS> sums, Rows<F, GATHERED_COLUMNS> out, i64 thread,
                  i64 threads) {
    reduce<Gathered::values>(pair_offsets, sums, out, thread, threads);
}

// The same for two masks: the third and the sixth their maximum.
template <class F>
void reduce_mask_sums(Array1<const i64> pair_offsets, Rows<const F, SUMS> sums, Rows<F, GATHERED_COLUMNS> out,
                      i64 thread, i64 threads) {
    reduce<Gathered::masks>(pair_offsets, sums, out, thread, threads);
}

} }  // namespace sp
