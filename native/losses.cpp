// How far rows that were read from a file are from those that were written: splatpainter/io/losses.py.
#include "kernels.h"
#include "maths.h"

namespace sp { namespace {

SP_INLINE bool same_bits(const float* a, const float* b, i64 n) {
    u32 bits = 0;
    for (i64 k = 0; k < n; ++k) bits |= bits_of<u32>(a[k]) ^ bits_of<u32>(b[k]);
    return !bits;
}

SP_INLINE void widen(float* range, float value) {
    if (value < range[0]) range[0] = value;
    if (value > range[1]) range[1] = value;
}

// Coefficients of row i: those of [n, K, 3] as [n, 3 K].
SP_INLINE float entry(const float* row, i64 width, i64 k) { return k < width ? row[k] : 0.0f; }

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
    const i64 width0 = sh0.shape[1], width1 = sh1.shape[1], width = width0 > width1 ? width0 : width1;
    float* spans = ranges.row(thread);
    for (i64 i = share.begin; i < share.end; ++i) {
        differs(i) = false;
        if (!counted(i)) continue;
        const float *m0 = means0.row(i), *m1 = means1.row(i), *q0 = quats0.row(i), *q1 = quats1.row(i);
        const float *s0 = scales0.row(i), *s1 = scales1.row(i), *c0 = sh0.row(i), *c1 = sh1.row(i);
        if (comparable && same_bits(m0, m1, 3) && same_bits(q0, q1, 4) && same_bits(s0, s1, 3) &&
            bits_of<u32>(opacities0(i)) == bits_of<u32>(opacities1(i)) && same_bits(c0, c1, width))
            continue;
        differs(i) = true;

        double size = 0, smallest = s0[0], squares = 0, ratio = 1;
        for (int k = 0; k < 3; ++k) {
            if (s0[k] > size) size = s0[k];
            if (s0[k] < smallest) smallest = s0[k];
            const double move = ((double)m1[k] + shift(3 + k)) - ((double)m0[k] + shift(k));
            squares += move * move;
        }
        errors(0, i) = sqrt_of(squares) / size;
        for (int k = 0; k < 3; ++k) {
            if (!(s0[k] >= thin * size)) continue;
            const double one = (double)s1[k] / s0[k], two = one < 1 ? 1 / one : one;
            if (two > ratio) ratio = two;
        }
        errors(4, i) = ratio;

        double color = 0, energy[3] = {0, 0, 0};
        for (i64 k = 0; k < width; ++k) {
            const float before = entry(c0, width0, k), after = entry(c1, width1, k);
            const double off = after - before;
            if (k < 3) {
                const double size_of_it = off < 0 ? -off : off;
                if (size_of_it > color) color = size_of_it;
            } else {
                energy[k % 3] += off * off;
            }
        }
        errors(1, i) = color;
        const double most = energy[0] > energy[1] ? energy[0] : energy[1];
        errors(2, i) = energy[2] > most ? energy[2] : most;
        for (i64 k = 0; k < width0; ++k) widen(spans + (k < 3 ? 0 : 2), c0[k]);
        for (i64 k = 0; k < width1; ++k) widen(spans + (k < 3 ? 4 : 6), c1[k]);

        const double fade = (double)opacities1(i) - opacities0(i);
        errors(3, i) = fade < 0 ? -fade : fade;

        double norm0 = 0, norm1 = 0, apart = 0, mirrored = 0;
        for (int k = 0; k < 4; ++k) norm0 += (double)q0[k] * q0[k], norm1 += (double)q1[k] * q1[k];
        norm0 = sqrt_of(norm0), norm1 = sqrt_of(norm1);
        for (int k = 0; k < 4; ++k) {
            const double a = q0[k] / norm0, b = q1[k] / norm1;
            apart += (a - b) * (a - b), mirrored += (a + b) * (a + b);
        }
        errors(5, i) = size > (double)(anisotropy * (float)smallest) ? (apart < mirrored ? apart : mirrored) : 0;
    }
}

} }  // namespace sp

SP_KERNELS_TO_V3(losses, ONE(row_losses))
