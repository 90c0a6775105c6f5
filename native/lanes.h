// Numbers in 16 lanes: loops over LANES in explicit vectors, with NaN kept and one rounding each.
#pragma once
#include "arrays.h"

namespace sp { namespace {

constexpr int LANES = 16;

// A vector of W lanes, as wide as the CPU's registers: arithmetic, comparisons and ?: work on all lanes of it, and give
// the same bits whatever W is.
#if defined(__AVX512F__)
#define SP_VECTOR_BYTES 64
#elif defined(__AVX2__)
#define SP_VECTOR_BYTES 32
#else
#define SP_VECTOR_BYTES 16
#endif
template <class F> struct WideOf { typedef F type __attribute__((vector_size(SP_VECTOR_BYTES))); };
template <class F> using Wide = typename WideOf<F>::type;
template <class F> struct IntegerOf;
template <> struct IntegerOf<float> { using type = i32; };
template <> struct IntegerOf<double> { using type = i64; };
template <class F> constexpr int W = SP_VECTOR_BYTES / (int)sizeof(F);
#define SP_LANES(F, l) for (int l = 0; l < LANES; l += W<F>)

template <class To, class From>
SP_INLINE To bits_of(From value) {
    static_assert(sizeof(To) == sizeof(From));
    To out;
    __builtin_memcpy(&out, &value, sizeof out);
    return out;
}

// Aligned to the vector's size.
template <class F> SP_INLINE Wide<F> load(const F* from) { return *reinterpret_cast<const Wide<F>*>(from); }
template <class F> SP_INLINE void store(F* to, Wide<F> value) { *reinterpret_cast<Wide<F>*>(to) = value; }
// Anywhere.
template <class F> SP_INLINE Wide<F> load_unaligned(const F* from) {
    Wide<F> out;
    __builtin_memcpy(&out, from, sizeof out);
    return out;
}
template <class F> SP_INLINE void store_unaligned(F* to, Wide<F> value) { __builtin_memcpy(to, &value, sizeof value); }
template <class F> SP_INLINE Wide<F> all(F value) { return value - Wide<F>{}; }

// Vectors of 8 and 16, whatever the CPU's registers hold.
template <class F> struct LanesOf {
    typedef F eight __attribute__((vector_size(8 * sizeof(F))));
    typedef F sixteen __attribute__((vector_size(16 * sizeof(F))));
};

// fused(a, b, c): a b + c, rounded once, with the same bits everywhere. One instruction on x86-64-v3, v4 and arm64;
// elsewhere the product's error and the sum's are found exactly and rounded to odd, so that the last rounding is right
// (S. Boldo and G. Melquiond, "Emulation of FMA and correctly rounded sums: proved algorithms using rounding to odd",
// IEEE Transactions on Computers 57, 2008); no part of their callers, which would take twice as long to compile. Not
// for products beyond 2^995 of doubles.
#if defined(__FMA__) || defined(__aarch64__)
constexpr bool FUSED_IS_EMULATED = false;
SP_INLINE float fused(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
SP_INLINE double fused(double a, double b, double c) { return __builtin_fma(a, b, c); }
#if defined(__clang__)
SP_INLINE Wide<float> fused(Wide<float> a, Wide<float> b, Wide<float> c) { return __builtin_elementwise_fma(a, b, c); }
SP_INLINE Wide<double> fused(Wide<double> a, Wide<double> b, Wide<double> c) {
    return __builtin_elementwise_fma(a, b, c);
}
#else
SP_INLINE Wide<float> fused(Wide<float> a, Wide<float> b, Wide<float> c) {
    for (int l = 0; l < W<float>; ++l) a[l] = __builtin_fmaf(a[l], b[l], c[l]);
    return a;
}
SP_INLINE Wide<double> fused(Wide<double> a, Wide<double> b, Wide<double> c) {
    for (int l = 0; l < W<double>; ++l) a[l] = __builtin_fma(a[l], b[l], c[l]);
    return a;
}
#endif
#else
constexpr bool FUSED_IS_EMULATED = true;
// sum = a + b rounded to nearest, error = what that lost; sum then goes to the neighbour with an odd last bit.
template <class D, class L>
SP_INLINE D sum_to_odd(D a, D b) {
    const D sum = a + b, part = sum - a, error = (a - (sum - part)) + (b - part);
    L bits = bits_of<L>(sum);
    const L towards = ((bits_of<L>(error) ^ bits) >> 63) | 1;  // -1 where the error points to 0, else 1
    const L inexact = L((error > 0.0) | (error < 0.0)) != 0;   // NaN is not
    bits += ((bits & 1) == 0) & inexact ? towards : L{};
    return bits_of<D>(bits);
}
SP_INLINE float fused(float a, float b, float c) {
    return (float)sum_to_odd<double, i64>((double)a * (double)b, (double)c);
}
typedef double TwiceWide __attribute__((vector_size(2 * SP_VECTOR_BYTES)));
__attribute__((noinline)) Wide<float> fused_by_odd_sums(TwiceWide product, TwiceWide c) {
    typedef i64 L __attribute__((vector_size(2 * SP_VECTOR_BYTES)));
    return __builtin_convertvector(sum_to_odd<TwiceWide, L>(product, c), Wide<float>);
}
// Rounding twice, to double and to float, is rounding once unless the double lies halfway between two floats: its last
// 29 bits are 1 and zeros, or the float is subnormal (of sums that vanish entirely, none is inexact: products have 48
// bits). One sum in 2^29 by chance, so that the others need not be looked into.
__attribute__((noinline)) Wide<float> fused(Wide<float> a, Wide<float> b, Wide<float> c) {
    typedef i64 L __attribute__((vector_size(2 * SP_VECTOR_BYTES)));
    const TwiceWide product = __builtin_convertvector(a, TwiceWide) * __builtin_convertvector(b, TwiceWide);
    const TwiceWide third = __builtin_convertvector(c, TwiceWide), sum = product + third;
    const Wide<float> out = __builtin_convertvector(sum, Wide<float>);
    const L halfway = ((L)sum << 35) == (i64)(u64(1) << 63);
    const Wide<i32> size = (Wide<i32>)out & 0x7fffffff, tiny = (size > 0) & (size <= 0x00800000);
    const Wide<i32> doubtful = tiny | __builtin_convertvector(halfway, Wide<i32>);
    typedef i64 Pair __attribute__((vector_size(16)));
    const Pair any = (Pair)doubtful;
    if (__builtin_expect((any[0] | any[1]) != 0, 0)) return fused_by_odd_sums(product, third);
    return out;
}
template <class D, class L>
SP_INLINE D fused_doubles(D a, D b, D c) {
    // The product as high + low, by Dekker's and Veltkamp's splitting.
    const double split = 134217729.0;  // 2^27 + 1
    const D a1 = split * a, a_high = a1 - (a1 - a), a_low = a - a_high;
    const D b1 = split * b, b_high = b1 - (b1 - b), b_low = b - b_high;
    const D high = a * b;
    const D low = ((a_high * b_high - high) + a_high * b_low + a_low * b_high) + a_low * b_low;
    const D second = c + low, part = second - c, second_error = (c - (second - part)) + (low - part);
    const D first = high + second, rest = first - high, first_error = (high - (first - rest)) + (second - rest);
    const D out = first + sum_to_odd<D, L>(second_error, first_error);
    return out == out ? out : high + c;  // infinities
}
__attribute__((noinline)) double fused(double a, double b, double c) { return fused_doubles<double, i64>(a, b, c); }
__attribute__((noinline)) Wide<double> fused(Wide<double> a, Wide<double> b, Wide<double> c) {
    return fused_doubles<Wide<double>, Wide<i64>>(a, b, c);
}
#endif

// Bit l is set where lane l of a comparison holds.
#if defined(__clang__)
template <class V> SP_INLINE u32 bits_where(V holds) {
    constexpr int lanes = sizeof(V) / sizeof(holds[0]);
    typedef bool Bits __attribute__((ext_vector_type(lanes)));
    const Bits bits = __builtin_convertvector(holds, Bits);
    if constexpr (lanes == 16) return bits_of<u16>(bits);
    else return bits_of<u8>(bits) & ((1u << lanes) - 1);
}
#else
template <class V> SP_INLINE u32 bits_where(V holds) {
    u32 out = 0;
    for (unsigned l = 0; l < sizeof(V) / sizeof(holds[0]); ++l) out |= (u32)(holds[l] != 0) << l;
    return out;
}
#endif

SP_INLINE Wide<float> magnitude_of(Wide<float> x) { return (Wide<float>)((Wide<u32>)x & 0x7fffffffu); }
SP_INLINE Wide<double> magnitude_of(Wide<double> x) {
    return (Wide<double>)((Wide<u64>)x & 0x7fffffffffffffffu);
}

SP_INLINE float magnitude_of(float x) { return __builtin_fabsf(x); }
SP_INLINE double magnitude_of(double x) { return __builtin_fabs(x); }

// Of numbers and of vectors, lane by lane; the first argument where one is NaN.
template <class V> SP_INLINE V smaller_of(V a, V b) { return b < a ? b : a; }
template <class V> SP_INLINE V larger_of(V a, V b) { return b > a ? b : a; }

// The number type of a vector, or of a number.
template <class V> struct ScalarOf { using type = V; };
template <> struct ScalarOf<Wide<float>> { using type = float; };
template <> struct ScalarOf<Wide<double>> { using type = double; };

// The first argument where the second is NaN.
template <class F> SP_INLINE F min_of(F a, F b) { return b < a ? b : a; }
template <class F> SP_INLINE F max_of(F a, F b) { return b > a ? b : a; }
SP_INLINE float abs_of(float a) { return __builtin_fabsf(a); }
SP_INLINE double abs_of(double a) { return __builtin_fabs(a); }

template <class T, i64 C>
SP_INLINE void prefetch_row(const Array<T, 2, C>& array, i64 i) {
    __builtin_prefetch(array.data + i * array.last(), 0, 3);
}

} }  // namespace sp
