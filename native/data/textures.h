// Maps of materials looked up at texture coordinates: bilinear, repeating; as splattrain/data/materials.py says.
#pragma once
#include "../maths.h"

namespace sp { namespace {

namespace textures {
struct Taps { i64 first, second; double share; };

// The two texels around a coordinate that repeats, and the second's share; the first where it is no number.
SP_INLINE Taps taps(float coordinate, i64 size) {
    const double at = (double)(coordinate - floor_of(coordinate)) * (double)size - 0.5, before = floor_of(at);
    if (!(before >= -1.0 && before <= (double)size)) return {0, 0, 0.0};
    const i64 whole = (i64)before, first = (whole + size) % size;
    return {first, (first + 1) % size, at - before};
}
}  // namespace textures

// out: [M, C] table[pixels] at uvs [M, 2] (v up). pixels: [h, w, C]; table: [256].
void sample_bilinear(Array3<const u8> pixels, Rows<const float, 2> uvs, Array<const float, 1, 256> table,
                            Array2<float> out, i64 thread, i64 threads) {
    const i64 height = pixels.shape[0], width = pixels.shape[1], channels = pixels.shape[2], count = uvs.shape[0];
    for (i64 i = count * thread / threads; i < count * (thread + 1) / threads; ++i) {
        const textures::Taps x = textures::taps(uvs(i, 0), width), y = textures::taps(1.0f - uvs(i, 1), height);
        for (i64 c = 0; c < channels; ++c) {
            auto row = [&](i64 line) {
                const double left = table(pixels(line, x.first, c)), right = table(pixels(line, x.second, c));
                return left * (1 - x.share) + right * x.share;
            };
            out(i, c) = (float)(row(y.first) * (1 - y.share) + row(y.second) * y.share);
        }
    }
}

} }  // namespace sp
