// Height, normal, window, residual and trust of the surface at any points: moving least squares over patches, as in
// splatpainter/surface/estimate.py and splatpainter/surface/surface_samples.py, which explain it. Plain IEEE
// arithmetic, in the order of patches.
#pragma once

#include "../maths.h"
#include "../search.h"
#include "falloff.h"

namespace sp { namespace {
namespace surface {

constexpr int MAX_NEIGHBOURS = 768;    // patches in one window; where there are more the window shrinks
constexpr i64 MAX_TESTED = 1 << 14;    // samples and columns of cells that one search looks at
static_assert(MAX_TESTED > 10 * MAX_NEIGHBOURS);
constexpr double SIGMAS = 2.5;         // standard deviations within which a patch is looked at
constexpr double MIN_PATCHES = 8.0;    // effective number, (sum w)^2 / sum w^2, below which the window grows, ...
constexpr int MAX_GROWTHS = 4;         // ... at most so often, ...
constexpr double GROWTH = 1.4;         // ... by this factor.
constexpr int MAX_SHRINKS = 24;        // by GROWTH: to a three thousandth
constexpr double MIN_MASS = 2e-3;      // patches that weigh less than this share of the heaviest one are left out
constexpr int REWEIGHTINGS = 4;        // rounds in which patches off the surface by one `tau` lose 0.4 of their vote
// tau, in windows: in the first round, afterwards in residuals of the round before, at least.
constexpr double FIRST_TAU = 0.5, TAU_RESIDUALS = 2.0, MIN_TAU = 0.25;
constexpr double MIN_SLANT = 0.35;     // cosine of normal and line of sight below which the step along it is bounded
// rms distance of the patches' centres from their plane, in windows: up to the first they lie on the surface, from the
// second they are a cloud behind it (an optimised asset shows the front of its Gaussians, not their centres), and the
// surface is where light stops. Between the two the height is a mixture.
constexpr double PRECISE_RESIDUAL = 0.12, CLOUDY_RESIDUAL = 0.27;
// Share of the light that has been stopped at the surface of a cloud. On objects fitted from points with noise (density
// control, 700 steps) the median error of height is 0.66 widths by centres alone, 0.44, 0.30, 0.28 with 0.5, 0.3, 0.25.
constexpr double RAY_SHARE = 0.25;
constexpr double RAY_RADIUS = 0.5;     // distance of the six rays around the query, in windows
// Logistic regression: 1; residual, its square, at most 0.15 of it; thickness; 1 - agreement; cosine between normal and
// line of sight, its square; the step from the query to the surface in windows, up to 1 and beyond. Fitted by
// scripts/calibrate/trust.py, which prints these numbers, on eight training objects (clean, and fitted by 3DGS from
// noisy points or from true depths: each kind counts a third); on five held-out objects AUC 0.85, 0.63, 0.73.
constexpr double TRUST_WEIGHTS[] = {3.32, -8.97, 15.03, -5.27, -3.77, -2.38, 2.65, -1.82, -0.65, -0.60};
constexpr double MAX_TRUST_MOVE = 2.5;
constexpr double FEW_PATCHES = 3.0;    // effective number below which trust falls in proportion
constexpr int DEPTH_BINS = 128;        // into which patches are sorted by depth
constexpr int RAY_ROWS = 6;            // of the workspace that following the rays takes
// Queries that a thread takes at a time, by place: those that lie together share one search.
constexpr i64 MIN_BLOCK = 64, MAX_BLOCK = 1024, BLOCKS_PER_THREAD = 4;
constexpr i64 MIN_GROUP = 3;           // queries from which on a shared search is worth its time
constexpr double GROUP_WINDOWS = 2.0;  // edge of the cells in which queries lie together, in their mean window
constexpr i64 MAX_CANDIDATES = 1024;   // samples that a shared search may find
// A shared search may take so many steps. Each of its queries alone would take at most five times as many, so that none
// of them would have given up.
constexpr i64 MAX_SHARED_STEPS = MAX_TESTED / 8;
constexpr double SURE = 0.99999;       // of a squared distance: within it rounding cannot put a sample out of the box
constexpr int CELL_BITS = 20;          // of a cell's index along each axis
// Columns of SurfaceSamples.patches, and of a patch within a window: its mean; M, which takes the mean's offset from
// any point to the mean of the product of patch and window there (their covariance is h^2 (1 - M)); its unsigned
// normal; its weight; 0..1 how far it has a normal.
enum { MEAN = 0, AXES = 3, SCALES = 12, OPACITY_COLUMN = 15, PATCH_COLUMNS = 16 };
enum { X, Y, Z, MXX, MXY, MXZ, MYY, MYZ, MZZ, NX, NY, NZ, MASS, FLATNESS, ROWS };

struct Grid {
    Array1<const i64> keys, level_starts;
    Array1<const double> cell_sizes, reaches, corner;
    Rows<const float, PATCH_COLUMNS> patches;
};

// What one thread writes on while it works.
struct Workspace {
        i64 near[MAX_NEIGHBOURS + 1], order[MAX_NEIGHBOURS];
    alignas(64) double mass[MAX_NEIGHBOURS], terms[8][MAX_NEIGHBOURS], rows[ROWS][MAX_NEIGHBOURS], sums[18];
    // Of a shared search: samples, their centres and longest axes; the largest window that it will do for, 0: none.
    i64 candidates[MAX_CANDIDATES + 1], candidate_count;
    alignas(64) double x[MAX_CANDIDATES + 8], y[MAX_CANDIDATES + 8], z[MAX_CANDIDATES + 8], squares[MAX_CANDIDATES + 8];
    double shared_window;
};

struct Range { i64 first, last; };
SP_INLINE Range cell_range(double first, double last, double radius, double corner, double size) {
    const double top = (double)((1 << 20) - 1);
    double low = (first - radius - corner) / size, high = (last + radius - corner) / size;
    low = low == low ? min_of(max_of(low, 0.0), top) : 0.0;
    high = high == high ? min_of(max_of(high, 0.0), top) : 0.0;
    return {(i64)low, (i64)high};
}

// Samples whose patch, widened by `window`, reaches a box within SIGMAS standard deviations of its longest axis (its
// squared distance counting as `share` of it), level by level in the order of their keys, into `out` [room + 1];
// returns their number, or room + 1 where they do not fit or it took more than `most` steps. Costs as many steps as
// there are samples and occupied columns of cells near the box, however small cells are against the window.
SP_SMALL i64 search(const Grid& g, const double* low, const double* high, double window, i64 most,
                    double share, i64* out, i64 room) {
    i64 count = 0, tested = 0;
    const i64 mask = (1 << CELL_BITS) - 1;
    auto key_of = [](i64 x, i64 y, i64 z) { return (x << 2 * CELL_BITS) | (y << CELL_BITS) | z; };
    for (i64 level = 0; level < g.cell_sizes.shape[0]; ++level) {
        const double size = g.cell_sizes(level), reach = g.reaches(level);
        const double radius = SIGMAS * sqrt_of(reach * reach + window * window);
        const auto [x0, x1] = cell_range(low[0], high[0], radius, g.corner(0), size);
        const auto [y0, y1] = cell_range(low[1], high[1], radius, g.corner(1), size);
        const auto [z0, z1] = cell_range(low[2], high[2], radius, g.corner(2), size);
        const i64 end = g.level_starts(level + 1);
        i64 i = first_not_below(g.keys, g.level_starts(level), end, key_of(x0, y0, z0));
        while (i < end) {
            const i64 key = g.keys(i), x = key >> 2 * CELL_BITS, y = (key >> CELL_BITS) & mask, z = key & mask;
            if (x > x1) break;
            if (++tested > most) return room + 1;
            const bool below = y < y0, above = y > y1 || (y == y1 && z > z1);
            if (below || above || z > z1 || z < z0) {
                // Outside the box: on to its next cell in the order of keys.
                const i64 inside = key_of(x, y + (z > z1), z0);
                const i64 next = below ? key_of(x, y0, z0) : above ? key_of(x + 1, y0, z0) : inside;
                i = first_not_below_near(g.keys, i, end, next);
                continue;
            }
            // The rest of a column within the box. Which samples count cannot be foreseen, so there is no branch.
            const i64 last = key_of(x, y, z1);
            for (; i < end && g.keys(i) <= last; ++i, ++tested) {
                const float* p = g.patches.row(i);
                double distance = 0.0;
                for (int a = 0; a < 3; ++a) {
                    const double at = p[MEAN + a], beside = larger_of(larger_of(low[a] - at, at - high[a]), 0.0);
                    distance += beside * beside;
                }
                const double longest = p[SCALES];
                out[count] = i;
                count += share * distance < SIGMAS * SIGMAS * (longest * longest + window * window);
                if (count > room || tested > most) return room + 1;
            }
        }
    }
    return count;
}

// Those that reach a point.
inline i64 gather(const Grid& g, const double* point, double window, i64* out, i64 room) {
    return search(g, point, point, window, MAX_TESTED, 1.0, out, room);
}

// Whether a sample lies in the cells that `search` visits for a point.
SP_SMALL bool is_visited(const Grid& g, i64 i, const double* point, double window) {
    i64 level = 0;
    while (i >= g.level_starts(level + 1)) ++level;
    const double reach = g.reaches(level), radius = SIGMAS * sqrt_of(reach * reach + window * window);
    for (int a = 0; a < 3; ++a) {
        const auto [first, last] = cell_range(point[a], point[a], radius, g.corner(a), g.cell_sizes(level));
        const i64 cell = (g.keys(i) >> (2 - a) * CELL_BITS) & ((1 << CELL_BITS) - 1);
        if (cell < first || cell > last) return false;
    }
    return true;
}

// One search for all queries in a box whose windows are no larger than this: what `select` chooses from. shared_window
// is 0 where there are too many samples.
SP_SMALL void search_together(const Grid& g, const double* low, const double* high, double window, Workspace& w) {
    const i64 count = search(g, low, high, window, MAX_SHARED_STEPS, SURE, w.candidates, MAX_CANDIDATES);
    w.shared_window = count > MAX_CANDIDATES ? 0.0 : window;
    if (count > MAX_CANDIDATES) return;
    w.candidate_count = count;
    for (i64 k = 0; k < (count ? count + 8 : 0); ++k) {
        const float* p = g.patches.row(w.candidates[min_of(k, count - 1)]);
        w.x[k] = p[MEAN], w.y[k] = p[MEAN + 1], w.z[k] = p[MEAN + 2];
        // The choice goes on by eights, and takes none of those behind the last one.
        w.squares[k] = k < count ? (double)p[SCALES] * (double)p[SCALES] : -INFINITE;
    }
}

// What `gather` finds, from a shared search.
inline i64 select(const Grid& g, const double* point, double window, Workspace& w, i64 room) {
    using V = Wide<double>;
    const double px = point[0], py = point[1], pz = point[2], squared = window * window;
    i64 count = 0;
    for (i64 start = 0; start < w.candidate_count; start += 8)
        SP_EIGHT(lane) {
            const i64 k = start + lane;
            const V dx = load(&w.x[k]) - px, dy = load(&w.y[k]) - py, dz = load(&w.z[k]) - pz;
            const V distance = dx * dx + dy * dy + dz * dz;
            const V reach = SIGMAS * SIGMAS * (load(&w.squares[k]) + squared);
            const u32 sure = bits_where(distance < SURE * reach);
            for (u32 rest = bits_where(distance < reach); rest; rest &= rest - 1) {
                const int bit = __builtin_ctz(rest);
                const i64 i = w.candidates[k + bit];
                if (!(sure >> bit & 1) && !is_visited(g, i, point, window)) continue;
                if (count == room) return room + 1;
                w.near[count++] = i;
            }
        }
    return count;
}

// Unit eigenvector of the smallest eigenvalue of a symmetric matrix (Smith 1961; cross products of rows).
inline void smallest_eigenvector(double xx, double xy, double xz, double yy, double yz, double zz, double* out) {
    const double third = (xx + yy + zz) / 3.0;
    double a = xx - third, b = yy - third, c = zz - third;
    const double p = (a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0;
    const double root = sqrt_of(max_of(p, 0.0));
    out[0] = 0.0, out[1] = 0.0, out[2] = 1.0;
    if (root <= 0.0) return;
    const double det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
    const double r = min_of(max_of(det / (2.0 * root * root * root), -1.0), 1.0);
    const double angle = acos_of(r) / 3.0;
    const double smallest = third + 2.0 * root * cos_of(angle + 2.0 * PI / 3.0);
    a = xx - smallest, b = yy - smallest, c = zz - smallest;
    const double products[3][3] = {
        {xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy},
        {xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz},
        {b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz},
    };
    double best = -1.0;
    for (const double* n : products) {
        const double length = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
        if (length > best) {
            best = length;
            __builtin_memcpy(out, n, 3 * sizeof(double));
        }
    }
    if (best <= 0.0) {
        out[0] = 0.0, out[1] = 0.0, out[2] = 1.0;
        return;
    }
    const double scale = 1.0 / sqrt_of(best);
    for (int k = 0; k < 3; ++k) out[k] *= scale;
}

SP_INLINE void normalize(double* n) {
    const double scale = 1.0 / max_of(sqrt_of(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), 1e-30);
    for (int k = 0; k < 3; ++k) n[k] *= scale;
}

// What the patches near[:count] weigh in the window h around a point.
inline void masses(const Grid& g, i64 count, const double* point, double h, Workspace& w) {
    using V = Wide<double>;
    const double squared = h * h;
    for (i64 k = 0; k < count; ++k) {
        const float* p = g.patches.row(w.near[k]);
        const double x = p[MEAN] - point[0], y = p[MEAN + 1] - point[1], z = p[MEAN + 2] - point[2];
        for (int a = 0; a < 3; ++a) {
            double d = p[AXES + 3 * a] * x + p[AXES + 3 * a + 1] * y;
            d += p[AXES + 3 * a + 2] * z;
            w.terms[a][k] = d;
            w.terms[4 + a][k] = (double)p[SCALES + a] * (double)p[SCALES + a];
        }
        w.terms[7][k] = p[OPACITY_COLUMN];
    }
    for (i64 start = 0; start < count; start += 8)
        SP_EIGHT(lane) {
            const i64 k = start + lane;
            V exponent = {}, area = load(&w.terms[7][k]);
            for (int a = 0; a < 3; ++a) {
                const V d = load(&w.terms[a][k]), v = load(&w.terms[4 + a][k]), t = v + squared;
                exponent += d * d / t;
                area *= a < 2 ? root_of(v / t) : h / root_of(t);
            }
            store(&w.mass[k], area * falloff(-0.5 * exponent));
        }
}

// The columns of patch i in a window h but for its weight, into rows[:][k].
SP_INLINE void patch(const Grid& g, i64 i, double h, Workspace& w, i64 k) {
    const float* p = g.patches.row(i);
    double m[6] = {};
    for (int a = 0; a < 3; ++a) {
        const double x = p[AXES + 3 * a], y = p[AXES + 3 * a + 1], z = p[AXES + 3 * a + 2];
        const double scale = p[SCALES + a], f = h * h / (scale * scale + h * h);
        m[0] += f * x * x, m[1] += f * x * y, m[2] += f * x * z;
        m[3] += f * y * y, m[4] += f * y * z, m[5] += f * z * z;
        w.rows[X + a][k] = p[MEAN + a];
        w.rows[NX + a][k] = p[AXES + 6 + a];
    }
    for (int c = 0; c < 6; ++c) w.rows[MXX + c][k] = m[c];
    const double flat = 1.0 - (double)p[SCALES + 2] / (double)p[SCALES + 1];
    w.rows[FLATNESS][k] = flat * flat;
}

// What the first `used` patches say of the surface at a point with normal n, into `sums` [18]: weights, and times
// these: means (3) and second moments (6) of the patches within the window, whose covariances are h^2 (1 - M); normals
// turned to n (3); offsets along the mean of both normals; squared heights; then squared weights, variances along n,
// cosines of normals. Eight patches at a time, each lane with sums of its own, which are added up at the end; patches
// behind the last one weigh nothing.
inline void votes(Workspace& work, i64 used, const double* point, const double* n, double h, double tau) {
    using V = Wide<double>;
    auto& rows = work.rows;
    const double px = point[0], py = point[1], pz = point[2], n0 = n[0], n1 = n[1], n2 = n[2];
    const double inverse_tau = 1.0 / (tau * h), squared = h * h;
    alignas(64) double sums[18][8] = {};
    for (i64 start = 0; start < used; start += 8)
        SP_EIGHT(lane) {
            const i64 k = start + lane;
            auto row = [&](int column) { return load(&rows[column][k]); };
            const V mxx = row(MXX), mxy = row(MXY), mxz = row(MXZ), myy = row(MYY), myz = row(MYZ), mzz = row(MZZ);
            const V x = row(X) - px, y = row(Y) - py, z = row(Z) - pz, flat = row(FLATNESS);
            const V ux = mxx * x + mxy * y + mxz * z, uy = mxy * x + myy * y + myz * z;
            const V uz = mxz * x + myz * y + mzz * z;
            // The patch's normal, turned to n.
            V nx = row(NX), ny = row(NY), nz = row(NZ), cosine = nx * n0 + ny * n1 + nz * n2;
            const auto away = cosine < 0.0;
            nx = away ? -nx : nx, ny = away ? -ny : ny, nz = away ? -nz : nz, cosine = away ? -cosine : cosine;
            // Patches off the plane, and those that face elsewhere, lose their vote.
            const V plane = ux * n0 + uy * n1 + uz * n2, r = plane * inverse_tau;
            const V crease = falloff(((cosine < 1.0 ? cosine : all(1.0)) - 1.0) * (1.0 / 0.3));
            const V w = row(MASS) * falloff(-0.5 * r * r) * (1.0 - flat + flat * crease);
            const V c = w * squared, f = w * flat;
            // Offset along the mean of both normals, as far as the patch has one.
            const V offset = w * plane + 0.5 * f * (ux * nx + uy * ny + uz * nz - plane);
            const V along = mxx * n0 * n0 + myy * n1 * n1 + mzz * n2 * n2 +
                            2.0 * (mxy * n0 * n1 + mxz * n0 * n2 + myz * n1 * n2);
            const V wx = w * ux, wy = w * uy, wz = w * uz;
            const V terms[18] = {w, wx, wy, wz, wx * ux + c * (1.0 - mxx), wx * uy - c * mxy, wx * uz - c * mxz,
                                 wy * uy + c * (1.0 - myy), wy * uz - c * myz, wz * uz + c * (1.0 - mzz), f * nx,
                                 f * ny, f * nz, offset, w * plane * plane, w * w, c * (1.0 - along), w * cosine};
            for (int t = 0; t < 18; ++t) store(&sums[t][lane], load(&sums[t][lane]) + terms[t]);
        }
    for (int t = 0; t < 18; ++t) work.sums[t] = sum_of_eight(sums[t]);
}

// The order of values[:count], ascending, equal ones as they come: into bins, and by insertion within these.
inline void nearest_first(const double* values, i64 count, i64* order) {
    double low = INFINITE, high = -INFINITE;
    for (i64 k = 0; k < count; ++k) low = min_of(low, values[k]), high = max_of(high, values[k]);
    const double scale = high > low ? (DEPTH_BINS - 1) / (high - low) : 0.0;
    i64 starts[DEPTH_BINS + 1] = {};
    for (i64 k = 0; k < count; ++k) ++starts[(i64)((values[k] - low) * scale) + 1];
    for (int b = 0; b < DEPTH_BINS; ++b) starts[b + 1] += starts[b];
    for (i64 k = 0; k < count; ++k) order[starts[(i64)((values[k] - low) * scale)]++] = k;
    for (i64 k = 1; k < count; ++k) {
        const i64 self = order[k];
        i64 at = k;
        for (; at > 0 && values[order[at - 1]] > values[self]; --at) order[at] = order[at - 1];
        order[at] = self;
    }
}

// Mean height over the plane (point, n) at which rays against n have lost RAY_SHARE of their light.
inline double front_height(const Grid& g, i64 count, const double* point, const double* n, double h, Workspace& w) {
    double ax, ay, az;
    if (abs_of(n[0]) < 0.6) ax = 0.0, ay = n[2], az = -n[1];
    else ax = -n[2], ay = 0.0, az = n[0];
    const double scale = 1.0 / sqrt_of(ax * ax + ay * ay + az * az);
    ax *= scale, ay *= scale, az *= scale;
    const double bx = n[1] * az - n[2] * ay, by = n[2] * ax - n[0] * az, bz = n[0] * ay - n[1] * ax;
    i64 reached = 0;
    double* centers = w.rows[RAY_ROWS - 1];
    for (i64 k = 0; k < count; ++k) {
        const i64 i = w.near[k];
        const float* p = g.patches.row(i);
        const double x = p[MEAN] - point[0], y = p[MEAN + 1] - point[1], z = p[MEAN + 2] - point[2];
        const double u = x * ax + y * ay + z * az, v = x * bx + y * by + z * bz;
        if (!(sqrt_of(u * u + v * v) - RAY_RADIUS * h > 3.001 * p[SCALES])) {
            w.near[reached] = i;
            centers[reached++] = -(x * n[0] + y * n[1] + z * n[2]);
        }
    }
    nearest_first(centers, reached, w.order);
    double clear[8], heights[8], u[8] = {}, v[8] = {}, exponents[8];
    for (int ray = 0; ray < 7; ++ray) {
        u[ray] = ray < 6 ? RAY_RADIUS * h * cos_of(PI / 3.0 * ray) : 0.0;
        v[ray] = ray < 6 ? RAY_RADIUS * h * sin_of(PI / 3.0 * ray) : 0.0;
        clear[ray] = 1.0;
    }
    int left = 7;
    for (i64 m = 0; m < reached && left > 0; ++m) {
        const float* p = g.patches.row(w.near[w.order[m]]);
        const double x = p[MEAN] - point[0], y = p[MEAN + 1] - point[1], z = p[MEAN + 2] - point[2];
        double nn = 0, na = 0, nb = 0, aa = 0, ab = 0, bb = 0;
        for (int a = 0; a < 3; ++a) {
            const double qx = p[AXES + 3 * a], qy = p[AXES + 3 * a + 1], qz = p[AXES + 3 * a + 2];
            const double s = 1.0 / (double)p[SCALES + a];
            const double cn = (qx * n[0] + qy * n[1] + qz * n[2]) * s, ca = (qx * ax + qy * ay + qz * az) * s;
            const double cb = (qx * bx + qy * by + qz * bz) * s;
            nn += cn * cn, na += cn * ca, nb += cn * cb, aa += ca * ca, ab += ca * cb, bb += cb * cb;
        }
        const double at = x * ax + y * ay + z * az, beside = x * bx + y * by + z * bz;
        aa -= na * na / nn, ab -= na * nb / nn, bb -= nb * nb / nn;
        const double height = -centers[w.order[m]];
        na /= nn, nb /= nn;
        for (int ray = 0; ray < 8; ++ray) {
            const double du = at - u[ray], dv = beside - v[ray];
            exponents[ray] = aa * du * du + 2.0 * ab * du * dv + bb * dv * dv;
        }
        for (int ray = 0; ray < 7; ++ray) {
            if (exponents[ray] > 9.0 || clear[ray] < 0.0) continue;
            clear[ray] *= 1.0 - min_of(p[OPACITY_COLUMN] * exp_of(-0.5 * exponents[ray]), 0.999);
            if (1.0 - clear[ray] >= RAY_SHARE) {
                const double du = at - u[ray], dv = beside - v[ray];
                heights[ray] = min_of(max_of(height + na * du + nb * dv, -h), h);
                clear[ray] = -1.0;
                --left;
            }
        }
    }
    double total = 0.0, mean = 0.0;
    for (int ray = 0; ray < 7; ++ray)
        if (clear[ray] < 0.0) mean += heights[ray], total += 1.0;
    return total > 0.0 ? mean / total : 0.0;
}

// 0..1 probability that a height is off by less than 0.3 widths of the Gaussians seen there. out: what `estimate` found
// for a query along d.
inline double trust_of(const double* query, const double* d, const double* out) {
    const double along = (out[0] - query[0]) * d[0] + (out[1] - query[1]) * d[1] + (out[2] - query[2]) * d[2];
    const double move = min_of(MAX_TRUST_MOVE, abs_of(along) / out[6]);
    const double slant = max_of(0.0, min_of(1.0, -(out[3] * d[0] + out[4] * d[1] + out[5] * d[2])));
    const double residual = min_of(1.0, out[7]), thickness = min_of(1.0, out[8]);
    const double terms[] = {1.0, residual, residual * residual, min_of(residual, 0.15), thickness, 1.0 - out[10], slant,
                            slant * slant, min_of(move, 1.0), max_of(move - 1.0, 0.0)};
    double odds = 0.0;
    for (int k = 0; k < 10; ++k) odds += TRUST_WEIGHTS[k] * terms[k];
    return min_of(1.0, out[9] / FEW_PATCHES) / (1.0 + exp_of(-odds));
}

SP_INLINE bool is_query(const double* point, double h) {
    return 0.0 < h && h < 1e30 && abs_of(point[0]) + abs_of(point[1]) + abs_of(point[2]) < 1e30;
}

// One query; `out` stays as it is where there is no surface.
inline void estimate(const Grid& g, const double* query, const double* d, double h, Workspace& w, double* out) {
    double point[3] = {query[0], query[1], query[2]}, n[3], eigen[3];
    if (!is_query(point, h)) return;
    // A window with enough patches in it.
    i64 count = 0;
    int shrinks = 0;
    double total = 0.0, largest = 0.0, effective = 0.0;
    for (int growth = 0; growth < MAX_GROWTHS + MAX_SHRINKS + 1; ++growth) {
        count = h <= w.shared_window ? select(g, point, h, w, MAX_NEIGHBOURS)
                                     : gather(g, point, h, w.near, MAX_NEIGHBOURS);
        if (count > MAX_NEIGHBOURS) {
            count = 0;
            ++shrinks;
            h /= GROWTH;
            continue;
        }
        double squares = 0.0;
        total = largest = 0.0;
        masses(g, count, point, h, w);
        for (i64 k = 0; k < count; ++k) {
            total += w.mass[k];
            squares += w.mass[k] * w.mass[k];
            largest = max_of(largest, w.mass[k]);
        }
        effective = squares > 0.0 ? total * total / squares : 0.0;
        if (shrinks > 0 || effective >= MIN_PATCHES || growth >= MAX_GROWTHS) break;
        h *= GROWTH;
    }
    if (count < 1 || !(total > 0.0)) return;
    i64 used = 0;
    // Chosen without a branch, then looked at in a row: several at a time.
    for (i64 k = 0; k < count; ++k) {
        w.order[used] = w.near[k], w.rows[MASS][used] = w.mass[k];
        used += w.mass[k] >= MIN_MASS * largest;
    }
    for (i64 k = 0; k < used; ++k) patch(g, w.order[k], h, w, k);
    // The votes go on by eights.
    for (i64 k = used; k % 8; ++k)
        for (auto& row : w.rows) row[k] = 0.0;
    // First normal: of the patches, turned to the viewer.
    for (int j = 0; j < 3; ++j) n[j] = -1e-3 * d[j];
    for (i64 k = 0; k < used; ++k) {
        const double nx = w.rows[NX][k], ny = w.rows[NY][k], nz = w.rows[NZ][k];
        double f = w.rows[MASS][k] * w.rows[FLATNESS][k] / total;
        f = nx * d[0] + ny * d[1] + nz * d[2] <= 0.0 ? f : -f;
        n[0] += f * nx, n[1] += f * ny, n[2] += f * nz;
    }
    const double scale = 1.0 / sqrt_of(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    for (int j = 0; j < 3; ++j) n[j] *= scale;
    double tau = FIRST_TAU, residual = 1.0, thickness = 1.0, agreement = 0.0, height = 0.0, left = 0.0, s0 = 0.0;
    effective = 0.0;
    for (int round = 0; round < REWEIGHTINGS; ++round) {
        votes(w, used, point, n, h, tau);
        const double* s = w.sums;
        s0 = s[0];
        if (!(s0 > 0.0)) break;
        effective = s0 * s0 / s[15];
        const double cx = s[1] / s0, cy = s[2] / s0, cz = s[3] / s0;
        smallest_eigenvector(s[4] / s0 - cx * cx, s[5] / s0 - cx * cy, s[6] / s0 - cx * cz, s[7] / s0 - cy * cy,
                             s[8] / s0 - cy * cz, s[9] / s0 - cz * cz, eigen);
        const double center = cx * n[0] + cy * n[1] + cz * n[2];
        residual = sqrt_of(max_of(s[14] / s0 - center * center, 0.0)) / h;
        thickness = sqrt_of(max_of(s[16] / s0, 0.0)) / h;
        agreement = s[17] / s0;
        height = s[13] / s0;
        // The next normal: of the centres and of the patches.
        if (eigen[0] * n[0] + eigen[1] * n[1] + eigen[2] * n[2] < 0.0)
            for (int j = 0; j < 3; ++j) eigen[j] = -eigen[j];
        for (int j = 0; j < 3; ++j) n[j] = eigen[j] + s[10 + j] / s0;
        normalize(n);
        const double side = n[0] * d[0] + n[1] * d[1] + n[2] * d[2];
        if (side > 0.0) {  // turned away: the wall's other side
            for (int j = 0; j < 3; ++j) n[j] -= 1.01 * side * d[j];
            normalize(n);
        }
        const double slant = -(n[0] * d[0] + n[1] * d[1] + n[2] * d[2]);
        const double step = min_of(max_of(-height / max_of(slant, MIN_SLANT), -h), h);
        for (int j = 0; j < 3; ++j) point[j] += step * d[j];
        left = height + step * slant;
        tau = min_of(max_of(TAU_RESIDUALS * residual, MIN_TAU), FIRST_TAU);
    }
    if (!(s0 > 0.0)) return;
    if (residual > PRECISE_RESIDUAL) {
        double share = min_of((residual - PRECISE_RESIDUAL) / (CLOUDY_RESIDUAL - PRECISE_RESIDUAL), 1.0);
        share = share * share * (3.0 - 2.0 * share);
        const double front = front_height(g, count, point, n, h, w);
        const double slant = -(n[0] * d[0] + n[1] * d[1] + n[2] * d[2]);
        const double step = min_of(max_of(-share * front / max_of(slant, MIN_SLANT), -h), h);
        for (int j = 0; j < 3; ++j) point[j] += step * d[j];
    }
    for (int j = 0; j < 3; ++j) out[j] = point[j] + left * n[j], out[3 + j] = n[j];
    out[6] = h, out[7] = residual, out[8] = thickness, out[9] = effective, out[10] = agreement;
    out[11] = trust_of(query, d, out);
}

// Queries [start, start + size) by place, as numbers from `start` on: those in one cell, GROUP_WINDOWS of their mean
// windows wide, share a key. What is no query has -1.
SP_SMALL void order_by_place(const Rows<const double, 3>& points, const Array1<const double>& widths, i64 start,
                             i64 size, i64* keys, i64* order) {
    double low[3] = {INFINITE, INFINITE, INFINITE}, total = 0.0, number = 0.0;
    for (i64 k = 0; k < size; ++k) {
        const double* point = points.row(start + k);
        if (!is_query(point, widths(start + k))) continue;
        for (int a = 0; a < 3; ++a) low[a] = min_of(low[a], point[a]);
        total += widths(start + k), number += 1.0;
    }
    const double edge = GROUP_WINDOWS * total / number;
    for (i64 k = 0; k < size; ++k) {
        const double* point = points.row(start + k);
        i64 key = -1;
        if (is_query(point, widths(start + k))) {
            key = 0;
            for (int a = 0; a < 3; ++a)
                key = key << CELL_BITS | integer_of<i64>((point[a] - low[a]) / edge, 0, (1 << CELL_BITS) - 1);
        }
        order[k] = k, keys[k] = key;
    }
    // Shell's sort: a few hundred, most of them in order.
    for (i64 gap = size / 2; gap > 0; gap /= 2)
        for (i64 k = gap; k < size; ++k) {
            const i64 key = keys[k], self = order[k];
            i64 at = k;
            for (; at >= gap && keys[at - gap] > key; at -= gap) keys[at] = keys[at - gap], order[at] = order[at - gap];
            keys[at] = key, order[at] = self;
        }
}

}  // namespace surface

inline void estimate_surface(Array1<const i64> keys, Array1<const i64> level_starts, Array1<const double> cell_sizes,
                             Array1<const double> reaches, Array1<const double> corner,
                             Rows<const float, surface::PATCH_COLUMNS> patches,
                             Rows<const double, 3> points, Rows<const double, 3> directions,
                             Array1<const double> widths, Rows<double, 12> out, i64 thread, i64 threads) {
    const surface::Grid grid = {keys, level_starts, cell_sizes, reaches, corner, patches};
    surface::Workspace work = {};
    const i64 count = points.shape[0], share = count / (threads * surface::BLOCKS_PER_THREAD);
    const i64 block = min_of(max_of(share, surface::MIN_BLOCK), surface::MAX_BLOCK);
    for (i64 start = thread * block; start < count; start += threads * block) {
        const i64 size = min_of(block, count - start);
        i64 keys[surface::MAX_BLOCK], order[surface::MAX_BLOCK];
        surface::order_by_place(points, widths, start, size, keys, order);
        for (i64 first = 0; first < size;) {
            i64 last = first + 1;
            while (last < size && keys[last] == keys[first] && keys[first] >= 0) ++last;
            work.shared_window = 0.0;
            if (last - first >= surface::MIN_GROUP) {
                double low[3] = {INFINITE, INFINITE, INFINITE}, high[3] = {-INFINITE, -INFINITE, -INFINITE}, widest = 0;
                for (i64 k = first; k < last; ++k) {
                    const double* point = points.row(start + order[k]);
                    for (int a = 0; a < 3; ++a) low[a] = min_of(low[a], point[a]), high[a] = max_of(high[a], point[a]);
                    widest = max_of(widest, widths(start + order[k]));
                }
                surface::search_together(grid, low, high, widest, work);
            }
            for (; first < last; ++first) {
                const i64 q = start + order[first];
                surface::estimate(grid, points.row(q), directions.row(q), widths(q), work, out.row(q));
            }
        }
    }
}

} }  // namespace sp
