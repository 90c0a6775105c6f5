// Rows of large arrays, gathered, compared and put into records of files: splatpainter/kernels/rows.py.
#include "kernels.h"
#include "maths.h"

namespace sp { namespace {

void take_rows(Array2<const u32> values, Array1<const i64> ids, Array2<u32> out, i64 thread, i64 threads) {
    const i64 columns = values.shape[1];
    checked(columns - 1, out.shape[1]);
    const Share share = share_of(ids.shape[0], thread, threads);
    for (i64 k = share.begin; k < share.end; ++k)
        __builtin_memcpy(out.row(k), values.row(ids(k)), columns * sizeof(u32));
}

// ids: [K] rows of both; none: row k is the k-th of both.
void compare_rows(Array2<const u32> before, Array2<const u32> after, Array1<const i64> ids, Array1<bool> differ,
                  i64 thread, i64 threads) {
    const i64 columns = before.shape[1];
    checked(columns - 1, after.shape[1]);
    const Share share = share_of(differ.shape[0], thread, threads);
    for (i64 k = share.begin; k < share.end; ++k) {
        const i64 row = ids.empty() ? k : ids(k);
        const u32 *a = before.row(row), *b = after.row(row);
        u32 bits = 0;
        for (i64 c = 0; c < columns; ++c) bits |= a[c] ^ b[c];
        differ(k) = bits != 0;
    }
}

// Columns of records take the values that differ from what a row (-1: none) of `before` holds.
void put_columns(Array2<const u32> values, Array2<const u32> before, Array1<const i64> rows,
                 Array1<const i64> columns, Array2<u32> records, i64 thread, i64 threads) {
    const i64 width = columns.shape[0];
    checked(width - 1, values.shape[1]);
    for (i64 c = 0; c < width; ++c) checked(columns(c), records.shape[1]);
    const Share share = share_of(rows.shape[0], thread, threads);
    for (i64 k = share.begin; k < share.end; ++k) {
        const u32* from = values.row(k);
        u32* to = records.row(k);
        if (rows(k) < 0) {
            for (i64 c = 0; c < width; ++c) to[columns(c)] = from[c];
            continue;
        }
        const u32* old = before.row(rows(k));
        u32 bits = 0;
        for (i64 c = 0; c < width; ++c) bits |= from[c] ^ old[c];
        if (!bits) continue;
        for (i64 c = 0; c < width; ++c)
            if (from[c] != old[c]) to[columns(c)] = from[c];
    }
}

// The nearest byte, of two the even one; NaN is 0. Beside so large a number a sum has no room for fractions.
template <class F> SP_INLINE u8 byte_of(F value) {
    constexpr F NO_FRACTIONS = sizeof(F) == 4 ? F(1 << 23) : F(i64(1) << 52);
    const F positive = value > 0 ? value : F(0), inside = positive < 255 ? positive : F(255);
    return (u8)(int)((inside + NO_FRACTIONS) - NO_FRACTIONS);
}

// Records of a .splat file (io/formats/splat.py): 12 bytes of centre, 12 of scales, red, green, blue, opacity, and the
// four components of the rotation. base: the coefficients of degree 0; y00: their basis function.
void pack_splat_rows(Rows<const float, 3> means, Rows<const float, 3> scales, Rows<const float, 3> base,
                     Array1<const float> opacities, Rows<const float, 4> quats, double y00, Rows<u8, 32> records,
                     i64 thread, i64 threads) {
    const Share share = share_of(records.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        u8* out = records.row(i);
        __builtin_memcpy(out, means.row(i), 12);
        __builtin_memcpy(out + 12, scales.row(i), 12);
        // In registers until all is known: bytes may lie anywhere, so that after each of them all would be read again.
        const float *dc = base.row(i), *q = quats.row(i);
        const double a = q[0], b = q[1], c = q[2], d = q[3];
        const double length = sqrt_of(a * a + b * b + c * c + d * d), divisor = length > 0 ? length : 1;
        const double turned[4] = {a / divisor, b / divisor, c / divisor, d / divisor};
        u8 packed[8];
        for (int k = 0; k < 3; ++k) packed[k] = byte_of((float)(0.5 + y00 * (double)dc[k]) * 255.0f);
        packed[3] = byte_of(opacities(i) * 255.0f);
        for (int k = 0; k < 4; ++k) packed[4 + k] = byte_of(turned[k] * 128 + 128);
        __builtin_memcpy(out + 24, packed, 8);
    }
}

// What the bytes of columns `first` on of records stand for.
void look_up_bytes(Array2<const u8> records, i64 first, Array1<const float> table, Array2<float> out, i64 thread,
                   i64 threads) {
    const i64 width = out.shape[1];
    checked(first, records.shape[1]), checked(first + width - 1, records.shape[1]), checked(255, table.shape[0]);
    const Share share = share_of(out.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const u8* from = records.row(i) + first;
        float* to = out.row(i);
        for (i64 k = 0; k < width; ++k) to[k] = table(from[k]);
    }
}

} }  // namespace sp

SP_KERNELS_TO_V3(rows,
    ONE(pack_splat_rows),
    ONE(look_up_bytes),
    ONE(take_rows),
    ONE(compare_rows),
    ONE(put_columns)
)
