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
void pack_base_colors(Pixels<const float, 3> sh, double y00, Rows<u16, 3> halves, i64 thread, i64 threads) {
    constexpr double LARGEST = 65504;
    const Share share = share_of(sh.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i)
        for (int c = 0; c < 3; ++c) {
            const double color = 0.5 + y00 * (double)sh(i, 0, c), known = color == color ? color : 0.0;
            halves(i, c) = half_of((float)max_of(-LARGEST, min_of(LARGEST, known)));
        }
}

// Three magnitudes of 8 bits over a shared power of two, its 5 bits and three signs; NaN counts as 0. Sixteen
// coefficients at a time: they lie one after the other but for each Gaussian's first.
void pack_harmonic_codes(Pixels<const float, 3> sh, Array2<u32> codes, i64 thread, i64 threads) {
    using V = Wide<float>;
    using U = Wide<u32>;
    using I = Wide<i32>;
    const V largest_float = all(3.402823466e38f), zero = {};
    const i64 columns = codes.shape[1], count = codes.shape[0] * columns;
    checked(codes.shape[0] - 1, sh.shape[0]), checked(columns, sh.shape[1]);
    alignas(64) float values[3][LANES] = {};
    alignas(64) u32 packed[LANES];
    const Share share = share_of(codes.shape[0], thread, threads);
    i64 row = share.begin, column = 0;
    for (i64 first = share.begin * columns, end = share.end * columns; first < end; first += LANES) {
        const i64 some = min_of<i64>(LANES, end - first);
        for (i64 l = 0; l < some; ++l) {
            const float* from = sh.row(row, 1 + column);
            for (int c = 0; c < 3; ++c) values[c][l] = from[c];
            if (++column == columns) column = 0, ++row;
        }
        SP_LANES(float, l) {
            V size[3], largest = zero;
            U code = {};
            for (int c = 0; c < 3; ++c) {
                const V value = load(&values[c][l]), magnitude = magnitude_of(value);
                const V held = largest_float < magnitude ? largest_float : magnitude;
                size[c] = value == value ? held : zero;
                largest = size[c] > largest ? size[c] : largest;
                code |= (U)(value < zero) & (1u << (24 + c));
            }
            // The power of two that is not smaller than the largest, from 2^-15 on.
            const U bits = (U)largest;
            const I power = (I)(bits >> 23) - 111 + (I)((bits & 0x007fffffu) == 0);
            const I low = power < 0 ? I{} : power, exponent = low > 31 ? I{} + 31 : low;
            const V scale = 255.0f * (V)((U)(142 - exponent) << 23);
            // Half a step is added before the cut, so that values are rounded.
            for (int c = 0; c < 3; ++c) {
                const V step = size[c] * scale + 0.5f, held = 255.0f < step ? all(255.0f) : step;
                code |= (U)__builtin_convertvector(held, I) << (8 * c);
            }
            code |= (U)exponent << 27;
            store(&packed[l], largest > zero ? code : U{});
        }
        __builtin_memcpy(codes.data + checked(first, count), packed, some * sizeof(u32));
    }
}

} }  // namespace sp

SP_KERNELS_TO_V3(frames,
    ONE(pack_base_colors),
    ONE(pack_harmonic_codes)
)
