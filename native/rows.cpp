// Rows of large arrays, gathered, compared and put into records of files: splatpainter/kernels/rows.py.
#include "kernels.h"

namespace sp { namespace {

void take_rows(Array2<const u32> values, Array1<const i64> ids, Array2<u32> out, i64 thread, i64 threads) {
    const i64 columns = values.shape[1];
    checked(columns - 1, out.shape[1]);
    const Share share = share_of(ids.shape[0], thread, threads);
    for (i64 k = share.begin; k < share.end; ++k)
        __builtin_memcpy(out.row(k), values.row(ids(k)), columns * sizeof(u32));
}

void compare_rows(Array2<const u32> before, Array2<const u32> after, Array1<const i64> ids, Array1<bool> differ,
                  i64 thread, i64 threads) {
    const i64 columns = before.shape[1];
    checked(columns - 1, after.shape[1]);
    const Share share = share_of(ids.shape[0], thread, threads);
    for (i64 k = share.begin; k < share.end; ++k) {
        const u32 *a = before.row(ids(k)), *b = after.row(ids(k));
        u32 bits = 0;
        for (i64 c = 0; c < columns; ++c) bits |= a[c] ^ b[c];
        differ(k) = bits != 0;
    }
}

// Columns of records, side by side.
void pick_columns(Array2<const u32> records, Array1<const i64> columns, Array2<u32> out, i64 thread, i64 threads) {
    const i64 width = columns.shape[0];
    checked(width - 1, out.shape[1]);
    for (i64 c = 0; c < width; ++c) checked(columns(c), records.shape[1]);
    const Share share = share_of(out.shape[0], thread, threads);
    for (i64 k = share.begin; k < share.end; ++k) {
        const u32* from = records.row(k);
        u32* to = out.row(k);
        for (i64 c = 0; c < width; ++c) to[c] = from[columns(c)];
    }
}

// The other way, of the values that differ from what a row (-1: none) of `before` holds.
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

} }  // namespace sp

SP_KERNELS(rows,
    ONE(take_rows),
    ONE(compare_rows),
    ONE(pick_columns),
    ONE(put_columns)
)
