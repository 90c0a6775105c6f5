// Rows of large arrays, gathered and compared: splatpainter/kernels/rows.py.
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

} }  // namespace sp

SP_KERNELS(rows,
    ONE(take_rows),
    ONE(compare_rows)
)
