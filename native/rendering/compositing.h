// Compositing a tile front to back: what all kernels over tiles share. Knows no cameras, only `projected` and lists.
//
// C = sum_i w_i c_i + T bg with w_i = alpha_i T_i, T_i = prod_{j<i} (1 - alpha_j). A tile is 16 x 16 pixels = 16
// blocks of 4 x 4; a block is 16 lanes. Field 0 of a tile's state is the transmittance, T. A pixel that accepts no
// more Gaussians has its T negated: w is then negative, and `T - w > MIN_TRANSMITTANCE` fails for ever after, without
// a branch.
//
// Alphas are computed as powers of 2 above MIN_ALPHA: log2(alpha / MIN_ALPHA) is a quadratic of the pixel whose
// coefficients are the Gaussian's, below 0 where it is not drawn, and bounded by the logarithm of the largest alpha.
#pragma once
#include "geometry.h"

namespace sp { namespace {

constexpr int SIDE = TILE / 4, BLOCKS = SIDE * SIDE;
// What is read is asked for this many list entries before it is used.
constexpr i64 PREFETCH_ENTRIES = 6;
constexpr double LOG2_E = 1.4426950408889634;
// log2 of the largest alpha of the profile inria over the smallest.
constexpr double MAX_LEVEL = 7.992910019989189;
// Blocks are tested with a bound that is this much too large: rounding must not drop what is drawn.
constexpr double CULLING_MARGIN = 1.01;

// Which renderer's pictures: see splatpainter/rendering/profiles.py.
enum class Profile { inria, playcanvas };

template <class F> using Field = F[BLOCKS][LANES];
// The first field of every tile's state; what the others hold each kernel names.
constexpr int TRANSMITTANCE = 0;
// A set of blocks: bit b is block b.
using BlockSet = u32;
constexpr BlockSet ALL_BLOCKS = (1u << BLOCKS) - 1;

struct Pixel { i64 x, y; };
SP_INLINE Pixel pixel_of(i64 x0, i64 y0, int b, int l) {
    return {x0 + (b % SIDE) * 4 + (l & 3), y0 + (b / SIDE) * 4 + (l >> 2)};
}

// A thread's tiles, some neighbours at a time, which show many of the same Gaussians:
// for (Turn turn(tiles, thread, threads); turn.k < tiles; turn.next()).
struct Turn {
    i64 k, group, skipped;
    SP_INLINE Turn(i64 tiles, i64 thread, i64 threads) {
        group = tiles < 32 * threads ? 1 : 4;
        k = thread * group, skipped = (threads - 1) * group;
    }
    SP_INLINE void next() {
        ++k;
        if ((k & (group - 1)) == 0) k += skipped;
    }
};

// First pixel of a tile; T = 1 inside the picture, -1 (accepts nothing) outside, other fields 0.
template <class F>
SP_INLINE Pixel open_tile(i64 tile, i64 width, i64 height, Field<F>* state, int fields) {
    const i64 across = (width + TILE - 1) / TILE, ty = tile / across;
    const Pixel first = {(tile - ty * across) * TILE, ty * TILE};
    __builtin_memset(state, 0, fields * sizeof(Field<F>));
    const int right = (int)min_of<i64>(width - first.x, TILE), low = (int)min_of<i64>(height - first.y, TILE);
    for (int b = 0; b < BLOCKS; ++b)
        for (int l = 0; l < LANES; ++l) {
            const Pixel p = pixel_of(0, 0, b, l);
            state[TRANSMITTANCE][b][l] = p.y < low && p.x < right ? F(1) : F(-1);
        }
    return first;
}

// The open blocks without those in which no pixel accepts more.
template <class F>
SP_INLINE BlockSet still_open(const Field<F>& T, BlockSet open) {
    for (BlockSet rest = open; rest; rest &= rest - 1) {
        const int b = __builtin_ctz(rest);
        BlockSet some = 0;
        SP_LANES(F, l) some |= bits_where(load(&T[b][l]) > F(0));
        if (!some) open &= ~(1u << b);
    }
    return open;
}

// Centres of pixels (px), relative to that of the tile's first pixel.
template <class F> struct Places {
    alignas(64) Field<F> pixel_x = {}, pixel_y = {};
    constexpr Places() {
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l)
                pixel_x[b][l] = F((b % SIDE) * 4 + (l & 3)), pixel_y[b][l] = F((b / SIDE) * 4 + (l >> 2));
    }
};
template <class F> constexpr Places<F> PLACES;

struct Blocks { int begin, end; };

// Blocks of a tile that [m - e, m + e] hits, m relative to the centre of the tile's first pixel.
template <class F>
SP_INLINE Blocks blocks_hit(F m, F e) {
    const F limit = F(TILE - 1);
    if (m + e < F(0)) return {0, 0};
    // In this order of arguments NaN becomes the bound: casts of NaN are undefined.
    return {(int)min_of(limit, max_of(F(0), m - e)) >> 2, ((int)min_of(limit, m + e) >> 2) + 1};
}

// A Gaussian in a tile: its centre relative to that of the tile's first pixel, the coefficients of the quadratic, its
// largest values with and without the bound on alpha, its opacity, and the blocks that its ellipse may touch.
template <class F>
struct Footprint {
    F mx, my, a2, b1, c2, level, bound, opacity;
    BlockSet blocks;
};

// List entries whose footprints are found together, in vectors over the entries.
constexpr int BATCH = 64;

// The footprints of up to BATCH list entries in a tile. read() takes those from `from` on, ended by `end`.
//
// Blocks that may have a pixel with a positive level are found by the ellipse and its box at the blocks' centres: in
// the norm of the ellipse no pixel is farther from its block's centre than the block's corners.
template <class F>
struct Footprints {
    using Integer = typename IntegerOf<F>::type;
    // One place more than entries: of what draws nothing.
    alignas(64) F mx[BATCH + 1], my[BATCH + 1], a2[BATCH + 1], b1[BATCH + 1], c2[BATCH + 1], level[BATCH + 1];
    alignas(64) F bound[BATCH + 1];
    alignas(64) F right[LANES], low[LANES];
    alignas(64) Integer blocks[BATCH + 1];  // sets of blocks
    u64 entries[BLOCKS];  // of each block: bit j is entry from + j
    const F* row[BATCH + 1];
    i64 from, count;

    SP_INLINE void read(const Rows<const F, COLUMNS>& projected, const Array1<const i32>& flatten_ids, i64 begin,
                        i64 end, Pixel first) {
        from = begin;
        count = min_of<i64>(BATCH, end - from);
        for (u64& some : entries) some = 0;
        const i64 last = flatten_ids.shape[0] - 1;  // beyond `end` is what the next tile shows
        mx[BATCH] = my[BATCH] = a2[BATCH] = b1[BATCH] = c2[BATCH] = bound[BATCH] = F(0);
        level[BATCH] = F(-1), row[BATCH] = projected.row(flatten_ids(begin));
        for (i64 at = 0; at < count; at += LANES) {
            const i64 some = min_of<i64>(LANES, count - at);
            for (i64 j = 0; j < LANES; ++j) {
                // What is left of the last vector is the first entry again, with a level that draws nothing.
                const F* p = projected.row(flatten_ids(from + at + (j < some ? j : 0)));
                if (j < some) prefetch_row(projected, flatten_ids(min_of(from + at + j + BATCH, last)));
                const i64 k = at + j;
                row[k] = p;
                mx[k] = p[MEAN_X], my[k] = p[MEAN_Y];
                a2[k] = p[CONIC_A], b1[k] = p[CONIC_B], c2[k] = p[CONIC_C];
                level[k] = j < some ? p[SQUARED_RADIUS] : F(0);
                right[j] = p[EXTENT_X], low[j] = p[EXTENT_Y];
            }
            SP_LANES(F, l) find(at + l, l, first);
        }
    }

    SP_INLINE void find(i64 k, int l, Pixel first) {
        using V = Wide<F>;
        using I = Wide<Integer>;
        const F half = F(0.5 * LOG2_E);
        const V x = load(mx + k) - (F(first.x) + F(0.5)), y = load(my + k) - (F(first.y) + F(0.5));
        const V a = half * load(a2 + k), b = F(LOG2_E) * load(b1 + k), c = half * load(c2 + k);
        // SQUARED_RADIUS = 2 ln(opacity / MIN_ALPHA) + RADIUS_MARGIN
        const V most = half * (load(level + k) - F(RADIUS_MARGIN));
        store(mx + k, x), store(my + k, y), store(a2 + k, a), store(b1 + k, b), store(c2 + k, c);
        store(level + k, most), store(bound + k, smaller_of(most, all(F(MAX_LEVEL))));
        const V corner = F(2.25) * (a + magnitude_of(b) + c), reach = sqrt_of(most) + sqrt_of(corner);
        const V limit = F(CULLING_MARGIN) * reach * reach, ex = load(right + l) + F(2), ey = load(low + l) + F(2);
        V dx[SIDE], cross[SIDE], square[SIDE];
        I across[SIDE], down[SIDE];
        for (int side = 0; side < SIDE; ++side) {
            dx[side] = x - F(side * 4 + 1.5);
            across[side] = (I)(dx[side] <= ex) & (I)(dx[side] >= -ex);
            const V dy = y - F(side * 4 + 1.5);
            down[side] = (I)(dy <= ey) & (I)(dy >= -ey);
            cross[side] = b * dy, square[side] = c * dy * dy;
        }
        I sets = {};
        for (int block = 0; block < BLOCKS; ++block) {
            const int i = block % SIDE, j = block / SIDE;
            const V distance = fused(fused(a, dx[i], cross[j]), dx[i], square[j]);
            const I inside = (I)(distance <= limit) & across[i] & down[j];
            sets |= inside & (Integer(1) << block);
            entries[block] |= (u64)bits_where(inside != 0) << k;
        }
        store(blocks + k, sets);
    }

    SP_INLINE Footprint<F> operator[](i64 j) const {
        return {mx[j], my[j], a2[j], b1[j], c2[j], level[j], bound[j], row[j][OPACITY], (BlockSet)blocks[j]};
    }
};

// The same, one entry after the other.
template <class F>
struct EachFootprint {
    Footprints<F> batch;
    SP_INLINE EachFootprint() { batch.from = batch.count = -1; }
    SP_INLINE Footprint<F> at(const Rows<const F, COLUMNS>& projected, const Array1<const i32>& flatten_ids, i64 p,
                              i64 end, Pixel first) {
        if (p - batch.from >= batch.count || batch.count < 0) batch.read(projected, flatten_ids, p, end, first);
        return batch[p - batch.from];
    }
};

// Whether a walk over a tile's list ends where no pixel accepts more, or goes on through what is hidden.
enum class Walk { until_closed, through };

// body(p, its footprint) for list entries [begin, end) of a tile, front to back. Blocks are asked after each eighth
// entry whether they are open, as asking costs as much as drawing. Returns one past the last entry used.
template <Walk way, class F, class Body>
SP_INLINE i64 walk(const Rows<const F, COLUMNS>& projected, const Array1<const i32>& flatten_ids, i64 begin, i64 end,
                   Pixel first, const Field<F>* state, BlockSet& open, Body body) {
    EachFootprint<F> drawn;
    for (i64 p = begin; p < end; ++p) {
        body(p, drawn.at(projected, flatten_ids, p, end, first));
        if (way == Walk::through || ((p - begin) & 7) != 7) continue;
        open = still_open<F>(state[TRANSMITTANCE], open);
        if (!open) return p + 1;
    }
    return end;
}

// body(b) for each block of a set, in order.
template <class Body>
SP_INLINE void over_blocks(BlockSet blocks, Body body) {
    for (; blocks; blocks &= blocks - 1) body(__builtin_ctz(blocks));
}

// MIN_ALPHA 2^x for x from 0 to 8; anything outside. The polynomial is the best one of its degree for 2^r, |r| <= 1/2,
// in relative error (7.5e-8; by Lawson's iteration).
SP_INLINE Wide<float> alpha_at_level(Wide<float> x) {
    using V = Wide<float>;
    using U = Wide<u32>;
    const float shift = 12582912.0f;  // 1.5 2^23: added and taken away again, it rounds to an integer
    const V shifted = x + shift, r = x - (shifted - shift);
    constexpr double s = MIN_ALPHA;
    V p = fused(all(float(s * 0.0013276471519513017)), r, all(float(s * 0.00967554133067596)));
    p = fused(p, r, all(float(s * 0.055507132749612)));
    p = fused(p, r, all(float(s * 0.2402211972393396)));
    p = fused(p, r, all(float(s * 0.693146967063865)));
    p = fused(p, r, all(float(s * 1.0000000716546553)));
    return (V)((U)p + ((U)shifted << 23));
}
SP_INLINE Wide<double> alpha_at_level(Wide<double> x) {
    for (int l = 0; l < W<double>; ++l) x[l] = MIN_ALPHA * exp_of(6.931471805599453e-1 * x[l]);
    return x;
}

// Offsets (px) from the pixels of lanes l .. l + W of block b to a Gaussian's centre, and the level there.
template <class F> struct Offset { Wide<F> dx, dy, level; };
template <class F>
SP_INLINE Offset<F> offset(const Footprint<F>& g, int b, int l) {
    using V = Wide<F>;
    const V dx = g.mx - load(&PLACES<F>.pixel_x[b][l]), dy = g.my - load(&PLACES<F>.pixel_y[b][l]);
    const V slope = fused(all(g.a2), dx, g.b1 * dy);
    return {dx, dy, fused(-slope, dx, fused(-g.c2 * dy, dy, all(g.level)))};
}

// Alphas of a Gaussian in lanes l .. l + W of block b, 0 where that is too little to be drawn.
template <Profile profile, class F>
SP_INLINE Wide<F> alpha_of(const Footprint<F>& g, Wide<F> level) {
    using V = Wide<F>;
    const V zero = {};
    // Where the polynomial is dear, lanes are asked whether any needs it.
    if constexpr (FUSED_IS_EMULATED)
        if (!bits_where(level >= F(0))) return zero;
    if constexpr (profile == Profile::inria) {
        const V bound = all(g.bound), bounded = bound < level ? bound : level;  // NaN stays NaN
        return level >= F(0) ? alpha_at_level(bounded) : zero;
    } else {
        const V bound = all(g.level), bounded = bound < level ? bound : level, cap = all(F(PLAYCANVAS_MAX_ALPHA));
        V alpha = alpha_at_level(bounded) - g.opacity * F(PLAYCANVAS_FALLOFF);
        alpha = alpha < cap ? alpha : cap;
        const auto drawn = (level >= F(0)) & (alpha >= F(MIN_ALPHA));
        return drawn ? alpha : zero;
    }
}
template <Profile profile, class F>
SP_INLINE Wide<F> alpha_of(const Footprint<F>& g, int b, int l) {
    return alpha_of<profile, F>(g, offset(g, b, l).level);
}

// Weights w = alpha T, 0 where the pixel accepts no more. T goes on.
template <Profile profile, class F>
SP_INLINE Wide<F> accept_into(Wide<F>& T, Wide<F> alpha) {
    using V = Wide<F>;
    const V before = T, w = alpha * before, next = before - w;
    const auto accepted = profile == Profile::inria ? next > F(MIN_TRANSMITTANCE) : before >= F(MIN_TRANSMITTANCE);
    T = accepted ? next : -magnitude_of(before);
    return accepted ? w : V{};
}
template <Profile profile, class F>
SP_INLINE Wide<F> accept(F* T, Wide<F> alpha) {
    Wide<F> state = load(T);
    const Wide<F> w = accept_into<profile, F>(state, alpha);
    store(T, state);
    return w;
}

} }  // namespace sp
