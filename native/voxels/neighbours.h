// Points near to points and what hangs together, as in splatpainter/voxels/neighbours.py.
#pragma once
#include "../maths.h"
#include "../search.h"
#include "../vectors.h"

namespace sp { namespace {
namespace neighbours {
constexpr int CELL_BITS = 20;            // of a cube's index along each axis
constexpr i64 QUERIES_PER_BLOCK = 256;   // that a thread takes at a time
}  // namespace neighbours

// The point nearest to each query within a radius, among the 27 cubes around it; of equally near ones the first in the
// order of keys. `nearest` and `distance` stay as they are where there is none.
inline void find_nearest(Rows<const double, 3> points, Rows<const double, 3> queries, Array1<const i64> keys,
                         Array1<const i64> order, Rows<const i64, 3> cells, double radius, Array1<i64> nearest,
                         Array1<double> distance, i64 thread, i64 threads) {
    using namespace neighbours;
    const i64 count = queries.shape[0];
    for (i64 start = thread * QUERIES_PER_BLOCK; start < count; start += threads * QUERIES_PER_BLOCK)
        for (i64 i = start; i < min_of(start + QUERIES_PER_BLOCK, count); ++i) {
            const Vector query = vector_from(queries.row(i));
            const i64* cell = cells.row(i);
            double least = radius * radius;
            i64 best = -1;
            for (i64 x = cell[0] - 1; x < cell[0] + 2; ++x)
                for (i64 y = cell[1] - 1; y < cell[1] + 2; ++y) {
                    const i64 row = (x << 2 * CELL_BITS) | (y << CELL_BITS), last = row | (cell[2] + 1);
                    i64 k = first_not_below(keys, 0, keys.shape[0], row | (cell[2] - 1));
                    for (; k < keys.shape[0] && keys(k) <= last; ++k) {
                        const i64 j = order(k);
                        const Vector d = vector_from(points.row(j)) - query;
                        const double square = dot(d, d);
                        if (square < least || (best < 0 && square == least)) least = square, best = j;
                    }
                }
            if (best >= 0) nearest(i) = best, distance(i) = sqrt_of(least);
        }
}

// The first of the labels that hang together with k, and every step to it halved.
SP_INLINE i64 root_of(const Array1<i64>& parents, i64 k) {
    while (parents(k) != k) {
        parents(k) = parents(parents(k));
        k = parents(k);
    }
    return k;
}

// Makes the labels one[i] and two[i] the same for every i, the smaller one. One thread: each depends on those before.
inline void join_labels(Array1<const i64> one, Array1<const i64> two, Array1<i64> parents, i64 thread, i64) {
    if (thread != 0) return;
    for (i64 i = 0; i < one.shape[0]; ++i) {
        const i64 a = root_of(parents, one(i)), b = root_of(parents, two(i));
        if (a < b) parents(b) = a;
        else if (b < a) parents(a) = b;
    }
}

// Every label's first one.
inline void flatten_labels(Array1<i64> parents, i64 thread, i64) {
    if (thread != 0) return;
    for (i64 k = 0; k < parents.shape[0]; ++k) parents(k) = root_of(parents, k);
}

} }  // namespace sp
