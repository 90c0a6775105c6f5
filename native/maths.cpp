// Elementary functions of whole arrays: what kernels compute with, for Python and for the tests.
#include "kernels.h"
#include "maths.h"

namespace sp { namespace {

template <class F, class Function>
SP_INLINE void each(Array1<const F> x, Array1<F> out, i64 thread, i64 threads, Function function) {
    const Share share = share_of(x.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) out(i) = function(x(i));
}

#define SP_ELEMENTWISE(name)                                                                  \
    template <class F>                                                                        \
    void name##_each(Array1<const F> x, Array1<F> out, i64 thread, i64 threads) {             \
        each(x, out, thread, threads, [](F v) { return F(name##_of(v)); });                   \
    }
SP_ELEMENTWISE(exp) SP_ELEMENTWISE(log) SP_ELEMENTWISE(sin) SP_ELEMENTWISE(cos) SP_ELEMENTWISE(acos)
SP_ELEMENTWISE(atan)

template <class F>
void atan2_each(Array1<const F> y, Array1<const F> x, Array1<F> out, i64 thread, i64 threads) {
    const Share share = share_of(x.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) out(i) = F(atan2_of(y(i), x(i)));
}
// x^exponent for x >= 0.
template <class F>
void power_each(Array1<const F> x, double exponent, Array1<F> out, i64 thread, i64 threads) {
    each(x, out, thread, threads, [=](F v) { return F(exp_of(exponent * log_of((double)v))); });
}
// Display sRGB >= 0 to linear light (IEC 61966-2-1), or back. One loop for both: 0 added, and a factor or divisor of 1,
// change no bit.
template <class F>
void srgb_each(Array1<const F> x, bool to_linear, Array1<F> out, i64 thread, i64 threads) {
    const F end = to_linear ? F(0.04045) : F(0.0031308);  // of the straight piece
    const F factor = to_linear ? F(1) : F(12.92), divisor = to_linear ? F(12.92) : F(1);
    const F offset = to_linear ? F(0.055) : F(0), scale = to_linear ? F(1.055) : F(1);
    const F gain = to_linear ? F(1) : F(1.055), drop = to_linear ? F(0) : F(0.055);
    const double exponent = to_linear ? 2.4 : 1 / 2.4;
    const Share share = share_of(x.shape[0], thread, threads);
#if defined(__clang__) && defined(__AVX2__) && !defined(SP_CHECKED)
#pragma clang loop vectorize(enable)
#endif
    for (i64 i = share.begin; i < share.end; ++i) {
        const F v = x(i), power = F(exp_of(exponent * log_of((double)((max_of(v, end) + offset) / scale))));
        const F straight = factor * v / divisor, curved = gain * power - drop;
        out(i) = v <= end ? straight : curved;
    }
}
// The first half in vectors, the others one by one.
template <class F>
void fused_each(Array1<const F> a, Array1<const F> b, Array1<const F> c, Array1<F> out, i64 thread, i64) {
    if (thread != 0) return;
    i64 i = 0;
    for (; i + W<F> <= a.shape[0] / 2; i += W<F>)
        store_unaligned(&out(i), fused(load_unaligned(&a(i)), load_unaligned(&b(i)), load_unaligned(&c(i))));
    for (; i < a.shape[0]; ++i) out(i) = fused(a(i), b(i), c(i));
}
// x.shape[0] is a multiple of LANES.
template <class F>
void exp_of_negative_each(Array1<const F> x, Array1<F> out, i64 thread, i64 threads) {
    const Share share = share_of(x.shape[0] / W<F>, thread, threads);
    for (i64 i = share.begin; i < share.end; ++i)
        store_unaligned(&out(i * W<F>), exp_of_negative(load_unaligned(&x(i * W<F>))));
}

} }  // namespace sp

SP_KERNELS(maths,
    BOTH(exp_each),
    BOTH(log_each),
    FLOAT_FIRST(sin_each),
    FLOAT_FIRST(cos_each),
    FLOAT_FIRST(acos_each),
    FLOAT_FIRST(atan_each),
    FLOAT_FIRST(atan2_each),
    BOTH(power_each),
    FLOAT_FIRST(srgb_each),
    FLOAT_FIRST(fused_each),
    FLOAT_FIRST(exp_of_negative_each)
)
