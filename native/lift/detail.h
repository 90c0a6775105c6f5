// How far a picture has one colour, and which pixels get a detail Gaussian; as splatpainter/lift/local/detail.py says.
#pragma once
#include "../maths.h"

namespace sp { namespace {

namespace detail {
constexpr double ONE_COLOR = 0.04, UNIFORM_COLOR_REACHES = 1.7;

// The pixel that holds a coordinate; -1 for what is no number.
SP_INLINE i64 pixel_at(double x) { return x == x ? integer_of<i64>(floor_of(x), -1, 1 << 30) : -1; }
}  // namespace detail

// How far each pixel's colour goes on, both ways along directions [A, 2] (x, y): the largest of `reaches` (ascending,
// pixels). picture: [H, W, 3]; depth: [H, W], not above 0 where there is no surface. Pixels are a thread's in blocks.
void measure_reaches(Pixels<const float, 3> picture, Array2<const float> depth, Array1<const i64> ys,
                            Array1<const i64> xs, Rows<const double, 2> directions, Array1<const double> reaches,
                            Array1<double> out, i64 thread, i64 threads) {
    using namespace detail;
    const i64 height = depth.shape[0], width = depth.shape[1], count = ys.shape[0];
    auto one_color = [&](i64 y, i64 x, double reach, double dx, double dy) {
        const i64 steps = (i64)ceil_of(reach);
        for (i64 s = -steps; s <= steps; ++s) {
            const double along = (double)s / (double)steps * reach;
            const i64 row = pixel_at((double)y + 0.5 + along * dy), column = pixel_at((double)x + 0.5 + along * dx);
            if (row < 0 || column < 0 || row >= height || column >= width || !(depth(row, column) > 0)) return false;
            for (int c = 0; c < 3; ++c)
                if (!((double)abs_of(picture(row, column, c) - picture(y, x, c)) <= ONE_COLOR)) return false;
        }
        return true;
    };
    for (i64 n = count * thread / threads; n < count * (thread + 1) / threads; ++n) {
        out(n) = reaches(0);
        for (i64 k = 1; k < reaches.shape[0]; ++k) {
            if (!one_color(ys(n), xs(n), UNIFORM_COLOR_REACHES * reaches(k), directions(n, 0), directions(n, 1))) break;
            out(n) = reaches(k);
        }
    }
}

// Chooses, in this order, pixels that no ellipse of a chosen one covers yet. along, across: [A] half lengths and
// widths, pixels; covered: [H, W] false; chosen: [A] false. By one thread.
void choose_details(Array1<const i64> ys, Array1<const i64> xs, Rows<const double, 2> directions,
                           Array1<const double> along, Array1<const double> across, Array1<const i64> order,
                           Array2<bool> covered, Array1<bool> chosen, i64, i64) {
    const i64 height = covered.shape[0], width = covered.shape[1];
    for (i64 k = 0; k < order.shape[0]; ++k) {
        const i64 n = order(k), y = ys(n), x = xs(n);
        if (covered(y, x)) continue;
        chosen(n) = true;
        covered(y, x) = true;
        const i64 reach = (i64)ceil_of(min_of(max_of(along(n), across(n)), (double)(height + width)));
        for (i64 row = max_of<i64>(y - reach, 0); row < min_of(y + reach + 1, height); ++row)
            for (i64 column = max_of<i64>(x - reach, 0); column < min_of(x + reach + 1, width); ++column) {
                const double dx = (double)(column - x), dy = (double)(row - y);
                const double u = (dx * directions(n, 0) + dy * directions(n, 1)) / along(n);
                const double v = (dy * directions(n, 0) - dx * directions(n, 1)) / across(n);
                if (u * u + v * v <= 1) covered(row, column) = true;
            }
    }
}

} }  // namespace sp
