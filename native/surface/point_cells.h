// Points in cubes, sorted by the cube that each lies in: `PointCells` of splatpainter/surface/unwrap.py.
#pragma once
#include "../search.h"
#include "../vectors.h"

namespace sp { namespace {

namespace point_cells {
constexpr int CELL_BITS = 21;  // of a cell's index along each axis
constexpr i64 LAST = (i64(1) << CELL_BITS) - 1;
}  // namespace point_cells
// Points of PointCells.sorted_rows that kernels read at a time, and their numbers.
constexpr int READ_AT_ONCE = 8;
alignas(64) constexpr double COUNTING[READ_AT_ONCE] = {0, 1, 2, 3, 4, 5, 6, 7};

struct Cell { i64 x, y, z; };

struct PointCells {
    Array1<const i64> keys, order;
    Array1<const double> corner;
    double size;

    // The cell of a position: -1 below the first one, and for NaN.
    SP_INLINE Cell floored(Vector p) const {
        const Vector c = in_cells(p);
        return {index(__builtin_floor(c.x)), index(__builtin_floor(c.y)), index(__builtin_floor(c.z))};
    }
    // The same, but that one cell before the first one counts as the first.
    SP_INLINE Cell truncated(Vector p) const {
        const Vector c = in_cells(p);
        return {index(__builtin_trunc(c.x)), index(__builtin_trunc(c.y)), index(__builtin_trunc(c.z))};
    }

    // visit(first, last): the entries of each row of cells along z, of those 27 around one. Rows come in the order of
    // keys, so that each is looked for behind the last one; a visit that returns false ends them.
    template <class Visit>
    SP_INLINE void rows_around(Cell cell, Visit visit) const {
        const i64 count = keys.shape[0], z0 = max_of<i64>(cell.z - 1, 0), z1 = cell.z + 1;
        i64 last = 0;
        for (i64 x = max_of<i64>(cell.x - 1, 0); x <= min_of(cell.x + 1, point_cells::LAST); ++x) {
            const i64 plane = x << 2 * point_cells::CELL_BITS, y0 = max_of<i64>(cell.y - 1, 0);
            for (i64 y = y0; y <= cell.y + 1; ++y) {
                const i64 row = plane | (y << point_cells::CELL_BITS);
                const i64 first = y == y0 ? first_not_below(keys, last, count, row | z0)
                                          : first_not_below_near(keys, last, count, row | z0);
                for (last = first; last < count && keys(last) <= (row | z1);) ++last;
                if (first < last && !visit(first, last)) return;
            }
        }
    }

    // visit(point) for each point in the 27 cells around one, until a call returns false.
    template <class Visit>
    SP_INLINE void around(Cell cell, Visit visit) const {
        rows_around(cell, [&](i64 first, i64 last) {
            for (i64 k = first; k < last; ++k)
                if (!visit(order(k))) return false;
            return true;
        });
    }

private:
    SP_INLINE Vector in_cells(Vector p) const {
        return {(p.x - corner(0)) / size, (p.y - corner(1)) / size, (p.z - corner(2)) / size};
    }
    // Clamped as a float, because casts of what an integer cannot hold are undefined. What lies beyond the last cell is
    // looked for there, and is too far away from everything in it.
    static SP_INLINE i64 index(double x) {
        x = x > -1.0 ? x : -1.0;
        return (i64)(x < (double)point_cells::LAST ? x : (double)point_cells::LAST);
    }
};

} }  // namespace sp
