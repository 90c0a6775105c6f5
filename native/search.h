// Binary search in a sorted array.
#pragma once
#include "lanes.h"

namespace sp { namespace {

// Index of the first of keys[low:high] (ascending) that is >= key; `high` where none is. Without branches that depend
// on keys: half of them would be foreseen wrongly.
template <class T, class K>
SP_INLINE i64 first_not_below(const Array1<const T>& keys, i64 low, i64 high, K key) {
    i64 count = high - low;
    if (count <= 0) return high;
    while (count > 1) {
        const i64 half = count / 2;
        low += keys(low + half - 1) < key ? half : 0;
        count -= half;
    }
    return low + (keys(low) < key);
}

// The same where it is likely to be near `low`: by steps that double.
template <class T, class K>
SP_INLINE i64 first_not_below_near(const Array1<const T>& keys, i64 low, i64 high, K key) {
    i64 step = 1;
    while (low + step <= high && keys(low + step - 1) < key) {
        low += step;
        step *= 2;
    }
    return first_not_below(keys, low, min_of(low + step - 1, high), key);
}

} }  // namespace sp
