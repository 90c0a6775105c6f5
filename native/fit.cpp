// What a fit needs beside the renderer: splatpainter/fit.
#include "kernels.h"
#include "fit/image_loss.h"

namespace sp { namespace {

constexpr i64 ADAM_BLOCK = 1024, NEIGHBOUR_BLOCK = 256;  // Gaussians and points that a thread takes at a time

// One step of Adam in place; all arrays [N, C], rates [C]. old1 and new1 are beta1 and 1 - beta1, old2 and new2 of
// beta2.
template <class F>
void adam_step(Array2<F> value, Array2<const F> gradient, Array2<F> mean, Array2<F> square, Array1<const F> rates,
               F old1, F new1, F old2, F new2, F epsilon, F correction, i64 thread, i64 threads) {
    const i64 count = value.shape[0], columns = value.shape[1];
    for (i64 block = thread; block < (count + ADAM_BLOCK - 1) / ADAM_BLOCK; block += threads)
        for (i64 n = block * ADAM_BLOCK; n < min_of(count, (block + 1) * ADAM_BLOCK); ++n)
            for (i64 c = 0; c < columns; ++c) {
                const F g = gradient(n, c), m = old1 * mean(n, c) + new1 * g, v = old2 * square(n, c) + new2 * g * g;
                mean(n, c) = m;
                square(n, c) = v;
                value(n, c) -= rates(c) * m / (sqrt_of(v) * correction + epsilon);
            }
}

// out [M]: mean squared distance of each point to its `count` nearest others, from a grid: order [M], the points'
// numbers cell after cell; listed [M, 3] these points; cells [M, 3]; starts [cells + 1]. best: [threads, count].
void neighbour_squares(Rows<const float, 3> points, Rows<const float, 3> listed, Array1<const i64> order,
                       Rows<const i64, 3> cells, Array1<const i64> starts, Array1<const i64> shape, double cell,
                       i64 count, Array1<float> out, Array2<float> scratch, i64 thread, i64 threads) {
    const i64 sx = shape(0), sy = shape(1), sz = shape(2), reach = max_of(sx, max_of(sy, sz)), size = points.shape[0];
    checked(count - 1, scratch.shape[1]);
    float* best = scratch.row(thread);
    for (i64 block = thread; block < (size + NEIGHBOUR_BLOCK - 1) / NEIGHBOUR_BLOCK; block += threads)
        for (i64 i = block * NEIGHBOUR_BLOCK; i < min_of(size, (block + 1) * NEIGHBOUR_BLOCK); ++i) {
            for (i64 k = 0; k < count; ++k) best[k] = (float)INFINITE;
            const i64 cx = cells(i, 0), cy = cells(i, 1), cz = cells(i, 2);
            const float px = points(i, 0), py = points(i, 1), pz = points(i, 2);
            for (i64 ring = 0; ring <= reach; ++ring) {
                // All points of the cells within ring - 1 are seen: nothing nearer than that is left.
                const double bound = (double)(ring - 1) * cell;
                if (ring > 1 && best[count - 1] <= bound * bound) break;
                for (i64 x = max_of<i64>(cx - ring, 0); x < min_of(cx + ring + 1, sx); ++x)
                    for (i64 y = max_of<i64>(cy - ring, 0); y < min_of(cy + ring + 1, sy); ++y) {
                        const bool inner = x > cx - ring && x < cx + ring && y > cy - ring && y < cy + ring;
                        for (i64 side = 0; side <= 2 * ring; side += inner ? 2 * ring : 1) {
                            const i64 z = cz - ring + side;
                            if (z < 0 || z >= sz) continue;
                            const i64 key = (x * sy + y) * sz + z;
                            for (i64 j = starts(key); j < starts(key + 1); ++j) {
                                if (order(j) == i) continue;
                                const float a = listed(j, 0) - px, b = listed(j, 1) - py, c = listed(j, 2) - pz;
                                const float d = a * a + b * b + c * c;
                                if (!(d < best[count - 1])) continue;
                                i64 k = count - 1;
                                for (; k > 0 && best[k - 1] > d; --k) best[k] = best[k - 1];
                                best[k] = d;
                            }
                        }
                    }
            }
            float total = 0.0f;
            for (i64 k = 0; k < count; ++k) total += best[k];
            out(i) = total / (float)count;
        }
}

} }  // namespace sp

SP_KERNELS_TO_V3(fit,
    ONE(ssim_maps),
    ONE(loss_gradient),
    FLOAT_FIRST(adam_step),
    ONE(neighbour_squares)
)
