// The nearest set pixel of a mask, for every pixel: 8SED (Danielsson 1980), as splatpainter/lift/nearest.py says.
#pragma once
#include "../lanes.h"

namespace sp { namespace {

// Coordinate of pixels that know of no set pixel yet: farther away than any.
constexpr i32 NOWHERE = -(1 << 20);

namespace nearest {
// Steps along an axis count as no more than these: beyond all pictures of 16,384 pixels a side, and squares fit.
constexpr i32 FARTHEST = 23000;

template <class V> SP_INLINE V squared(V to_y, V to_x, V y, V x) {
    const V dy = larger_of(to_y - y, V{} - FARTHEST), dx = larger_of(to_x - x, V{} - FARTHEST);
    return dy * dy + dx * dx;
}

// What the pixels from x on know, or the three of the row before of each: the nearer. at: of the first of them; before:
// how far the row before lies back; squares: of their distances.
template <class V, class Load, class Store>
SP_INLINE void ask_row_before(i32* nearest_y, i32* nearest_x, i32* squares, i64 at, i64 before, V y, V x,
                              const Load& from, const Store& to) {
    V best_y = from(nearest_y + at), best_x = from(nearest_x + at), best = squared(best_y, best_x, y, x);
    for (i64 j = -1; j < 2; ++j) {
        const V other_y = from(nearest_y + at - before + j), other_x = from(nearest_x + at - before + j);
        const V square = squared(other_y, other_x, y, x);
        const auto nearer = square < best;
        best = nearer ? square : best, best_y = nearer ? other_y : best_y, best_x = nearer ? other_x : best_x;
    }
    to(nearest_y + at, best_y), to(nearest_x + at, best_x), to(squares, best);
}
}  // namespace nearest

// nearest_y, nearest_x: [(H + 2) (W + 2)] NOWHERE, with one column more on both sides and one row more above and below,
// so that no neighbour has to be asked for; first: row of the first set pixel, before which there is nothing to pass on
// downwards; out: [H, W] -1. H and W at most 16,384. By one thread.
void find_nearest_pixels(Array2<const bool> mask, Array1<i32> nearest_y, Array1<i32> nearest_x, i64 first,
                         Array2<i32> out, i64, i64) {
    const i64 height = mask.shape[0], width = mask.shape[1], stride = width + 2;
    checked((height + 2) * stride - 1, nearest_y.shape[0]), checked((height + 2) * stride - 1, nearest_x.shape[0]);
    checked(first, height), checked(height - 1, out.shape[0]), checked(width - 1, out.shape[1]);
    for (i64 y = 0; y < height; ++y)
        for (i64 x = 0; x < width; ++x)
            if (mask(y, x)) {
                nearest_y((y + 1) * stride + x + 1) = (i32)y;
                nearest_x((y + 1) * stride + x + 1) = (i32)x;
            }
    using V = Wide<i32>;
    V lanes;
    for (int l = 0; l < W<i32>; ++l) lanes[l] = l;
    // Downwards, then upwards; in each row to the right with the row before it, then to the left without. Until the end
    // `out` has the squares of the distances.
    for (int turn = 0; turn < 2; ++turn) {
        const i64 step = turn == 0 ? 1 : -1, end = turn == 0 ? height : -1;
        for (i64 y = turn == 0 ? first : height - 1; y != end; y += step) {
            const i64 row = (y + 1) * stride + 1;
            i32 *ys = nearest_y.data + row, *xs = nearest_x.data + row, *squares = out.row(y);
            i64 x = 0;
            for (; x + W<i32> <= width; x += W<i32>)
                nearest::ask_row_before<V>(
                    nearest_y.data, nearest_x.data, squares + x, row + x, step * stride, V{} + (i32)y, lanes + (i32)x,
                    [](const i32* from) { return load_unaligned(from); },
                    [](i32* to, V value) { store_unaligned(to, value); });
            for (; x < width; ++x)
                nearest::ask_row_before<i32>(
                    nearest_y.data, nearest_x.data, squares + x, row + x, step * stride, (i32)y, (i32)x,
                    [](const i32* from) { return *from; }, [](i32* to, i32 value) { *to = value; });
            // Then each pixel asks the one before it, whose square grows by the next odd number with every step.
            for (int sweep = 0; sweep < 2; ++sweep) {
                i32 from_y = NOWHERE, from_x = NOWHERE, square = 2 * nearest::FARTHEST * nearest::FARTHEST, odd = 1;
                for (i64 k = 0; k < width; ++k) {
                    const i64 at = sweep == 0 ? k : width - 1 - k;
                    const i32 passed = square + odd;
                    const bool nearer = passed < squares[at];
                    const i32 apart = sweep == 0 ? (i32)at - xs[at] : xs[at] - (i32)at;
                    odd = nearer ? odd + 2 : 2 * apart + 1;
                    square = nearer ? passed : squares[at];
                    from_y = nearer ? from_y : ys[at];
                    from_x = nearer ? from_x : xs[at];
                    squares[at] = square, ys[at] = from_y, xs[at] = from_x;
                }
            }
        }
    }
    for (i64 y = 0; y < height; ++y)
        for (i64 x = 0; x < width; ++x) {
            const i64 here = (y + 1) * stride + x + 1;
            out(y, x) = nearest_y(here) == NOWHERE ? -1 : (i32)(nearest_y(here) * width + nearest_x(here));
        }
}

} }  // namespace sp
