// Rows of compressed PLY files, put into words and taken out of them: splatpainter/io/formats/compressed_ply.py, which
// has the layout. All arithmetic in double, as numpy's was before: the words are the same.
#include "kernels.h"
#include "maths.h"

namespace sp { namespace {

constexpr i64 CHUNK_ROWS = 256;
constexpr double SQRT_2 = 1.4142135623730951;
constexpr double LEVELS[3][3] = {{2047, 1023, 2047}, {2047, 1023, 2047}, {255, 255, 255}};

// Nearest of 0..levels between low and high; an empty or infinite range gives 0.
SP_INLINE u32 level_of(double value, double low, double high, double levels) {
    const double span = high - low;
    if (!(span > 0 && span <= 1.7976931348623157e308)) return 0;
    const double share = (value - low) / span, inside = share < 0 ? 0 : share > 1 ? 1 : share;
    return (u32)floor_of(inside * levels + 0.5);
}

SP_INLINE double value_of(u32 level, double low, double high, double levels) {
    const double part = (double)level / levels;
    return low * (1 - part) + high * part;
}

SP_INLINE u32 word_of(const u32* level) { return level[0] << 21 | level[1] << 11 | level[2]; }

SP_INLINE void levels_of(u32 word, u32* level) {
    level[0] = word >> 21 & 2047, level[1] = word >> 11 & 1023, level[2] = word & 2047;
}

SP_INLINE void widen(const double* values, double* low, double* high) {
    for (int k = 0; k < 3; ++k) {
        if (values[k] < low[k]) low[k] = values[k];
        if (values[k] > high[k]) high[k] = values[k];
    }
}

// Which component is the largest, and the other three in order: 2-10-10-10 bits, 0..1023 for -1/sqrt(2)..1/sqrt(2).
SP_INLINE u32 rotation_word(const float* q) {
    double unit[4], squares = (double)q[0] * q[0];
    for (int k = 1; k < 4; ++k) squares += (double)q[k] * q[k];
    const double length = sqrt_of(squares);
    for (int k = 0; k < 4; ++k) unit[k] = q[k] / length;
    int largest = 0;
    for (int k = 1; k < 4; ++k)
        if (__builtin_fabs(unit[k]) > __builtin_fabs(unit[largest])) largest = k;
    const double sign = unit[largest] < 0 ? -1 : 1;
    u32 word = (u32)largest;
    for (int k = 0; k < 4; ++k) {
        if (k == largest) continue;
        const double level = floor_of((sign * unit[k] / SQRT_2 + 0.5) * 1023 + 0.5);
        word = word << 10 | (u32)(level < 0 ? 0 : level > 1023 ? 1023 : level);
    }
    return word;
}

SP_INLINE void rotation_of(u32 word, float* q) {
    const u32 largest = word >> 30;
    double squares = 0;
    int shift = 20;
    for (u32 k = 0; k < 4; ++k) {
        if (k == largest) continue;
        const double small = ((double)(word >> shift & 1023) / 1023 - 0.5) * SQRT_2;
        squares += small * small;
        q[k] = (float)small, shift -= 10;
    }
    const double rest = 1 - squares;
    q[largest] = (float)sqrt_of(rest > 0 ? rest : 0);
}

// A new file's tables. log_scales: natural logarithms, cut; y00: the basis function of the base colour. ranges: of each
// chunk the least x, y, z, the largest, the same of scales and of colours; words: position, rotation, scale, colour.
void pack_chunks(Rows<const float, 3> means, Rows<const float, 3> log_scales, Array3<const float> sh,
                 Array1<const float> opacities, Rows<const float, 4> quats, double y00, Rows<float, 18> ranges,
                 Rows<u32, 4> words, i64 thread, i64 threads) {
    const i64 count = means.shape[0];
    const Share share = share_of(ranges.shape[0], thread, threads);
    for (i64 c = share.begin; c < share.end; ++c) {
        const i64 first = c * CHUNK_ROWS, last = first + CHUNK_ROWS < count ? first + CHUNK_ROWS : count;
        double values[CHUNK_ROWS][3][3], low[3][3], high[3][3];
        for (i64 i = first; i < last; ++i) {
            double(*row)[3] = values[i - first];
            for (int k = 0; k < 3; ++k) {
                row[0][k] = means(i, k), row[1][k] = log_scales(i, k);
                row[2][k] = (float)(0.5 + y00 * (double)sh(i, 0, k));
            }
            for (int g = 0; g < 3; ++g) {
                if (i == first)
                    for (int k = 0; k < 3; ++k) low[g][k] = high[g][k] = row[g][k];
                widen(row[g], low[g], high[g]);
            }
        }
        for (i64 i = first; i < last; ++i) {
            u32 level[3][3], *word = words.row(i);
            for (int g = 0; g < 3; ++g)
                for (int k = 0; k < 3; ++k)
                    level[g][k] = level_of(values[i - first][g][k], low[g][k], high[g][k], LEVELS[g][k]);
            const u32 alpha = (u32)floor_of((double)opacities(i) * 255 + 0.5);
            word[0] = word_of(level[0]), word[1] = rotation_word(quats.row(i)), word[2] = word_of(level[1]);
            word[3] = level[2][0] << 24 | level[2][1] << 16 | level[2][2] << 8 | alpha;
        }
        float* range = ranges.row(c);
        for (int g = 0; g < 3; ++g)
            for (int k = 0; k < 3; ++k) range[6 * g + k] = (float)low[g][k], range[6 * g + 3 + k] = (float)high[g][k];
    }
}

// Positions as a new file's words have them.
void round_in_chunks(Rows<const float, 3> means, Rows<float, 3> rounded, i64 thread, i64 threads) {
    const i64 count = means.shape[0], chunks = (count + CHUNK_ROWS - 1) / CHUNK_ROWS;
    const Share share = share_of(chunks, thread, threads);
    for (i64 c = share.begin; c < share.end; ++c) {
        const i64 first = c * CHUNK_ROWS, last = first + CHUNK_ROWS < count ? first + CHUNK_ROWS : count;
        double low[3], high[3];
        for (int k = 0; k < 3; ++k) low[k] = high[k] = means(first, k);
        for (i64 i = first; i < last; ++i) {
            const double row[3] = {means(i, 0), means(i, 1), means(i, 2)};
            widen(row, low, high);
        }
        for (i64 i = first; i < last; ++i)
            for (int k = 0; k < 3; ++k) {
                const u32 level = level_of(means(i, k), low[k], high[k], LEVELS[0][k]);
                rounded(i, k) = (float)value_of(level, low[k], high[k], LEVELS[0][k]);
            }
    }
}

// The other way, of rows that begin at a chunk. log_scales: [N, 3], whose exponentials the caller takes.
void unpack_chunks(Rows<const u32, 4> words, Rows<const float, 18> ranges, double y00, Rows<float, 3> means,
                   Rows<double, 3> log_scales, Array3<float> sh, Array1<float> opacities, Rows<float, 4> quats,
                   i64 thread, i64 threads) {
    const Share share = share_of(words.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const u32* word = words.row(i);
        const float* range = ranges.row(i / CHUNK_ROWS);
        u32 level[3][3];
        levels_of(word[0], level[0]), levels_of(word[2], level[1]);
        for (int k = 0; k < 3; ++k) {
            level[2][k] = word[3] >> (24 - 8 * k) & 255;
            means(i, k) = (float)value_of(level[0][k], range[k], range[3 + k], LEVELS[0][k]);
            log_scales(i, k) = value_of(level[1][k], range[6 + k], range[9 + k], LEVELS[1][k]);
            const double color = value_of(level[2][k], range[12 + k], range[15 + k], LEVELS[2][k]);
            sh(i, 0, k) = (float)((color - 0.5) / y00);
        }
        opacities(i) = (float)((double)(word[3] & 255) / 255);
        rotation_of(word[1], quats.row(i));
    }
}

// Coefficients beyond the base colour to bytes, channel by channel: -4 is 0, 4 is 255; NaN, of rows that are not drawn,
// is the middle.
void pack_sh_bytes(Array3<const float> sh, Array2<u8> bytes, i64 thread, i64 threads) {
    const i64 bands = sh.shape[1] - 1;
    const Share share = share_of(sh.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i)
        for (i64 c = 0; c < 3; ++c)
            for (i64 k = 0; k < bands; ++k) {
                const double value = sh(i, 1 + k, c), level = ((value == value ? value : 0) / 8 + 0.5) * 256;
                bytes(i, c * bands + k) = (u8)(level < 0 ? 0 : level > 255 ? 255 : level);
            }
}

// The other way: what the bytes stand for, by a table.
void unpack_sh_bytes(Array2<const u8> bytes, Array1<const float> table, Array3<float> sh, i64 thread, i64 threads) {
    const i64 bands = sh.shape[1] - 1;
    const Share share = share_of(sh.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i)
        for (i64 c = 0; c < 3; ++c)
            for (i64 k = 0; k < bands; ++k) sh(i, 1 + k, c) = table(bytes(i, c * bands + k));
}

} }  // namespace sp

SP_KERNELS_TO_V3(packing,
    ONE(pack_chunks),
    ONE(round_in_chunks),
    ONE(unpack_chunks),
    ONE(pack_sh_bytes),
    ONE(unpack_sh_bytes)
)
