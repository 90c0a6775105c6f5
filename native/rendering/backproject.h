// The adjoint of compositing: what pixels give back to Gaussians, by weight. See rasterize.h for the lists.
//
// Sums are stored per pair of a Gaussian and a tile, those of one Gaussian beside each other, and added in tile order
// afterwards: no atomics, so results are the same bits for any number of threads.
#pragma once
#include "rasterize.h"

namespace sp { namespace {

// Columns of one pair's sums: w m v (3), w m, alpha m, max w, two unused. Of two masks without values: w n, alpha n,
// max w, w m, alpha m, max w, two unused.
constexpr int SUMS = 8;

// values: sums of one mask with values; masks: of two masks.
enum class Gathered { values, masks };

// sums[pair_ids[p]] for list entries [begin, end), from fields T, m v (3), m of the tile, or T, n, unused (2), m.
// THROUGH: also count the alpha of Gaussians behind the point where all pixels stop; otherwise stop there too. Returns
// one past the last entry used.
template <Profile profile, Gathered gathered, bool THROUGH, class F>
SP_INLINE i64 backproject_tile(const Rows<const F, COLUMNS>& projected, const Array1<const i32>& flatten_ids,
                               const Array1<const i32>& pair_ids, i64 begin, i64 end, Pixel first,
                               Field<F>* __restrict state, BlockSet& open, const Rows<F, SUMS>& sums) {
    alignas(64) F lanes[6][LANES];
    EachFootprint<F> drawn;
    for (i64 p = begin; p < end; ++p) {
        const i64 ahead = min_of(p + PREFETCH_ENTRIES, end - 1);
        prefetch_row(sums, pair_ids(ahead));
        const Footprint<F> g = drawn.at(projected, flatten_ids, p, end, first);
        SP_LANES(F, l) {
            Wide<F> s[6] = {};
            over_blocks(g.blocks & open, [&](int b) {
                const Wide<F> alpha = alpha_of<profile>(g, b, l), zero = {};
                const Wide<F> w = accept<profile>(&state[0][b][l], alpha), m = load(&state[4][b][l]);
                if constexpr (gathered == Gathered::values) {
                    for (int c = 0; c < 3; ++c) s[c] = fused(w, load(&state[1 + c][b][l]), s[c]);
                } else {
                    const Wide<F> n = load(&state[1][b][l]), counted = n > F(0) ? w : zero;
                    s[0] = fused(w, n, s[0]);
                    s[1] = fused(alpha, n, s[1]);
                    s[2] = counted > s[2] ? counted : s[2];
                }
                s[3] = fused(w, m, s[3]);
                s[4] = fused(alpha, m, s[4]);
                const Wide<F> counted = m > F(0) ? w : zero;
                s[5] = counted > s[5] ? counted : s[5];
            });
            for (int c = 0; c < 6; ++c) store(&lanes[c][l], s[c]);
        }
        F* out = sums.row(pair_ids(p));
        sums_of<5, F>(lanes, out);
        for (int c = gathered == Gathered::values ? 5 : 2; c < 6; c += 3) {
            F peak = F(0);
            for (int l = 0; l < LANES; ++l) peak = max_of(peak, lanes[c][l]);
            out[c] = peak;
        }
        if (!THROUGH && ((p - begin) & 7) == 7 && !(open = still_open<F>(state[0], open))) return p + 1;
    }
    return end;
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
    alignas(64) Field<F> state[5];
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), width, height, state, 5);
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        BlockSet open = load_mask<F>(mask, first, state[4]);
        if (!open) {
            clear(pair_ids, begin, end, sums);
            continue;
        }
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l) {
                const F m = state[4][b][l];
                const auto [x, y] = pixel_of(first.x, first.y, b, l);
                if (m > F(0))
                    for (int c = 0; c < 3; ++c) state[1 + c][b][l] = m * values(y, x, c);
            }
        backproject_tile<profile, Gathered::values, true>(projected, flatten_ids, pair_ids, begin, end, first, state,
                                                          open, sums);
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
    alignas(64) Field<F> state[5];
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), mask.shape[1], mask.shape[0], state, 5);
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        BlockSet open = load_mask<F>(mask, first, state[4]) | load_mask<F>(mask2, first, state[1]);
        if (!open) {
            clear(pair_ids, begin, end, sums);
            continue;
        }
        backproject_tile<Profile::inria, Gathered::masks, true>(projected, flatten_ids, pair_ids, begin, end, first,
                                                                state, open, sums);
    }
}

// Rasterize, subtract and backproject, tile by tile, while the tile is in cache. errors [T]: sum of m |target -
// image|^2.
template <class F>
void sirt_tiles(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> pair_ids,
                Array1<const i32> tile_ids, Array1<const i64> isect_offsets, Array1<const F> background,
                Pixels<const F, 3> target, Array2<const F> mask, Rows<F, SUMS> sums, Array1<F> errors, i64 thread,
                i64 threads) {
    const i64 height = mask.shape[0], width = mask.shape[1];
    alignas(64) Field<F> rasterized[5], state[5];
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), width, height, state, 5);
        open_tile<F>(tile_ids(k), width, height, rasterized, 5);
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        errors(k) = F(0);
        BlockSet open = load_mask<F>(mask, first, state[4]);
        if (!open) {
            clear(pair_ids, begin, end, sums);
            continue;
        }
        const BlockSet masked = open;
        i64 stop = composite<Profile::inria>(projected, flatten_ids, begin, end, first, rasterized, open);
        open = masked;
        F error = F(0);
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l) {
                const F m = state[4][b][l];
                if (!(m > F(0))) continue;
                const auto [x, y] = pixel_of(first.x, first.y, b, l);
                const F T = abs_of(rasterized[0][b][l]);
                for (int c = 0; c < 3; ++c) {
                    const F difference = target(y, x, c) - (rasterized[1 + c][b][l] + T * background(c));
                    error += m * difference * difference;
                    state[1 + c][b][l] = m * difference;
                }
            }
        errors(k) = error;
        stop = backproject_tile<Profile::inria, Gathered::values, false>(projected, flatten_ids, pair_ids, begin, stop,
                                                                         first, state, open, sums);
        clear(pair_ids, stop, end, sums);
    }
}

template <Gathered gathered, class F>
SP_INLINE void reduce(const Array1<const i64>& pair_offsets, const Rows<const F, SUMS>& sums, const Rows<F, 6>& out,
                      i64 thread, i64 threads) {
    const Share share = share_of(out.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        F total[6] = {};
        for (i64 pair = pair_offsets(i); pair < pair_offsets(i + 1); ++pair) {
            const F* s = sums.row(pair);
            for (int k = 0; k < 6; ++k) {
                const bool peak = k == 5 || (gathered == Gathered::masks && k == 2);
                total[k] = peak ? max_of(total[k], s[k]) : total[k] + s[k];
            }
        }
        __builtin_memcpy(out.row(i), total, sizeof total);
    }
}

// out [M, 6]: each Gaussian's sums over its tiles, the sixth their maximum.
template <class F>
void reduce_pairs(Array1<const i64> pair_offsets, Rows<const F, SUMS> sums, Rows<F, 6> out, i64 thread, i64 threads) {
    reduce<Gathered::values>(pair_offsets, sums, out, thread, threads);
}

// The same for two masks: the third and the sixth their maximum.
template <class F>
void reduce_mask_sums(Array1<const i64> pair_offsets, Rows<const F, SUMS> sums, Rows<F, 6> out, i64 thread,
                      i64 threads) {
    reduce<Gathered::masks>(pair_offsets, sums, out, thread, threads);
}

} }  // namespace sp
