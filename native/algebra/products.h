// Products of matrices whose sums run from the first term to the last: the same bits on every machine, which no BLAS
// gives.
#pragma once
#include "../lanes.h"

namespace sp { namespace {

namespace products {
// One row of 3 numbers times a matrix [3, 3]: what points and axes are turned by.
template <class A, class F> SP_INLINE void turn(const A* row, const F* matrix, F* out) {
    const F x = row[0], y = row[1], z = row[2];
    for (int j = 0; j < 3; ++j) out[j] = x * matrix[j] + y * matrix[3 + j] + z * matrix[6 + j];
}

constexpr int ROWS_AT_ONCE = 4;

// COUNT columns from `begin` on of one row times a matrix [inner, columns], with all sums in registers.
template <int COUNT, class A, class F>
SP_INLINE void multiply_few(const A* row, const F* matrix, i64 inner, i64 begin, i64 columns, F* out) {
    F sums[COUNT];
    for (int j = 0; j < COUNT; ++j) sums[j] = F(row[0]) * matrix[begin + j];
    for (i64 k = 1; k < inner; ++k)
        for (int j = 0; j < COUNT; ++j) sums[j] += F(row[k]) * matrix[k * columns + begin + j];
    for (int j = 0; j < COUNT; ++j) out[begin + j] = sums[j];
}

// Columns [begin, columns) of one row times a matrix [inner, columns].
template <class A, class F>
SP_INLINE void multiply(const A* row, const F* matrix, i64 inner, i64 begin, i64 columns, F* out) {
    for (; begin + 4 <= columns; begin += 4) multiply_few<4>(row, matrix, inner, begin, columns, out);
    switch (columns - begin) {
        case 3: return multiply_few<3>(row, matrix, inner, begin, columns, out);
        case 2: return multiply_few<2>(row, matrix, inner, begin, columns, out);
        case 1: return multiply_few<1>(row, matrix, inner, begin, columns, out);
    }
}

// ROWS_AT_ONCE rows times LANES columns from `begin` on, with all sums in registers.
template <class A, class F>
SP_INLINE void multiply_block(const A* rows, const F* matrix, i64 inner, i64 begin, i64 columns, F* out) {
    constexpr int VECTORS = LANES / W<F>;
    Wide<F> sums[ROWS_AT_ONCE][VECTORS];
    for (i64 k = 0; k < inner; ++k)
        for (int v = 0; v < VECTORS; ++v) {
            const Wide<F> entries = load_unaligned(&matrix[k * columns + begin + v * W<F>]);
            for (int r = 0; r < ROWS_AT_ONCE; ++r) {
                const Wide<F> product = F(rows[r * inner + k]) * entries;
                sums[r][v] = k ? sums[r][v] + product : product;
            }
        }
    for (int r = 0; r < ROWS_AT_ONCE; ++r)
        for (int v = 0; v < VECTORS; ++v) store_unaligned(&out[r * columns + begin + v * W<F>], sums[r][v]);
}

template <class A, class F>
SP_INLINE void multiply_stacks(const Array3<const A>& first, const Array3<const F>& second, const Array3<F>& out,
                               i64 thread, i64 threads) {
    const i64 rows = out.shape[1], columns = out.shape[2], inner = first.shape[2];
    checked(inner - 1, second.shape[1]), checked(columns - 1, second.shape[2]);
    const Share share = share_of(out.shape[0] * rows, thread, threads);
    for (i64 r = share.begin; r < share.end;) {
        const i64 n = r / rows, i = r - n * rows;
        const A* row = first.row(first.shape[0] == 1 ? 0 : n, i);
        const F* matrix = second.row(second.shape[0] == 1 ? 0 : n, 0);
        F* target = out.row(n, i);
        if (inner == 3 && columns == 3) {
            turn(row, matrix, target);
            ++r;
            continue;
        }
        const bool many = i + ROWS_AT_ONCE <= rows && r + ROWS_AT_ONCE <= share.end;
        if (many && columns >= LANES) {
            // The last block may overlap the one before: the same sums once more.
            for (i64 j = 0; j < columns; j += LANES)
                multiply_block(row, matrix, inner, min_of(j, columns - LANES), columns, target);
        } else {
            for (int k = 0; k < (many ? ROWS_AT_ONCE : 1); ++k)
                multiply(row + k * inner, matrix, inner, 0, columns, target + k * columns);
        }
        r += many ? ROWS_AT_ONCE : 1;
    }
}
}  // namespace products

// out [N, I, J] = first [N, I, K] second [N, K, J]; either has N = 1 where all share it. None of them is
// empty. A thread takes some rows.
template <class F>
void multiply_matrices(Array3<const F> first, Array3<const F> second, Array3<F> out, i64 thread, i64 threads) {
    products::multiply_stacks(first, second, out, thread, threads);
}

// The same of single by double precision, in double.
void multiply_by_doubles(Array3<const float> first, Array3<const double> second, Array3<double> out, i64 thread,
                         i64 threads) {
    products::multiply_stacks(first, second, out, thread, threads);
}

// out [F, C] += first^T second for first [M, F], second [M, C], in double precision. A thread takes some rows of `out`.
template <class F>
void add_transposed_product(Array2<const F> first, Array2<const double> second, Array2<double> out, i64 thread,
                            i64 threads) {
    const Share share = share_of(out.shape[0], thread, threads);
    const i64 columns = out.shape[1];
    for (i64 m = 0; m < first.shape[0]; ++m)
        for (i64 f = share.begin; f < share.end; ++f) {
            const double value = first(m, f);
            for (i64 c = 0; c < columns; ++c) out(f, c) += value * second(m, c);
        }
}

} }  // namespace sp
