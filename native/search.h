// Binary search in a sorted array.
#pragma once
#include "arrays.h"

namespace sp { namespace {

// Index of the first of keys[low:high] (ascending) that is >= key; `high` where none is.
template <class T, class K>
SP_INLINE i64 first_not_below(const Array1<const T>& keys, i64 low, i64 high, K key) {
    while (low < high) {
        const i64 middle = low + (high - low) / 2;
        if (keys(middle) < key) low = middle + 1;
        else high = middle;
    }
    return low;
}

} }  // namespace sp
