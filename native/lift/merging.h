// With which Gaussian each of a mixture is joined at the least cost; lift/local/gaussian_merging.py explains it.
#pragma once
#include "../maths.h"

namespace sp { namespace {

namespace merging {
// Cells along an axis run from -CELLS to CELLS: a key is (x 2 CELLS + y) 2 CELLS + z.
constexpr i64 CELLS = 1 << 20, ROW = 2 * CELLS;
constexpr double MAX_LOSS = 0.3, SHAPE_COST = 0.02;
}  // namespace merging

// Of M Gaussians in ascending order of their cells' keys. covariances: [M, 3, 3] blurred; log_volumes: [M] of these;
// slots: [M], no two of which are joined; limit: of the squared distance that a pair may have, over the larger of
// their traces and by their shares; costs: [M] the highest that a partner may have; partners: [M] -1. By one thread:
// each pair is looked at once, for both.
void find_partners(Array1<const i64> keys, Rows<const double, 3> points, Array3<const double> covariances,
                          Array1<const double> log_volumes, Array1<const double> masses, Rows<const double, 3> colors,
                          Array1<const double> pixels, Array1<const bool> slots, double limit, Array1<double> costs,
                          Array1<i64> partners, i64, i64) {
    using namespace merging;
    const i64 count = keys.shape[0];
    i64 begins[5] = {};  // of the four rows of cells after that of each one, from 1 on; they only move on
    for (i64 i = 0; i < count; ++i) {
        const double xi = points(i, 0), yi = points(i, 1), zi = points(i, 2);
        for (int k = 0; k < 5; ++k) {
            i64 begin = i + 1, last = keys(i) + 1;
            if (k > 0) {
                const i64 first = keys(i) + (k == 1 ? ROW : ROW * ROW + ROW * (k - 3)) - 1;
                last = first + 2;
                while (begins[k] < count && keys(begins[k]) < first) ++begins[k];
                begin = begins[k];
            }
            for (i64 j = begin; j < count && keys(j) <= last; ++j) {
                if (slots(i) && slots(j)) continue;
                // What it costs in colour: most pairs fail here, before anything dear is computed.
                const double total = pixels(i) + pixels(j);
                const double red = colors(i, 0) - colors(j, 0), green = colors(i, 1) - colors(j, 1);
                const double blue = colors(i, 2) - colors(j, 2);
                const double squares = red * red + green * green + blue * blue;
                double cost = squares * pixels(i) * pixels(j) / (3 * total);
                if (cost >= costs(i) && cost >= costs(j)) continue;
                const double x = points(j, 0) - xi, y = points(j, 1) - yi, z = points(j, 2) - zi;
                const double share = masses(i) / (masses(i) + masses(j)), other = 1 - share, spread = share * other;
                const double* p = &covariances(i, 0, 0);
                const double* q = &covariances(j, 0, 0);
                const double size = max_of(p[0] + p[4] + p[8], q[0] + q[4] + q[8]);
                if (spread * (x * x + y * y + z * z) > limit * size) continue;
                // Volume of the joined one: the determinant of its covariance.
                const double a = share * p[0] + other * q[0] + spread * x * x;
                const double b = share * p[1] + other * q[1] + spread * x * y;
                const double c = share * p[2] + other * q[2] + spread * x * z;
                const double d = share * p[4] + other * q[4] + spread * y * y;
                const double e = share * p[5] + other * q[5] + spread * y * z;
                const double f = share * p[8] + other * q[8] + spread * z * z;
                const double volume = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d);
                const double loss = 0.5 * (log_of(volume) - share * log_volumes(i) - other * log_volumes(j));
                if (!(loss < MAX_LOSS)) continue;
                cost += SHAPE_COST * total * max_of(loss, 0.0);
                if (cost < costs(i)) costs(i) = cost, partners(i) = j;
                if (cost < costs(j)) costs(j) = cost, partners(j) = i;
            }
        }
    }
}

} }  // namespace sp
