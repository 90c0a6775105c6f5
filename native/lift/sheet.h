// Cells and Gaussians of a sheet, as in splatpainter/lift/sheets/sheet.py and splatpainter/lift/sheets/resurface.py,
// which explain them and their thresholds. Sums of three run from the first term to the last.
#pragma once
#include "../maths.h"
#include "../vectors.h"

namespace sp { namespace {

namespace sheet {
constexpr i64 LARGEST_CELL = 8;  // pixels along its edge; smaller ones are a half, a quarter and an eighth of it
constexpr double MIN_QUAT = 1e-15;

// Third column of the rotation matrix of a quaternion, and all of it: columns are the rotated axes.
struct Turn { double w, x, y, z; };
SP_INLINE Turn turn_of(const double* q) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    const double norm = larger_of(sqrt_of(w * w + x * x + y * y + z * z), MIN_QUAT);
    return {w / norm, x / norm, y / norm, z / norm};
}
SP_INLINE Vector normal_of(Turn t) {
    return {2 * (t.x * t.z + t.w * t.y), 2 * (t.y * t.z - t.w * t.x), 1 - 2 * (t.x * t.x + t.y * t.y)};
}

// Distance of a point from a Gaussian in its standard deviations, none of which counts as less than `flatness` of the
// longest.
SP_SMALL double sigmas_of(const double* mean, const double* quat, const double* scale, double flatness, Vector point) {
    const Turn t = turn_of(quat);
    const double longest = larger_of(larger_of(scale[0], scale[1]), scale[2]);
    const Vector apart = {point.x - mean[0], point.y - mean[1], point.z - mean[2]};
    const Vector axes[3] = {
        {1 - 2 * (t.y * t.y + t.z * t.z), 2 * (t.x * t.y + t.w * t.z), 2 * (t.x * t.z - t.w * t.y)},
        {2 * (t.x * t.y - t.w * t.z), 1 - 2 * (t.x * t.x + t.z * t.z), 2 * (t.y * t.z + t.w * t.x)},
        normal_of(t),
    };
    double squares[3];
    for (int c = 0; c < 3; ++c) {
        const double offset = dot(apart, axes[c]) / larger_of(scale[c], flatness * longest);
        squares[c] = offset * offset;
    }
    return sqrt_of(squares[0] + squares[1] + squares[2]);
}

// Whether a block of pixels, all of them covered, lies on a plane: 1 / depth bends by less than `limit` of itself.
SP_SMALL bool is_plane(const Array2<const double>& depth, i64 top, i64 left, i64 size, double limit) {
    auto inverse = [&](i64 y, i64 x) { return 1.0 / depth(top + y, left + x); };
    const i64 half = size / 2, last = size - 1;
    const double a = inverse(0, 0), b = inverse(0, last), c = inverse(last, 0), d = inverse(last, last);
    const double middle = ((inverse(half - 1, half - 1) + inverse(half - 1, half)) +
                           (inverse(half, half - 1) + inverse(half, half))) / 4;
    const double bend = abs_of((((a + b) + c) + d) / 4 - middle) + abs_of(a + d - b - c) / 2;
    return bend < limit * larger_of(middle, 1e-30);
}

// Whether all pixels of a block and of the eight around it are covered and of one colour; what lies beyond the picture
// does not count, but for what fills the last largest cells up.
SP_SMALL bool is_flat(const Pixels<const float, 3>& colors, const Array2<const bool>& covered, i64 top, i64 left,
                       i64 size, float range) {
    const i64 height = covered.shape[0], width = covered.shape[1];
    auto filled = [](i64 length) { return (length + LARGEST_CELL - 1) / LARGEST_CELL * LARGEST_CELL; };
    const i64 bottom = min_of(top + 2 * size, filled(height)), right = min_of(left + 2 * size, filled(width));
    if (bottom > height || right > width) return false;
    const i64 first = max_of<i64>(left - size, 0);
    const float* start = colors.row(top, left);
    float low[3] = {start[0], start[1], start[2]}, high[3] = {start[0], start[1], start[2]};
    for (i64 y = max_of<i64>(top - size, 0); y < bottom; ++y) {
        for (i64 x = first; x < right; ++x) {
            if (!covered(y, x)) return false;
            const float* color = colors.row(y, x);
            for (int c = 0; c < 3; ++c) low[c] = min_of(low[c], color[c]), high[c] = max_of(high[c], color[c]);
        }
        for (int c = 0; c < 3; ++c)
            if (!(high[c] - low[c] < range)) return false;
    }
    return true;
}
}  // namespace sheet

// sizes [H, W] (zeros): at the first pixel of each cell its edge, pixels. Pixels of `covered` in cells as large as one
// colour (within `flat_range`) and a plane (1 / depth bends by less than flat_depth edges) allow; depth > 0 there.
SP_SMALL void choose_cells(Pixels<const float, 3> colors, Array2<const bool> covered, Array2<const double> depth,
                  float flat_range, double flat_depth, double fx, Array2<u8> sizes, i64 thread, i64 threads) {
    constexpr i64 LARGEST = sheet::LARGEST_CELL;
    const i64 height = covered.shape[0], width = covered.shape[1];
    const Share share = share_of((height + LARGEST - 1) / LARGEST, thread, threads);
    for (i64 y0 = share.begin * LARGEST; y0 < min_of(share.end * LARGEST, height); y0 += LARGEST)
        for (i64 x0 = 0; x0 < width; x0 += LARGEST) {
            // What larger cells do not take goes to the smaller ones within them.
            u8 left[LARGEST];  // a bit for each pixel of a row
            for (i64 y = 0; y < LARGEST; ++y) {
                left[y] = 0;
                for (i64 x = 0; x < LARGEST; ++x)
                    left[y] |= (y0 + y < height && x0 + x < width && covered(y0 + y, x0 + x)) << x;
            }
            for (i64 size = LARGEST; size > 0; size /= 2)
                for (i64 top = 0; top < LARGEST; top += size)
                    for (i64 side = 0; side < LARGEST; side += size) {
                        const u32 block = ((1u << size) - 1) << side;
                        u32 all = block;
                        for (i64 y = top; y < top + size; ++y) all &= left[y];
                        if (all != block) continue;
                        if (size > 1 && !(sheet::is_plane(depth, y0 + top, x0 + side, size, flat_depth * size / fx) &&
                                          sheet::is_flat(colors, covered, y0 + top, x0 + side, size, flat_range)))
                            continue;
                        sizes(y0 + top, x0 + side) = (u8)size;
                        for (i64 y = top; y < top + size; ++y) left[y] &= (u8)~block;
                    }
        }
}

// Flat Gaussians in planes with `normals` [G, 3] (camera space), as in sheet.pixel_gaussians: means [G, 3], quats
// [G, 4], scales [G, 3]. rays: [G, 3] sight lines; depth: [G]; layout: [G, 5] width in pixels, edge of the cell in
// pixels, stretch, how many share the cell, shift.
SP_SMALL void lay_gaussians(Rows<const double, 3> rays, Array1<const double> depth, Rows<const double, 3> normals,
                   Rows<const double, 5> layout, Rows<const double, 4> world_to_camera, double fx, double thickness,
                   Rows<double, 3> means, Rows<double, 4> quats, Rows<double, 3> scales, i64 thread, i64 threads) {
    const double* turn[3] = {world_to_camera.row(0), world_to_camera.row(1), world_to_camera.row(2)};
    // What lies along camera axes, in world axes.
    auto world = [&](Vector v, int i) { return v.x * turn[0][i] + v.y * turn[1][i] + v.z * turn[2][i]; };
    const Share share = share_of(depth.shape[0], thread, threads);
    for (i64 g = share.begin; g < share.end; ++g) {
        const Vector ray = vector_from(rays.row(g)), normal = vector_from(normals.row(g));
        const double length = length_of(ray);
        const Vector view = {ray.x / length, ray.y / length, ray.z / length};
        // The axis that the slant shortens lies along the normal's part across the line of sight.
        const Vector slant = normal - dot(normal, view) * view;
        const double size = length_of(slant), whole = larger_of(size, 1e-12);
        Vector across;
        if (size > 1e-6) across = cross(normal, Vector{slant.x / whole, slant.y / whole, slant.z / whole});
        else {
            const Vector axis = abs_of(view.x) < 0.9 ? Vector{1.0, 0.0, 0.0} : Vector{0.0, 1.0, 0.0};
            across = cross(normal, cross(view, axis));
        }
        const double norm = larger_of(length_of(across), 1e-12);
        across = {across.x / norm, across.y / norm, across.z / norm};
        const Vector along = cross(normal, across);
        const bool mirrored = dot(cross(across, along), normal) < 0.0;
        double m[3][3];
        for (int i = 0; i < 3; ++i) {
            m[i][0] = world(across, i), m[i][1] = world(along, i), m[i][2] = world(normal, i);
            if (mirrored) m[i][0] = m[i][0] * -1.0;  // quaternions have no left-handed frames
        }
        // 4 q q^T is linear in the matrix; its row with the largest diagonal gives q without cancellation.
        const double wx = m[2][1] - m[1][2], wy = m[0][2] - m[2][0], wz = m[1][0] - m[0][1];
        const double xy = m[0][1] + m[1][0], xz = m[0][2] + m[2][0], yz = m[1][2] + m[2][1];
        const double rows[4][4] = {{1 + m[0][0] + m[1][1] + m[2][2], wx, wy, wz},
                                   {wx, 1 + m[0][0] - m[1][1] - m[2][2], xy, xz},
                                   {wy, xy, 1 - m[0][0] + m[1][1] - m[2][2], yz},
                                   {wz, xz, yz, 1 - m[0][0] - m[1][1] + m[2][2]}};
        int best = 0;
        for (int k = 1; k < 4; ++k) best = rows[k][k] > rows[best][best] ? k : best;
        const double* q = rows[best];
        const double root = sqrt_of(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int k = 0; k < 4; ++k) quats(g, k) = q[k] / root;
        const double z = depth(g), width_px = layout(g, 0), cell_px = layout(g, 1), stretch = layout(g, 2);
        const double width = width_px * z / fx;
        scales(g, 0) = width, scales(g, 1) = width * stretch / layout(g, 3), scales(g, 2) = width * thickness;
        const Vector at = {ray.x * z - turn[0][3], ray.y * z - turn[1][3], ray.z * z - turn[2][3]};
        const double shift = layout(g, 4) * cell_px * z / fx * stretch;
        for (int i = 0; i < 3; ++i) means(g, i) = world(at, i) + shift * world(along, i);
    }
}

// out [C]: whether sheet Gaussians (means [C, 3], quats [C, 4]) hang past the horizon of the Gaussians in whose place
// they lie (host_means [N, 3], ...): the cosine between line of sight and normal is less than `horizon`, and they are
// farther than `most` standard deviations from their host (hosts [C]) and from all that weigh most in the pixels
// (heaviest [H, W], -1: none) within `reach` of their own (pixels [C, 2], x and y).
SP_SMALL void mark_past_horizon(Rows<const double, 3> host_means, Rows<const double, 4> host_quats,
                                Rows<const double, 3> host_scales, Rows<const double, 3> means,
                                Rows<const double, 4> quats, Array1<const i64> hosts, Rows<const double, 2> pixels,
                                Array2<const i64> heaviest, Array1<const double> position, double horizon,
                                double most, double flatness, i64 reach, Array1<bool> out, i64 thread, i64 threads) {
    const i64 height = heaviest.shape[0], width = heaviest.shape[1];
    const Vector eye = {position(0), position(1), position(2)};
    const Share share = share_of(means.shape[0], thread, threads);
    for (i64 c = share.begin; c < share.end; ++c) {
        out(c) = false;
        const Vector point = vector_from(means.row(c)), sight = point - eye;
        const double facing = abs_of(dot(sheet::normal_of(sheet::turn_of(quats.row(c))), sight));
        if (!(facing / larger_of(length_of(sight), 1e-30) < horizon)) continue;
        auto is_beyond = [&](i64 i) {
            return sheet::sigmas_of(host_means.row(i), host_quats.row(i), host_scales.row(i), flatness, point) > most;
        };
        bool beyond = is_beyond(hosts(c));
        // Any Gaussian of the surroundings may be the surface here, not only the pixel's own. Neighbours mostly share
        // theirs.
        const i64 x = integer_of<i64>(pixels(c, 0), -reach - 1, width + reach);
        const i64 y = integer_of<i64>(pixels(c, 1), -reach - 1, height + reach);
        i64 known = hosts(c);
        for (i64 dy = -reach; dy <= reach && beyond; ++dy)
            for (i64 dx = -reach; dx <= reach && beyond; ++dx) {
                const i64 beside = heaviest(max_of<i64>(min_of(y + dy, height - 1), 0),
                                            max_of<i64>(min_of(x + dx, width - 1), 0));
                if (beside < 0 || beside == known) continue;
                known = beside, beyond = is_beyond(beside);
            }
        out(c) = beyond;
    }
}

} }  // namespace sp
