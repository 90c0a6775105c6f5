// How a surface bends around points, as in splatpainter/session/curvature.py.
#pragma once
#include "point_cells.h"

namespace sp { namespace {

// out: [Q, 3] per point: how many samples are within `radius`, and in sum their (n2 - n1) (p2 - p1) and squared
// distances, in units of it. samples, facing: points and normals in cells of `size`.
inline void sum_turns(Rows<const double, 3> samples, Rows<const double, 3> facing, Array1<const i64> keys,
                      Array1<const i64> order, Array1<const double> corner, double size, double radius,
                      Rows<const double, 3> points, Rows<const double, 3> normals, Rows<double, 3> out, i64 thread,
                      i64 threads) {
    constexpr i64 POINTS_PER_BLOCK = 256;
    // Between normals: what faces further away is the other side of something thin.
    constexpr double MIN_AGREEING_COSINE = -0.2;
    const PointCells cells = {keys, order, corner, size};
    const i64 count = points.shape[0];
    for (i64 start = thread * POINTS_PER_BLOCK; start < count; start += threads * POINTS_PER_BLOCK)
        for (i64 q = start; q < min_of(start + POINTS_PER_BLOCK, count); ++q) {
            const Vector p = vector_from(points.row(q)), n = vector_from(normals.row(q));
            double near = 0.0, turns = 0.0, squares = 0.0;
            cells.around(cells.floored(p), [&](i64 j) {
                const Vector d = vector_from(samples.row(j)) - p, m = vector_from(facing.row(j));
                const Vector away = {d.x / radius, d.y / radius, d.z / radius};
                const double square = dot(away, away);
                if (!(square <= 1.0 && dot(m, n) >= MIN_AGREEING_COSINE)) return true;
                near += 1.0, turns += dot(away, m - n), squares += square;
                return true;
            });
            store_vector(out.row(q), {near, turns, squares});
        }
}

} }  // namespace sp
