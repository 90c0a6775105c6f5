// C-contiguous arrays as kernels take them: a pointer and a shape, nothing owned.
//
// With SP_CHECKED every access is checked (python native/build.py --checked); otherwise an index is one multiply-add.
//
// Everything in native/ lies in an unnamed namespace: each subject is compiled once per kind of CPU, and with external
// names the linker would keep one copy of every function, compiled for whichever CPU came first. For the same reason
// nothing of the C++ standard library is used, not even its headers.
#pragma once
#include <stdint.h>

#define SP_INLINE inline __attribute__((always_inline))
// Of functions that take little time: neither unrolled nor in vectors, as each is compiled for every kind of CPU.
#if defined(__clang__)
#define SP_SMALL __attribute__((noinline, minsize))
#else
#define SP_SMALL __attribute__((noinline))
#endif

namespace sp {

using i8 = int8_t;
using u8 = uint8_t;
using i16 = int16_t;
using u16 = uint16_t;
using i32 = int32_t;
using u32 = uint32_t;
using i64 = int64_t;
using u64 = uint64_t;

// What Python fills in for every argument: an array, or a number in `shape[0]` (for float and double: the double's
// bits).
struct Argument {
    void* data;
    i64 shape[4];
};

namespace {

#ifdef SP_CHECKED
extern "C" int printf(const char*, ...);
extern "C" int fflush(void*);
extern "C" [[noreturn]] void abort();
[[noreturn]] __attribute__((noinline)) void out_of_bounds(i64 index, i64 size) {
    printf("splatpainter kernel: index %lld of %lld\n", (long long)index, (long long)size);
    fflush(nullptr);
    abort();
}
SP_INLINE i64 checked(i64 index, i64 size) {
    if (index < 0 || index >= size) out_of_bounds(index, size);
    return index;
}
#else
SP_INLINE i64 checked(i64 index, i64) { return index; }
#endif

// N dimensions, 1 to 4; the last one has FIXED entries where that is not 0 (Python checks it, and rows then have
// constant offsets). None in Python is an array without entries, data == nullptr.
template <class T, int N, i64 FIXED = 0>
struct Array {
    using Element = T;
    T* data;
    i64 shape[N];

    SP_INLINE i64 last() const { return FIXED ? FIXED : shape[N - 1]; }
    SP_INLINE T& operator()(i64 i) const {
        static_assert(N == 1);
        return data[checked(i, last())];
    }
    SP_INLINE T& operator()(i64 i, i64 j) const {
        static_assert(N == 2);
        return data[checked(i, shape[0]) * last() + checked(j, last())];
    }
    SP_INLINE T& operator()(i64 i, i64 j, i64 k) const {
        static_assert(N == 3);
        return data[(checked(i, shape[0]) * shape[1] + checked(j, shape[1])) * last() + checked(k, last())];
    }
    SP_INLINE T& operator()(i64 i, i64 j, i64 k, i64 l) const {
        static_assert(N == 4);
        const i64 plane = checked(i, shape[0]) * shape[1] + checked(j, shape[1]);
        return data[(plane * shape[2] + checked(k, shape[2])) * last() + checked(l, last())];
    }
    // Row i of a 2-D array: a pointer, so what is read through it is not checked (its length is, for fixed ones).
    SP_INLINE T* row(i64 i) const {
        static_assert(N == 2);
        return data + checked(i, shape[0]) * last();
    }
    // The last axis at (i, j) of a 3-D array: a pixel's channels.
    SP_INLINE T* row(i64 i, i64 j) const {
        static_assert(N == 3);
        return data + (checked(i, shape[0]) * shape[1] + checked(j, shape[1])) * last();
    }
    SP_INLINE bool empty() const { return shape[0] == 0; }
};

template <class T> using Array1 = Array<T, 1>;
template <class T> using Array2 = Array<T, 2>;
template <class T> using Array3 = Array<T, 3>;
template <class T> using Array4 = Array<T, 4>;
// [n, C] and [h, w, C].
template <class T, i64 C> using Rows = Array<T, 2, C>;
template <class T, i64 C> using Pixels = Array<T, 3, C>;

// The share [begin, end) of `count` equal jobs that one of `threads` threads takes.
struct Share { i64 begin, end; };
SP_INLINE Share share_of(i64 count, i64 thread, i64 threads) {
    return {count * thread / threads, count * (thread + 1) / threads};
}

} }  // namespace sp
