// The nearest set pixel of a mask, for every pixel: 8SED (Danielsson 1980), as splatpainter/lift/nearest.py says.
#pragma once
#include "../lanes.h"

namespace sp { namespace {

// Coordinate of pixels that know of no set pixel yet: farther away than any.
constexpr i32 NOWHERE = -(1 << 20);

// nearest_y, nearest_x: [(H + 2) (W + 2)] NOWHERE, with one column more on both sides and one row more above and below,
// so that no neighbour has to be asked for; first: row of the first set pixel, before which there is nothing to pass on
// downwards; out: [H, W] -1. By one thread.
void find_nearest_pixels(Array2<const bool> mask, Array1<i32> nearest_y, Array1<i32> nearest_x, i64 first,
                                Array2<i32> out, i64, i64) {
    const i64 height = mask.shape[0], width = mask.shape[1], stride = width + 2;
    for (i64 y = 0; y < height; ++y)
        for (i64 x = 0; x < width; ++x)
            if (mask(y, x)) {
                nearest_y((y + 1) * stride + x + 1) = (i32)y;
                nearest_x((y + 1) * stride + x + 1) = (i32)x;
            }
    // Squares of NOWHERE do not fit into 32 bits.
    auto squared = [&](i64 at, i64 y, i64 x) {
        const i64 dy = nearest_y(at) - y, dx = nearest_x(at) - x;
        return dy * dy + dx * dx;
    };
    // Downwards, then upwards; in each row to the right with the row before it, then to the left without.
    for (int turn = 0; turn < 2; ++turn) {
        const i64 step = turn == 0 ? 1 : -1, end = turn == 0 ? height : -1;
        for (i64 y = turn == 0 ? first : height - 1; y != end; y += step)
            for (int sweep = 0; sweep < 2; ++sweep)
                for (i64 k = 0; k < width; ++k) {
                    const i64 x = sweep == 0 ? k : width - 1 - k, here = (y + 1) * stride + x + 1;
                    i64 best = squared(here, y, x), from = here;
                    if (best == 0) continue;
                    auto ask = [&](i64 other) {
                        const i64 distance = squared(other, y, x);
                        if (distance < best) best = distance, from = other;
                    };
                    if (sweep == 0)
                        for (i64 j = -1; j < 2; ++j) ask(here - step * stride + j);
                    ask(sweep == 0 ? here - 1 : here + 1);
                    nearest_y(here) = nearest_y(from);
                    nearest_x(here) = nearest_x(from);
                }
    }
    for (i64 y = 0; y < height; ++y)
        for (i64 x = 0; x < width; ++x) {
            const i64 here = (y + 1) * stride + x + 1;
            if (nearest_y(here) != NOWHERE) out(y, x) = (i32)(nearest_y(here) * width + nearest_x(here));
        }
}

} }  // namespace sp
