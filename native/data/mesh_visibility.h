// Which points a camera sees past the triangles of a mesh; as splattrain/data/mesh_visibility.py says.
#pragma once
#include "../maths.h"

namespace sp { namespace {

namespace mesh_visibility {
constexpr double DEPTH_SLACK = 2e-5;  // part of a point's distance that a triangle must be in front of it by
constexpr u8 MIN_COVERAGE = 128;

// Calls with the tile of every tile that triangle f touches, inside its ranges of columns and rows.
template <class Each>
SP_INLINE void each_tile(Rows<const i64, 2> low, Rows<const i64, 2> high, i64 f, i64 across, Each each) {
    for (i64 row = low(f, 1); row <= high(f, 1); ++row)
        for (i64 column = low(f, 0); column <= high(f, 0); ++column) each(row * across + column);
}

// Texel of a coordinate that repeats: 0 .. size - 1, also for what is no number.
SP_INLINE i64 texel(double x, i64 size) {
    return integer_of<i64>((x - floor_of(x)) * (double)size, 0, size - 1);
}
}  // namespace mesh_visibility

// counts: [tiles] 0, how many triangles touch each tile of `across` in a row; low, high: [F, 2] first and last column
// and row of each triangle. By one thread.
void count_tile_members(Rows<const i64, 2> low, Rows<const i64, 2> high, i64 across, Array1<i64> counts, i64, i64) {
    for (i64 f = 0; f < low.shape[0]; ++f)
        mesh_visibility::each_tile(low, high, f, across, [&](i64 tile) { ++counts(tile); });
}

// Those triangles, tile by tile, from each tile's entry of `next` [tiles] on, which goes on. By one thread.
void list_tile_members(Rows<const i64, 2> low, Rows<const i64, 2> high, i64 across, Array1<i64> next,
                              Array1<i64> members, i64, i64) {
    for (i64 f = 0; f < low.shape[0]; ++f)
        mesh_visibility::each_tile(low, high, f, across, [&](i64 tile) { members(next(tile)++) = f; });
}

// Sets visible [M] to false where a triangle cuts the line from the origin to a point [M, 3]. tile: [M] of each point;
// corners: [F, 3, 3]; uvs: [F, 3, 2]; alpha: [h, w] coverage, [1, 1] where all is solid; tile t's triangles are
// members[starts[t] : starts[t + 1]].
void hide_points(Rows<const double, 3> points, Array1<const i64> tile, Pixels<const double, 3> corners,
                        Pixels<const double, 2> uvs, Array2<const u8> alpha, Array1<const i64> starts,
                        Array1<const i64> members, Array1<bool> visible, i64 thread, i64 threads) {
    using namespace mesh_visibility;
    const i64 height = alpha.shape[0], width = alpha.shape[1], count = points.shape[0];
    const bool holes = height > 1 || width > 1;
    auto hidden = [&](i64 i) {
        const double px = points(i, 0), py = points(i, 1), pz = points(i, 2);
        for (i64 k = starts(tile(i)); k < starts(tile(i) + 1); ++k) {
            const i64 f = members(k);
            const double ax = corners(f, 0, 0), ay = corners(f, 0, 1), az = corners(f, 0, 2);
            const double ux = corners(f, 1, 0) - ax, uy = corners(f, 1, 1) - ay, uz = corners(f, 1, 2) - az;
            const double vx = corners(f, 2, 0) - ax, vy = corners(f, 2, 1) - ay, vz = corners(f, 2, 2) - az;
            // The point x the second edge
            const double cx = py * vz - pz * vy, cy = pz * vx - px * vz, cz = px * vy - py * vx;
            const double det = ux * cx + uy * cy + uz * cz;
            if (det == 0) continue;
            const double b = -(ax * cx + ay * cy + az * cz) / det;
            if (b < 0 || b > 1) continue;
            // - corner x the first edge
            const double qx = -ay * uz + az * uy, qy = -az * ux + ax * uz, qz = -ax * uy + ay * ux;
            const double c = (px * qx + py * qy + pz * qz) / det;
            if (c < 0 || b + c > 1) continue;
            const double t = (vx * qx + vy * qy + vz * qz) / det;
            if (t <= 0 || t >= 1 - DEPTH_SLACK) continue;
            if (holes) {
                const double a = 1 - b - c;
                const double u = a * uvs(f, 0, 0) + b * uvs(f, 1, 0) + c * uvs(f, 2, 0);
                const double v = 1 - (a * uvs(f, 0, 1) + b * uvs(f, 1, 1) + c * uvs(f, 2, 1));
                if (alpha(texel(v, height), texel(u, width)) < MIN_COVERAGE) continue;
            }
            return true;
        }
        return false;
    };
    for (i64 i = count * thread / threads; i < count * (thread + 1) / threads; ++i)
        if (visible(i) && hidden(i)) visible(i) = false;
}

} }  // namespace sp
