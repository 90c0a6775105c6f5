// How a surface bends around points, as in splatpainter/session/measures/curvature.py.
#pragma once
#include "falloff.h"
#include "point_cells.h"

namespace sp { namespace {
namespace curvature {

constexpr i64 POINTS_PER_BLOCK = 256;  // that a thread takes at a time
// Between normals: what faces further away is the other side of something thin.
constexpr double MIN_AGREEING_COSINE = -0.2;

}  // namespace curvature

// out: [Q, 3] per point: how many samples are within `radius`, and in sum their (n2 - n1) (p2 - p1) and squared
// distances, in units of it. samples: [6, S + READ_AT_ONCE] points and normals, in the order of `keys` [S] (cells of
// `radius`).
inline void sum_turns(Array2<const double> samples, Array1<const i64> keys, Array1<const double> corner, double radius,
                      Rows<const double, 3> points, Rows<const double, 3> normals, Rows<double, 3> out, i64 thread,
                      i64 threads) {
    using namespace curvature;
    using V = Wide<double>;
    const PointCells cells = {keys, keys, corner, radius};
    const i64 count = points.shape[0], stride = samples.shape[1];
    const double inverse = 1.0 / radius;
    for (i64 start = thread * POINTS_PER_BLOCK; start < count; start += threads * POINTS_PER_BLOCK)
        for (i64 q = start; q < min_of(start + POINTS_PER_BLOCK, count); ++q) {
            const Vector p = vector_from(points.row(q)), n = vector_from(normals.row(q));
            alignas(64) double near[8] = {}, turns[8] = {}, squares[8] = {};
            cells.rows_around(cells.floored(p), [&](i64 first, i64 last) {
                for (i64 begin = first; begin < last; begin += READ_AT_ONCE) {
                    checked(begin + READ_AT_ONCE - 1, stride);
                    SP_EIGHT(l) {
                        auto row = [&](int r) { return load_unaligned(samples.data + r * stride + begin + l); };
                        const V x = (row(0) - p.x) * inverse, y = (row(1) - p.y) * inverse;
                        const V z = (row(2) - p.z) * inverse;
                        const V fx = row(3), fy = row(4), fz = row(5), square = x * x + y * y + z * z;
                        const V cosine = fx * n.x + fy * n.y + fz * n.z;
                        const V turn = x * (fx - n.x) + y * (fy - n.y) + z * (fz - n.z), zero = {};
                        const auto counts = (square <= 1.0) & (cosine >= MIN_AGREEING_COSINE) &
                                            (load(&COUNTING[l]) < (double)(last - begin));
                        store(&near[l], load(&near[l]) + (counts ? all(1.0) : zero));
                        store(&turns[l], load(&turns[l]) + (counts ? turn : zero));
                        store(&squares[l], load(&squares[l]) + (counts ? square : zero));
                    }
                }
                return true;
            });
            store_vector(out.row(q), {sum_of_eight(near), sum_of_eight(turns), sum_of_eight(squares)});
        }
}

} }  // namespace sp
