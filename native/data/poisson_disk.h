// Poisson-disk selection of points on surfaces and their distances, by a grid of linked lists; as
// splattrain/data/poisson_disk.py says.
#pragma once
#include "../maths.h"

namespace sp { namespace {

namespace poisson_disk {
constexpr float SAME_SIDE = 0.25f;  // cosine of normals below which points lie on different sides
constexpr int NEIGHBOURS = 5;

struct Cell { i64 x, y, z; };

// Points in cells of a grid: `heads` is the last that came into each cell, -1 where none did, `following` the one that
// came before a point.
struct Grid {
    Array<const float, 1, 3> low;
    float size;
    Array<const i64, 1, 3> dims;

    i64 index(float position, int axis) const {
        return integer_of<i64>((position - low(axis)) / size, 0, dims(axis) - 1);
    }
    Cell of(const float* p) const { return {index(p[0], 0), index(p[1], 1), index(p[2], 2)}; }
    i64 number(Cell c) const { return (c.x * dims(1) + c.y) * dims(2) + c.z; }

    void put(i64 i, Cell cell, Array1<i32> heads, Array1<i32> following) const {
        following(i) = heads(number(cell));
        heads(number(cell)) = (i32)i;
    }
    // Calls with every point in a cell and the 26 around it, until one call returns false.
    template <class Look>
    void around(Cell c, Array1<const i32> heads, Array1<const i32> following, Look look) const {
        for (i64 x = max_of<i64>(c.x - 1, 0); x < min_of(c.x + 2, dims(0)); ++x)
            for (i64 y = max_of<i64>(c.y - 1, 0); y < min_of(c.y + 2, dims(1)); ++y)
                for (i64 z = max_of<i64>(c.z - 1, 0); z < min_of(c.z + 2, dims(2)); ++z)
                    for (i64 j = heads(number({x, y, z})); j >= 0; j = following(j))
                        if (!look(j)) return;
    }
};

SP_INLINE float squared_distance(const float* p, const float* q) {
    const float a = p[0] - q[0], b = p[1] - q[1], c = p[2] - q[2];
    return a * a + b * b + c * c;
}
SP_INLINE float cosine(const float* n, const float* m) { return n[0] * m[0] + n[1] * m[1] + n[2] * m[2]; }
SP_INLINE Array1<const i32> unchanged(Array1<i32> array) { return {array.data, {array.shape[0]}}; }
}  // namespace poisson_disk

// Puts points [M, 3] into the grid of `dims` cells of a size from `low` on. heads: [cells] -1; following: [M]. By one
// thread.
void fill_point_grid(Rows<const float, 3> points, Array<const float, 1, 3> low, float size, Array<const i64, 1, 3> dims,
                            Array1<i32> heads, Array1<i32> following, i64, i64) {
    const poisson_disk::Grid grid{low, size, dims};
    for (i64 i = 0; i < points.shape[0]; ++i) grid.put(i, grid.of(points.row(i)), heads, following);
}

// Takes points in `order` that keep `reach` from those taken before, until none are left to take; left: [1] how many.
// By one thread.
void throw_points(Rows<const float, 3> points, Rows<const float, 3> normals, Array1<const i64> order,
                         Array1<bool> taken, Array1<i32> heads, Array1<i32> following, Array<const float, 1, 3> low,
                         float size, float reach, Array<const i64, 1, 3> dims, Array1<i64> left, i64, i64) {
    using namespace poisson_disk;
    const Grid grid{low, size, dims};
    const float limit = reach * reach;
    for (i64 k = 0; k < order.shape[0] && left(0) > 0; ++k) {
        const i64 i = order(k);
        if (taken(i)) continue;
        const float *p = points.row(i), *n = normals.row(i);
        const Cell cell = grid.of(p);
        bool free = true;
        grid.around(cell, unchanged(heads), unchanged(following), [&](i64 j) {
            free = !(squared_distance(p, points.row(j)) < limit && cosine(n, normals.row(j)) > SAME_SIDE);
            return free;
        });
        if (!free) continue;
        taken(i) = true;
        grid.put(i, cell, heads, following);
        --left(0);
    }
}

// Mean distance of each point to the nearest NEIGHBOURS of the same side, at most `size`. out: [M].
void take_mean_distances(Rows<const float, 3> points, Rows<const float, 3> normals, Array1<const i32> heads,
                                Array1<const i32> following, Array<const float, 1, 3> low, float size,
                                Array<const i64, 1, 3> dims, Array1<float> out, i64 thread, i64 threads) {
    using namespace poisson_disk;
    const Grid grid{low, size, dims};
    const i64 count = points.shape[0];
    for (i64 i = count * thread / threads; i < count * (thread + 1) / threads; ++i) {
        const float *p = points.row(i), *n = normals.row(i);
        float best[NEIGHBOURS];
        for (float& square : best) square = grid.size * grid.size;
        grid.around(grid.of(p), heads, following, [&](i64 j) {
            const float square = squared_distance(p, points.row(j));
            if (square < best[NEIGHBOURS - 1] && j != i && cosine(n, normals.row(j)) > SAME_SIDE) {
                int k = NEIGHBOURS - 1;
                for (; k > 0 && best[k - 1] > square; --k) best[k] = best[k - 1];
                best[k] = square;
            }
            return true;
        });
        float total = 0;
        for (float square : best) total += sqrt_of(square);
        out(i) = total / (float)NEIGHBOURS;
    }
}

// The centre closest to each point, where a different orientation counts as distance: `turn` is its square for a right
// angle. The grid is that of the centres. out: [M], -1 where there is none around.
void find_closest_centers(Rows<const float, 3> points, Rows<const float, 3> normals, Rows<const float, 3> centers,
                                 Rows<const float, 3> center_normals, Array1<const i32> heads,
                                 Array1<const i32> following, Array<const float, 1, 3> low, float size,
                                 Array<const i64, 1, 3> dims, double turn, Array1<i64> out, i64 thread, i64 threads) {
    using namespace poisson_disk;
    const Grid grid{low, size, dims};
    const i64 count = points.shape[0];
    for (i64 i = count * thread / threads; i < count * (thread + 1) / threads; ++i) {
        const float *p = points.row(i), *n = normals.row(i);
        double nearest = 1e30;
        i64 closest = -1;
        grid.around(grid.of(p), heads, following, [&](i64 j) {
            const double aside = 1.0 - (double)cosine(n, center_normals.row(j));
            const double square = (double)squared_distance(p, centers.row(j)) + turn * aside;
            if (square < nearest) nearest = square, closest = j;
            return true;
        });
        out(i) = closest;
    }
}

} }  // namespace sp
