// Three numbers as one: what geometry in world units is written in.
#pragma once
#include "rendering/geometry.h"

namespace sp { namespace {

using Vector = Vec3<double>;

template <class F> SP_INLINE Vec3<F> operator+(Vec3<F> a, Vec3<F> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class F> SP_INLINE Vec3<F> operator-(Vec3<F> a, Vec3<F> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class F> SP_INLINE Vec3<F> operator*(F s, Vec3<F> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class F> SP_INLINE F dot(Vec3<F> a, Vec3<F> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class F> SP_INLINE Vec3<F> cross(Vec3<F> a, Vec3<F> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
SP_INLINE double length_of(Vector a) { return __builtin_sqrt(dot(a, a)); }

// Three numbers as they lie in memory.
template <class F> SP_INLINE Vec3<F> vector_from(const F* v) { return {v[0], v[1], v[2]}; }
SP_INLINE Vector as_vector(const float* v) { return {v[0], v[1], v[2]}; }
template <class F> SP_INLINE void store_vector(F* out, Vec3<F> v) { out[0] = v.x, out[1] = v.y, out[2] = v.z; }

// Whether squares of both are far from overflow; not for NaN.
SP_INLINE bool is_moderate(Vector p, Vector n) {
    return abs_of(p.x) + abs_of(p.y) + abs_of(p.z) + abs_of(n.x) + abs_of(n.y) + abs_of(n.z) < 1e30;
}

} }  // namespace sp
