// Shadow maps of points from many directions, folded into what each point loses, as in splatpainter/lighting.py.
#pragma once
#include "maths.h"
#include "vectors.h"

namespace sp { namespace {
namespace shadows {

constexpr float FARTHEST = -1e30f;

// One direction's map: [size, size] pixels of `pixel` world units, across the direction.
struct View {
    Vec3<float> towards, side, other;
    float pixel, half;

    SP_INLINE float u_of(Vec3<float> p) const { return dot(p, side) / pixel + half - 0.5f; }
    SP_INLINE float v_of(Vec3<float> p) const { return dot(p, other) / pixel + half - 0.5f; }
};

struct Views {
    Rows<const float, 3> towards, side, other;
    float pixel;
    i64 size;

    SP_INLINE View operator()(i64 k) const {
        return {vector_from(towards.row(k)), vector_from(side.row(k)), vector_from(other.row(k)), pixel,
                (float)((double)size / 2.0)};
    }
};

}  // namespace shadows

// Squared distances from some points to their `rank`-th nearest others, by looking at all of them. rank: 0 (itself) to
// 7.
inline void measure_neighbour_squares(Rows<const float, 3> points, Array1<const i64> picks, i64 rank,
                                      Array1<double> squares, i64 thread, i64 threads) {
    for (i64 k = thread; k < picks.shape[0]; k += threads) {
        const Vector p = as_vector(points.row(picks(k)));
        double nearest[8];  // ascending
        for (int n = 0; n <= rank; ++n) nearest[n] = INFINITE;
        for (i64 i = 0; i < points.shape[0]; ++i) {
            const Vector d = as_vector(points.row(i)) - p;
            const double square = dot(d, d);
            if (!(square < nearest[rank])) continue;
            i64 at = rank;
            for (; at > 0 && nearest[at - 1] > square; --at) nearest[at] = nearest[at - 1];
            nearest[at] = square;
        }
        squares(k) = nearest[rank];
    }
}

// depth [B, size, size]: how far towards directions first .. first + B (as many as there are) the points reach.
inline void draw_shadow_maps(Rows<const float, 3> points, Rows<const float, 3> towards, Rows<const float, 3> side,
                             Rows<const float, 3> other, float pixel, i64 first, Array3<float> depth, i64 thread,
                             i64 threads) {
    using namespace shadows;
    const i64 size = depth.shape[1], count = min_of(depth.shape[0], towards.shape[0] - first);
    const Views views = {towards, side, other, pixel, size};
    for (i64 slot = thread; slot < count; slot += threads) {
        const View view = views(first + slot);
        float* map = &depth(slot, 0, 0);
        for (i64 i = 0; i < size * size; ++i) map[i] = FARTHEST;
        for (i64 i = 0; i < points.shape[0]; ++i) {
            const Vec3<float> p = vector_from(points.row(i));
            const i64 x = integer_of<i64>(view.u_of(p), 0, size - 2), y = integer_of<i64>(view.v_of(p), 0, size - 2);
            const float t = dot(p, view.towards);
            // Two by two pixels: no light through the gaps between points.
            for (i64 ix = x; ix < x + 2; ++ix)
                for (i64 iy = y; iy < y + 2; ++iy)
                    if (t > depth(slot, ix, iy)) depth(slot, ix, iy) = t;
        }
    }
}

// Adds to lost_front, lost_back [N, 9] and shade [N, 2] (cosine-weighted) what these maps say is blocked. folded: [K,
// 9] the directions' SH, weights: [K] their solid angles.
inline void fold_shadows(Rows<const float, 3> points, Rows<const float, 3> normals, Rows<const float, 3> towards,
                         Rows<const float, 3> side, Rows<const float, 3> other, float pixel, i64 first,
                         Array3<const float> depth, Rows<const float, 9> folded, Array1<const float> weights,
                         Rows<float, 9> lost_front, Rows<float, 9> lost_back, Rows<float, 2> shade, i64 thread,
                         i64 threads) {
    using namespace shadows;
    const i64 size = depth.shape[1], count = min_of(depth.shape[0], towards.shape[0] - first);
    const Views views = {towards, side, other, pixel, size};
    const float lift = 2.2f * pixel, bias = 0.3f * pixel, end = (float)(size - 1);
    const Share share = share_of(points.shape[0], thread, threads);
    for (i64 slot = 0; slot < count; ++slot) {
        const i64 k = first + slot;
        const View view = views(k);
        const float* sh = folded.row(k);
        for (i64 i = share.begin; i < share.end; ++i) {
            const Vec3<float> p = vector_from(points.row(i)), n = vector_from(normals.row(i));
            const float cosine = dot(n, view.towards);
            const bool front = cosine >= 0.0f;
            const Vec3<float> lifted = p + (front ? lift : -lift) * n;
            const float u = view.u_of(lifted), v = view.v_of(lifted), t = dot(lifted, view.towards) + bias;
            if (!(u > -1.0f && u < end && v > -1.0f && v < end)) continue;  // NaN too
            const i64 x = (i64)u, y = (i64)v;
            // The share of the four pixels around it that is in the way.
            const double fu = (double)u - (double)x, fv = (double)v - (double)y;
            double hidden = 0.0;
            if (depth(slot, x, y) > t) hidden += (1.0 - fu) * (1.0 - fv);
            if (depth(slot, x + 1, y) > t) hidden += fu * (1.0 - fv);
            if (depth(slot, x, y + 1) > t) hidden += (1.0 - fu) * fv;
            if (depth(slot, x + 1, y + 1) > t) hidden += fu * fv;
            if (!(hidden > 0.0)) continue;
            const double lost = hidden * (double)abs_of(cosine);
            float* sums = front ? lost_front.row(i) : lost_back.row(i);
            float& closed = shade(i, front ? 0 : 1);
            closed = (float)((double)closed + lost * (double)weights(k));
            for (int c = 0; c < 9; ++c) sums[c] = (float)((double)sums[c] + lost * (double)sh[c]);
        }
    }
}

} }  // namespace sp
