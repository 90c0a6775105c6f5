// Colours as they travel to a page and lie in its textures: splatpainter/server/frames.py.
#include "kernels.h"
#include "maths.h"

namespace sp { namespace {

// The nearest half of numbers within +-65504, of two the even one.
SP_INLINE u16 half_of(float value) {
    const u32 bits = bits_of<u32>(value), size = bits & 0x7fffffffu, sign = (bits >> 16) & 0x8000u;
    // Below 2^-14 halves are 2^-24 apart, as are floats from 1/2 on.
    const u32 small = bits_of<u32>(bits_of<float>(size) + 0.5f) - 0x3f000000u;
    const u32 normal = (size + 0xfffu + ((size >> 13) & 1u) - 0x38000000u) >> 13;
    return (u16)(sign | (size < 0x38800000u ? small : normal));
}

// Bits of base colours in half precision; y00: the constant band's basis function.
SP_SMALL void pack_base_colors(Pixels<const float, 3> sh, double y00, Rows<u16, 3> halves, i64 thread, i64 threads) {
    constexpr double LARGEST = 65504;
    const Share share = share_of(sh.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i)
        for (int c = 0; c < 3; ++c) {
            const double color = 0.5 + y00 * (double)sh(i, 0, c), known = color == color ? color : 0.0;
            halves(i, c) = half_of((float)max_of(-LARGEST, min_of(LARGEST, known)));
        }
}

// Three magnitudes of 8 bits over a shared power of two, its 5 bits and three signs; NaN counts as 0.
SP_SMALL void pack_harmonic_codes(Pixels<const float, 3> sh, Array2<u32> codes, i64 thread, i64 threads) {
    constexpr float LARGEST = 3.402823466e38f;
    const i64 columns = codes.shape[1];
    checked(codes.shape[0] - 1, sh.shape[0]), checked(columns, sh.shape[1]);
    const Share share = share_of(codes.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const float* from = sh.row(i, 0) + 3;
        u32* to = codes.row(i);
        for (i64 j = 0; j < columns; ++j) {
            float size[3], largest = 0;
            u32 code = 0;
            for (int c = 0; c < 3; ++c) {
                const float value = from[3 * j + c], magnitude = min_of(abs_of(value), LARGEST);
                size[c] = value == value ? magnitude : 0.0f;
                largest = max_of(largest, size[c]);
                code |= (u32)(value < 0) << (24 + c);
            }
            // The power of two that is not smaller than the largest, from 2^-15 on.
            const u32 bits = bits_of<u32>(largest);
            const i32 power = (i32)(bits >> 23) - 126 - ((bits & 0x007fffffu) == 0) + 15;
            const i32 exponent = power < 0 ? 0 : power > 31 ? 31 : power;
            const float scale = 255.0f * bits_of<float>((u32)(142 - exponent) << 23);
            // Half a step is added before the cut, so that values are rounded.
            for (int c = 0; c < 3; ++c) code |= (u32)(i32)min_of(size[c] * scale + 0.5f, 255.0f) << (8 * c);
            to[j] = largest > 0 ? code | (u32)exponent << 27 : 0;
        }
    }
}

} }  // namespace sp

SP_KERNELS_TO_V3(frames,
    ONE(pack_base_colors),
    ONE(pack_harmonic_codes)
)
