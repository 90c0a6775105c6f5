// The exponential map around a point of a surface, and the smoothing and thinning of its samples, as in
// splatpainter/surface/unwrap.py, which explains them.
#pragma once
#include "../maths.h"
#include "falloff.h"
#include "point_cells.h"

namespace sp { namespace {
namespace unwrapping {

constexpr i64 MAX_NEIGHBOURS = 256;    // of a sample; beyond them it has none
constexpr i64 POINTS_PER_BLOCK = 256;  // that a thread takes at a time
// Cosines of 120 degrees, at most between the normals of neighbours, and of 20, from which a step turns around the line
// where both tangent planes meet.
constexpr double MAX_CREASE_COSINE = -0.4999999999999998, HINGE_COSINE = 0.9396926207859084;
// Sine of the angle at which a neighbour may lie above or below the tangent plane, where the normals agree.
constexpr double MAX_LIFT = 0.35;
// Spacings by which neighbours may disagree about a point and still be averaged: behind a bump, ways around it meet.
constexpr double SAME_SHEET = 1.5;
constexpr double WEIGHT_WIDTH = 0.8;  // standard deviation of the weights of neighbours, in spacings
// No way is shorter than so many straight lines: where that is too long already, the way need not be measured.
constexpr double MIN_CHORD_RATIO = 1 - 1e-6;
constexpr double MIN_AGREEING_COSINE = 0.2;  // between the normals of a query and of a sample that smooths it
constexpr double SMOOTHED_TURN = 0.4;        // by which it is below 1 where a sample's weight has fallen to 1/e

struct Samples {
    Rows<const double, 3> points, normals;
    double spacing, reach;  // reach: distance up to which samples are neighbours
    PointCells cells;
};

// Samples that are neighbours of a point with a normal, into `out`; returns how many. i: the point itself, or -1.
inline i64 neighbours(const Samples& s, i64 i, Vector p, Vector n, i64* out) {
    i64 count = 0;
    const Cell cell = s.cells.truncated(p);
    if (cell.x < 0 || cell.y < 0 || cell.z < 0) return 0;
    s.cells.around(cell, [&](i64 j) {
        if (j == i) return true;
        const Vector q = vector_from(s.points.row(j)), m = vector_from(s.normals.row(j)), d = q - p;
        const double square = dot(d, d);
        if (square > s.reach * s.reach) return true;
        const double cosine = dot(m, n);
        if (cosine < MAX_CREASE_COSINE) return true;
        // Along the mean normal a neighbour lies at most so high, more where the normals part.
        const Vector mean = m + n;
        const double height = abs_of(dot(d, mean)) / length_of(mean);
        const double half_sine = sqrt_of(max_of(0.5 - 0.5 * cosine, 0.0));
        if (height > (MAX_LIFT + 0.55 * half_sine) * sqrt_of(square) + 1e-12) return true;
        if (count < MAX_NEIGHBOURS) out[count++] = j;
        return true;
    });
    return count;
}

// Of a number, or of as many as a register holds.
template <class V>
struct Step {
    V length, u, v;
    Vec3<V> right;
};

// A way along an arc over its chord: t / sin t for t = share atan(half), half = sine / (1 + cosine) being the tangent
// of half the angle between the normals, share 0 to 1.
SP_INLINE double arc_over_chord(double half, double share) {
    const double turn = atan_of(half) * share;
    return turn > 1e-4 ? turn / sin_of(turn) : 1.0;
}
// Series for angles of up to 22 degrees, to a relative error of 1e-12.
SP_INLINE Wide<double> arc_over_chord(Wide<double> half, Wide<double> share) {
    using V = Wide<double>;
    const V x = half * half;
    V atan = {};
    for (int k = 15; k > 0; k -= 2) atan = 1.0 / k - x * atan;
    const V turn = half * atan * share, y = turn * turn;
    V out = 1.0 + y * (1.0 / 6 + y * (7.0 / 360 + y * (31.0 / 15120 + y * (127.0 / 604800 + y * (73.0 / 3421440)))));
    const auto large = ~(half <= 0.2);
    if (bits_where(large))
        for (int l = 0; l < W<double>; ++l)
            if (large[l]) out[l] = arc_over_chord((double)half[l], (double)share[l]);
    return out;
}

// The step from a sample to a neighbour q with normal m: its length, (u, v) of the way, and the direction of right
// there.
template <class V>
SP_INLINE Step<V> step_to(Vec3<V> point, Vec3<V> n, Vec3<V> right, Vec3<V> q, Vec3<V> m) {
    const V zero = V{}, one = zero + 1.0, least = zero + 1e-30;
    auto larger = [](V x, V y) { return y > x ? y : x; };
    auto norm = [](Vec3<V> x) { return root_of(dot(x, x)); };
    const Vec3<V> d = q - point;
    // Right, turned with the normal by the smallest rotation: v - (v.(n + m)) / (1 + n.m) (n + m), for v.n = 0; then
    // made exactly tangent and exactly unit.
    const V cosine = dot(n, m), half_turn = larger(one + cosine, zero + 1e-9);
    Vec3<V> r = right - (dot(right, m) / half_turn) * (n + m);
    r = r - dot(r, m) * m;
    r = (one / larger(norm(r), least)) * r;
    const Vec3<V> up = cross(n, right), hinge = cross(n, m);
    const V chord = norm(d), sine = norm(hinge);
    // Around the line where the planes meet, if they meet at a crease and each end lies on its side of it: along that
    // line, then across it in both planes.
    const Vec3<V> line = (one / larger(sine, least)) * hinge, out = cross(line, n);  // out: across, in the first plane
    const V second = -dot(d, n) / larger(sine, least), first = dot(d, out) - second * cosine;
    const V across = first + second, along = dot(d, line);
    const Vec3<V> way = across * out + along * line;
    const auto creased = (cosine < HINGE_COSINE) & (sine > 1e-6) & (first * second >= 0.0);
    // Else as an arc: its chord lies half-way between both tangent planes.
    const V c0 = dot(d, right) + dot(d, r), c1 = dot(d, up) + dot(d, cross(m, r)), scale = root_of(c0 * c0 + c1 * c1);
    const auto pointed = scale > 1e-12 * chord;
    const V lever = norm(cross(d, hinge)) / larger(sine * chord, least);
    const V arc = chord * arc_over_chord(sine / half_turn, lever), share = pointed ? arc / scale : zero;
    const auto still = chord <= 0.0;
    const V length = creased ? root_of(across * across + along * along) : (pointed ? arc : chord);
    const V u = creased ? dot(way, right) : share * c0, v = creased ? dot(way, up) : share * c1;
    return {still ? zero : length, still ? zero : u, still ? zero : v, r};
}

struct Place {
    i64 nearest;  // the neighbour with the shortest way to it, -1 where none is reached
    double u, v;
    Vector right;
};

// What the map is while it grows: infinite distances where it is not yet.
struct Map {
    Rows<const double, 2> uv;
    Rows<const double, 3> right;
    Array1<const double> distances;
};

// What `average` writes on: the reached neighbours and the steps from them, each number of all of them in a row.
struct Ways {
    i64 samples[MAX_NEIGHBOURS];
    alignas(64) double from[12][MAX_NEIGHBOURS], length[MAX_NEIGHBOURS], step[6][MAX_NEIGHBOURS];
};

// Where the reached ones of some neighbours see a point.
SP_SMALL Place average(const Samples& s, const Map& map, const i64* near, i64 count, Vector p, Vector n, Ways& ways) {
    using V = Wide<double>;
    i64 reached = 0;
    for (i64 k = 0; k < count; ++k) {
        const i64 j = near[k];
        if (!(map.distances(j) < INFINITE)) continue;
        const double *point = s.points.row(j), *normal = s.normals.row(j), *right = map.right.row(j);
        for (int a = 0; a < 3; ++a) {
            ways.from[a][reached] = point[a], ways.from[3 + a][reached] = normal[a];
            ways.from[6 + a][reached] = right[a];
        }
        ways.from[9][reached] = map.uv(j, 0), ways.from[10][reached] = map.uv(j, 1);
        ways.from[11][reached] = map.distances(j);
        ways.samples[reached++] = j;
    }
    if (reached == 0) return {-1, 0.0, 0.0, {0.0, 0.0, 0.0}};
    // Steps from all of them, as many at a time as a register holds; lanes behind the last one do as it does.
    for (i64 k = reached; k % W<double>; ++k)
        for (auto& row : ways.from) row[k] = row[reached - 1];
    const Vec3<V> target = {all(p.x), all(p.y), all(p.z)}, facing = {all(n.x), all(n.y), all(n.z)};
    const double width = WEIGHT_WIDTH * s.spacing, sheet = (SAME_SHEET * s.spacing) * (SAME_SHEET * s.spacing);
    for (i64 k = 0; k < reached; k += W<double>) {
        auto from = [&](int row) { return load(&ways.from[row][k]); };
        const Step<V> step = step_to<V>({from(0), from(1), from(2)}, {from(3), from(4), from(5)},
                                        {from(6), from(7), from(8)}, target, facing);
        const V distance = step.length / width;
        store(&ways.length[k], from(11) + step.length);
        store(&ways.step[0][k], falloff(-0.5 * distance * distance) + 1e-9);
        store(&ways.step[1][k], from(9) + step.u), store(&ways.step[2][k], from(10) + step.v);
        store(&ways.step[3][k], step.right.x), store(&ways.step[4][k], step.right.y);
        store(&ways.step[5][k], step.right.z);
    }
    i64 best = 0;
    for (i64 k = 1; k < reached; ++k)
        if (ways.length[k] < ways.length[best]) best = k;
    // Those that are not on another sheet than the nearest one.
    const double best_u = ways.step[1][best], best_v = ways.step[2][best];
    double total = 0.0, u = 0.0, v = 0.0;
    Vector right = {0.0, 0.0, 0.0};
    for (i64 k = 0; k < reached; ++k) {
        const double w = ways.step[0][k], ju = ways.step[1][k], jv = ways.step[2][k];
        if ((ju - best_u) * (ju - best_u) + (jv - best_v) * (jv - best_v) > sheet) continue;
        total += w, u += w * ju, v += w * jv;
        right = right + w * Vector{ways.step[3][k], ways.step[4][k], ways.step[5][k]};
    }
    right = right - dot(right, n) * n;
    right = 1.0 / max_of(length_of(right), 1e-30) * right;
    return {ways.samples[best], u / total, v / total, right};
}

// Samples by their distance from the first one, the nearest first, of equal ones the lower number.
struct Heap {
    Array1<double> keys;
    Array1<i64> ids;
    i64 filled;

    SP_INLINE bool before(double key, i64 id, i64 at) const {
        return key < keys(at) || (key == keys(at) && id < ids(at));
    }

    void add(double key, i64 id) {
        i64 at = filled++;
        while (at > 0) {
            const i64 parent = (at - 1) / 2;
            if (!before(key, id, parent)) break;
            keys(at) = keys(parent), ids(at) = ids(parent);
            at = parent;
        }
        keys(at) = key, ids(at) = id;
    }

    void remove_first() {
        const i64 last = --filled;  // its place is free now, and it is what has to find a new one
        const double key = keys(last);
        const i64 id = ids(last);
        i64 at = 0;
        for (i64 child = 1; child < last; child = 2 * at + 1) {
            if (child + 1 < last && before(keys(child + 1), ids(child + 1), child)) ++child;
            if (!before(keys(child), ids(child), last)) break;
            keys(at) = keys(child), ids(at) = ids(child);
            at = child;
        }
        keys(at) = key, ids(at) = id;
    }
};

// What samples say of the surface at a point: their weights, and by these their offsets (3) and normals (3). Eight
// samples at a time, each lane with sums of its own.
struct Sums {
    alignas(64) double lanes[7][READ_AT_ONCE] = {};

    // rows: six rows of numbers, `stride` apart, at the first sample; used: how many of the eight count.
    SP_INLINE void add(const double* rows, i64 stride, i64 used, Vector p, Vector n, double squared) {
        using V = Wide<double>;
        SP_EIGHT(l) {
            auto row = [&](int r) { return load_unaligned(rows + r * stride + l); };
            const V x = row(0) - p.x, y = row(1) - p.y, z = row(2) - p.z, fx = row(3), fy = row(4), fz = row(5);
            const V square = (x * x + y * y + z * z) / squared, cosine = fx * n.x + fy * n.y + fz * n.z;
            // Those that are too far away or face elsewhere weigh nothing. A cosine may be 1 and a bit.
            const V turn = (cosine < 1.0 ? cosine - 1.0 : V{}) / SMOOTHED_TURN;
            const auto counts = (square <= 1.0) & (cosine >= MIN_AGREEING_COSINE) & (load(&COUNTING[l]) < (double)used);
            const V w = counts ? falloff(turn - 2.0 * square) : V{};
            const V terms[7] = {w, w * x, w * y, w * z, w * fx, w * fy, w * fz};
            for (int t = 0; t < 7; ++t) store(&lanes[t][l], load(&lanes[t][l]) + terms[t]);
        }
    }

    SP_INLINE double of(int field) const { return sum_of_eight(lanes[field]); }
};

}  // namespace unwrapping

// Points that keep their distance from those before them: see `thinned`. One thread: each depends on all before it.
inline void thin_points(Rows<const double, 3> points, Rows<const double, 3> normals, Array1<const i64> keys,
                        Array1<const i64> order, Array1<const double> corner, double size, double least_square,
                        Array1<bool> chosen, i64 thread, i64) {
    using namespace unwrapping;
    if (thread != 0) return;
    const PointCells cells = {keys, order, corner, size};
    for (i64 i = 0; i < points.shape[0]; ++i) {
        const Vector p = vector_from(points.row(i)), n = vector_from(normals.row(i));
        bool free = true;
        cells.around(cells.truncated(p), [&](i64 j) {
            if (!chosen(j)) return true;
            const Vector d = vector_from(points.row(j)) - p;
            free = !(dot(n, vector_from(normals.row(j))) > 0.0 && dot(d, d) < least_square);
            return free;
        });
        chosen(i) = free;
    }
}

// samples: [6, S + READ_AT_ONCE] points and normals, in the order of `keys` [S] (cells of `radius`). Every lane has
// sums of its own, added up at the end; samples that do not count have weight 0.
inline void smooth_points(Array2<const double> samples, Array1<const i64> keys, Array1<const double> corner,
                          double radius, Rows<const double, 3> points, Rows<const double, 3> normals,
                          Array2<double> out, Rows<double, 3> out_normals, i64 thread, i64 threads) {
    using namespace unwrapping;
    const PointCells cells = {keys, keys, corner, radius};
    const double squared = radius * radius;
    const i64 count = points.shape[0], block = POINTS_PER_BLOCK, stride = samples.shape[1];
    for (i64 start = thread * block; start < count; start += threads * block)
        for (i64 q = start; q < min_of(start + block, count); ++q) {
            Vector p = vector_from(points.row(q)), n = vector_from(normals.row(q));
            if (!is_moderate(p, n)) continue;
            for (int round = 0; round < 2; ++round) {  // the second time by the first mean
                const Cell cell = cells.floored(p);
                if (cell.x < 0 || cell.y < 0 || cell.z < 0) break;
                Sums sums;
                cells.rows_around(cell, [&](i64 first, i64 last) {
                    for (i64 begin = first; begin < last; begin += READ_AT_ONCE) {
                        checked(begin + READ_AT_ONCE - 1, stride);
                        sums.add(samples.data + begin, stride, last - begin, p, n, squared);
                    }
                    return true;
                });
                const Vector turn = {sums.of(4), sums.of(5), sums.of(6)};
                const double mass = sums.of(0), length = length_of(turn);
                if (!(mass > 0.0 && length > 1e-9 * mass)) break;
                n = {turn.x / length, turn.y / length, turn.z / length};
                const double height = dot({sums.of(1), sums.of(2), sums.of(3)}, n) / mass;
                p = p + height * n;
            }
            store_vector(out.row(q), p);
            store_vector(out_normals.row(q), n);
        }
}

// Dijkstra's order over the samples, from sample 0, by a heap whose older entries are skipped. One thread: each sample
// takes its place from those before it. tentative, settled [S], heap_keys, heap_ids [H]: to write on.
SP_SMALL void spread_map(Rows<const double, 3> points, Rows<const double, 3> normals, double spacing, double reach,
                       Array1<const i64> keys, Array1<const i64> order, Array1<const double> corner, double size,
                       double limit_u, double limit_v, double limit_cosine, Rows<double, 2> uv, Rows<double, 3> right,
                       Array1<double> distances, Rows<double, 3> rims, Array1<double> tentative, Array1<bool> settled,
                       Array1<double> heap_keys, Array1<i64> heap_ids, i64 thread, i64) {
    using namespace unwrapping;
    const i64 total = points.shape[0];
    if (thread != 0 || total == 0) return;
    const Samples samples = {points, normals, spacing, reach, {keys, order, corner, size}};
    const Map map = {{uv.data, {total, 2}}, {right.data, {total, 3}}, {distances.data, {total}}};
    Heap heap = {heap_keys, heap_ids, 0};
    for (i64 i = 0; i < total; ++i) tentative(i) = INFINITE, settled(i) = false;
    i64 near[MAX_NEIGHBOURS];
    Ways ways;
    const Vector first_normal = vector_from(normals.row(0));
    tentative(0) = 0.0;
    heap.add(0.0, 0);
    while (heap.filled > 0) {
        const double key = heap.keys(0);
        const i64 i = heap.ids(0);
        heap.remove_first();
        if (settled(i)) continue;
        settled(i) = true;
        const Vector p = vector_from(points.row(i)), n = vector_from(normals.row(i));
        const i64 count = neighbours(samples, i, p, n, near);
        if (i > 0) {
            const Place place = average(samples, map, near, count, p, n, ways);
            if (place.nearest < 0) continue;
            uv(i, 0) = place.u, uv(i, 1) = place.v;
            store_vector(right.row(i), place.right);
        }
        distances(i) = key;
        // Where the neighbours lie: all around, or to one side, at a rim.
        Vector inwards = {0.0, 0.0, 0.0};
        for (i64 k = 0; k < count; ++k) inwards = inwards + (vector_from(points.row(near[k])) - p);
        inwards = inwards - dot(inwards, n) * n;
        const double share = (double)max_of<i64>(count, 1) * reach;
        store_vector(rims.row(i), {inwards.x / share, inwards.y / share, inwards.z / share});
        // Beyond the rectangle, or turned too far, nothing is reached from here.
        if (abs_of(uv(i, 0)) > limit_u || abs_of(uv(i, 1)) > limit_v || dot(n, first_normal) < limit_cosine) continue;
        const Vector here = vector_from(right.row(i));
        for (i64 k = 0; k < count; ++k) {
            const i64 j = near[k];
            if (settled(j)) continue;
            const Vector q = vector_from(points.row(j));
            if (key + MIN_CHORD_RATIO * length_of(q - p) >= tentative(j)) continue;
            const double length = key + step_to<double>(p, n, here, q, vector_from(normals.row(j))).length;
            if (length < tentative(j) && heap.filled < heap_keys.shape[0]) {
                tentative(j) = length;
                heap.add(length, j);
            }
        }
    }
}

// The map at other points of the surface; `out` and `nearest` stay as they are where no reached sample is a neighbour.
inline void interpolate_map(Rows<const double, 3> points, Rows<const double, 3> normals, Rows<const double, 3> right,
                            Rows<const double, 2> uv, Array1<const double> distances, double spacing, double reach,
                            Array1<const i64> keys, Array1<const i64> order, Array1<const double> corner, double size,
                            Rows<const double, 3> queries, Rows<const double, 3> query_normals, Array2<double> out,
                            Array1<i64> nearest, i64 thread, i64 threads) {
    using namespace unwrapping;
    const Samples samples = {points, normals, spacing, reach, {keys, order, corner, size}};
    const Map map = {uv, right, distances};
    i64 near[MAX_NEIGHBOURS];
    Ways ways;
    const i64 total = queries.shape[0], block = POINTS_PER_BLOCK;
    for (i64 start = thread * block; start < total; start += threads * block)
        for (i64 q = start; q < min_of(start + block, total); ++q) {
            const Vector p = vector_from(queries.row(q)), n = vector_from(query_normals.row(q));
            if (!is_moderate(p, n)) continue;
            const i64 count = neighbours(samples, -1, p, n, near);
            if (count == 0) continue;
            const Place place = average(samples, map, near, count, p, n, ways);
            if (place.nearest < 0) continue;
            out(q, 0) = place.u, out(q, 1) = place.v;
            i64 closest = place.nearest;
            double square = INFINITE;
            for (i64 k = 0; k < count; ++k) {
                if (!(distances(near[k]) < INFINITE)) continue;
                const Vector d = vector_from(points.row(near[k])) - p;
                const double apart = dot(d, d);
                if (apart < square) closest = near[k], square = apart;
            }
            nearest(q) = closest;
        }
}

} }  // namespace sp
