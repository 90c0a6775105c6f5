// Depth order, and which Gaussians each tile draws, front to back. Stable, so equal for any number of threads.
#pragma once
#include "projection.h"

namespace sp { namespace {

// Rows are asked for this many entries before they are read.
constexpr i64 SORT_PREFETCH = 32;
// Digits of the radix sort, bits.
constexpr int DIGIT_BITS = 11;
constexpr i64 DIGITS = 1 << DIGIT_BITS;

// Slots of all Gaussians by increasing z, ties by slot, into order [M]: a stable radix sort of as many bits as the
// range of z has. Each thread sorts a range of z, cut where about as many lie before as its share. spare, value, value2
// [M]: space. share_tiles [threads, shares]: of each thread, the tiles touched at most (tile_counts, by slot) by those
// of its entries that lie in each of as many equal shares of the order.
void sort_depths(Array1<const float> keys, Array1<const i32> counts, Array1<const i32> tile_counts, Array1<i32> order,
                 Array1<i32> spare, Array1<u32> value, Array1<u32> value2, Array2<i64> share_tiles, i64 thread,
                 i64 threads) {
    const auto each_slot = [&](auto body) {
        for (i64 block = 0; block < counts.shape[0]; ++block) {
            const i64 first = block * GAUSSIANS_PER_BLOCK;
            for (i64 slot = first; slot < first + counts(block); ++slot) body(slot, bits_of<u32>(keys(slot)));
        }
    };
    i64 histogram[3][DIGITS];
    // Every thread counts all of them in bins between the nearest and the farthest: nobody waits for anybody.
    u32 nearest = ~u32(0), farthest = 0, low = 0, high = DIGITS;
    i64 begin = 0;
    int width = 0;
    each_slot([&](i64, u32 v) { nearest = min_of(nearest, v), farthest = max_of(farthest, v); });
    while (nearest < farthest && (farthest - nearest) >> width >= DIGITS) ++width;
    if (threads > 1) {
        __builtin_memset(histogram[0], 0, sizeof histogram[0]);
        i64 total = 0;
        each_slot([&](i64, u32 v) { ++histogram[0][(v - nearest) >> width], ++total; });
        const auto cut = [&](i64 part, i64& before) {
            u32 bin = 0;
            for (before = 0; bin < DIGITS && before < total * part / threads; ++bin) before += histogram[0][bin];
            return part == threads ? (u32)DIGITS : bin;
        };
        i64 end;
        low = cut(thread, begin), high = cut(thread + 1, end);
    }
    // As many passes as there are bits left, so that the last one ends in `order`.
    int bits = width;
    while (bits < 32 && (u64)(high - low) << width > u64(1) << bits) ++bits;
    const int passes = (bits + DIGIT_BITS - 1) / DIGIT_BITS;
    if (passes & 1) {
        Array1<u32> taken = value; value = value2; value2 = taken;
        Array1<i32> held = order; order = spare; spare = held;
    }
    // Those of the range go through a buffer, which takes all and keeps some: no branch that nobody could predict.
    constexpr i64 HELD = 256;
    i32 slots[HELD];
    u32 held_values[HELD];
    i64 m = begin, held_count = 0;
    const u32 lowest = nearest + (low << width);
    const auto flush = [&] {
        for (i64 k = 0; k < held_count; ++k, ++m) order(m) = slots[k], value(m) = held_values[k];
        held_count = 0;
    };
    each_slot([&](i64 slot, u32 v) {
        const u32 bin = (v - nearest) >> width;
        slots[held_count] = (i32)slot, held_values[held_count] = v - lowest;
        held_count += (threads == 1) | ((bin >= low) & (bin < high));
        if (held_count == HELD) flush();
    });
    flush();
    __builtin_memset(histogram, 0, sizeof histogram);
    for (i64 i = begin; i < m; ++i)
        for (int pass = 0; pass < passes; ++pass) ++histogram[pass][(value(i) >> (DIGIT_BITS * pass)) & (DIGITS - 1)];
    for (int pass = 0; pass < passes; ++pass) {
        i64 start = begin;
        for (i64 b = 0; b < DIGITS; ++b) {
            const i64 count = histogram[pass][b];
            histogram[pass][b] = start;
            start += count;
        }
        const int shift = DIGIT_BITS * pass;
        for (i64 i = begin; i < m; ++i) {
            const u32 v = value(i);
            const i64 to = histogram[pass][(v >> shift) & (DIGITS - 1)]++;
            value2(to) = v;
            spare(to) = order(i);
        }
        Array1<u32> taken = value; value = value2; value2 = taken;
        Array1<i32> held = order; order = spare; spare = held;
    }
    const i64 shares = share_tiles.shape[1], total = order.shape[0];
    for (i64 share = 0; share < shares; ++share) {
        const Share all = share_of(total, share, shares);
        i64 tiles = 0;
        for (i64 i = max_of(all.begin, begin); i < min_of(all.end, m); ++i) tiles += tile_counts(order(i));
        share_tiles(thread, share) = tiles;
    }
}

// The rows of tiles of LANES entries that are found in vectors; entries that touch more have the others one by one.
constexpr int TILE_ROWS = 3;

// tile_span and tile_columns of LANES entries: rows and columns of tiles, and what each of the first rows touches.
template <class F>
struct TileLanes {
    using Integer = typename IntegerOf<F>::type;
    alignas(64) F mx[LANES], my[LANES], a[LANES], b[LANES], q[LANES], ex[LANES], ey[LANES];
    alignas(64) Integer row[2][LANES], column[2][LANES], span[TILE_ROWS][2][LANES];

    using V = Wide<F>;
    using I = Wide<Integer>;
    // As `clamped` in geometry.h.
    SP_INLINE static I clamp(V x, i64 last) {
        const V zero = {}, most = all(F(last));
        x = x > zero ? x : zero;
        return __builtin_convertvector(x < most ? x : most, I);
    }
    SP_INLINE static I at_least(I x, i64 least) {
        const I bound = I{} + (Integer)least;
        return x < bound ? bound : x;
    }

    SP_INLINE void put(int lane, const F* p) {
        mx[lane] = p[MEAN_X], my[lane] = p[MEAN_Y], a[lane] = p[CONIC_A], b[lane] = p[CONIC_B];
        q[lane] = p[SQUARED_RADIUS], ex[lane] = p[EXTENT_X], ey[lane] = p[EXTENT_Y];
    }

    SP_INLINE void find(const i64* grid) {
        const F per_tile = F(1.0 / TILE), one = F(1);
        const V zero = {};
        SP_LANES(F, l) {
            const V x = load(mx + l), y = load(my + l), ry = load(ey + l), rx = load(ex + l), ca = load(a + l);
            const I down = at_least(clamp((y - ry) * per_tile, grid[3]), grid[2]);
            const I down_end = clamp((y + ry) * per_tile + one, grid[3]);
            const I across = at_least(clamp((x - rx) * per_tile, grid[1]), grid[0]);
            const I across_end = clamp((x + rx) * per_tile + one, grid[1]);
            const I first = across, last = across_end < across ? across : across_end;
            store(row[0] + l, down), store(row[1] + l, down_end < down ? down : down_end);
            store(column[0] + l, first), store(column[1] + l, last);
            const V slope = -load(b + l) / ca, width = sqrt_of(load(q + l) / ca), star = slope * ry * ry / rx;
            const V shrink = one / ry;
            V y0 = __builtin_convertvector(down, V) * F(TILE);
            for (int r = 0; r < TILE_ROWS; ++r, y0 += F(TILE)) {
                const V low = larger_of(y0 - y, -ry), high = smaller_of(y0 + F(TILE) - y, ry);
                const V right = smaller_of(larger_of(star, low), high), left = smaller_of(larger_of(-star, low), high);
                const V up = right * shrink, fall = left * shrink;
                const V x1 = x + slope * right + width * sqrt_of(larger_of(one - up * up, zero));
                const V x0 = x + slope * left - width * sqrt_of(larger_of(one - fall * fall, zero));
                const V most = __builtin_convertvector(last, V);
                const auto clamp_to = [&](V v) {
                    v = v > zero ? v : zero;
                    return __builtin_convertvector(v < most ? v : most, I);
                };
                const I begin = clamp_to(x0 * per_tile), end = clamp_to(x1 * per_tile + one);
                store(span[r][0] + l, begin < first ? first : begin), store(span[r][1] + l, end);
            }
        }
    }

    // What tile_columns gives for row `row[0] + r` of an entry.
    SP_INLINE Span columns(int lane, i64 r, const F* p) const {
        if (r < TILE_ROWS) return {span[r][0][lane], span[r][1][lane]};
        return tile_columns(p[MEAN_X], p[MEAN_Y], p[CONIC_A], p[CONIC_B], p[SQUARED_RADIUS], p[EXTENT_X], p[EXTENT_Y],
                            F(row[0][lane] + r) * F(TILE), (i64)column[0][lane], (i64)column[1][lane]);
    }
};

// Pairs are written this many at a time, of which the last ones may be none.
constexpr i64 PAIRS_AT_ONCE = 4;

// A pair of an entry and a tile, as one number.
SP_INLINE i64 pair_of(i64 entry, i64 tile) { return (i64)((u64)entry << 32 | (u32)tile); }

// Entries in depth order (order [M]: their slots), and the tiles that each touches. projected [M, 16] and gaussian_ids
// [M] of the slots' unsorted and ids; pairs: of each share from begins [shares + 1] on, with PAIRS_AT_ONCE to spare;
// pair_offsets [M + 1]: beside each entry how many pairs its share has up to it; histogram [shares, T]: pairs of tiles.
template <class F>
void list_pairs(Array1<const i32> order, Rows<const F, COLUMNS> unsorted, Array1<const i32> ids,
                Array1<const i64> begins, Array1<const i64> grid, Array2<const i32> tile_slots,
                Rows<F, COLUMNS> projected, Array1<i64> gaussian_ids, Array1<i64> pairs, Array1<i64> pair_offsets,
                Array2<i64> histogram, i64 thread, i64 threads) {
    const i64 m = projected.shape[0], shares = histogram.shape[0];
    const i64 edges[4] = {grid(0), grid(1), grid(2), grid(3)}, across = edges[1] - edges[0];
    const bool all_tiles = tile_slots.shape[0] == 0;
    // Read while the group before is listed: at once, every vector would wait until what was written to its lanes has
    // left for the cache, behind whole rows.
    TileLanes<F> groups[2];
    for (i64 share = thread; share < shares; share += threads) {
        const Share entries = share_of(m, share, shares);
        const i64 first = begins(share), limit = begins(share + 1) - PAIRS_AT_ONCE;
        i64 at = first;
        for (i64 next = entries.begin; next < entries.end + LANES; next += LANES) {
            const i64 i = next - LANES;
            for (int l = 0; l < LANES && next < entries.end; ++l) {
                // What is left of the last vector is its first entry again.
                const i64 entry = next + (next + l < entries.end ? l : 0), slot = order(entry);
                const i64 soon = order(min_of(entry + SORT_PREFETCH, m - 1));
                prefetch_row(unsorted, soon), __builtin_prefetch(ids.data + soon, 0, 3);
                const F* p = unsorted.row(slot);
                __builtin_memcpy(projected.row(entry), p, COLUMNS * sizeof(F));
                gaussian_ids(entry) = ids(slot);
                groups[next / LANES & 1].put(l, p);
            }
            if (i < entries.begin) continue;
            const int count = (int)min_of<i64>(LANES, entries.end - i);
            TileLanes<F>& lanes = groups[i / LANES & 1];
            lanes.find(edges);
            const i64 group = at;
            for (int l = 0; l < count; ++l) {
                const F* p = projected.row(i + l);
                const i64 rows = lanes.row[1][l] - lanes.row[0][l];
                for (i64 r = 0; r < rows; ++r) {
                    const i64 ty = lanes.row[0][l] + r;
                    const Span span = lanes.columns(l, r, p);
                    if (all_tiles) {
                        const i64 pair = pair_of(i + l, ty * across + span.begin);
                        // A slip in the count may cost a tile, but never memory.
                        const i64 touched = min_of(max_of(span.end - span.begin, i64(0)), limit - at);
                        i64* out = &pairs(at);
                        checked(at + PAIRS_AT_ONCE - 1, pairs.shape[0]);
                        for (i64 k = 0; k < PAIRS_AT_ONCE; ++k) out[k] = pair + k;
                        for (i64 k = PAIRS_AT_ONCE; k < touched; ++k) pairs(at + k) = pair + k;
                        at += touched;
                        continue;
                    }
                    for (i64 tx = span.begin; tx < span.end; ++tx) {
                        const i64 tile = tile_slots(ty, tx);
                        if (tile >= 0 && at < limit) pairs(at++) = pair_of(i + l, tile);
                    }
                }
                pair_offsets(i + l + 1) = at - first;
            }
            for (i64 k = group; k < at; ++k) ++histogram(share, (i64)(u32)pairs(k));
        }
    }
}

// The pairs of list_pairs, tile after tile. totals [shares + 1]: pairs of the shares before; first [shares, T]: where
// those of each share and tile begin, moved on here. pair_offsets: made whole.
void place_pairs(Array1<const i64> pairs, Array1<const i64> begins, Array1<const i64> totals, Array2<i64> first,
                 Array1<i64> pair_offsets, Array1<i32> flatten_ids, Array1<i32> pair_ids, i64 thread, i64 threads) {
    const i64 shares = first.shape[0], m = pair_offsets.shape[0] - 1;
    for (i64 share = thread; share < shares; share += threads) {
        const Share entries = share_of(m, share, shares);
        for (i64 i = entries.begin; i < entries.end; ++i) pair_offsets(i + 1) += totals(share);
        for (i64 q = totals(share); q < totals(share + 1); ++q) {
            const u64 pair = (u64)pairs(begins(share) + q - totals(share));
            const i64 p = first(share, (i64)(u32)pair)++;
            flatten_ids(p) = (i32)(pair >> 32);
            pair_ids(p) = (i32)q;
        }
    }
}

} }  // namespace sp
