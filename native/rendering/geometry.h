// One Gaussian seen by one camera. EWA splatting as in splatpainter/rendering/cpu/geometry.py.
#pragma once
#include "../maths.h"
#include "profiles.h"

namespace sp { namespace {

constexpr int TILE = 16;
// Added to a Gaussian's squared radius: what is drawn must be decided by alpha alone.
constexpr double RADIUS_MARGIN = 1e-3;
constexpr double MAX_MAGNITUDE = 1e15, MIN_QUAT = 1e-15;

// Columns of `projected` [M, 16].
enum { MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_Y, EXTENT_X,
       SQUARED_RADIUS, UNCLAMPED_RED, UNCLAMPED_GREEN, UNCLAMPED_BLUE, COLUMNS };

// The camera vector [27]: rotation, translation, lens, bounds for Jacobians, window, centre.
enum { FX = 12, FY, CX, CY, U_MIN, U_MAX, V_MIN, V_MAX, X_MIN, X_MAX, Y_MIN, Y_MAX, EYE_X, EYE_Y, EYE_Z, CAMERA_SIZE };

template <class F> struct Vec3 { F x, y, z; };
// Of the pixel with respect to the camera-space point, at (u, v) = (x, y) / z clamped to a little outside the picture
// (a linearisation far outside explodes), and the clamped u, v.
template <class F> struct Jacobian { F j00, j02, j11, j12, uc, vc; };

template <class C, class F>
SP_INLINE Vec3<F> to_camera(const C* cam, F px, F py, F pz) {
    return {cam[0] * px + cam[1] * py + cam[2] * pz + cam[9],
            cam[3] * px + cam[4] * py + cam[5] * pz + cam[10],
            cam[6] * px + cam[7] * py + cam[8] * pz + cam[11]};
}

template <class C, class F>
SP_INLINE Jacobian<F> jacobian(const C* cam, F u, F v, F rz) {
    const F zero = {};
    const F uc = smaller_of(larger_of(u, zero + cam[U_MIN]), zero + cam[U_MAX]);
    const F vc = smaller_of(larger_of(v, zero + cam[V_MIN]), zero + cam[V_MAX]);
    F j00 = cam[FX] * rz, j11 = cam[FY] * rz;
    return {j00, -j00 * uc, j11, -j11 * vc, uc, vc};
}

// Whether the box of half extents ex, ey around (mx, my) meets the camera's window; not for NaN.
template <class C, class F>
SP_INLINE auto meets_window(const C* cam, F mx, F my, F ex, F ey) {
    return (mx + ex > cam[X_MIN]) & (mx - ex < cam[X_MAX]) & (my + ey > cam[Y_MIN]) & (my - ey < cam[Y_MAX]);
}

// J W, [2, 3]: of the pixel with respect to the world point.
template <class C, class F>
SP_INLINE void to_world(const C* cam, const Jacobian<F>& j, F* p) {
    for (int k = 0; k < 3; ++k) {
        p[k] = j.j00 * cam[k] + j.j02 * cam[6 + k];
        p[3 + k] = j.j11 * cam[3 + k] + j.j12 * cam[6 + k];
    }
}

// out [4] = quat / |quat|, NaN for the zero one; returns 1 / |quat|. Scaled first: float32 squares of 1e-25 vanish.
template <class F>
SP_INLINE F unit_quat(const F* quat, F* out) {
    const F big = 1 / larger_of(larger_of(magnitude_of(quat[0]), magnitude_of(quat[1])),
                                larger_of(magnitude_of(quat[2]), magnitude_of(quat[3])));
    const F w = quat[0] * big, x = quat[1] * big, y = quat[2] * big, z = quat[3] * big;
    const F inverse = 1 / sqrt_of(w * w + x * x + y * y + z * z);
    out[0] = w * inverse, out[1] = x * inverse, out[2] = y * inverse, out[3] = z * inverse;
    return inverse * big;
}

// [3, 3] of a unit quaternion, row by row.
template <class F>
SP_INLINE void rotation(const F* unit, F* q) {
    const F w = unit[0], x = unit[1], y = unit[2], z = unit[3];
    q[0] = 1 - 2 * (y * y + z * z), q[1] = 2 * (x * y - w * z), q[2] = 2 * (x * z + w * y);
    q[3] = 2 * (x * y + w * z), q[4] = 1 - 2 * (x * x + z * z), q[5] = 2 * (y * z - w * x);
    q[6] = 2 * (x * z - w * y), q[7] = 2 * (y * z + w * x), q[8] = 1 - 2 * (x * x + y * y);
}

// P R, [2, 3]: the rotated axes in pixels per world unit.
template <class F>
SP_INLINE void project_axes(const F* p, const F* q, F* out) {
    for (int row = 0; row < 2; ++row)
        for (int k = 0; k < 3; ++k)
            out[3 * row + k] = p[3 * row] * q[k] + p[3 * row + 1] * q[3 + k] + p[3 * row + 2] * q[6 + k];
}

// Whether Gaussians' means and quaternions are in the ranges of Splats.drawable; NaN is not.
template <class F>
SP_INLINE auto in_range(F x, F y, F z, const F* quat) {
    const auto largest = decltype(x[0] + 0)(MAX_MAGNITUDE), smallest = decltype(x[0] + 0)(MIN_QUAT);
    const F norm = larger_of(larger_of(magnitude_of(quat[0]), magnitude_of(quat[1])),
                             larger_of(magnitude_of(quat[2]), magnitude_of(quat[3])));
    // A larger one may hide NaN.
    const F sum = quat[0] + quat[1] + quat[2] + quat[3];
    return (norm >= smallest) & (norm <= largest) & (sum == sum) & (magnitude_of(x) <= largest) &
           (magnitude_of(y) <= largest) & (magnitude_of(z) <= largest);
}

struct Span { i64 begin, end; };

// int(x) within [0, last], 0 for NaN; clamped as a float, because casts of what an integer cannot hold are undefined.
template <class F>
SP_INLINE i64 clamped(F x, i64 last) {
    x = x > F(0) ? x : F(0);
    return (i64)(x < F(last) ? x : F(last));
}

// Tiles which the interval [m - e, m + e] touches, within [first, last).
template <class F>
SP_INLINE Span tile_span(F m, F e, i64 first, i64 last) {
    i64 begin = max_of(clamped((m - e) * F(1.0 / TILE), last), first);
    return {begin, max_of(clamped((m + e) * F(1.0 / TILE) + F(1), last), begin)};
}

// Tiles of the row that starts at pixel y0 which the ellipse touches, within [first, last).
template <class F>
SP_INLINE Span tile_columns(F mx, F my, F a, F b, F q, F ex, F ey, F y0, i64 first, i64 last) {
    F slope = -b / a;
    F width = sqrt_of(q / a);
    F star = slope * ey * ey / ex;
    F shrink = F(1) / ey;
    F low = max_of(y0 - my, -ey);
    F high = min_of(y0 + F(TILE) - my, ey);
    F right = min_of(max_of(star, low), high);
    F left = min_of(max_of(-star, low), high);
    F up = right * shrink;
    F down = left * shrink;
    F x1 = mx + slope * right + width * sqrt_of(max_of(F(1) - up * up, F(0)));
    F x0 = mx + slope * left - width * sqrt_of(max_of(F(1) - down * down, F(0)));
    i64 begin = max_of(clamped(x0 * F(1.0 / TILE), last), first);
    return {begin, clamped(x1 * F(1.0 / TILE) + F(1), last)};
}

// Real spherical harmonics for a unit direction, INRIA's order and signs, (degree + 1)^2 entries.
template <class V>
SP_INLINE void sh_basis(V x, V y, V z, i64 degree, V* b) {
    using F = typename ScalarOf<V>::type;
    b[0] = V{} + F(0.2820947917738781);
    if (degree < 1) return;
    b[1] = F(-0.48860251190292) * y;
    b[2] = F(0.48860251190292) * z;
    b[3] = F(-0.48860251190292) * x;
    if (degree < 2) return;
    V zz = z * z, c1 = x * x - y * y, s1 = F(2) * x * y;
    b[4] = F(0.5462742152960395) * s1;
    b[5] = F(-1.092548430592079) * z * y;
    b[6] = F(0.9461746957575601) * zz - F(0.3153915652525201);
    b[7] = F(-1.092548430592079) * z * x;
    b[8] = F(0.5462742152960395) * c1;
    if (degree < 3) return;
    V linear = F(-2.285228997322329) * zz + F(0.4570457994644658);
    V c2 = x * c1 - y * s1, s2 = x * s1 + y * c1;
    b[9] = F(-0.5900435899266435) * s2;
    b[10] = F(1.445305721320277) * z * s1;
    b[11] = linear * y;
    b[12] = z * (F(1.865881662950577) * zz - F(1.119528997770346));
    b[13] = linear * x;
    b[14] = F(1.445305721320277) * z * c1;
    b[15] = F(-0.5900435899266435) * c2;
    if (degree < 4) return;
    V cubic = z * (F(-4.683325804901025) * zz + F(2.007139630671868));
    V square = F(3.31161143515146) * zz - F(0.47308734787878);
    V c3 = x * c2 - y * s2, s3 = x * s2 + y * c2;
    b[16] = F(0.6258357354491763) * s3;
    b[17] = F(-1.770130769779931) * z * s2;
    b[18] = square * s1;
    b[19] = cubic * y;
    b[20] = F(1.984313483298443) * z * b[12] - F(1.006230589874905) * b[6];
    b[21] = cubic * x;
    b[22] = square * c1;
    b[23] = F(-1.770130769779931) * z * c2;
    b[24] = F(0.6258357354491763) * c3;
}

} }  // namespace sp
