// Of views that are there: the tiles that some entries touch, some of their tiles and entries, and two of them as one.
// See ProjectedView in splatpainter/rendering/cpu/projected_view.py.
#pragma once
#include "geometry.h"

namespace sp { namespace {

// Rows are asked for this many entries before they are read.
constexpr i64 ROW_PREFETCH = 32;

// Set hit [shares, T] where a tile of the grid (all that it spans) is touched by one of some entries [K].
template <class F>
void mark_tiles(Rows<const F, COLUMNS> projected, Array1<const i64> entries, Array1<const i64> grid, Array2<bool> hit,
                i64 thread, i64 threads) {
    const i64 count = entries.shape[0], shares = hit.shape[0], width = grid(1) - grid(0);
    for (i64 share = thread; share < shares; share += threads) {
        const Share part = share_of(count, share, shares);
        for (i64 k = part.begin; k < part.end; ++k) {
            prefetch_row(projected, entries(min_of(k + ROW_PREFETCH, count - 1)));
            const F* p = projected.row(entries(k));
            const F mx = p[MEAN_X], my = p[MEAN_Y], ex = p[EXTENT_X], ey = p[EXTENT_Y];
            const Span rows = tile_span(my, ey, grid(2), grid(3)), columns = tile_span(mx, ex, grid(0), grid(1));
            for (i64 ty = rows.begin; ty < rows.end; ++ty) {
                // Where others have marked all that it could, as in most places, the ellipse is not asked for.
                bool known = true;
                for (i64 tx = columns.begin; tx < columns.end; ++tx) known &= hit(share, ty * width + tx);
                if (known) continue;
                const Span span = tile_columns(mx, my, p[CONIC_A], p[CONIC_B], p[SQUARED_RADIUS], ex, ey,
                                               F(ty) * F(TILE), columns.begin, columns.end);
                for (i64 tx = span.begin; tx < span.end; ++tx) hit(share, ty * width + tx) = true;
            }
        }
    }
}

// Pairs in the tiles in use ([T]) of selected entries ([M], or [0]: all): per_tile [T], and per entry counts [M] of
// those whose bits are set in `some` [M / 64, rounded up]; no other is written. Like the two kernels after it by one
// thread, which waits for memory: two take nearly as long.
void count_pairs(Array1<const i32> flatten_ids, Array1<const i64> isect_offsets, Array1<const bool> used,
                 Array1<const bool> selected, Array1<u64> some, Array1<i32> counts, Array1<i64> per_tile, i64 thread,
                 i64) {
    if (thread != 0) return;
    for (i64 w = 0; w < some.shape[0]; ++w) some(w) = 0;
    for (i64 k = 0; k < used.shape[0]; ++k) {
        per_tile(k) = 0;
        if (!used(k)) continue;
        for (i64 p = isect_offsets(k); p < isect_offsets(k + 1); ++p) {
            const i32 i = flatten_ids(p);
            if (!selected.empty() && !selected(i)) continue;
            const u64 word = some(i >> 6), bit = u64(1) << (i & 63);
            counts(i) = (word & bit ? counts(i) : 0) + 1;
            some(i >> 6) = word | bit;
            ++per_tile(k);
        }
    }
}

// Numbers these entries in their order, M' of M: at [M'], which they are; pair_offsets [M' + 1], where their pairs
// begin, and so their counts; before [M / 64, rounded up]: how many there are before each word of `some`. M' into
// total [1].
void number_entries(Array1<const u64> some, Array1<i32> counts, Array1<i32> before, Array1<i64> at,
                    Array1<i64> pair_offsets, Array1<i64> total, i64 thread, i64) {
    if (thread != 0) return;
    i64 number = 0, pair = 0;
    for (i64 w = 0; w < some.shape[0]; ++w) {
        before(w) = (i32)number;
        for (u64 rest = some(w); rest; rest &= rest - 1) {
            const i64 i = w * 64 + __builtin_ctzll(rest);
            const i32 count = counts(i);
            at(number) = i;
            pair_offsets(number++) = pair;
            counts(i) = (i32)pair;
            pair += count;
        }
    }
    pair_offsets(number) = pair;
    total(0) = number;
}

// These pairs, tile after tile: their entries' new numbers into `to`, their own into `pairs`, those of one entry in the
// order of their tiles. some, before: as of number_entries; begins [M]: its counts, moved on here.
void take_pairs(Array1<const i32> flatten_ids, Array1<const i64> isect_offsets, Array1<const bool> used,
                Array1<const u64> some, Array1<const i32> before, Array1<i32> begins, Array1<i32> to, Array1<i32> pairs,
                i64 thread, i64) {
    if (thread != 0) return;
    i64 q = 0;
    for (i64 k = 0; k < used.shape[0]; ++k) {
        if (!used(k)) continue;
        for (i64 p = isect_offsets(k); p < isect_offsets(k + 1); ++p) {
            const i32 i = flatten_ids(p);
            const u64 word = some(i >> 6), bit = u64(1) << (i & 63);
            if (!(word & bit)) continue;
            to(q) = before(i >> 6) + __builtin_popcountll(word & (bit - 1));
            pairs(q++) = begins(i)++;
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

// Numbers of the entries of two views in the depth order of both, ties by id, and where their pairs begin. at [M']: the
// entries of the first one that are meant; ids2 [M2]: what stands for those of the second.
template <class F>
void merge_entries(Rows<const F, COLUMNS> projected, Array1<const i64> ids, Array1<const i64> at,
                   Array1<const i64> offsets, Rows<const F, COLUMNS> projected2, Array1<const i64> ids2,
                   Array1<const i64> offsets2, Array1<i32> entry, Array1<i32> entry2, Array1<i64> new_offsets,
                   i64 thread, i64) {
    if (thread != 0) return;
    const i64 m = at.shape[0], m2 = ids2.shape[0];
    i64 a = 0, b = 0, pairs = 0;
    for (i64 k = 0; k < m + m2; ++k) {
        new_offsets(k) = pairs;
        bool first = b == m2;
        if (a < m && b < m2) {
            prefetch_row(projected, at(min_of(a + ROW_PREFETCH, m - 1)));
            const F z = projected.row(at(a))[DEPTH], z2 = projected2.row(b)[DEPTH];
            first = z < z2 || (z == z2 && ids(at(a)) < ids2(b));
        }
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

// The pairs of some entries (chosen [M], C of them), Q of P, in the order of the tiles' lists: pairs [Q] where in
// flatten_ids they stand, begins [T + 1] where those of each tile begin, entries [Q] which of the chosen ones each is
// of, pair_ids [Q] its place among all pairs in the order of these, pair_offsets [C + 1] where those of each begin.
// number: [M] to be written to; pairs, entries and pair_ids have room for P. Q into total [1]. By one thread.
SP_SMALL void list_chosen_pairs(Array1<const i32> flatten_ids, Array1<const i64> isect_offsets,
                                Array1<const bool> chosen, Array1<i32> number, Array1<i64> pairs, Array1<i64> begins,
                                Array1<i64> entries, Array1<i64> pair_ids, Array1<i64> pair_offsets, Array1<i64> total,
                                i64 thread, i64) {
    if (thread != 0) return;
    const i64 tiles = isect_offsets.shape[0] - 1;
    i64 count = 0, q = 0;
    for (i64 i = 0; i < chosen.shape[0]; ++i) number(i) = chosen(i) ? (i32)count++ : -1;
    for (i64 c = 0; c <= count; ++c) pair_offsets(c) = 0;
    for (i64 k = 0; k < tiles; ++k) {
        begins(k) = q;
        for (i64 p = isect_offsets(k); p < isect_offsets(k + 1); ++p) {
            const i32 entry = number(flatten_ids(p));
            if (entry < 0) continue;
            // How many there are is counted one place further on: the sum of those before is then where each begins.
            pairs(q) = p, entries(q) = entry, ++pair_offsets(entry + 1);
            ++q;
        }
    }
    begins(tiles) = q, total(0) = q;
    for (i64 c = 0; c < count; ++c) pair_offsets(c + 1) += pair_offsets(c);
    // Each takes the next place of its entry, and the places go back to where they began.
    for (i64 k = 0; k < q; ++k) pair_ids(k) = pair_offsets(entries(k))++;
    for (i64 c = count; c > 0; --c) pair_offsets(c) = pair_offsets(c - 1);
    if (count) pair_offsets(0) = 0;
}

} }  // namespace sp
