// How far two pictures are apart, and how much detail one has: splatpainter/lift/masks.py.
#pragma once
#include "../lanes.h"

namespace sp { namespace {

// difference [H, W]: of the channel that differs most, both pictures clipped to 0..1.
template <class F>
void compare_pictures(Pixels<const F, 3> edited, Pixels<const F, 3> render, Array2<F> difference, i64 thread,
                      i64 threads) {
    const i64 height = edited.shape[0], width = edited.shape[1];
    checked(height - 1, render.shape[0]), checked(width - 1, render.shape[1]);
    checked(height - 1, difference.shape[0]), checked(width - 1, difference.shape[1]);
    const auto clipped = [](F value) { return min_of(max_of(value, F(0)), F(1)); };
    const Share share = share_of(height, thread, threads);
    for (i64 y = share.begin; y < share.end; ++y) {
        const F *one = edited.row(y, 0), *other = render.row(y, 0);
        F* to = difference.row(y);
        for (i64 x = 0; x < width; ++x) {
            F apart[3];
            for (int c = 0; c < 3; ++c) apart[c] = abs_of(clipped(one[3 * x + c]) - clipped(other[3 * x + c]));
            to[x] = max_of(max_of(apart[0], apart[1]), apart[2]);
        }
    }
}

// out [H, W]: difference of each pixel of grey [H, W] to its right and lower neighbours'.
template <class F>
void measure_contrast(Array2<const F> grey, Array2<F> out, i64 thread, i64 threads) {
    const i64 height = grey.shape[0], width = grey.shape[1];
    checked(height - 1, out.shape[0]), checked(width - 1, out.shape[1]);
    const Share share = share_of(height, thread, threads);
    for (i64 y = share.begin; y < share.end; ++y) {
        const F *here = grey.row(y), *below = grey.row(min_of(y + 1, height - 1));
        F* to = out.row(y);
        for (i64 x = 0; x + 1 < width; ++x) to[x] = abs_of(here[x + 1] - here[x]) + abs_of(below[x] - here[x]);
        if (width) to[width - 1] = abs_of(below[width - 1] - here[width - 1]);
    }
}

} }  // namespace sp
