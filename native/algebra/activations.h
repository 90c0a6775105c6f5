// What networks put between their layers.
#pragma once
#include "../maths.h"

namespace sp { namespace {

// x / (1 + exp(-x)), from exp(-|x|), which cannot overflow; relative error below 5e-6, and 2e-7 for |x| < 4.
void silu_each(Array1<const float> x, Array1<float> out, i64 thread, i64 threads) {
    using V = Wide<float>;
    auto silu = [](V v) {
        const V zero = {}, size = v > zero ? v : -v, e = exp_of_negative(-size), top = v > zero ? all(1.0f) : e;
        const V value = v * (top / (1.0f + e));
        return v == v ? value : v;
    };
    const i64 count = x.shape[0], vectors = (count + W<float> - 1) / W<float>;
    const Share share = share_of(vectors, thread, threads);
    for (i64 k = share.begin; k < share.end; ++k) {
        const i64 first = k * W<float>, numbers = min_of<i64>(W<float>, count - first);
        if (numbers == W<float>) {
            store_unaligned(&out(first), silu(load_unaligned(&x(first))));
            continue;
        }
        alignas(64) float rest[W<float>] = {};
        for (i64 l = 0; l < numbers; ++l) rest[l] = x(first + l);
        store(rest, silu(load(rest)));
        for (i64 l = 0; l < numbers; ++l) out(first + l) = rest[l];
    }
}

} }  // namespace sp
