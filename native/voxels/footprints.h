// Where a Gaussian lies in the voxel cube, as in splatpainter/voxels/footprints.py, which explains it.
#pragma once
#include "../maths.h"
#include "../rendering/profiles.h"
#include "../vectors.h"

namespace sp { namespace {
namespace lattice {

constexpr i64 MAX_SAMPLES = 4096;  // of one Gaussian: larger ones are sampled more coarsely, not longer
constexpr double SIGMAS = 2.5;     // half-length of a footprint in standard deviations
// MIN_ALPHA exp(SIGMAS^2 / 2): fainter ones have shorter footprints.
constexpr double FULL_OPACITY = 0.08925449056284993;
constexpr double SQRT_TWO_PI = 2.5066282746310002;
constexpr double FIXED_POINT_UNIT = 1 << 20;  // steps per unit of optical thickness
// Cap of one sample's thickness, so that sums over a hundred million Gaussians stay below 2^63.
constexpr double MAX_SAMPLE_THICKNESS = 1e4;

struct Gaussians {
    Rows<const float, 3> means;
    Rows<const float, 4> quats;
    Rows<const float, 3> scales;
    Array1<const float> opacities;
};

struct Cube {
    Vector corner;
    double voxel;
    i64 resolution;
};

struct Steps { i64 a, b, c; };

// Samples to each side of the middle along the three axes, for half-lengths in voxels.
SP_INLINE Steps steps_of(double half_a, double half_b, double half_c) {
    for (double spacing = 1.0;; spacing *= 1.1) {
        const double a = half_a >= 0.5 ? ceil_of(half_a / spacing) : 0.0;
        const double b = half_b >= 0.5 ? ceil_of(half_b / spacing) : 0.0;
        const double c = half_c >= 0.5 ? ceil_of(half_c / spacing) : 0.0;
        if ((2.0 * a + 1.0) * (2.0 * b + 1.0) * (2.0 * c + 1.0) <= (double)MAX_SAMPLES) return {(i64)a, (i64)b, (i64)c};
    }
}

// The Gaussian along one axis of its lattice: weights[n] = exp(-(n spacing sigmas)^2 / 2).
SP_INLINE void weights_along(i64 steps, double spacing, double sigmas, double* weights) {
    for (i64 n = 0; n <= steps; ++n) {
        const double s = (double)n * spacing;
        weights[n] = exp_of(-0.5 * (s * s) * sigmas * sigmas);
    }
}

// What one thread writes on.
struct Workspace {
    double weights[3][MAX_SAMPLES / 2 + 1], thickness[MAX_SAMPLES];
    i32 keys[MAX_SAMPLES];
};

// Gaussian n's samples inside the cube, into `work`; returns their number (0 for a faint one).
inline i64 footprint_of(const Gaussians& g, i64 n, const Cube& cube, Workspace& work) {
    const double opacity = min_of((double)g.opacities(n), 1.0);
    if (!(opacity > MIN_ALPHA)) return 0;
    const double sigmas = opacity > FULL_OPACITY ? SIGMAS : sqrt_of(2.0 * log_of(opacity / MIN_ALPHA));
    // Capped: a backdrop many cubes wide is cut, so that some of its samples fall into this one.
    const double max_scale = 2.0 * (double)cube.resolution / sigmas;
    const float* scales = g.scales.row(n);
    const double sa = min_of((double)scales[0] / cube.voxel, max_scale);
    const double sb = min_of((double)scales[1] / cube.voxel, max_scale);
    const double sc = min_of((double)scales[2] / cube.voxel, max_scale);
    const auto [na, nb, nc] = steps_of(sa * sigmas, sb * sigmas, sc * sigmas);
    const double da = 1.0 / (double)max_of<i64>(na, 1), db = 1.0 / (double)max_of<i64>(nb, 1);
    const double dc = 1.0 / (double)max_of<i64>(nc, 1);
    const double la = sa * sigmas * da, lb = sb * sigmas * db, lc = sc * sigmas * dc;
    // A sample stands for a cell of the lattice; on an axis without steps, for the Gaussian's whole integral. Across
    // the shortest axis the alpha is what it is, so there the cells' weights sum to one.
    double middle = opacity / (SQRT_TWO_PI * min_of(min_of(sa, sb), sc));
    middle *= na > 0 ? la : SQRT_TWO_PI * sa;
    middle *= nb > 0 ? lb : SQRT_TWO_PI * sb;
    middle *= nc > 0 ? lc : SQRT_TWO_PI * sc;

    // The lattice's steps in voxels.
    const float* quat = g.quats.row(n);
    double w = quat[0], x = quat[1], y = quat[2], z = quat[3];
    const double norm = sqrt_of(w * w + x * x + y * y + z * z);
    w /= norm, x /= norm, y /= norm, z /= norm;
    const Vector a = la * Vector{1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)};
    const Vector b = lb * Vector{2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)};
    const Vector c = lc * Vector{2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)};
    const Vector center = (1.0 / cube.voxel) * (as_vector(g.means.row(n)) - cube.corner);

    // Rows along the third axis, so far as they are inside the ellipsoid. The exponential of the three axes' sum is the
    // product of theirs.
    weights_along(na, da, sigmas, work.weights[0]);
    weights_along(nb, db, sigmas, work.weights[1]);
    weights_along(nc, dc, sigmas, work.weights[2]);
    const double limit = (double)cube.resolution;
    const i32 resolution = (i32)cube.resolution;
    i64 count = 0;
    for (i64 i = -na; i <= na; ++i)
        for (i64 j = -nb; j <= nb; ++j) {
            const double u = (double)i * da, v = (double)j * db, across = u * u + v * v;
            const Vector row = center + (double)i * a + (double)j * b;
            const double weight = middle * work.weights[0][i < 0 ? -i : i] * work.weights[1][j < 0 ? -j : j];
            for (i64 k = -nc; k <= nc; ++k) {
                const double s = (double)k * dc;
                if (across + s * s > 1.0 + 1e-9) continue;
                // Compared as floats: a far outlier would overflow the integer.
                const Vector at = row + (double)k * c;
                const double px = floor_of(at.x), py = floor_of(at.y), pz = floor_of(at.z);
                if (!(px >= 0.0 && px < limit && py >= 0.0 && py < limit && pz >= 0.0 && pz < limit)) continue;
                work.keys[count] = ((i32)px * resolution + (i32)py) * resolution + (i32)pz;
                work.thickness[count++] = weight * work.weights[2][k < 0 ? -k : k];
            }
        }
    return count;
}

}  // namespace lattice

// Adds the Gaussians' thickness, in fixed point, to totals [volumes, R^3]: each of the first few threads has a volume
// of its own; more would cost more memory than they save time.
inline void deposit_thickness(Rows<const float, 3> means, Rows<const float, 4> quats, Rows<const float, 3> scales,
                              Array1<const float> opacities, Array1<const i64> gaussian_ids,
                              Array1<const double> min_corner, double voxel, i64 resolution, Array2<i64> totals,
                              i64 thread, i64 threads) {
    using namespace lattice;
    threads = min_of(threads, totals.shape[0]);
    if (thread >= threads) return;
    const Gaussians gaussians = {means, quats, scales, opacities};
    const Cube cube = {{min_corner(0), min_corner(1), min_corner(2)}, voxel, resolution};
    Workspace work;
    for (i64 m = thread; m < gaussian_ids.shape[0]; m += threads) {
        const i64 count = footprint_of(gaussians, gaussian_ids(m), cube, work);
        for (i64 s = 0; s < count; ++s) {
            // In this order NaN becomes 0: casts of NaN are undefined.
            const double thickness = min_of(max_of(0.0, work.thickness[s]), MAX_SAMPLE_THICKNESS);
            totals(thread, work.keys[s]) += (i64)(thickness * FIXED_POINT_UNIT + 0.5);
        }
    }
}

// Floats from the sum of all volumes.
inline void sum_thickness(Array2<const i64> totals, Array1<float> out, i64 thread, i64 threads) {
    const Share share = share_of(out.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        i64 total = 0;
        for (i64 volume = 0; volume < totals.shape[0]; ++volume) total += totals(volume, i);
        out(i) = (float)((double)total / lattice::FIXED_POINT_UNIT);
    }
}

// Which Gaussians have a sample in a voxel of `marked` [R^3]; box: [3, 2] world units, around what is marked.
inline void find_touching(Rows<const float, 3> means, Rows<const float, 4> quats, Rows<const float, 3> scales,
                          Array1<const float> opacities, Array1<const i64> gaussian_ids,
                          Array1<const double> min_corner, double voxel, i64 resolution, Array1<const u8> marked,
                          Rows<const double, 2> box, Array1<bool> out, i64 thread, i64 threads) {
    using namespace lattice;
    const Gaussians gaussians = {means, quats, scales, opacities};
    const Cube cube = {{min_corner(0), min_corner(1), min_corner(2)}, voxel, resolution};
    Workspace work;
    for (i64 m = thread; m < gaussian_ids.shape[0]; m += threads) {
        const i64 n = gaussian_ids(m);
        const float* s = scales.row(n);
        const double reach = SIGMAS * (double)max_of(max_of(s[0], s[1]), s[2]);
        bool near = true;
        for (int axis = 0; axis < 3; ++axis) {
            const double mean = means(n, axis);
            near &= mean + reach >= box(axis, 0) && mean - reach <= box(axis, 1);
        }
        out(m) = false;
        if (!near) continue;
        const i64 count = footprint_of(gaussians, n, cube, work);
        for (i64 k = 0; k < count && !out(m); ++k) out(m) = marked(work.keys[k]) != 0;
    }
}

} }  // namespace sp
