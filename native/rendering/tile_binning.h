// Depth order, and which Gaussians each tile draws, front to back. Stable, so equal for any number of threads.
//
// Also of views that are there: some of their tiles and entries, and two of them as one.
#pragma once
#include "projection.h"

namespace sp { namespace {

constexpr i64 SORT_PREFETCH = 8;

// Slots of all Gaussians by increasing z, ties by slot: a stable radix sort of 11 + 11 + 10 bits. Each thread sorts a
// range of z, cut where about as many lie before as its share; the result lies in `spare` where swapped[thread] is set,
// else in `order`. ranges [threads, 2]: where the thread's part of these begins and ends.
void sort_depths(Array1<const float> keys, Array1<const i32> counts, Array1<i32> order, Array1<i32> spare,
                 Array1<u32> value, Array1<u32> value2, Array1<bool> swapped, Rows<i64, 2> ranges, i64 thread,
                 i64 threads) {
    const auto each_slot = [&](auto body) {
        for (i64 block = 0; block < counts.shape[0]; ++block) {
            const i64 first = block * GAUSSIANS_PER_BLOCK;
            for (i64 slot = first; slot < first + counts(block); ++slot) body(slot, bits_of<u32>(keys(slot)));
        }
    };
    i64 histogram[3][2048];
    // Every thread counts all of them in bins between the nearest and the farthest: nobody waits for anybody.
    u32 nearest = ~u32(0), farthest = 0, low = 0, high = 2048;
    i64 begin = 0;
    int width = 0;
    if (threads > 1) {
        each_slot([&](i64, u32 v) { nearest = min_of(nearest, v), farthest = max_of(farthest, v); });
        while (nearest < farthest && (farthest - nearest) >> width >= 2048) ++width;
        __builtin_memset(histogram, 0, sizeof histogram);
        i64 total = 0;
        each_slot([&](i64, u32 v) { ++histogram[0][(v - nearest) >> width], ++total; });
        const auto cut = [&](i64 part, i64& before) {
            u32 bin = 0;
            for (before = 0; bin < 2048 && before < total * part / threads; ++bin) before += histogram[0][bin];
            return part == threads ? 2048u : bin;
        };
        i64 end;
        low = cut(thread, begin), high = cut(thread + 1, end);
    }
    // Those of the range go through a buffer, which takes all and keeps some: no branch that nobody could predict.
    constexpr i64 HELD = 256;
    i32 slots[HELD];
    u32 held_values[HELD];
    i64 m = begin, held_count = 0;
    const auto flush = [&] {
        for (i64 k = 0; k < held_count; ++k, ++m) order(m) = slots[k], value(m) = held_values[k];
        held_count = 0;
    };
    each_slot([&](i64 slot, u32 v) {
        const u32 bin = (v - nearest) >> width;
        slots[held_count] = (i32)slot, held_values[held_count] = v;
        held_count += (threads == 1) | ((bin >= low) & (bin < high));
        if (held_count == HELD) flush();
    });
    flush();
    ranges(thread, 0) = begin, ranges(thread, 1) = m;
    __builtin_memset(histogram, 0, sizeof histogram);
    for (i64 i = begin; i < m; ++i) {
        const u32 v = value(i);
        ++histogram[0][v & 2047];
        ++histogram[1][(v >> 11) & 2047];
        ++histogram[2][v >> 22];
    }
    swapped(thread) = false;
    for (int digit = 0; digit < 3; ++digit) {
        i64 start = begin;
        bool constant = false;
        for (i64 b = 0; b < 2048; ++b) {
            const i64 count = histogram[digit][b];
            constant |= count == m - begin;
            histogram[digit][b] = start;
            start += count;
        }
        if (constant) continue;
        const int shift = 11 * digit;
        for (i64 i = begin; i < m; ++i) {
            const u32 v = value(i);
            const i64 to = histogram[digit][(v >> shift) & 2047]++;
            value2(to) = v;
            spare(to) = order(i);
        }
        Array1<u32> taken = value; value = value2; value2 = taken;
        Array1<i32> held = order; order = spare; spare = held;
        swapped(thread) = !swapped(thread);
    }
}

template <class F>
void gather_sorted(Array1<const i32> order, Rows<const F, COLUMNS> unsorted, Array1<const i32> ids,
                   Array1<const i32> tile_counts, Rows<F, COLUMNS> projected, Array1<i32> gaussian_ids,
                   Array1<i32> max_tiles,
                   i64 thread, i64 threads) {
    const i64 m = order.shape[0];
    for (i64 i = m * thread / threads; i < m * (thread + 1) / threads; ++i) {
        prefetch_row(unsorted, order(min_of(i + SORT_PREFETCH, m - 1)));
        const i64 slot = order(i);
        __builtin_memcpy(projected.row(i), unsorted.row(slot), COLUMNS * sizeof(F));
        gaussian_ids(i) = ids(slot);
        max_tiles(i) = tile_counts(slot);
    }
}

template <class F>
void list_pairs(Rows<const F, COLUMNS> projected, Array1<const i64> begins, Array1<const i32> max_tiles,
                Array1<const i64> grid, Array2<const i32> tile_slots, Array1<i64> ends, Array1<i32> pair_tiles,
                Array2<i64> histogram, i64 thread, i64 threads) {
    const i64 m = projected.shape[0], shares = histogram.shape[0], width = grid(1) - grid(0);
    const bool all = tile_slots.shape[0] == 0;
    for (i64 share = thread; share < shares; share += threads)
        for (i64 i = m * share / shares; i < m * (share + 1) / shares; ++i) {
            const F* p = projected.row(i);
            const F mx = p[MEAN_X], my = p[MEAN_Y], ex = p[EXTENT_X], ey = p[EXTENT_Y];
            i64 at = begins(i);
            const i64 full = at + max_tiles(i);
            Span rows = tile_span(my, ey, grid(2), grid(3)), columns = tile_span(mx, ex, grid(0), grid(1));
            for (i64 ty = rows.begin; ty < rows.end; ++ty) {
                Span span = tile_columns(mx, my, p[CONIC_A], p[CONIC_B], p[SQUARED_RADIUS], ex, ey, F(ty) * F(TILE),
                                         columns.begin, columns.end);
                for (i64 tx = span.begin; tx < span.end; ++tx) {
                    const i64 tile = all ? ty * width + tx : tile_slots(ty, tx);
                    if (tile >= 0 && at < full) {  // a slip in the count may cost a tile, but never memory
                        pair_tiles(at++) = (i32)tile;
                        ++histogram(share, tile);
                    }
                }
            }
            ends(i) = at;
        }
}

void place_pairs(Array1<const i64> begins, Array1<const i64> ends, Array1<const i32> pair_tiles,
                        Array1<const i64> pair_offsets, Array2<i64> first, Array1<i32> flatten_ids,
                        Array1<i32> pair_ids, i64 thread, i64 threads) {
    const i64 m = begins.shape[0], shares = first.shape[0];
    for (i64 share = thread; share < shares; share += threads)
        for (i64 i = m * share / shares; i < m * (share + 1) / shares; ++i)
            for (i64 k = 0; k < ends(i) - begins(i); ++k) {
                const i64 p = first(share, pair_tiles(begins(i) + k))++;
                flatten_ids(p) = (i32)i;
                pair_ids(p) = (i32)(pair_offsets(i) + k);
            }
}

// Set hit [shares, T] where a tile of the grid (all that it spans) is touched by an entry that is selected ([M]).
template <class F>
void mark_tiles(Rows<const F, COLUMNS> projected, Array1<const bool> selected, Array1<const i64> grid, Array2<bool> hit,
                i64 thread, i64 threads) {
    const i64 m = projected.shape[0], shares = hit.shape[0], width = grid(1) - grid(0);
    for (i64 share = thread; share < shares; share += threads)
        for (i64 i = m * share / shares; i < m * (share + 1) / shares; ++i) {
            if (!selected(i)) continue;
            const F* p = projected.row(i);
            const F mx = p[MEAN_X], my = p[MEAN_Y], ex = p[EXTENT_X], ey = p[EXTENT_Y];
            const Span rows = tile_span(my, ey, grid(2), grid(3)), columns = tile_span(mx, ex, grid(0), grid(1));
            for (i64 ty = rows.begin; ty < rows.end; ++ty) {
                const Span span = tile_columns(mx, my, p[CONIC_A], p[CONIC_B], p[SQUARED_RADIUS], ex, ey,
                                               F(ty) * F(TILE), columns.begin, columns.end);
                for (i64 tx = span.begin; tx < span.end; ++tx) hit(share, ty * width + tx) = true;
            }
        }
}

// Pairs in the tiles in use ([T]) of selected entries ([M], or [0]: all): added to per_entry [M], which begins as
// zeros, and per_tile [T].
void count_pairs(Array1<const i32> flatten_ids, Array1<const i64> isect_offsets, Array1<const bool> used,
                 Array1<const bool> selected, Array1<i32> per_entry, Array1<i64> per_tile, i64 thread, i64) {
    if (thread != 0) return;
    for (i64 k = 0; k < used.shape[0]; ++k) {
        per_tile(k) = 0;
        if (!used(k)) continue;
        for (i64 p = isect_offsets(k); p < isect_offsets(k + 1); ++p) {
            const i32 i = flatten_ids(p);
            if (!selected.empty() && !selected(i)) continue;
            ++per_entry(i);
            ++per_tile(k);
        }
    }
}

// These pairs, tile after tile: their entries' new numbers [M] into `to`, their own into `pairs`. at [M]: where the
// pairs of each entry begin; pairs of one entry are in the order of their tiles.
void take_pairs(Array1<const i32> flatten_ids, Array1<const i64> isect_offsets, Array1<const bool> used,
                Array1<const bool> selected, Array1<const i32> new_entry, Array1<i32> at, Array1<i32> to,
                Array1<i32> pairs, i64 thread, i64) {
    if (thread != 0) return;
    i64 q = 0;
    for (i64 k = 0; k < used.shape[0]; ++k) {
        if (!used(k)) continue;
        for (i64 p = isect_offsets(k); p < isect_offsets(k + 1); ++p) {
            const i32 i = flatten_ids(p);
            if (!selected.empty() && !selected(i)) continue;
            to(q) = new_entry(i);
            pairs(q++) = at(i)++;
        }
    }
}

// Entries `at` [M'] of a view at their new numbers `entry` [M'], or one after the other where that is [0].
template <class F>
void put_entries(Array1<const i64> at, Array1<const i32> entry, Rows<const F, COLUMNS> projected,
                 Array1<const i64> gaussian_ids, Rows<F, COLUMNS> new_projected, Array1<i64> new_ids, i64 thread,
                 i64 threads) {
    const Share share = share_of(at.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const i64 to = entry.empty() ? i : entry(i);
        __builtin_memcpy(new_projected.row(to), projected.row(at(i)), COLUMNS * sizeof(F));
        new_ids(to) = gaussian_ids(at(i));
    }
}

// Numbers of the entries of two views in the depth order of both, ties by id, and where their pairs begin.
template <class F>
void merge_entries(Array1<const F> depths, Array1<const i64> ids, Array1<const i64> offsets, Array1<const F> depths2,
                   Array1<const i64> ids2, Array1<const i64> offsets2, Array1<i32> entry, Array1<i32> entry2,
                   Array1<i64> new_offsets, i64 thread, i64) {
    if (thread != 0) return;
    const i64 m = ids.shape[0], m2 = ids2.shape[0];
    i64 a = 0, b = 0, pairs = 0;
    for (i64 k = 0; k < m + m2; ++k) {
        new_offsets(k) = pairs;
        bool first = b == m2;
        if (a < m && b < m2) first = depths(a) < depths2(b) || (depths(a) == depths2(b) && ids(a) < ids2(b));
        if (first) {
            entry(a) = (i32)k;
            pairs += offsets(a + 1) - offsets(a);
            ++a;
        } else {
            entry2(b) = (i32)k;
            pairs += offsets2(b + 1) - offsets2(b);
            ++b;
        }
    }
    new_offsets(m + m2) = pairs;
}

// The pairs of each tile of two views with the same tiles, front to back.
void merge_pairs(Array1<const i32> flatten_ids, Array1<const i32> pair_ids, Array1<const i64> isect_offsets,
                 Array1<const i64> pair_offsets, Array1<const i32> entry, Array1<const i32> flatten_ids2,
                 Array1<const i32> pair_ids2, Array1<const i64> isect_offsets2, Array1<const i64> pair_offsets2,
                 Array1<const i32> entry2, Array1<const i64> new_offsets, Array1<i32> to, Array1<i32> pairs, i64 thread,
                 i64 threads) {
    for (i64 k = thread; k < isect_offsets.shape[0] - 1; k += threads) {
        i64 p = isect_offsets(k), p2 = isect_offsets2(k);
        const i64 end = isect_offsets(k + 1), end2 = isect_offsets2(k + 1);
        for (i64 q = p + p2; q < end + end2; ++q) {
            if (p2 == end2 || (p < end && entry(flatten_ids(p)) < entry2(flatten_ids2(p2)))) {
                const i32 i = flatten_ids(p);
                to(q) = entry(i);
                pairs(q) = (i32)(new_offsets(entry(i)) + (pair_ids(p) - pair_offsets(i)));
                ++p;
            } else {
                const i32 i = flatten_ids2(p2);
                to(q) = entry2(i);
                pairs(q) = (i32)(new_offsets(entry2(i)) + (pair_ids2(p2) - pair_offsets2(i)));
                ++p2;
            }
        }
    }
}

} }  // namespace sp
