// Elementary functions with the same bits on every system: libm's differ between systems and versions.
//
// Only sums, products, quotients, roots and fused multiply-adds, each rounded as IEEE 754 says. Formulas and
// coefficients of log, sin, cos, acos and atan are those of FreeBSD's msun (fdlibm), errors below 1 unit in the last
// place:
//
//   Copyright (C) 1993 by Sun Microsystems, Inc. All rights reserved.
//   Developed at SunSoft, a Sun Microsystems, Inc. business. Permission to use, copy, modify, and distribute this
//   software is freely granted, provided that this notice is preserved.
//
// float forms are those of double, rounded.
#pragma once
#include "exp_table.h"
#include "lanes.h"

namespace sp { namespace {

constexpr double PI = 3.141592653589793;
constexpr double INFINITE = __builtin_inf(), NOT_A_NUMBER = __builtin_nan("");

SP_INLINE float sqrt_of(float x) { return __builtin_sqrtf(x); }
SP_INLINE double sqrt_of(double x) { return __builtin_sqrt(x); }
SP_INLINE float floor_of(float x) { return __builtin_floorf(x); }
SP_INLINE double floor_of(double x) { return __builtin_floor(x); }
SP_INLINE float ceil_of(float x) { return __builtin_ceilf(x); }
SP_INLINE double ceil_of(double x) { return __builtin_ceil(x); }
#if defined(__clang__)
SP_INLINE Wide<float> sqrt_of(Wide<float> x) { return __builtin_elementwise_sqrt(x); }
SP_INLINE Wide<double> sqrt_of(Wide<double> x) { return __builtin_elementwise_sqrt(x); }
#else
SP_INLINE Wide<float> sqrt_of(Wide<float> x) {
    for (int l = 0; l < W<float>; ++l) x[l] = sqrt_of(x[l]);
    return x;
}
SP_INLINE Wide<double> sqrt_of(Wide<double> x) {
    for (int l = 0; l < W<double>; ++l) x[l] = sqrt_of(x[l]);
    return x;
}
#endif
template <class F> SP_INLINE bool is_finite(F x) { return abs_of(x) < F(INFINITE); }

// Integers of numbers that they cannot hold are undefined in C++ and differ between CPUs: clamp first. 0 for NaN.
template <class Integer, class F>
SP_INLINE Integer integer_of(F x, Integer low, Integer high) {
    if (!(x == x)) return 0;
    return x <= F(low) ? low : x >= F(high) ? high : (Integer)x;
}

// The sum of 16 lanes, halves first: lane l + lane l + 8, of these l + 4, and so on; always in this order.
template <class F>
SP_INLINE F sum_of(const F* lanes) {
    F s[8];
    for (int l = 0; l < 8; ++l) s[l] = lanes[l] + lanes[l + 8];
    for (int l = 0; l < 4; ++l) s[l] += s[l + 4];
    return (s[0] + s[2]) + (s[1] + s[3]);
}

// The sums of COUNT (1 to 8) times 16 lanes, each in the order of sum_of, and zeros: out[0..7]. lanes are aligned.
template <int COUNT, class F>
SP_INLINE void sums_of(const F (*lanes)[LANES], F* out) {
    using V = typename LanesOf<F>::eight;
    V s[8] = {};
    for (int k = 0; k < COUNT; ++k) {
        V low, high;
        __builtin_memcpy(&low, lanes[k], sizeof low);
        __builtin_memcpy(&high, lanes[k] + 8, sizeof high);
        s[k] = low + high;
    }
    V pairs[4], fours[2];
    for (int k = 0; k < 4; ++k)  // of fields k and k + 4
        pairs[k] = __builtin_shufflevector(s[k], s[k + 4], 0, 1, 2, 3, 8, 9, 10, 11) +
                   __builtin_shufflevector(s[k], s[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    for (int k = 0; k < 2; ++k)  // of fields k, k + 2, k + 4, k + 6
        fours[k] = __builtin_shufflevector(pairs[k], pairs[k + 2], 0, 1, 8, 9, 4, 5, 12, 13) +
                   __builtin_shufflevector(pairs[k], pairs[k + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    const V all = __builtin_shufflevector(fours[0], fours[1], 0, 8, 2, 10, 4, 12, 6, 14) +
                  __builtin_shufflevector(fours[0], fours[1], 1, 9, 3, 11, 5, 13, 7, 15);
    __builtin_memcpy(out, &all, sizeof all);
}

// The largest of 16 lanes, none of them NaN; they are aligned.
template <class F>
SP_INLINE F largest_of(const F* lanes) {
    using V = typename LanesOf<F>::eight;
    V low, high;
    __builtin_memcpy(&low, lanes, sizeof low);
    __builtin_memcpy(&high, lanes + 8, sizeof high);
    V most = larger_of(low, high);
    most = larger_of(most, __builtin_shufflevector(most, most, 4, 5, 6, 7, 0, 1, 2, 3));
    most = larger_of(most, __builtin_shufflevector(most, most, 2, 3, 0, 1, 6, 7, 4, 5));
    return max_of(most[0], most[1]);
}

// exp(x) for x <= 0 in single precision: 2^n times a polynomial (Cephes' exp2f coefficients); relative error about
// 1e-7, 2^-126 below, and for NaN.
SP_INLINE Wide<float> exp_of_negative(Wide<float> x) {
    using V = Wide<float>;
    using I = Wide<i32>;
    const V low = all(-126.0f), scaled = x * 1.4426950408889634f;
    const V y = scaled > low ? scaled : low;  // NaN becomes `low`: casts of NaN are undefined
    const I n = __builtin_convertvector(y - 0.5f, I);
    const V r = y - __builtin_convertvector(n, V);
    V p = fused(all(1.535336188319500e-4f), r, all(1.339887440266574e-3f));
    p = fused(p, r, all(9.618437357674640e-3f));
    p = fused(p, r, all(5.550332471162809e-2f));
    p = fused(p, r, all(2.402264791363012e-1f));
    p = fused(p, r, all(6.931472028550421e-1f));
    p = fused(p, r, all(1.0f));
    return (V)((I)p + (n << 23));
}

// exp(x), by a table (P. T. P. Tang, "Table-Driven Implementation of the Exponential Function in IEEE Floating-Point
// Arithmetic", ACM TOMS 1989): x = k ln 2 / 128 + r, exp(x) = 2^(k / 128) exp(r). Size of the table, coefficients and
// order of operations are those of Szabolcs Nagy's exp (Arm Optimized Routines, MIT licence), which glibc has since
// 2.28. Error below 0.52 units in the last place; 0 below -708, infinity above 709.
SP_INLINE double exp_of(double x) {
    const double shift = 0x1.8p52;  // added and taken away again, it rounds to an integer
    const double bounded = x > -800.0 ? (x < 800.0 ? x : 800.0) : (x == x ? -800.0 : x);
    const double shifted = fused(0x1.71547652b82fep0 * 128, bounded, shift);
    const u64 number = bits_of<u64>(shifted);
    const double steps = shifted - shift;
    const double r = fused(steps, -0x1.cf79abc9e3b39p-47, fused(steps, -0x1.62e42fefa0000p-8, bounded));
    const u64 i = number & 127;
    const double scale = bits_of<double>((u64)EXP_BITS[i] + (number << 45));
    const double square = r * r;
    double rest = fused(square, fused(r, 0x1.555555555543cp-3, 0x1.ffffffffffdbdp-2), EXP_TAILS[i] + r);
    rest = fused(square * square, fused(r, 0x1.1111167a4d017p-7, 0x1.55555cf172b91p-5), rest);
    const double value = fused(scale, rest, scale);
    return x < -708.0 ? 0.0 : x > 709.0 ? INFINITE : value;
}
SP_INLINE float exp_of(float x) { return (float)exp_of((double)x); }
SP_INLINE Wide<double> exp_of_negative(Wide<double> x) {
    for (int l = 0; l < W<double>; ++l) x[l] = exp_of(x[l]);
    return x;
}

// The natural logarithm; -infinity of 0, NaN below. Subnormal numbers count as 0.
SP_INLINE double log_of(double x) {
    u64 bits = bits_of<u64>(x);
    bits += 0x3ff0000000000000u - 0x3fe6a09e667f3bcdu;
    const double k = (double)((i64)(bits >> 52) - 0x3ff);
    const double m = bits_of<double>((bits & 0x000fffffffffffffu) + 0x3fe6a09e667f3bcdu);  // [sqrt(1/2), sqrt(2))
    const double f = m - 1.0, half = 0.5 * f * f, s = f / (2.0 + f), z = s * s, w = z * z;
    const double even = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01));
    const double odd = z * (6.666666666666735130e-01 + w * (2.857142874366239149e-01 +
                       w * (1.818357216161805012e-01 + w * 1.479819860511658591e-01)));
    const double low = s * (half + (odd + even)) + k * 1.90821492927058770002e-10;
    const double value = low - half + f + k * 6.93147180369123816490e-01;
    if (!(x >= 0x1p-1022)) return x >= 0.0 ? -INFINITE : NOT_A_NUMBER;
    return x < INFINITE ? value : x;
}
SP_INLINE float log_of(float x) { return (float)log_of((double)x); }

// The natural logarithm of positive normal numbers in vectors; anything for others. float: Cephes' logf, error about
// 1e-7 of the result and of 1.
SP_INLINE Wide<float> log_of_positive(Wide<float> x) {
    using V = Wide<float>;
    using U = Wide<u32>;
    const U bits = (U)x - 0x3f3504f3u;  // sqrt(1/2)
    const Wide<i32> exponent = (Wide<i32>)bits >> 23;
    const V k = __builtin_convertvector(exponent, V), f = (V)((bits & 0x007fffffu) + 0x3f3504f3u) - 1.0f, z = f * f;
    V p = fused(all(7.0376836292e-2f), f, all(-1.1514610310e-1f));
    p = fused(p, f, all(1.1676998740e-1f));
    p = fused(p, f, all(-1.2420140846e-1f));
    p = fused(p, f, all(1.4249322787e-1f));
    p = fused(p, f, all(-1.6668057665e-1f));
    p = fused(p, f, all(2.0000714765e-1f));
    p = fused(p, f, all(-2.4999993993e-1f));
    p = fused(p, f, all(3.3333331174e-1f));
    const V rest = fused(k, all(-2.12194440e-4f), fused(p * f, z, -0.5f * z));
    return fused(k, all(0.693359375f), f + rest);
}
SP_INLINE Wide<double> log_of_positive(Wide<double> x) {
    for (int l = 0; l < W<double>; ++l) x[l] = log_of(x[l]);
    return x;
}

namespace angles {

// x = n pi / 2 + high + low; returns n modulo 4. For |x| up to a million; beyond, NaN and infinities, 1e6 stands for x.
SP_INLINE int quadrant(double x, double& high, double& low) {
    const double bounded = x > -1e6 ? (x < 1e6 ? x : 1e6) : -1e6;
    const double n = (bounded * 6.36619772367581382433e-01 + 0x1.8p52) - 0x1.8p52;
    // pi / 2 in parts of 33 bits, so that n times each is exact.
    const double r1 = bounded - n * 1.57079632673412561417e+00, w2 = n * 6.07710050630396597660e-11, r2 = r1 - w2;
    double r = r2, w = n * 2.02226624879595063154e-21 - ((r1 - r2) - w2);
    if (abs_of(r2 - w) < 0x1p-40) {  // near a multiple of pi / 2
        const double w3 = n * 2.02226624871116645580e-21;
        r = r2 - w3;
        w = n * 8.47842766036889956997e-32 - ((r2 - r) - w3);
    }
    high = r - w;
    low = (r - high) - w;
    return (int)(i64)n & 3;
}
SP_INLINE double sine(double x, double y) {  // of x + y, |x| <= pi / 4
    const double z = x * x, w = z * z, v = z * x;
    const double r = 8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 + z * 2.75573137070700676789e-06) +
                     z * w * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10);
    return x - ((z * (0.5 * y - v * r) - y) - v * -1.66666666666666324348e-01);
}
SP_INLINE double cosine(double x, double y) {
    const double z = x * x, w = z * z;
    const double first = -1.38888888888741095749e-03 + z * 2.48015872894767294178e-05;
    const double second = 2.08757232129817482790e-09 + z * -1.13596475577881948265e-11;
    const double r = z * (4.16666666666666019037e-02 + z * first) + w * w * (-2.75573143513906633035e-07 + z * second);
    const double half = 0.5 * z, rest = 1.0 - half;
    return rest + (((1.0 - rest) - half) + (z * r - x * y));
}
SP_INLINE double acos_ratio(double z) {
    const double tail = -4.00555345006794114027e-02 + z * (7.91534994289814532176e-04 + z * 3.47933107596021167570e-05);
    const double p = z * (1.66666666666666657415e-01 +
                          z * (-3.25565818622400915405e-01 + z * (2.01212532134862925881e-01 + z * tail)));
    const double q = 1.0 + z * (-2.40339491173441421878e+00 + z * (2.02094576023350569471e+00 +
                     z * (-6.88283971605453293030e-01 + z * 7.70381505559019352791e-02)));
    return p / q;
}
constexpr double HALF_PI_HIGH = 1.57079632679489655800e+00, HALF_PI_LOW = 6.12323399573676603587e-17;

}  // namespace angles

// For angles of up to a million radians.
SP_INLINE double sin_of(double x) {
    double high, low;
    const int n = angles::quadrant(x, high, low);
    const double value = n & 1 ? angles::cosine(high, low) : angles::sine(high, low);
    return is_finite(x) ? (n & 2 ? -value : value) : NOT_A_NUMBER;
}
SP_INLINE double cos_of(double x) {
    double high, low;
    const int n = angles::quadrant(x, high, low);
    const double value = n & 1 ? angles::sine(high, low) : angles::cosine(high, low);
    return is_finite(x) ? ((n + 1) & 2 ? -value : value) : NOT_A_NUMBER;
}

// 0 to pi; NaN outside of -1 to 1.
SP_INLINE double acos_of(double x) {
    using namespace angles;
    const double size = abs_of(x);
    if (!(size < 1.0)) return x == 1.0 ? 0.0 : x == -1.0 ? PI : NOT_A_NUMBER;
    if (size < 0.5) return HALF_PI_HIGH - (x - (HALF_PI_LOW - x * acos_ratio(x * x)));
    const double z = (1.0 - size) * 0.5, s = sqrt_of(z), ratio = acos_ratio(z);
    if (x < 0.0) return 2.0 * (HALF_PI_HIGH - (s + (ratio * s - HALF_PI_LOW)));
    const double high = bits_of<double>(bits_of<u64>(s) & 0xffffffff00000000u);
    const double low = (z - high * high) / (s + high);
    return 2.0 * (high + (ratio * s + low));
}

// -pi / 2 to pi / 2; NaN stays NaN.
SP_INLINE double atan_of(double x) {
    constexpr double HIGH[4] = {4.63647609000806093515e-01, 7.85398163397448278999e-01, 9.82793723247329054082e-01,
                                angles::HALF_PI_HIGH};
    constexpr double LOW[4] = {2.26987774529616870924e-17, 3.06161699786838301793e-17, 1.39033110312309984516e-17,
                               angles::HALF_PI_LOW};
    const double size = abs_of(x);
    if (size > 0x1p66) return x < 0.0 ? -angles::HALF_PI_HIGH : angles::HALF_PI_HIGH;
    int piece = -1;
    double t = size;
    if (size >= 0.4375) {
        if (size < 0.6875) piece = 0, t = (2.0 * size - 1.0) / (2.0 + size);
        else if (size < 1.1875) piece = 1, t = (size - 1.0) / (size + 1.0);
        else if (size < 2.4375) piece = 2, t = (size - 1.5) / (1.0 + 1.5 * size);
        else piece = 3, t = -1.0 / size;
    }
    const double z = t * t, w = z * z;
    const double even_tail = 6.66107313738753120669e-02 +
                             w * (4.97687799461593236017e-02 + w * 1.62858201153657823623e-02);
    const double even = z * (3.33333333333329318027e-01 +
                             w * (1.42857142725034663711e-01 + w * (9.09088713343650656196e-02 + w * even_tail)));
    const double odd_tail = -7.69187620504482999495e-02 +
                            w * (-5.83357013379057348645e-02 + w * -3.65315727442169155270e-02);
    const double odd = w * (-1.99999999998764832476e-01 + w * (-1.11111104054623557880e-01 + w * odd_tail));
    const double value = piece < 0 ? t - t * (even + odd) : HIGH[piece] - ((t * (even + odd) - LOW[piece]) - t);
    return x < 0.0 ? -value : value;
}

// -pi to pi: the angle of (x, y). Signs of zeros and pairs of infinities as in C.
SP_INLINE double atan2_of(double y, double x) {
    if (!(x == x && y == y)) return NOT_A_NUMBER;
    const bool left = bits_of<u64>(x) >> 63, down = bits_of<u64>(y) >> 63;
    const double across = abs_of(x), up = abs_of(y);
    double angle;
    if (up == 0.0) angle = 0.0;
    else if (across == 0.0) angle = angles::HALF_PI_HIGH;
    else if (!is_finite(across)) angle = is_finite(up) ? 0.0 : PI / 4;
    else if (!is_finite(up)) angle = angles::HALF_PI_HIGH;
    else angle = atan_of(up / across);
    if (left) angle = angle == angles::HALF_PI_HIGH ? angle : PI - (angle - 1.2246467991473531772e-16);
    return down ? -angle : angle;
}

} }  // namespace sp
