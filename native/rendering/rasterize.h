// Rasterization: tiles -> colours, alpha, depth, and the Gaussian that weighs most in each pixel.
//
// Kernels over tiles begin with `ProjectedView.tile_lists`: projected [M, 16]; flatten_ids [P], entries of `projected`,
// tile after tile, front to back; pair_ids [P], where each of these keeps its sums; tile_ids [T], numbered row by row
// over the picture; isect_offsets [T + 1], where each tile begins in flatten_ids.
#pragma once
#include "compositing.h"

namespace sp { namespace {

// Fields of a tile's state after T: sums of what is seen, by weight.
enum { SEEN = TRANSMITTANCE + 1, SEEN_DEPTH = SEEN + 3, SEEN_FIELDS };

// What `composite` tells of the weights that it finds: batch after batch, of each open block vector by vector, of each
// entry j of the batch that it adds there. Nothing is made of them here: what is drawn is wanted alone, in colours that
// may be others than those of the entries' rows.
template <class F>
struct DrawnColors {
    static constexpr bool RECOLORS = true;
    const F* colors;
    i64 columns;
    SP_INLINE void begin_batch(BlockSet) {}
    SP_INLINE void begin_pixels(int, int) {}
    SP_INLINE void add(int, Wide<F>) {}
    SP_INLINE void end_batch(i64, i64) {}
};

// Add list entries [begin, end) to the fields of a tile; returns one past the last entry used, as `walk` would. Not by
// `walk`: here a pixel's sums stay in registers for a batch of entries, which no sum over the pixels asks for.
template <Profile profile, class F, class Weights>
SP_INLINE i64 composite(const Rows<const F, COLUMNS>& projected, const Array1<const i32>& flatten_ids, i64 begin,
                        i64 end, Pixel first, Field<F>* __restrict state, BlockSet& open, Weights& weights) {
    using V = Wide<F>;
    constexpr bool ahead = !FUSED_IS_EMULATED && sizeof(F) == 4;  // where it pays: it is three copies of alpha_of
    Footprints<F> drawn;
    constexpr bool recolors = Weights::RECOLORS;
    const F* tints[recolors ? BATCH + 1 : 1];
    i64 closing = begin;  // the entry that closed a block last
    for (i64 from = begin; from < end; from += BATCH) {
        drawn.read(projected, flatten_ids, from, end, first);
        if constexpr (recolors) {
#pragma clang loop vectorize(disable) unroll(disable)
            for (i64 j = 0; j < drawn.count; ++j) tints[j] = weights.colors + flatten_ids(from + j) * weights.columns;
            tints[BATCH] = tints[0];
        }
        weights.begin_batch(open);
        over_blocks(open, [&](int b) {
            const u64 hits = drawn.entries[b];
            int last = 0;
            bool some = false;
            SP_LANES(F, l) {
                V T = load(&state[TRANSMITTANCE][b][l]), sums[4];
                weights.begin_pixels(b, l);
                if (!bits_where(T > F(0))) continue;
                for (int c = 0; c < 4; ++c) sums[c] = load(&state[SEEN + c][b][l]);
                bool accepts = true;
                // The alphas of the next two entries are on their way while T goes on: it then waits for nothing else.
                u64 rest = hits;
                const auto next = [&] {
                    const int j = rest ? __builtin_ctzll(rest) : BATCH;
                    rest &= rest - 1;
                    return j;
                };
                int j = next(), j2 = BATCH, j3 = BATCH;
                V alpha = {}, alpha2 = {}, alpha3 = {};
                if constexpr (ahead) {
                    j2 = next();
                    alpha = alpha_of<profile, F>(drawn[j], b, l), alpha2 = alpha_of<profile, F>(drawn[j2], b, l);
                }
                for (; j < BATCH; j = j2, alpha = alpha2, j2 = j3, alpha2 = alpha3) {
                    if constexpr (ahead) j3 = next(), alpha3 = alpha_of<profile, F>(drawn[j3], b, l);
                    else j2 = next(), alpha = alpha_of<profile, F>(drawn[j], b, l);
                    if constexpr (FUSED_IS_EMULATED && profile == Profile::inria)
                        if (!bits_where(alpha > F(0))) continue;  // changes nothing, and sums are dear
                    const V w = accept_into<profile, F>(T, alpha);
                    weights.add(j, w);
                    const F *row = drawn.row[j], *color = recolors ? tints[j] : row + RED;
                    for (int c = 0; c < 3; ++c) sums[c] = fused(w, all(color[c]), sums[c]);
                    sums[3] = fused(w, all(row[DEPTH]), sums[3]);
                    if (!bits_where(T > F(0))) {
                        accepts = false;
                        last = max_of(last, j);
                        break;
                    }
                }
                some |= accepts;
                store(&state[TRANSMITTANCE][b][l], T);
                for (int c = 0; c < 4; ++c) store(&state[SEEN + c][b][l], sums[c]);
            }
            if (some) return;
            open &= ~(1u << b);
            closing = max_of(closing, from + last);
        });
        weights.end_batch(from, drawn.count);
        if (!open) return min_of(end, begin + ((closing - begin) | 7) + 1);
    }
    return end;
}

// Fields of a tile that is composited -> colours over the background, expected depth, and alpha in place of T.
template <class F>
SP_INLINE void finish_tile(Field<F>* state, const F* background) {
    using V = Wide<F>;
    const V one = all(F(1)), zero = {};
    for (int b = 0; b < BLOCKS; ++b)
        SP_LANES(F, l) {
            const V T = magnitude_of(load(&state[TRANSMITTANCE][b][l])), alpha = one - T;
            for (int c = 0; c < 3; ++c)
                store(&state[SEEN + c][b][l], load(&state[SEEN + c][b][l]) + T * background[c]);
            store(&state[SEEN_DEPTH][b][l], T < one ? load(&state[SEEN_DEPTH][b][l]) / alpha : zero);
            store(&state[TRANSMITTANCE][b][l], alpha);
        }
}

template <Profile profile, class F>
void rasterize_tiles_as(Rows<const F, COLUMNS> projected, Rows<const F, 3> colors, Array1<const i32> flatten_ids,
                        Array1<const i32> tile_ids, Array1<const i64> isect_offsets, Array1<const F> background,
                        Pixels<F, 3> image, Array2<F> alpha, Array2<F> depth, Array1<i64> ends, i64 thread,
                        i64 threads) {
    const i64 height = alpha.shape[0], width = alpha.shape[1];
    const F back[3] = {background(0), background(1), background(2)};
    alignas(64) Field<F> state[SEEN_FIELDS];
    DrawnColors<F> weights{projected.data + RED, COLUMNS};
    if (!colors.empty()) {
        checked(projected.shape[0] - 1, colors.shape[0]);
        weights = {colors.data, 3};
    }
    for (Turn turn(tile_ids.shape[0], thread, threads); turn.k < tile_ids.shape[0]; turn.next()) {
        const i64 k = turn.k;
        const Pixel first = open_tile<F>(tile_ids(k), width, height, state, SEEN_FIELDS);
        BlockSet open = ALL_BLOCKS;
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        ends(k) = composite<profile>(projected, flatten_ids, begin, end, first, state, open, weights);
        finish_tile(state, back);
        for (int b = 0; b < BLOCKS; ++b)
            for (int row = 0; row < LANES; row += 4) {
                const auto [x, y] = pixel_of(first.x, first.y, b, row);
                const i64 some = y < height ? min_of<i64>(4, width - x) : 0;
                if (some <= 0) continue;
                F *colors = image.row(y, x), *alphas = &alpha(y, x), *depths = &depth(y, x);
                for (i64 l = 0; l < some; ++l) {
                    for (int c = 0; c < 3; ++c) colors[3 * l + c] = state[SEEN + c][b][row + l];
                    alphas[l] = state[TRANSMITTANCE][b][row + l], depths[l] = state[SEEN_DEPTH][b][row + l];
                }
            }
    }
}

// colors: [M, 3] in place of those of `projected`, or [0]. profile: 0 inria, 1 playcanvas. Out: image over the
// background, alpha, expected depth (0 where alpha is 0), and ends [T], one past the last entry of flatten_ids used.
template <class F>
void rasterize_tiles(Rows<const F, COLUMNS> projected, Rows<const F, 3> colors, Array1<const i32> flatten_ids,
                     Array1<const i32> tile_ids, Array1<const i64> isect_offsets, Array1<const F> background,
                     Pixels<F, 3> image, Array2<F> alpha, Array2<F> depth, Array1<i64> ends, i64 profile, i64 thread,
                     i64 threads) {
    auto kernel = profile == 0 ? rasterize_tiles_as<Profile::inria, F> : rasterize_tiles_as<Profile::playcanvas, F>;
    kernel(projected, colors, flatten_ids, tile_ids, isect_offsets, background, image, alpha, depth, ends, thread,
           threads);
}

template <Profile profile, class F>
void heaviest_tiles_as(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> tile_ids,
                       Array1<const i64> isect_offsets, Array2<i32> entries, i64 thread, i64 threads) {
    const i64 height = entries.shape[0], width = entries.shape[1];
    enum { PEAK_WEIGHT = TRANSMITTANCE + 1, FIELDS };
    alignas(64) Field<F> state[FIELDS];
    using Integer = typename IntegerOf<F>::type;
    alignas(64) Integer heaviest[BLOCKS][LANES];
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), width, height, state, FIELDS);
        BlockSet open = ALL_BLOCKS;
        __builtin_memset(heaviest, -1, sizeof heaviest);
        const i64 begin = isect_offsets(k), end = isect_offsets(k + 1);
        walk<Walk::until_closed>(projected, flatten_ids, begin, end, first, state, open, [&](i64 p, Footprint<F> g) {
            const i32 i = flatten_ids(p);
            over_blocks(g.blocks & open, [&](int b) {
                SP_LANES(F, l) {
                    const Wide<F> w = accept<profile>(&state[TRANSMITTANCE][b][l], alpha_of<profile>(g, b, l));
                    const Wide<F> peak = load(&state[PEAK_WEIGHT][b][l]);
                    const Wide<Integer> before = load(&heaviest[b][l]);
                    store(&state[PEAK_WEIGHT][b][l], w > peak ? w : peak);
                    store(&heaviest[b][l], w > peak ? Wide<Integer>{} + Integer(i) : before);
                }
            });
        });
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l) {
                const auto [x, y] = pixel_of(first.x, first.y, b, l);
                if (y < height && x < width) entries(y, x) = (i32)heaviest[b][l];
            }
    }
}

// entries [H, W]: the entry of `projected` with the largest weight, of equal ones the front one; -1 for none.
template <class F>
void heaviest_tiles(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> tile_ids,
                    Array1<const i64> isect_offsets, Array2<i32> entries, i64 profile, i64 thread, i64 threads) {
    auto kernel = profile == 0 ? heaviest_tiles_as<Profile::inria, F> : heaviest_tiles_as<Profile::playcanvas, F>;
    kernel(projected, flatten_ids, tile_ids, isect_offsets, entries, thread, threads);
}

} }  // namespace sp
