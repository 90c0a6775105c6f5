// Derivative of compositing: gradients of pixels -> of means2d, conics, opacities, colours, depths, per pair.
//
// Front to back with two numbers of state per pixel. For L with gradients (v_C, v_D, v_T) of colour, accumulated depth
// and final transmittance, and g_i = v_C . c_i + v_D z_i:
//
//     dL/d alpha_i = T_i g_i - R_i / (1 - alpha_i),   R_i = sum_{j > i} w_j g_j + T (v_C . bg + v_T)
//
// R starts as the whole sum, known from the picture itself, and loses w_i g_i at each Gaussian.
#pragma once
#include "compositing.h"

namespace sp { namespace {

// Fields of one pair: sums over its pixels of u, u dx, u dy, u dx^2, u dx dy, u dy^2 with u = e^-sigma dL/d alpha; of w
// v_C (3); of w v_D. Stored in 16 columns, one cache line in float32.
constexpr int GRADIENT_FIELDS = 10;

template <class F>
struct Pictures {
    Pixels<const F, 3> image, v_image;
    Array2<const F> alpha, depth, v_alpha, v_depth;
};

// Fields 1..5 = R, v_C (3), v_D. The renderer's depth is D / alpha with alpha = 1 - T.
template <class F>
SP_INLINE void load_gradients(const Pictures<F>& in, Pixel first, Field<F>* state) {
    for (int b = 0; b < BLOCKS; ++b)
        for (int l = 0; l < LANES; ++l) {
            const auto [x, y] = pixel_of(first.x, first.y, b, l);
            if (!(y < in.alpha.shape[0] && x < in.alpha.shape[1] && in.alpha(y, x) > F(0))) {
                state[0][b][l] = F(-1);  // nothing was drawn here
                continue;
            }
            const F a = in.alpha(y, x), d = in.depth(y, x), v_depth = in.v_depth(y, x);
            const F *c = in.image.row(y, x), *v = in.v_image.row(y, x);
            const F v_d = v_depth / a, v_t = d * v_d - in.v_alpha(y, x);
            state[1][b][l] = c[0] * v[0] + c[1] * v[1] + c[2] * v[2] + d * v_depth + (F(1) - a) * v_t;
            for (int k = 0; k < 3; ++k) state[2 + k][b][l] = v[k];
            state[5][b][l] = v_d;
        }
}

// ends [T]: where the forward pass stopped; then the pictures as they were drawn, and their gradients -> sums [P, 16].
template <class F>
void rasterize_backward_tiles(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids,
                              Array1<const i32> pair_ids, Array1<const i32> tile_ids, Array1<const i64> isect_offsets,
                              Array1<const i64> ends, Pixels<const F, 3> image, Array2<const F> alpha,
                              Array2<const F> depth, Pixels<const F, 3> v_image, Array2<const F> v_alpha,
                              Array2<const F> v_depth, Rows<F, COLUMNS> sums, i64 thread, i64 threads) {
    const Pictures<F> pictures = {image, v_image, alpha, depth, v_alpha, v_depth};
    alignas(64) Field<F> state[6];
    alignas(64) F lanes[GRADIENT_FIELDS][LANES];
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), alpha.shape[1], alpha.shape[0], state, 6);
        load_gradients(pictures, first, state);
        BlockSet open = ALL_BLOCKS;
        EachFootprint<F> drawn;
        const i64 begin = isect_offsets(k), end = ends(k);
        for (i64 p = begin; p < end; ++p) {
            const i64 ahead = min_of(p + PREFETCH_ENTRIES, end - 1);
            prefetch_row(sums, pair_ids(ahead));
            const F* row = projected.row(flatten_ids(p));
            const Footprint<F> g = drawn.at(projected, flatten_ids, p, end, first);
            const F channels[4] = {row[RED], row[GREEN], row[BLUE], row[DEPTH]};
            // Where alpha is cut off at its largest value, nothing moves it.
            const F uncapped = F(g.opacity > F(MAX_ALPHA) ? MAX_LEVEL : INFINITE);
            SP_LANES(F, l) {
                Wide<F> s[GRADIENT_FIELDS] = {};
                over_blocks(g.blocks & open, [&](int b) {
                    using V = Wide<F>;
                    const auto [dx, dy, level] = offset(g, b, l);
                    const V a = alpha_of<Profile::inria, F>(g, level), T = load(&state[0][b][l]), zero = {};
                    const V w = accept<Profile::inria>(&state[0][b][l], a);
                    V slope = {};
                    for (int c = 0; c < 4; ++c) {
                        const V v = load(&state[2 + c][b][l]);
                        slope = fused(all(channels[c]), v, slope);
                        s[6 + c] = fused(w, v, s[6 + c]);
                    }
                    const V R = load(&state[1][b][l]) - w * slope;
                    store(&state[1][b][l], R);
                    V u = a * (T * slope - R / (F(1) - a));
                    const auto counted = (w > zero) & (level <= uncapped);
                    u = counted ? u : zero;
                    const V ux = u * dx, uy = u * dy;
                    s[0] += u;
                    s[1] += ux;
                    s[2] += uy;
                    s[3] = fused(ux, dx, s[3]);
                    s[4] = fused(ux, dy, s[4]);
                    s[5] = fused(uy, dy, s[5]);
                });
                for (int c = 0; c < GRADIENT_FIELDS; ++c) store(&lanes[c][l], s[c]);
            }
            F* out = sums.row(pair_ids(p));
            sums_of<8, F>(lanes, out);
            sums_of<2, F>(lanes + 8, out + 8);
            const F shrink = F(1) / g.opacity;  // u has alpha in place of e^-sigma
            for (int c = 0; c < 6; ++c) out[c] *= shrink;
            if (((p - begin) & 7) == 7) open = still_open<F>(state[0], open);
        }
        for (i64 p = end; p < isect_offsets(k + 1); ++p)
            __builtin_memset(sums.row(pair_ids(p)), 0, COLUMNS * sizeof(F));
    }
}

} }  // namespace sp
