// The surface that one view sees, as in splatpainter/surface/visible.py, which explains it.
#pragma once
#include "../maths.h"
#include "../rendering/compositing.h"
#include "../vectors.h"

namespace sp { namespace {

// Follows each pixel's Gaussians front to back until `share` of the light is stopped, and notes the one that stops it:
// a block of 4 x 4 pixels at a time, whose transmittances turn negative where a pixel has its entry.
template <class F>
void find_front_entries(Rows<const F, COLUMNS> projected, Array1<const i32> flatten_ids, Array1<const i32> tile_ids,
                        Array1<const i64> isect_offsets, Array2<const bool> pixels, double share, Array2<i32> entry,
                        i64 thread, i64 threads) {
    const i64 height = pixels.shape[0], width = pixels.shape[1];
    const F stopped = F(share);
    alignas(64) Field<F> clear[1];
    for (i64 k = thread; k < tile_ids.shape[0]; k += threads) {
        const Pixel first = open_tile<F>(tile_ids(k), width, height, clear, 1);
        BlockSet open = 0;
        for (int b = 0; b < BLOCKS; ++b)
            for (int l = 0; l < LANES; ++l) {
                const Pixel at = pixel_of(first.x, first.y, b, l);
                if (at.y < height && at.x < width && pixels(at.y, at.x)) open |= 1u << b;
                else clear[0][b][l] = F(-1);
            }
        EachFootprint<F> drawn;
        const i64 end = isect_offsets(k + 1);
        for (i64 p = isect_offsets(k); p < end && open; ++p) {
            const i32 i = flatten_ids(p);
            const Footprint<F> g = drawn.at(projected, flatten_ids, p, end, first);
            over_blocks(g.blocks & open, [&](int b) {
                u32 stops = 0;
                SP_LANES(F, l) {
                    const Wide<F> before = load(&clear[0][b][l]);
                    const Wide<F> after = before - alpha_of<Profile::inria>(g, b, l) * before;
                    // Lanes that have their entry are below 0, and stay so.
                    const auto stop = (before > F(0)) & (F(1) - after >= stopped);
                    store(&clear[0][b][l], stop ? all(F(-1)) : after);
                    stops |= (u32)bits_where(stop) << l;
                }
                if (!stops) return;
                for (u32 rest = stops; rest; rest &= rest - 1) {
                    const Pixel at = pixel_of(first.x, first.y, b, __builtin_ctz(rest));
                    entry(at.y, at.x) = i;
                }
                open = (open & ~(1u << b)) | still_open<F>(clear[0], open & (1u << b));
            });
        }
    }
}

// Depths and normals of the planes around each pixel, by distance in the picture, of those that agree.
inline void interpolate_planes(Array2<const i32> index, double step, Rows<const double, 3> points,
                               Rows<const double, 3> normals, Array1<const double> windows,
                               Array1<const double> residuals, Array1<const bool> trusted,
                               Rows<const double, 2> pixels, Rows<const double, 2> rays, Rows<double, 6> out,
                               i64 thread, i64 threads) {
    const i64 height = index.shape[0], width = index.shape[1];
    for (i64 q = thread; q < pixels.shape[0]; q += threads) {
        const double px = pixels(q, 0) / step, py = pixels(q, 1) / step;
        const i64 bx = (i64)min_of(max_of(0.0, px), (double)width - 1.0);
        const i64 by = (i64)min_of(max_of(0.0, py), (double)height - 1.0);
        const i32 anchor = index(by, bx);
        if (anchor < 0 || !trusted(anchor)) continue;
        const double anchor_window = windows(anchor);
        double middle = 0.0;
        for (int turn = 0; turn < 2; ++turn) {  // first the pixel's own plane, then those that agree with it
            double total = 0.0, z = 0.0, window = 0.0, residual = 0.0;
            Vector normal = {0.0, 0.0, 0.0};
            for (i64 y = max_of<i64>(by - 1, 0); y < min_of(by + 2, height); ++y)
                for (i64 x = max_of<i64>(bx - 1, 0); x < min_of(bx + 2, width); ++x) {
                    const i32 k = index(y, x);
                    if (k < 0 || !trusted(k) || (turn == 0 && k != anchor)) continue;
                    const Vector n = vector_from(normals.row(k)), p = vector_from(points.row(k));
                    const double slope = rays(q, 0) * n.x + rays(q, 1) * n.y + n.z;
                    if (!(slope < -0.05)) continue;
                    const double depth = dot(p, n) / slope;
                    if (!(abs_of(depth - p.z) < 3.0 * windows(k))) continue;
                    if (turn == 1 && !(abs_of(depth - middle) * -slope < 0.5 * anchor_window)) continue;
                    const double dx = (double)x + 0.5 - px, dy = (double)y + 0.5 - py;
                    const double w = exp_of(-(dx * dx + dy * dy) / 0.7);
                    total += w, z += w * depth;
                    normal = normal + w * n;
                    window += w * windows(k);
                    residual += w * residuals(k) * windows(k);
                }
            if (!(total > 0.0)) break;
            middle = z / total;
            if (turn == 1) {
                double* o = out.row(q);
                o[0] = middle;
                store_vector(o + 1, 1.0 / max_of(1e-30, length_of(normal)) * normal);
                o[4] = window / total, o[5] = residual / total;
            }
        }
    }
}

} }  // namespace sp
