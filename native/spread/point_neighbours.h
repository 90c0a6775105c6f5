// The nearest neighbours of every point, and means over them; as splatpainter/spread/nearest_neighbours.py says.
#pragma once
#include "../maths.h"
#include "../search.h"

namespace sp { namespace {

namespace point_neighbours {
constexpr int NEIGHBOURS = 16, MAX_RINGS = 3, MAX_TESTED = 4096, BITS = 20;
constexpr i64 POINTS_PER_BLOCK = 256;  // that a thread takes at a time

template <class Each> SP_INLINE void share_out(i64 count, i64 thread, i64 threads, Each each) {
    for (i64 start = thread * POINTS_PER_BLOCK; start < count; start += threads * POINTS_PER_BLOCK)
        for (i64 i = start; i < min_of(count, start + POINTS_PER_BLOCK); ++i) each(i);
}

// The nearest so far, in rising distance; of equal ones those that came first.
struct Nearest {
    static constexpr int ROOM = NEIGHBOURS - 1;  // a point itself is the first of its neighbours
    i64 ids[ROOM];
    double squares[ROOM];
    int filled = 0;

    bool full() const { return filled == ROOM; }
    void insert(i64 id, double square) {
        if (full() && square >= squares[ROOM - 1]) return;
        int slot = full() ? ROOM - 1 : filled;
        for (; slot > 0 && squares[slot - 1] > square; --slot)
            squares[slot] = squares[slot - 1], ids[slot] = ids[slot - 1];
        squares[slot] = square, ids[slot] = id;
        filled = min_of(filled + 1, ROOM);
    }
};
}  // namespace point_neighbours

// keys: [M] ascending, of the cubes in which points lie; order: [M] the points in that order; cells: [M, 3] cube of
// each point; size: of a cube, world units; out: [M, NEIGHBOURS].
void find_neighbours(Rows<const double, 3> points, Array1<const i64> keys, Array1<const i64> order,
                            Rows<const i64, 3> cells, double size, Rows<i32, point_neighbours::NEIGHBOURS> out,
                            i64 thread, i64 threads) {
    using namespace point_neighbours;
    const i64 count = keys.shape[0];
    share_out(points.shape[0], thread, threads, [&](i64 i) {
        const double px = points(i, 0), py = points(i, 1), pz = points(i, 2);
        Nearest near;
        for (i64 ring = 1; ring <= MAX_RINGS; ++ring) {
            near.filled = 0;
            int tested = 0;
            for (i64 x = cells(i, 0) - ring; x <= cells(i, 0) + ring; ++x)
                for (i64 y = cells(i, 1) - ring; y <= cells(i, 1) + ring; ++y) {
                    const i64 row = (x << 2 * BITS) | (y << BITS), last = row | (cells(i, 2) + ring);
                    i64 k = first_not_below(keys, 0, count, row | (cells(i, 2) - ring));
                    for (; k < count && keys(k) <= last && tested < MAX_TESTED; ++k, ++tested) {
                        const i64 j = order(k);
                        if (j == i) continue;
                        const double dx = points(j, 0) - px, dy = points(j, 1) - py, dz = points(j, 2) - pz;
                        near.insert(j, dx * dx + dy * dy + dz * dz);
                    }
                }
            // Beyond the ring nothing nearer can be.
            const double reach = (double)ring * size;
            if (near.full() && (near.squares[near.filled - 1] <= reach * reach || tested >= MAX_TESTED)) break;
        }
        i32* row = out.row(i);
        row[0] = (i32)i;
        for (int n = 0; n < Nearest::ROOM; ++n) row[n + 1] = (i32)(n < near.filled ? near.ids[n] : i);
    });
}

// Mean and standard deviation of values [M, C] over the neighbours near [M, K] of each point, by weights [M] > 0.
void take_neighbour_means(Array2<const float> values, Array1<const float> weights, Array2<const i32> near,
                                 Array2<float> mean, Array2<float> deviation, i64 thread, i64 threads) {
    const i64 links = near.shape[1], channels = values.shape[1];
    point_neighbours::share_out(near.shape[0], thread, threads, [&](i64 i) {
        double total = 0;
        for (i64 n = 0; n < links; ++n) total += weights(near(i, n));
        for (i64 c = 0; c < channels; ++c) {
            double first = 0, second = 0;
            for (i64 n = 0; n < links; ++n) {
                const double w = weights(near(i, n)) / total, v = values(near(i, n), c);
                first += w * v;
                second += w * v * v;
            }
            mean(i, c) = (float)first;
            deviation(i, c) = (float)sqrt_of(max_of(second - first * first, 0.0));
        }
    });
}

// after_i = hold_i target_i + (1 - hold_i) sum_n links_in now_near(i,n).
void smooth_once(Array1<const float> now, Array1<const float> target, Array1<const float> hold,
                        Array2<const float> links, Array2<const i32> near, Array1<float> after, i64 thread,
                        i64 threads) {
    const i64 count = near.shape[1];
    point_neighbours::share_out(near.shape[0], thread, threads, [&](i64 i) {
        double total = 0;
        for (i64 n = 0; n < count; ++n) total += (double)links(i, n) * (double)now(near(i, n));
        const double held = hold(i);
        after(i) = (float)(held * (double)target(i) + (1.0 - held) * total);
    });
}

} }  // namespace sp
