// Weighted least squares in double precision: normal matrix, right side, solution. Each sum is one thread's, in the
// order of the rows, so that a solution has the same bits on every CPU and for any number of threads.
#pragma once
#include "../maths.h"

namespace sp { namespace {

namespace normal_equations {
constexpr int LINES = 4, COLUMNS = 8, VECTORS = COLUMNS / W<double>;  // of a block of the matrix, in registers
constexpr int ROWS = 64;                                             // of features that are worked on at a time

// COUNT columns of ROWS rows from (row, column) on, each row times its factor if there are any; 0 where there are none.
template <int COUNT, class F>
SP_INLINE void pack(Array2<const F> features, i64 row, i64 column, const double* factors, double (*out)[COUNT]) {
    const i64 rows = min_of<i64>(ROWS, features.shape[0] - row);
    const i64 columns = min_of<i64>(COUNT, features.shape[1] - column);
    for (i64 i = 0; i < ROWS; ++i)
        for (i64 k = 0; k < COUNT; ++k) {
            const double value = i < rows && k < columns ? (double)features(row + i, column + k) : 0.0;
            out[i][k] = factors && i < rows ? factors[i] * value : value;
        }
}

// sums[l][k] += sum_i plain[i][l] weighted[i][k], in the order of i.
SP_INLINE void add_products(i64 rows, const double (*weighted)[COLUMNS], const double (*plain)[LINES],
                            double (*sums)[COLUMNS]) {
    Wide<double> s[LINES][VECTORS];
    for (int l = 0; l < LINES; ++l)
        for (int v = 0; v < VECTORS; ++v) s[l][v] = load(&sums[l][v * W<double>]);
    for (i64 i = 0; i < rows; ++i)
        for (int l = 0; l < LINES; ++l)
            for (int v = 0; v < VECTORS; ++v) s[l][v] += load(&weighted[i][v * W<double>]) * plain[i][l];
    for (int l = 0; l < LINES; ++l)
        for (int v = 0; v < VECTORS; ++v) store(&sums[l][v * W<double>], s[l][v]);
}
}  // namespace normal_equations

// upper [F, F] += sum_i w_i f_i f_i^T, right [F] += sum_i v_i f_i over features [M, F], weights [M] w and values [M] v.
// Of the matrix only what is on and above the diagonal means anything.
template <class F>
void add_normal_equations(Array2<const F> features, Array1<const double> weights, Array1<const double> values,
                          Array2<double> upper, Array1<double> right, i64 thread, i64 threads) {
    using namespace normal_equations;
    const i64 count = features.shape[0], size = features.shape[1];
    alignas(64) double weighted[ROWS][COLUMNS], plain[ROWS][LINES], sums[LINES][COLUMNS];
    for (i64 start = 0; start < count; start += ROWS) {
        const i64 rows = min_of<i64>(ROWS, count - start);
        for (i64 a = thread * COLUMNS; a < size; a += threads * COLUMNS) {
            const i64 columns = min_of<i64>(COLUMNS, size - a);
            pack(features, start, a, &weights(start), weighted);
            for (i64 i = 0; i < rows; ++i)
                for (i64 k = 0; k < columns; ++k)
                    right(a + k) += values(start + i) * (double)features(start + i, a + k);
            for (i64 b = 0; b < a + columns; b += LINES) {
                pack<LINES>(features, start, b, nullptr, plain);
                const i64 lines = min_of<i64>(LINES, size - b);
                __builtin_memset(sums, 0, sizeof sums);
                for (i64 l = 0; l < lines; ++l)
                    for (i64 k = 0; k < columns; ++k) sums[l][k] = upper(b + l, a + k);
                add_products(rows, weighted, plain, sums);
                for (i64 l = 0; l < lines; ++l)
                    for (i64 k = 0; k < columns; ++k) upper(b + l, a + k) = sums[l][k];
            }
        }
    }
}

// right [F, C] <- matrix^-1 right for a symmetric positive matrix [F, F], given on and above the diagonal, which
// becomes its Cholesky factor. By one thread.
void solve_symmetric(Array2<double> upper, Array2<double> right, i64, i64) {
    const i64 n = right.shape[0], columns = right.shape[1];
    for (i64 j = 0; j < n; ++j) {
        double* row = &upper(j, 0);
        for (i64 k = 0; k < j; ++k) {
            const double* other = &upper(k, 0);
            const double scale = other[j];
            for (i64 i = j; i < n; ++i) row[i] -= other[i] * scale;
        }
        const double root = sqrt_of(max_of(row[j], 1e-300));
        for (i64 i = j; i < n; ++i) row[i] /= root;
    }
    auto take = [&](i64 from, double scale, i64 to) {
        for (i64 c = 0; c < columns; ++c) right(to, c) -= scale * right(from, c);
    };
    auto divide = [&](i64 k) {
        for (i64 c = 0; c < columns; ++c) right(k, c) /= upper(k, k);
    };
    for (i64 k = 0; k < n; ++k) {
        divide(k);
        for (i64 i = k + 1; i < n; ++i) take(k, upper(k, i), i);
    }
    for (i64 i = n - 1; i >= 0; --i) {
        for (i64 k = i + 1; k < n; ++k) take(k, upper(i, k), i);
        divide(i);
    }
}

} }  // namespace sp
