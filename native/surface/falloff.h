// exp of doubles in vectors, for weights: no table, and no fused multiply-adds, which are slow where CPUs lack them.
#pragma once
#include "../maths.h"

namespace sp { namespace {

// e^x for x <= 0: 2^n times the exponential's series for the rest, |rest| <= ln 2 / 2. Relative error below 4e-16; 0
// below -708. NaN stays NaN.
SP_INLINE Wide<double> falloff(Wide<double> x) {
    using V = Wide<double>;
    using I = Wide<i64>;
    const double shift = 0x1.8p52;  // added and taken away again, it rounds to an integer
    const V bounded = x < -709.0 ? all(-709.0) : x;
    const V shifted = bounded * 1.4426950408889634 + shift, n = shifted - shift;
    // ln 2 in two parts, of which n times the first is exact.
    const V r = (bounded - n * 0x1.62e42feep-1) - n * 0x1.a39ef35793c76p-33, s = r * r, q = s * s;
    // Pairs of terms, and pairs of these: few steps wait for each other.
    const V a = 1.0 + r, b = 0.5 + r * (1.0 / 6), c = 1.0 / 24 + r * (1.0 / 120), d = 1.0 / 720 + r * (1.0 / 5040);
    const V e = 1.0 / 40320 + r * (1.0 / 362880), f = 1.0 / 3628800 + r * (1.0 / 39916800);
    const V p = (a + s * b) + q * ((c + s * d) + q * ((e + s * f) + q * (1.0 / 479001600)));
    const V value = (V)((I)p + (((I)shifted) << 52));
    return x < -708.0 ? V{} : (x == x ? value : x);
}

SP_INLINE double root_of(double x) { return sqrt_of(x); }
#if defined(__clang__)
SP_INLINE Wide<double> root_of(Wide<double> x) { return __builtin_elementwise_sqrt(x); }
#else
SP_INLINE Wide<double> root_of(Wide<double> x) {
    for (int l = 0; l < W<double>; ++l) x[l] = sqrt_of(x[l]);
    return x;
}
#endif

// Eight numbers at a time on every CPU, in as many registers as that takes: sums by lanes are the same bits everywhere.
#define SP_EIGHT(l) for (int l = 0; l < 8; l += W<double>)

// The sum of eight lanes, halves first: always in this order.
SP_INLINE double sum_of_eight(const double* v) {
    return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}

} }  // namespace sp
