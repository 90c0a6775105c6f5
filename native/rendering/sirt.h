// Steps of SIRT in the colours of some Gaussians: what they weigh in every pixel is found once (cache_tiles), and a
// step (cached_step_tiles) then costs what they cost. See splatpainter/rendering/cpu/sirt.py.
#pragma once
#include "backproject.h"

namespace sp { namespace {

// Fields of a tile between steps: what the movable Gaussians are to make up (3), and the pixels' weight m.
enum { COLOR_LEFT, WEIGHT_LEFT = COLOR_LEFT + 3, SIRT_FIELDS };
constexpr i64 TILE_PIXELS = BLOCKS * LANES;

// Fields T, r, g, b of a tile without the movable Gaussians; the weights of these into `weights`. pairs [first, last):
// where in flatten_ids they stand.
template <class F>
SP_INLINE void cache_tile(const Rows<const F, COLUMNS>& projected, const Array1<const i32>& flatten_ids, i64 begin,
                          i64 end, Pixel start, const Array1<const i64>& pairs, i64 first, i64 last,
                          const Rows<const i64, 4>& boxes, const Array1<const i64>& block_offsets, Field<F>* state,
                          BlockSet open, const Rows<F, LANES>& weights) {
    i64 q = first;
    walk<Walk::until_closed>(projected, flatten_ids, begin, end, start, state, open, [&](i64 p, Footprint<F> g) {
        const F* row = projected.row(flatten_ids(p));
        F channels[3] = {row[RED], row[GREEN], row[BLUE]};
        const bool movable = q < last && pairs(q) == p;
        i64 slot = 0;
        BlockSet blocks = g.blocks & open;
        if (movable) {
            const i64* box = boxes.row(q);
            blocks = 0;
            for (i64 by = box[0]; by < box[1]; ++by)
                for (i64 bx = box[2]; bx < box[3]; ++bx) blocks |= 1u << checked(by * SIDE + bx, BLOCKS);
            slot = block_offsets(q++);
            for (F& c : channels) c = F(0);
        }
        over_blocks(blocks, [&](int b) {
            F* out = movable ? weights.row(slot++) : nullptr;
            if (!(open >> b & 1)) {
                __builtin_memset(out, 0, LANES * sizeof(F));
                return;
            }
            SP_LANES(F, l) {
                const Wide<F> alpha = alpha_of<Profile::inria>(g, b, l);
                const Wide<F> w = accept<Profile::inria>(&state[TRANSMITTANCE][b][l], alpha);
                for (int c = 0; c < 3; ++c)
                    store(&state[SEEN + c][b][l], fused(w, all(channels[c]), load(&state[SEEN + c][b][l])));
                if (movable) store(out + l, w);
            }
        });
    });
    for (i64 k = block_offsets(q); k < block_offsets(last); ++k) __builtin_memset(weights.row(k), 0, LANES * sizeof(F));
}

// Blocks of their tiles that the boxes of some pairs touch: boxes [Q, 4], rows and columns from, to; at least one of
// each. pairs [Q]: where in flatten_ids they stand; begins [T + 1]: where those of each tile begin; across: tiles of a
// row of the picture.
template <class F>
void find_block_boxes(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> tile_ids,
                      i64 across, Array1<const i64> pairs, Array1<const i64> begins, Rows<i64, 4> boxes, i64 thread,
                      i64 threads) {
    const F limit = F(TILE - 1);
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const i64 row = tile_ids(k) / across, column = tile_ids(k) - row * across;
        const F x0 = F(F(column * TILE) + F(0.5)), y0 = F(F(row * TILE) + F(0.5));
        for (i64 q = begins(k); q < begins(k + 1); ++q) {
            const F* p = projected.row(flatten_ids(pairs(q)));
            const F mean[2] = {p[MEAN_Y] - y0, p[MEAN_X] - x0}, extent[2] = {p[EXTENT_Y], p[EXTENT_X]};
            for (int side = 0; side < 2; ++side) {
                // In this order of arguments NaN becomes the bound: casts of NaN are undefined.
                const F low = min_of(limit, max_of(F(0), mean[side] - extent[side]));
                const F high = min_of(limit, max_of(F(0), mean[side] + extent[side]));
                boxes.row(q)[2 * side] = (i64)low >> 2, boxes.row(q)[2 * side + 1] = ((i64)high >> 2) + 1;
            }
        }
    }
}

// Q pairs of movable Gaussians: pairs [Q], where in flatten_ids they stand; begins [T + 1] of each tile in these; boxes
// [Q, 4] blocks that each touches; block_offsets [Q + 1] of each pair's blocks in the weights. Out: weights [B, 16]
// (aligned to 64 bytes), remainder [T, 4, 16, 16]: target minus what the other Gaussians make, and m.
template <class F>
void cache_tiles(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> /*pair_ids*/,
                 Array1<const i32> tile_ids, Array1<const i64> isect_offsets, Array1<const F> background,
                 Pixels<const F, 3> target, Array2<const F> mask, Array1<const i64> pairs, Array1<const i64> begins,
                 Rows<const i64, 4> boxes, Array1<const i64> block_offsets, Rows<F, LANES> weights,
                 Array4<F> remainder, i64 thread, i64 threads) {
    const i64 height = mask.shape[0], width = mask.shape[1];
    static_assert((int)SEEN == (int)MASKED_VALUES && (int)SEEN_FIELDS == (int)MASKED_FIELDS);
    alignas(64) Field<F> state[MASKED_FIELDS];  // T, what the others show (3), m
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), width, height, state, MASKED_FIELDS);
        F* out = &remainder(k, 0, 0, 0);
        const BlockSet open = load_mask<F>(mask, first, state[MASK]);
        if (!open) {
            __builtin_memset(out, 0, SIRT_FIELDS * TILE_PIXELS * sizeof(F));
            for (i64 b = block_offsets(begins(k)); b < block_offsets(begins(k + 1)); ++b)
                __builtin_memset(weights.row(b), 0, LANES * sizeof(F));
            continue;
        }
        cache_tile(projected, flatten_ids, isect_offsets(k), isect_offsets(k + 1), first, pairs, begins(k),
                   begins(k + 1), boxes, block_offsets, state, open, weights);
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l) {
                const auto [x, y] = pixel_of(first.x, first.y, b, l);
                const F T = abs_of(state[TRANSMITTANCE][b][l]);
                for (int c = 0; c < 3; ++c) {
                    const F rest = state[SEEN + c][b][l] + T * background(c);
                    const F goal = target(min_of(y, height - 1), min_of(x, width - 1), c);
                    out[c * TILE_PIXELS + b * LANES + l] = goal - rest;
                }
                out[WEIGHT_LEFT * TILE_PIXELS + b * LANES + l] = state[MASK][b][l];
            }
    }
}

// entries [Q]: which movable Gaussian each pair is of; pair_ids [Q]: where it keeps its sums; colors [C, 3] -> sums
// [Q, 8].
template <class F>
void cached_step_tiles(Array1<const i64> begins, Rows<const i64, 4> boxes, Array1<const i64> block_offsets,
                       Array1<const i64> entries, Array1<const i64> pair_ids, Rows<const F, LANES> weights,
                       Array4<const F> remainder, Rows<const F, 3> colors, Rows<F, SUMS> sums, i64 thread,
                       i64 threads) {
    alignas(64) Field<F> state[SIRT_FIELDS];
    alignas(64) F lanes[SIRT_FIELDS][LANES];
    for (i64 k = thread; k < remainder.shape[0]; k += threads) {
        if (begins(k) == begins(k + 1)) continue;
        __builtin_memcpy(state, &remainder(k, 0, 0, 0), sizeof state);
        for (i64 q = begins(k); q < begins(k + 1); ++q) {
            const F* color = colors.row(entries(q));
            const i64* box = boxes.row(q);
            i64 slot = block_offsets(q);
            for (i64 by = box[0]; by < box[1]; ++by)
                for (i64 bx = box[2]; bx < box[3]; ++bx, ++slot) {
                    const i64 b = checked(by * SIDE + bx, BLOCKS);
                    SP_LANES(F, l) {
                        const Wide<F> w = load(weights.row(slot) + l);
                        for (int c = 0; c < 3; ++c)
                            store(&state[c][b][l], fused(w, all(-color[c]), load(&state[c][b][l])));
                    }
                }
        }
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l)
                for (int f = COLOR_LEFT; f < WEIGHT_LEFT; ++f) state[f][b][l] *= state[WEIGHT_LEFT][b][l];
        for (i64 q = begins(k); q < begins(k + 1); ++q) {
            const i64* box = boxes.row(q);
            SP_LANES(F, l) {
                Wide<F> s[SIRT_FIELDS] = {};
                i64 slot = block_offsets(q);
                for (i64 by = box[0]; by < box[1]; ++by)
                    for (i64 bx = box[2]; bx < box[3]; ++bx, ++slot) {
                        const Wide<F> w = load(weights.row(slot) + l);
                        for (int f = 0; f < SIRT_FIELDS; ++f)
                            s[f] = fused(w, load(&state[f][by * SIDE + bx][l]), s[f]);
                    }
                for (int f = 0; f < SIRT_FIELDS; ++f) store(&lanes[f][l], s[f]);
            }
            sums_of<SIRT_FIELDS, F>(lanes, sums.row(pair_ids(q)));
        }
    }
}

} }  // namespace sp
