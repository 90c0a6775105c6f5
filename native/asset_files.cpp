// Rows of PLY and SOG files, taken apart and put together, and which Gaussians can be drawn: splatpainter/io/formats.
// All arithmetic in double, rounded once, as files have float32.
#include "kernels.h"
#include "maths.h"

namespace sp { namespace {

constexpr i64 BLOCK_ROWS = 64;
// Properties of a PLY ahead of those of SH: centre, rotation, scales, opacity.
constexpr i64 MEANS = 0, QUATS = 3, SCALES = 7, OPACITY = 10, SH = 11;

SP_INLINE double log1p_of(double x) {  // as precise near 0 (Kahan)
    const double up = 1 + x, near = log_of(up) * (x / (up - 1));
    return up == 1 ? x : is_finite(near) ? near : log_of(up);
}

// Where the properties of `width` SH values stand in records of `count` columns.
SP_INLINE const i64* places_of(const Array1<const i64>& columns, i64 width, i64 count) {
    checked(SH + width - 1, columns.shape[0]);
    for (i64 c = 0; c < columns.shape[0]; ++c) checked(columns(c), count);
    return columns.data;
}

// The properties of each record, of which `columns` says where they stand; scales from their logarithms, opacities from
// their logits.
void unpack_ply_rows(Array2<const u32> records, Array1<const i64> columns, Rows<u32, 3> means, Rows<u32, 4> quats,
                     Rows<float, 3> scales, Array1<float> opacities, Array2<u32> sh, i64 thread, i64 threads) {
    const i64 width = sh.shape[1], *at = places_of(columns, width, records.shape[1]);
    const Share share = share_of(records.shape[0], thread, threads);
    for (i64 first = share.begin; first < share.end; first += BLOCK_ROWS) {
        const i64 count = first + BLOCK_ROWS < share.end ? BLOCK_ROWS : share.end - first;
        float logs[3 * BLOCK_ROWS], logits[BLOCK_ROWS];
        for (i64 k = 0; k < count; ++k) {
            const u32* from = records.row(first + k);
            u32 *mean = means.row(first + k), *quat = quats.row(first + k), *color = sh.row(first + k);
            for (int c = 0; c < 3; ++c) mean[c] = from[at[MEANS + c]];
            for (int c = 0; c < 4; ++c) quat[c] = from[at[QUATS + c]];
            for (int c = 0; c < 3; ++c) logs[3 * k + c] = bits_of<float>(from[at[SCALES + c]]);
            logits[k] = bits_of<float>(from[at[OPACITY]]);
            for (i64 c = 0; c < width; ++c) color[c] = from[at[SH + c]];
        }
        float *scale = scales.row(first), *opacity = &opacities(first);
        for (i64 k = 0; k < 3 * count; ++k) scale[k] = (float)exp_of((double)logs[k]);
        for (i64 k = 0; k < count; ++k) opacity[k] = (float)(1 / (1 + exp_of(-(double)logits[k])));
    }
}

// The other way: finite logarithms and logits of all that is finite, by what stands for scales and opacities that have
// none. Other columns of the records stay.
void pack_ply_rows(Rows<const u32, 3> means, Rows<const u32, 4> quats, Rows<const float, 3> scales,
                   Array1<const float> opacities, Array2<const u32> sh, Array1<const i64> columns, double min_scale,
                   double min_opacity, double max_opacity, Array2<u32> records, i64 thread, i64 threads) {
    const i64 width = sh.shape[1], *at = places_of(columns, width, records.shape[1]);
    const Share share = share_of(records.shape[0], thread, threads);
    for (i64 first = share.begin; first < share.end; first += BLOCK_ROWS) {
        const i64 count = first + BLOCK_ROWS < share.end ? BLOCK_ROWS : share.end - first;
        float logs[3 * BLOCK_ROWS], logits[BLOCK_ROWS];
        const float *scale = scales.row(first), *opacity = &opacities(first);
        for (i64 k = 0; k < 3 * count; ++k) {
            const double x = scale[k];
            logs[k] = (float)log_of(x < min_scale ? min_scale : x);
        }
        for (i64 k = 0; k < count; ++k) {
            const double x = opacity[k], inside = x < min_opacity ? min_opacity : x > max_opacity ? max_opacity : x;
            logits[k] = (float)(log_of(inside) - log1p_of(-inside));
        }
        for (i64 k = 0; k < count; ++k) {
            u32* to = records.row(first + k);
            const u32 *mean = means.row(first + k), *quat = quats.row(first + k), *color = sh.row(first + k);
            for (int c = 0; c < 3; ++c) to[at[MEANS + c]] = mean[c];
            for (int c = 0; c < 4; ++c) to[at[QUATS + c]] = quat[c];
            for (int c = 0; c < 3; ++c) to[at[SCALES + c]] = bits_of<u32>(logs[3 * k + c]);
            to[at[OPACITY]] = bits_of<u32>(logits[k]);
            for (i64 c = 0; c < width; ++c) to[at[SH + c]] = color[c];
        }
    }
}

// Pixels of SOG planes, one a row: io/formats/sog.py has the layout. positions: what each word of an axis stands for;
// none: `means` are left. palette: [P, 3 (K - 1)]. missing: of each thread, rows without a rotation and rows that name
// no entry of the palette.
void unpack_sog_rows(Rows<const u8, 4> low, Rows<const u8, 4> high, Rows<const u8, 4> turns, Rows<const u8, 4> sizes,
                     Rows<const u8, 4> colors, Rows<const u8, 4> labels, Array2<const float> positions,
                     Array1<const float> scale_of, Array1<const float> base_of, Array2<const float> palette,
                     Rows<float, 3> means, Rows<float, 4> quats, Rows<float, 3> scales, Array1<float> opacities,
                     Array2<float> sh, Rows<i64, 2> missing, i64 thread, i64 threads) {
    constexpr double SQRT_2 = 1.4142135623730951;
    const i64 rest = sh.shape[1] - 3;
    i64 unturned = 0, unnamed = 0;
    const Share share = share_of(sh.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const u8 *turn = turns.row(i), *size = sizes.row(i), *color = colors.row(i);
        if (!positions.empty()) {
            const u8 *l = low.row(i), *h = high.row(i);
            for (int k = 0; k < 3; ++k) means(i, k) = positions(k, l[k] + 256 * h[k]);
        }
        float* q = quats.row(i);
        if (turn[3] < 252) {
            q[0] = 1, q[1] = q[2] = q[3] = 0, ++unturned;
        } else {
            double small[3];
            for (int k = 0; k < 3; ++k) small[k] = ((double)turn[k] / 255 * 2 - 1) / SQRT_2;
            const double left = 1 - (small[0] * small[0] + small[1] * small[1] + small[2] * small[2]);
            const int largest = turn[3] - 252;
            for (int k = 0, j = 0; k < 4; ++k) q[k] = (float)(k == largest ? sqrt_of(left > 0 ? left : 0) : small[j++]);
        }
        for (int k = 0; k < 3; ++k) scales(i, k) = scale_of(size[k]);
        opacities(i) = (float)((double)color[3] / 255);
        float* out = sh.row(i);
        for (int k = 0; k < 3; ++k) out[k] = base_of(color[k]);
        if (!rest) continue;
        const u8* label = labels.row(i);
        const i64 entry = label[0] + 256 * label[1];
        if (entry < palette.shape[0]) {
            __builtin_memcpy(out + 3, palette.row(entry), rest * sizeof(float));
        } else {
            for (i64 k = 0; k < rest; ++k) out[3 + k] = 0;
            ++unnamed;
        }
    }
    missing(thread, 0) = unturned, missing(thread, 1) = unnamed;
}

constexpr u32 NO_SIGN = 0x7fffffff, INFINITE_BITS = 0x7f800000;

// The largest magnitude, as bits: they are in the order of the numbers, with NaN above all.
SP_INLINE u32 largest_bits(const float* values, i64 count) {
    u32 most = 0;
    for (i64 k = 0; k < count; ++k) {
        const u32 bits = bits_of<u32>(values[k]) & NO_SIGN;
        most = bits > most ? bits : most;
    }
    return most;
}

// Which Gaussians can be drawn (Splats.drawable), and of each thread how many have values that are not finite, a zero
// rotation, a scale that is not positive, an opacity outside 0..1, or are not drawn for another reason.
void check_rows(Rows<const float, 3> means, Rows<const float, 4> quats, Rows<const float, 3> scales,
                Array1<const float> opacities, Array2<const float> sh, float most, float least_quat,
                Array1<bool> drawable, Rows<i64, 5> counts, i64 thread, i64 threads) {
    const u32 limit = bits_of<u32>(most), few = bits_of<u32>(most / 100), least = bits_of<u32>(least_quat);
    const i64 width = sh.shape[1];
    i64 odd[5] = {0, 0, 0, 0, 0};
    const Share share = share_of(drawable.shape[0], thread, threads);
    for (i64 i = share.begin; i < share.end; ++i) {
        const float *scale = scales.row(i), *color = sh.row(i), opacity = opacities(i);
        const u32 place = largest_bits(means.row(i), 3), turn = largest_bits(quats.row(i), 4);
        const u32 size = largest_bits(scale, 3), tint = largest_bits(color, width);
        const bool is_flat = (scale[0] <= 0) | (scale[1] <= 0) | (scale[2] <= 0);
        const bool is_outside = (opacity < 0) | (opacity > 1), is_opacity = (opacity >= 0) & (opacity <= 1);
        bool is_drawn = (place <= limit) & (turn <= limit) & (turn >= least) & (size <= limit) & !is_flat & is_opacity;
        // Of values below a hundredth no sum of 75 exceeds it.
        if (tint > few) {
            float sum = 0;
            for (i64 k = 0; k < width; ++k) sum += __builtin_fabsf(color[k]);
            is_drawn &= sum <= most;
        }
        drawable(i) = is_drawn;
        if (is_drawn) continue;
        const u32 own = bits_of<u32>(opacity) & NO_SIGN;
        const bool is_endless = (place >= INFINITE_BITS) | (turn >= INFINITE_BITS) | (size >= INFINITE_BITS) |
                                (tint >= INFINITE_BITS) | (own >= INFINITE_BITS);
        const bool is_unturned = turn == 0;
        odd[0] += is_endless, odd[1] += is_unturned, odd[2] += is_flat, odd[3] += is_outside;
        odd[4] += !(is_endless | is_unturned | is_flat | is_outside);
    }
    for (int k = 0; k < 5; ++k) counts(thread, k) = odd[k];
}

} }  // namespace sp

SP_KERNELS_TO_V3(asset_files,
    ONE(unpack_ply_rows),
    ONE(pack_ply_rows),
    ONE(unpack_sog_rows),
    ONE(check_rows)
)
