// Rays through the voxel cube, as in splatpainter/voxels/raycast.py, which says what they are for.
//
// A walk from wall to wall (Amanatides & Woo, Eurographics 1987) would take a hundred steps through empty voxels. The
// volume is packed into bricks of 4 x 4 x 4 voxels, 64 bits each, and every empty brick knows its clearance: the
// distance to the nearest brick that is not empty, in bricks along the longest axis. So a ray leaves a cube of empty
// bricks in one step, and walks from voxel to voxel only where there are some.
#pragma once
#include "../maths.h"
#include "../vectors.h"

namespace sp { namespace {
namespace bricks {

constexpr int BRICK_EDGE = 4;
constexpr i64 RAY_BLOCK = 256;
constexpr i64 MAX_CLEARANCE = 15;

SP_INLINE i64 inner(i64 cell) { return cell & (BRICK_EDGE - 1); }
SP_INLINE i64 across(i64 resolution) { return (resolution + BRICK_EDGE - 1) / BRICK_EDGE; }

// Bits of four voxels in a row.
SP_INLINE u64 four_bits(const float* row) {
    return (u64)(row[0] > 0.0f) | (u64)(row[1] > 0.0f) << 1 | (u64)(row[2] > 0.0f) << 2 | (u64)(row[3] > 0.0f) << 3;
}
SP_INLINE u64 four_bits(const u8* row) {
    u32 bytes;
    __builtin_memcpy(&bytes, row, sizeof bytes);  // the first one lowest, as all our systems have it
    const u32 highest = (((bytes & 0x7f7f7f7fu) + 0x7f7f7f7fu) | bytes) & 0x80808080u;  // of bytes that are not 0
    return ((highest >> 7) * 0x01020408u >> 24) & 15;  // which adds them up next to each other
}

// A volume's set voxels, [R, R, R] flat, as the words of the bricks.
template <class T>
SP_INLINE void pack(const Array1<const T>& volume, i64 resolution, const Array1<u64>& words, i64 thread, i64 threads) {
    const i64 count = across(resolution), whole = resolution / BRICK_EDGE;
    checked(resolution * resolution * resolution - 1, volume.shape[0]);
    checked(count * count * count - 1, words.shape[0]);
    const Share share = share_of(count, thread, threads);
    for (i64 bx = share.begin; bx < share.end; ++bx)
        for (i64 by = 0; by < count; ++by) {
            u64* __restrict out = words.data + (bx * count + by) * count;
            for (i64 bz = 0; bz < count; ++bz) out[bz] = 0;
            for (i64 x = bx * BRICK_EDGE; x < min_of((bx + 1) * BRICK_EDGE, resolution); ++x)
                for (i64 y = by * BRICK_EDGE; y < min_of((by + 1) * BRICK_EDGE, resolution); ++y) {
                    const T* __restrict row = volume.data + (x * resolution + y) * resolution;
                    const int shift = (int)(inner(x) * BRICK_EDGE + inner(y)) * BRICK_EDGE;
                    for (i64 bz = 0; bz < whole; ++bz) out[bz] |= four_bits(row + bz * BRICK_EDGE) << shift;
                    for (i64 z = whole * BRICK_EDGE; z < resolution; ++z)
                        out[whole] |= (u64)(row[z] > T(0)) << (shift + inner(z));
                }
        }
}

struct Volume {
    Array1<const u64> words;
    Array1<const u8> clearances;
    i64 resolution, count;
    Rows<const i64, 2> box;
    Vector origin;  // of the rays, in voxels
};

// As many rays as a register has lanes, which go on together until all have ended: what one does depends on no other.
// Cells are whole numbers in floating point, so that nothing is converted but indices.
using Lanes = Wide<double>;
using Mask = Wide<i64>;
constexpr int AT_ONCE = W<double>;
typedef i32 Indices __attribute__((vector_size(SP_VECTOR_BYTES / 2)));

SP_INLINE Indices indices_of(Lanes x) { return __builtin_convertvector(x, Indices); }
#if defined(__clang__)
SP_INLINE Lanes floor_of(Lanes x) { return __builtin_elementwise_floor(x); }
#else
SP_INLINE Lanes floor_of(Lanes x) {
    for (int l = 0; l < AT_ONCE; ++l) x[l] = __builtin_floor(x[l]);
    return x;
}
#endif

SP_INLINE Lanes lower(Lanes a, Lanes b) { return b < a ? b : a; }  // a where b is NaN
SP_INLINE Lanes higher(Lanes a, Lanes b) { return b > a ? b : a; }
SP_INLINE bool any_of(Mask m) { return bits_where(m) != 0; }

// One axis of the rays. Times are in lengths of their directions.
struct Axis {
    Lanes direction, inverse, shifted, forward;
    double origin, low, high;

    // low, high: of the box.
    SP_INLINE void set(double o, Lanes d, i64 first, i64 end) {
        // Along an axis that it does not move on, a ray reaches every wall at infinity: (wall + 1) / 0.
        const Mask still = d == 0.0;
        origin = o, low = (double)first, high = (double)end;
        direction = d, inverse = still ? all(INFINITE) : 1.0 / d, shifted = still ? all(-1.0) : all(o);
        forward = d >= 0.0 ? all(1.0) : Lanes{};
    }
    SP_INLINE Lanes time_of(Lanes wall) const { return (wall - shifted) * inverse; }
    // When they enter the box: never, where they are beside it and do not move; and when they leave it.
    SP_INLINE Lanes entry() const {
        const double still = origin >= low && origin < high ? -INFINITE : INFINITE;
        return direction == 0.0 ? all(still) : time_of(forward > 0.0 ? all(low) : all(high));
    }
    SP_INLINE Lanes exit() const { return time_of(forward > 0.0 ? all(high) : all(low)); }
    // Their cells at a time: rounding must not find one outside of the box.
    SP_INLINE Lanes cell_at(Lanes time) const {
        return floor_of(higher(all(low), lower(all(high - 1.0), origin + time * direction)));
    }
    // The same, and never behind a cell where they were: a ray through an edge of cells would go back through the wall
    // that it just crossed, and cross it again, for ever.
    SP_INLINE Lanes cell_from(Lanes cell, Lanes time) const {
        const Lanes there = cell_at(time);
        return forward > 0.0 ? higher(cell, there) : lower(cell, there);
    }
    // The wall through which they leave a cell, or the cube of empty bricks of this clearance around it.
    SP_INLINE Lanes wall_of(Lanes cell, Lanes clearance) const {
        const Lanes first = floor_of(cell * (1.0 / BRICK_EDGE)) * (double)BRICK_EDGE;
        const Lanes cube = first + (forward > 0.0 ? clearance : 1.0 - clearance) * (double)BRICK_EDGE;
        return clearance > 0.0 ? cube : cell + forward;
    }
};

// visit(lane, key, time, exit) for every set voxel that one of `count` rays crosses, in their order, until a call for
// that lane returns false. rays: [count, 3].
template <class Visit>
SP_INLINE void follow(const Volume& v, const float* rays, int count, Visit visit) {
    if (!(is_finite(v.origin.x) && is_finite(v.origin.y) && is_finite(v.origin.z))) return;
    Lanes dx = {}, dy = {}, dz = {};
    for (int l = 0; l < count; ++l) dx[l] = rays[3 * l], dy[l] = rays[3 * l + 1], dz[l] = rays[3 * l + 2];
    Axis ax, ay, az;
    ax.set(v.origin.x, dx, v.box(0, 0), v.box(0, 1));
    ay.set(v.origin.y, dy, v.box(1, 0), v.box(1, 1));
    az.set(v.origin.z, dz, v.box(2, 0), v.box(2, 1));
    // Where they are within the box of what is set. What is not finite, and lanes beyond the last ray, are nowhere.
    const Lanes end = lower(lower(ax.exit(), ay.exit()), az.exit());
    Lanes time = higher(higher(higher(Lanes{}, ax.entry()), ay.entry()), az.entry());
    Mask going = time < end;
    going &= (dx - dx == 0.0) & (dy - dy == 0.0) & (dz - dz == 0.0) & ((dx != 0.0) | (dy != 0.0) | (dz != 0.0));
    Lanes x = ax.cell_at(time), y = ay.cell_at(time), z = az.cell_at(time);
    const double bricks_across = (double)v.count;
    while (any_of(going)) {
        const double shrink = 1.0 / BRICK_EDGE;
        const Lanes bx = floor_of(x * shrink), by = floor_of(y * shrink), bz = floor_of(z * shrink);
        const Indices brick = indices_of((bx * bricks_across + by) * bricks_across + bz);
        const Lanes row = (x - bx * BRICK_EDGE) * BRICK_EDGE + (y - by * BRICK_EDGE);
        const Indices bit = indices_of(row * BRICK_EDGE + (z - bz * BRICK_EDGE));
        Lanes clearance;
        Mask set;
        for (int l = 0; l < AT_ONCE; ++l) {
            clearance[l] = (double)v.clearances(brick[l]);
            set[l] = -(i64)((v.words(brick[l]) >> bit[l]) & 1);
        }
        const Lanes wx = ax.wall_of(x, clearance), wy = ay.wall_of(y, clearance), wz = az.wall_of(z, clearance);
        const Lanes tx = ax.time_of(wx), ty = ay.time_of(wy), tz = az.time_of(wz);
        const Lanes exit = lower(lower(tx, ty), tz);
        set &= going;
        if (any_of(set)) {
            const Lanes key = (x * (double)v.resolution + y) * (double)v.resolution + z;
            for (int l = 0; l < AT_ONCE; ++l)
                if (set[l] && !visit(l, (i64)key[l], time[l], exit[l])) going[l] = 0;
        }
        // Through one wall; along the other axes only a cube's cells change.
        const Mask by_x = (tx <= ty) & (tx <= tz), by_y = ~by_x & (ty <= tz), by_z = ~by_x & ~by_y;
        const Mask within = clearance == 0.0;
        const Lanes x2 = by_x ? wx + ax.forward - 1.0 : (within ? x : ax.cell_from(x, exit));
        const Lanes y2 = by_y ? wy + ay.forward - 1.0 : (within ? y : ay.cell_from(y, exit));
        const Lanes z2 = by_z ? wz + az.forward - 1.0 : (within ? z : az.cell_from(z, exit));
        going &= exit < end;
        x = going ? x2 : x, y = going ? y2 : y, z = going ? z2 : z, time = exit;
    }
}

// visit(first, count) for all packets of rays that a thread takes.
template <class Visit>
SP_INLINE void each_packet(const Rows<const float, 3>& rays, i64 thread, i64 threads, Visit visit) {
    const i64 total = rays.shape[0];
    for (i64 start = thread * RAY_BLOCK; start < total; start += threads * RAY_BLOCK)
        for (i64 m = start; m < min_of(start + RAY_BLOCK, total); m += AT_ONCE)
            visit(m, (int)min_of<i64>(AT_ONCE, total - m));
}

}  // namespace bricks

inline void pack_marked(Array1<const u8> volume, i64 resolution, Array1<u64> words, i64 thread, i64 threads) {
    bricks::pack(volume, resolution, words, thread, threads);
}

inline void pack_dense(Array1<const float> volume, i64 resolution, Array1<u64> words, i64 thread, i64 threads) {
    bricks::pack(volume, resolution, words, thread, threads);
}

// Clearances of all bricks, at most MAX_CLEARANCE, by growing what is set brick by brick: a brick's is the number of
// steps after which it is reached. grown, spare: [B^3] to write on.
inline void measure_clearances(Array1<const u64> words, i64 resolution, Array1<u8> clearances, Array1<u8> grown,
                               Array1<u8> spare, i64 thread, i64) {
    using namespace bricks;
    if (thread != 0) return;
    const i64 n = across(resolution), all = n * n * n;
    checked(all - 1, words.shape[0]);
    u8 *now = grown.data, *next = spare.data, *out = clearances.data;
    for (i64 i = 0; i < all; ++i) now[i] = words.data[i] != 0, out[i] = 0;
    for (i64 step = 0; step < MAX_CLEARANCE; ++step) {
        for (i64 i = 0; i < all; ++i) out[i] = (u8)(out[i] + (now[i] ^ 1));
        // One brick further along each axis in turn: planes, then rows, then bricks.
        for (i64 stride = n * n; stride > 0; stride = stride == 1 ? 0 : stride / n) {
            for (i64 first = 0; first < all; first += stride * n) {
                const u8* __restrict from = now + first;
                u8* __restrict to = next + first;
                const i64 rest = stride * (n - 1);
                for (i64 i = 0; i < stride * n; ++i) to[i] = from[i];
                for (i64 i = 0; i < rest; ++i) to[i] = to[i] | from[i + stride];
                for (i64 i = 0; i < rest; ++i) to[i + stride] = to[i + stride] | from[i];
            }
            u8* t = now;
            now = next, next = t;
        }
    }
}

// The first set voxel on each ray; -1 and -1 where there is none.
inline void find_first_voxels(Array1<const u64> words, Array1<const u8> clearances, i64 resolution,
                              Rows<const i64, 2> box, Array1<const double> origin, double voxel,
                              Rows<const float, 3> rays, Array1<i64> keys, Array1<float> distances, i64 thread,
                              i64 threads) {
    using namespace bricks;
    const Volume volume = {words, clearances, resolution, across(resolution), box, {origin(0), origin(1), origin(2)}};
    each_packet(rays, thread, threads, [&](i64 m, int count) {
        for (int l = 0; l < count; ++l) keys(m + l) = -1, distances(m + l) = -1.0f;
        follow(volume, rays.row(m), count, [&](int lane, i64 key, double time, double) {
            keys(m + lane) = key, distances(m + lane) = (float)(time * voxel);
            return false;
        });
    });
}

// Marks the voxels that rays cross before they have crossed a thickness of `spent`, and tells which are not spent.
inline void mark_seen_voxels(Array1<const u64> words, Array1<const u8> clearances, i64 resolution,
                             Rows<const i64, 2> box, Array1<const double> origin, Array1<const float> density,
                             Rows<const float, 3> rays, double spent, Array1<bool> seen, Array1<bool> through,
                             i64 thread, i64 threads) {
    using namespace bricks;
    const Volume volume = {words, clearances, resolution, across(resolution), box, {origin(0), origin(1), origin(2)}};
    each_packet(rays, thread, threads, [&](i64 m, int count) {
        double depths[AT_ONCE] = {}, lengths[AT_ONCE];
        for (int l = 0; l < count; ++l) {
            const float* ray = rays.row(m + l);
            lengths[l] = length_of({ray[0], ray[1], ray[2]});
        }
        follow(volume, rays.row(m), count, [&](int lane, i64 key, double time, double exit) {
            __atomic_store_n(&seen(key), true, __ATOMIC_RELAXED);  // other threads may mark the same voxel
            depths[lane] += (double)density(key) * (exit - time) * lengths[lane];
            return !(depths[lane] > spent);
        });
        for (int l = 0; l < count; ++l) through(m + l) = !(depths[l] > spent);
    });
}

} }  // namespace sp
