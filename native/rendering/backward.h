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

// Fields of one pair: sums over its pixels of u = e^-sigma dL/d alpha, of u times offsets (dx, dy) and their products,
// of w v_C (3) and of w v_D. Stored in 16 columns, one cache line in float32.
enum { U, U_DX, U_DY, U_DX_DX, U_DX_DY, U_DY_DY, W_GRADIENT, GRADIENT_FIELDS = W_GRADIENT + 4 };
// Fields of a tile's state after T: R, v_C (3) and v_D.
enum { REMAINDER = TRANSMITTANCE + 1, V_COLOR, V_DEPTH = V_COLOR + 3, BACKWARD_FIELDS };

template <class F>
struct Pictures {
    Pixels<const F, 3> image, v_image;
    Array2<const F> alpha, depth, v_alpha, v_depth;
};

// R, v_C and v_D of each pixel. The renderer's depth is D / alpha with alpha = 1 - T.
template <class F>
SP_INLINE void load_gradients(const Pictures<F>& in, Pixel first, Field<F>* state) {
    for (int b = 0; b < BLOCKS; ++b)
        for (int l = 0; l < LANES; ++l) {
            const auto [x, y] = pixel_of(first.x, first.y, b, l);
            if (!(y < in.alpha.shape[0] && x < in.alpha.shape[1] && in.alpha(y, x) > F(0))) {
                state[TRANSMITTANCE][b][l] = F(-1);  // nothing was drawn here
                continue;
            }
            const F a = in.alpha(y, x), d = in.depth(y, x), v_depth = in.v_depth(y, x);
            const F *c = in.image.row(y, x), *v = in.v_image.row(y, x);
            const F v_d = v_depth / a, v_t = d * v_d - in.v_alpha(y, x);
            state[REMAINDER][b][l] = c[0] * v[0] + c[1] * v[1] + c[2] * v[2] + d * v_depth + (F(1) - a) * v_t;
            for (int k = 0; k < 3; ++k) state[V_COLOR + k][b][l] = v[k];
            state[V_DEPTH][b][l] = v_d;
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
    alignas(64) Field<F> state[BACKWARD_FIELDS];
    alignas(64) F lanes[GRADIENT_FIELDS][LANES];
    for (Turn turn(tile_ids.shape[0], thread, threads); turn.k < tile_ids.shape[0]; turn.next()) {
        const i64 k = turn.k, begin = isect_offsets(k), end = ends(k);
        if (begin == isect_offsets(k + 1)) continue;
        const Pixel first = open_tile<F>(tile_ids(k), alpha.shape[1], alpha.shape[0], state, BACKWARD_FIELDS);
        load_gradients(pictures, first, state);
        BlockSet open = ALL_BLOCKS;
        const auto gather = [&](i64 p, Footprint<F> g) {
            const i64 ahead = min_of(p + PREFETCH_ENTRIES, end - 1);
            prefetch_row(sums, pair_ids(ahead));
            const F* row = projected.row(flatten_ids(p));
            const F channels[4] = {row[RED], row[GREEN], row[BLUE], row[DEPTH]};
            // Where alpha is cut off at its largest value, nothing moves it.
            const F uncapped = F(g.opacity > F(MAX_ALPHA) ? MAX_LEVEL : INFINITE);
            SP_LANES(F, l) {
                Wide<F> s[GRADIENT_FIELDS] = {};
                over_blocks(g.blocks & open, [&](int b) {
                    using V = Wide<F>;
                    const auto [dx, dy, level] = offset(g, b, l);
                    const V a = alpha_of<Profile::inria, F>(g, level), T = load(&state[TRANSMITTANCE][b][l]), zero = {};
                    const V w = accept<Profile::inria>(&state[TRANSMITTANCE][b][l], a);
                    V slope = {};
                    for (int c = 0; c < 4; ++c) {
                        const V v = load(&state[V_COLOR + c][b][l]);
                        slope = fused(all(channels[c]), v, slope);
                        s[W_GRADIENT + c] = fused(w, v, s[W_GRADIENT + c]);
                    }
                    const V R = load(&state[REMAINDER][b][l]) - w * slope;
                    store(&state[REMAINDER][b][l], R);
                    V u = a * (T * slope - R / (F(1) - a));
                    const auto counted = (w > zero) & (level <= uncapped);
                    u = counted ? u : zero;
                    const V ux = u * dx, uy = u * dy;
                    s[U] += u;
                    s[U_DX] += ux;
                    s[U_DY] += uy;
                    s[U_DX_DX] = fused(ux, dx, s[U_DX_DX]);
                    s[U_DX_DY] = fused(ux, dy, s[U_DX_DY]);
                    s[U_DY_DY] = fused(uy, dy, s[U_DY_DY]);
                });
                for (int c = 0; c < GRADIENT_FIELDS; ++c) store(&lanes[c][l], s[c]);
            }
            F* out = sums.row(pair_ids(p));
            sums_of<8, F>(lanes, out);
            sums_of<2, F>(lanes + 8, out + 8);
            const F shrink = F(1) / g.opacity;  // u has alpha in place of e^-sigma
            for (int c = U; c < W_GRADIENT; ++c) out[c] *= shrink;
        };
        const i64 stop = walk<Walk::until_closed>(projected, flatten_ids, begin, end, first, state, open, gather);
        for (i64 p = stop; p < isect_offsets(k + 1); ++p)
            __builtin_memset(sums.row(pair_ids(p)), 0, COLUMNS * sizeof(F));
    }
}

} }  // namespace sp
