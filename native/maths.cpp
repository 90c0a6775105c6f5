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
    BOTH(sin_each),
    BOTH(cos_each),
    BOTH(acos_each),
    BOTH(atan_each),
    BOTH(atan2_each),
    BOTH(power_each),
    BOTH(fused_each),
    BOTH(exp_of_negative_each)
)
