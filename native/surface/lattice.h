// The lattice of points at which one view's surface is estimated: splatpainter/surface/visible.py.
#pragma once
#include "../maths.h"
#include "../vectors.h"

namespace sp { namespace {
namespace surface {
constexpr double MIN_QUAT_LENGTH = 1e-15, MIN_THICKNESS_SHARE = 1e-3;
}  // namespace surface

// One pixel with an entry per block of step x step pixels of entry [H, W]: chosen [LH, LW] is the first of `order`
// ([step step], places in a block, row by row) that has one; -1: none.
void choose_lattice_pixels(Array2<const i32> entry, Array1<const i64> order, i64 step, Array2<i32> chosen, i64 thread,
                           i64 threads) {
    const i64 height = entry.shape[0], width = entry.shape[1];
    checked((height - 1) / step, chosen.shape[0]), checked((width - 1) / step, chosen.shape[1]);
    const Share share = share_of(chosen.shape[0], thread, threads);
    for (i64 by = share.begin; by < share.end; ++by)
        for (i64 bx = 0; bx < chosen.shape[1]; ++bx) {
            i32 found = -1;
            for (i64 k = 0; k < order.shape[0] && found < 0; ++k) {
                const i64 place = order(k), y = by * step + place / step, x = bx * step + place % step;
                if (y < height && x < width && entry(y, x) >= 0) found = (i32)place;
            }
            chosen(by, bx) = found;
        }
}

// out [Q, 2]: z-depth at which each Gaussian ids [Q] is densest along its ray ([Q, 3], camera space), within two of
// its longest standard deviations; its width, the root of the product of the two longer ones. No axis counts as shorter
// than a thousandth of the longest. world_to_camera: [4, 4].
template <class F>
void measure_depths_along(Rows<const F, 3> means, Rows<const F, 4> quats, Rows<const F, 3> scales,
                          Array1<const i64> ids, Rows<const double, 3> rays, Rows<const double, 4> world_to_camera,
                          Rows<double, 2> out, i64 thread, i64 threads) {
    const double *turn[3] = {world_to_camera.row(0), world_to_camera.row(1), world_to_camera.row(2)};
    const Share share = share_of(ids.shape[0], thread, threads);
    for (i64 q = share.begin; q < share.end; ++q) {
        const i64 id = ids(q);
        const F *m = means.row(id), *w = quats.row(id), *s = scales.row(id);
        const double* ray = rays.row(q);
        // Rotation of the quaternion, then of the camera; sums run from the first term to the last.
        const double q0 = w[0], q1 = w[1], q2 = w[2], q3 = w[3];
        const double norm = larger_of(sqrt_of(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3), surface::MIN_QUAT_LENGTH);
        const double r = q0 / norm, x = q1 / norm, y = q2 / norm, z = q3 / norm;
        const double rotation[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - r * z), 2 * (x * z + r * y)},
                                       {2 * (x * y + r * z), 1 - 2 * (x * x + z * z), 2 * (y * z - r * x)},
                                       {2 * (x * z - r * y), 2 * (y * z + r * x), 1 - 2 * (x * x + y * y)}};
        double mean[3], axes[3][3];
        for (int i = 0; i < 3; ++i) {
            const double* row = turn[i];
            mean[i] = m[0] * row[0] + m[1] * row[1] + m[2] * row[2] + row[3];
            for (int c = 0; c < 3; ++c)
                axes[i][c] = row[0] * rotation[0][c] + row[1] * rotation[1][c] + row[2] * rotation[2][c];
        }
        const double longest = larger_of(larger_of((double)s[0], (double)s[1]), (double)s[2]);
        double size[3], along[3], offset[3];
        // The densest point along a ray, in the Gaussian's own axes, where it is a unit sphere.
        for (int c = 0; c < 3; ++c) {
            size[c] = larger_of((double)s[c], surface::MIN_THICKNESS_SHARE * longest);
            along[c] = (axes[0][c] * ray[0] + axes[1][c] * ray[1] + axes[2][c] * ray[2]) / size[c];
            offset[c] = (axes[0][c] * mean[0] + axes[1][c] * mean[1] + axes[2][c] * mean[2]) / size[c];
        }
        const double square = along[0] * along[0] + along[1] * along[1] + along[2] * along[2];
        const double depth =
            (along[0] * offset[0] + along[1] * offset[1] + along[2] * offset[2]) / larger_of(square, 1e-300);
        const double most = larger_of(larger_of(size[0], size[1]), size[2]), reach = 2 * most;
        out(q, 0) = smaller_of(larger_of(depth, mean[2] - reach), mean[2] + reach);
        // The two longer ones, the shorter of them first.
        const double middle = larger_of(smaller_of(size[0], size[1]), smaller_of(larger_of(size[0], size[1]), size[2]));
        out(q, 1) = sqrt_of(middle * most);
    }
}

// out [L]: how many of a lattice point's eight neighbours in index [LH, LW] (-1: none) are valid and lie on its plane,
// as it lies on theirs: within `share` of the smaller window.
void count_agreeing(Array2<const i32> index, Rows<const double, 3> points, Rows<const double, 3> normals,
                    Array1<const double> windows, Array1<const bool> valid, double share, Array1<i64> out, i64 thread,
                    i64 threads) {
    const i64 height = index.shape[0], width = index.shape[1];
    const Share part = share_of(height, thread, threads);
    for (i64 y = part.begin; y < part.end; ++y)
        for (i64 x = 0; x < width; ++x) {
            const i32 a = index(y, x);
            if (a < 0) continue;
            i64 count = 0;
            for (i64 v = max_of<i64>(y - 1, 0); v < min_of(y + 2, height); ++v)
                for (i64 u = max_of<i64>(x - 1, 0); u < min_of(x + 2, width); ++u) {
                    const i32 b = index(v, u);
                    if (b < 0 || b == a || !valid(b)) continue;
                    const Vector way = vector_from(points.row(b)) - vector_from(points.row(a));
                    const double off_here = abs_of(dot(way, vector_from(normals.row(a))));
                    const double off_there = abs_of(dot(way, vector_from(normals.row(b))));
                    const double limit = share * windows(a), other = share * windows(b);
                    count += off_here < limit && off_here < other && off_there < limit && off_there < other;
                }
            out(a) = count;
        }
}

} }  // namespace sp
