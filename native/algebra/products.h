// Products of matrices whose sums run from the first term to the last: the same bits on every machine, which no BLAS
// gives.
#pragma once
#include "../lanes.h"

namespace sp { namespace {

namespace products {
// One row of 3 numbers times a matrix [3, 3]: what points and axes are turned by.
template <class F> SP_INLINE void turn(const F* row, const F* matrix, F* out) {
    const F x = row[0], y = row[1], z = row[2];
    for (int j = 0; j < 3; ++j) out[j] = x * matrix[j] + y * matrix[3 + j] + z * matrix[6 + j];
}

constexpr int ROWS_AT_ONCE = 4;

// Columns [begin, columns) of one row times a matrix [inner, columns].
template <class F>
SP_INLINE void multiply(const F* row, const F* matrix, i64 inner, i64 begin, i64 columns, F* out) {
    for (i64 j = begin; j < columns; ++j) out[j] = row[0] * matrix[j];
    for (i64 k = 1; k < inner; ++k)
        for (i64 j = begin; j < columns; ++j) out[j] += row[k] * matrix[k * columns + j];
}

// ROWS_AT_ONCE rows times LANES columns from `begin` on, with all sums in registers.
template <class F>
SP_INLINE void multiply_block(const F* rows, const F* matrix, i64 inner, i64 begin, i64 columns, F* out) {
    constexpr int VECTORS = LANES / W<F>;
    Wide<F> sums[ROWS_AT_ONCE][VECTORS];
    for (i64 k = 0; k < inner; ++k)
        for (int v = 0; v < VECTORS; ++v) {
            const Wide<F> entries = load_unaligned(&matrix[k * columns + begin + v * W<F>]);
            for (int r = 0; r < ROWS_AT_ONCE; ++r) {
                const Wide<F> product = rows[r * inner + k] * entries;
                sums[r][v] = k ? sums[r][v] + product : product;
            }
        }
    for (int r = 0; r < ROWS_AT_ONCE; ++r)
        for (int v = 0; v < VECTORS; ++v) store_unaligned(&out[r * columns + begin + v * W<F>], sums[r][v]);
}
}  // namespace products

// out [N, I, J] = first [N, I, K] second [N, K, J]; either has N = 1 where all share it. None of them is
// empty. A thread takes some rows.
template <class F>
void multiply_matrices(Array3<const F> first, Array3<const F> second, Array3<F> out, i64 thread, i64 threads) {
    using namespace products;
    const i64 rows = out.shape[1], columns = out.shape[2], inner = first.shape[2], blocks = columns / LANES * LANES;
    checked(inner - 1, second.shape[1]), checked(columns - 1, second.shape[2]);
    const Share share = share_of(out.shape[0] * rows, thread, threads);
    for (i64 r = share.begin; r < share.end;) {
        const i64 n = r / rows, i = r - n * rows;
        const F *row = first.row(first.shape[0] == 1 ? 0 : n, i), *matrix = second.row(second.shape[0] == 1 ? 0 : n, 0);
        F* target = out.row(n, i);
        if (inner == 3 && columns == 3) {
            turn(row, matrix, target);
            ++r;
            continue;
        }
        const bool many = i + ROWS_AT_ONCE <= rows && r + ROWS_AT_ONCE <= share.end;
        if (many)
            for (i64 j = 0; j < blocks; j += LANES) multiply_block(row, matrix, inner, j, columns, target);
        for (int k = 0; k < (many ? ROWS_AT_ONCE : 1); ++k)
            multiply(row + k * inner, matrix, inner, many ? blocks : 0, columns, target + k * columns);
        r += many ? ROWS_AT_ONCE : 1;
    }
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
