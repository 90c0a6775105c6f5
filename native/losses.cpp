// How far rows that were read from a file are from those that were written: splatpainter/io/losses.py.
#include "kernels.h"
#include "maths.h"

namespace sp { namespace {

SP_INLINE bool same_bits(const float* a, const float* b, i64 n) {
    u32 bits = 0;
    for (i64 k = 0; k < n; ++k) bits |= bits_of<u32>(a[k]) ^ bits_of<u32>(b[k]);
    return !bits;
}

struct Span {
    float low, high;
    SP_INLINE void widen(const float* values, i64 count) {
        for (i64 k = 0; k < count; ++k) {
            low = values[k] < low ? values[k] : low;
            high = values[k] > high ? values[k] : high;
        }
    }
};

SP_INLINE void add_square(float off, double* energy) { *energy += (double)off * (double)off; }

// Rows i of `counted` get a column of `errors` (in order: distance by size, base colour, squared SH beyond it, opacity,
// largest ratio of scales, squared chord of quaternions), and `differs` where any bit differs (`comparable`: else all
// do). `ranges`, one row per thread: least and largest coefficient of the base and beyond it, before, then after.
void row_losses(Array1<const bool> counted, bool comparable, Array1<const double> shift, double thin, float anisotropy,
                Rows<const float, 3> means0, Rows<const float, 3> means1, Rows<const float, 4> quats0,
                Rows<const float, 4> quats1, Rows<const float, 3> scales0, Rows<const float, 3> scales1,
                Array1<const float> opacities0, Array1<const float> opacities1, Array2<const float> sh0,
                Array2<const float> sh1, Array2<double> errors, Array1<bool> differs, Rows<float, 8> ranges,
                i64 thread, i64 threads) {
    const Share share = share_of(counted.shape[0], thread, threads);
    const i64 width0 = sh0.shape[1], width1 = sh1.shape[1];
    const bool in_place = shift(0) == shift(3) && shift(1) == shift(4) && shift(2) == shift(5);
    const i64 both = width0 < width1 ? width0 : width1;
    float* range = ranges.row(thread);
    Span spans[4];
    for (int k = 0; k < 4; ++k) spans[k] = {range[2 * k], range[2 * k + 1]};
    for (i64 i = share.begin; i < share.end; ++i) {
        differs(i) = false;
        if (!counted(i)) continue;
        const float *m0 = means0.row(i), *m1 = means1.row(i), *q0 = quats0.row(i), *q1 = quats1.row(i);
        const float *s0 = scales0.row(i), *s1 = scales1.row(i), *c0 = sh0.row(i), *c1 = sh1.row(i);
        // Formats round some attributes and keep others: of equal bits nothing is computed.
        const bool stays = in_place && same_bits(m0, m1, 3), turns = !same_bits(q0, q1, 4);
        const bool grows = !same_bits(s0, s1, 3);
        if (comparable && stays && !turns && !grows && bits_of<u32>(opacities0(i)) == bits_of<u32>(opacities1(i)) &&
            same_bits(c0, c1, width0))
            continue;
        differs(i) = true;

        double size = 0, smallest = s0[0], squares = 0, ratio = 1;
        for (int k = 0; k < 3; ++k) {
            if (s0[k] > size) size = s0[k];
            if (s0[k] < smallest) smallest = s0[k];
        }
        for (int k = 0; k < 3 && !stays; ++k) {
            const double move = ((double)m1[k] + shift(3 + k)) - ((double)m0[k] + shift(k));
            squares += move * move;
        }
        errors(0, i) = stays ? 0 : sqrt_of(squares) / size;
        for (int k = 0; k < 3 && grows; ++k) {
            if (!(s0[k] >= thin * size)) continue;
            const double one = (double)s1[k] / s0[k], two = one < 1 ? 1 / one : one;
            if (two > ratio) ratio = two;
        }
        errors(4, i) = ratio;

        // Coefficients of [n, K, 3] are [n, 3 K]; those that one side lacks are 0 there.
        double color = 0, energy[3] = {0, 0, 0};
        for (int k = 0; k < 3; ++k) {
            const double off = c1[k] - c0[k], size_of_it = off < 0 ? -off : off;
            if (size_of_it > color) color = size_of_it;
        }
        for (i64 k = 3; k < both; k += 3)
            for (int c = 0; c < 3; ++c) add_square(c1[k + c] - c0[k + c], energy + c);
        for (i64 k = both; k < width0; k += 3)
            for (int c = 0; c < 3; ++c) add_square(0.0f - c0[k + c], energy + c);
        for (i64 k = both; k < width1; k += 3)
            for (int c = 0; c < 3; ++c) add_square(c1[k + c], energy + c);
        errors(1, i) = color;
        const double most = energy[0] > energy[1] ? energy[0] : energy[1];
        errors(2, i) = energy[2] > most ? energy[2] : most;
        spans[0].widen(c0, 3), spans[1].widen(c0 + 3, width0 - 3);
        spans[2].widen(c1, 3), spans[3].widen(c1 + 3, width1 - 3);

        const double fade = (double)opacities1(i) - opacities0(i);
        errors(3, i) = fade < 0 ? -fade : fade;

        const bool is_seen = turns && size > (double)(anisotropy * (float)smallest);
        errors(5, i) = 0;
        if (!is_seen) continue;
        double norm0 = 0, norm1 = 0, apart = 0, mirrored = 0;
        for (int k = 0; k < 4; ++k) norm0 += (double)q0[k] * q0[k], norm1 += (double)q1[k] * q1[k];
        norm0 = sqrt_of(norm0), norm1 = sqrt_of(norm1);
        for (int k = 0; k < 4; ++k) {
            const double a = q0[k] / norm0, b = q1[k] / norm1;
            apart += (a - b) * (a - b), mirrored += (a + b) * (a + b);
        }
        errors(5, i) = apart < mirrored ? apart : mirrored;
    }
    for (int k = 0; k < 4; ++k) range[2 * k] = spans[k].low, range[2 * k + 1] = spans[k].high;
}

} }  // namespace sp

SP_KERNELS_TO_V3(losses, ONE(row_losses))
