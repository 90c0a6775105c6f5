// On which side of a sheet's surface Gaussians lie; constants as in splatpainter/lift/sheets/near_surface.py.
#pragma once
#include "../maths.h"

namespace sp { namespace {

namespace near_surface {
constexpr double NORMAL_SIGMAS = 2.0, SURFACE_WINDOWS = 0.35, FAR_WINDOWS = 3.0, MIN_QUAT = 1e-15;
enum : u8 { BESIDE, TOUCHES, FAR_BEHIND };

// int(x) within [0, size), 0 for NaN.
SP_INLINE i64 pixel(double x, i64 size) { return integer_of<i64>(x, 0, size - 1); }
}  // namespace near_surface

// means, quats, scales: [N, ...]; ids: [Q]; turn: [4, 4] world to camera; lens: fx, fy, cx, cy; nearest: [H, W] flat
// index of the nearest covered pixel; entry: [H, W] entry of each covered pixel in depths [C], normals [C, 3] (camera
// space), windows [C], residuals [C] (world units); touching: only TOUCHES is asked for, and FAR_BEHIND not said. All
// in double precision, whatever the Gaussians are in.
template <class F>
void classify_sides(Rows<const F, 3> means, Rows<const F, 4> quats, Rows<const F, 3> scales, Array1<const i64> ids,
                    Rows<const double, 4> turn, Array1<const double> lens, Array2<const i32> nearest,
                    Array2<const i64> entry, Array1<const double> depths, Rows<const double, 3> normals,
                    Array1<const double> windows, Array1<const double> residuals, bool touching, Array1<u8> out,
                    i64 thread, i64 threads) {
    using namespace near_surface;
    const i64 height = nearest.shape[0], width = nearest.shape[1], count = ids.shape[0];
    const double fx = lens(0), fy = lens(1), cx = lens(2), cy = lens(3);
    for (i64 q = count * thread / threads; q < count * (thread + 1) / threads; ++q) {
        out(q) = BESIDE;
        const i64 i = ids(q);
        const double mx = means(i, 0), my = means(i, 1), mz = means(i, 2);
        const double x = turn(0, 0) * mx + turn(0, 1) * my + turn(0, 2) * mz + turn(0, 3);
        const double y = turn(1, 0) * mx + turn(1, 1) * my + turn(1, 2) * mz + turn(1, 3);
        const double z = turn(2, 0) * mx + turn(2, 1) * my + turn(2, 2) * mz + turn(2, 3);
        if (!(z > 0.0)) continue;
        const i64 at_pixel = nearest(pixel(fy * y / z + cy, height), pixel(fx * x / z + cx, width));
        const i64 line = at_pixel / width, column = at_pixel - line * width, at = entry(line, column);
        const double depth = depths(at), nx = normals(at, 0), ny = normals(at, 1), nz = normals(at, 2);
        double h = (x - ((double)column + 0.5 - cx) / fx * depth) * nx;
        h += (y - ((double)line + 0.5 - cy) / fy * depth) * ny;
        h += (z - depth) * nz;
        const double near = SURFACE_WINDOWS * windows(at) + 2.0 * residuals(at);
        if (abs_of(h) < near) {
            out(q) = TOUCHES;
            continue;
        }
        // Most of an asset lies far before the surface or far behind: the longest axis alone decides.
        const double sx = scales(i, 0), sy = scales(i, 1), sz = scales(i, 2), longest = max_of(sx, max_of(sy, sz));
        if ((touching ? abs_of(h) : h) > 1.000001 * NORMAL_SIGMAS * longest + near) continue;
        // The normal in world axes, then along each axis of the Gaussian.
        const double wx = turn(0, 0) * nx + turn(1, 0) * ny + turn(2, 0) * nz;
        const double wy = turn(0, 1) * nx + turn(1, 1) * ny + turn(2, 1) * nz;
        const double wz = turn(0, 2) * nx + turn(1, 2) * ny + turn(2, 2) * nz;
        double a = quats(i, 0), b = quats(i, 1), c = quats(i, 2), d = quats(i, 3);
        const double norm = max_of(sqrt_of(a * a + b * b + c * c + d * d), MIN_QUAT);
        a /= norm, b /= norm, c /= norm, d /= norm;
        double first = (1 - 2 * (c * c + d * d)) * wx + 2 * (b * c + a * d) * wy + 2 * (b * d - a * c) * wz;
        double second = 2 * (b * c - a * d) * wx + (1 - 2 * (b * b + d * d)) * wy + 2 * (c * d + a * b) * wz;
        double third = 2 * (b * d + a * c) * wx + 2 * (c * d - a * b) * wy + (1 - 2 * (b * b + c * c)) * wz;
        first *= sx, second *= sy, third *= sz;
        const double limit = NORMAL_SIGMAS * sqrt_of(first * first + second * second + third * third) + near;
        if (abs_of(h) < limit) out(q) = TOUCHES;
        else if (h < -limit - FAR_WINDOWS * windows(at)) out(q) = FAR_BEHIND;
    }
}

} }  // namespace sp
