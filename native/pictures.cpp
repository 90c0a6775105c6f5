// Packed pictures walked without making pixels of them, which tells what is damaged: splatpainter/pictures/jpeg_data.py
// and whole_files.py.
#include "kernels.h"

namespace sp { namespace {

constexpr i64 DAMAGED = 1, WHOLE = 0;

// Bits of a JPEG scan (ITU T.81), the highest of a byte first; a marker ends them. Behind the end there are zeros.
struct ScanBits {
    Array1<const u8> data;
    i64 at, count;
    u64 held;
    bool ended;

    SP_SMALL void fill() {
        while (count <= 40 && !ended) {
            if (at >= data.shape[0]) {
                ended = true;
                break;
            }
            const u8 byte = data(at);
            if (byte != 255) {
                ++at;
            } else {
                const u8 next = at + 1 < data.shape[0] ? data(at + 1) : 255;
                ended = next != 0;
                if (ended) break;
                at += 2;
            }
            held = held << 8 | byte, count += 8;
        }
    }
    SP_INLINE u32 peek(i64 bits) {
        if (count < bits) fill();
        if (count <= 0) return 0;
        return (u32)((count >= bits ? held >> (count - bits) : held << (bits - count)) & ((u64(1) << bits) - 1));
    }
    SP_INLINE u32 take(i64 bits) {
        const u32 value = bits ? peek(bits) : 0;
        count -= bits;
        return value;
    }
    // Entries of 65,536: bits of the code times 256, and its symbol; 0 where no code begins so.
    SP_INLINE i64 symbol(const u16* table) {
        const u16 entry = table[peek(16)];
        count -= entry >> 8;
        return entry ? entry & 255 : -1;
    }
    // Whether nothing but bits of one kind, of at most so many bytes, lies between here and the marker that ends the
    // scan.
    SP_SMALL bool ends(i64 most) {
        i64 bytes = 0;
        bool ones = true, zeros = true;
        do {
            const u64 all = (u64(1) << (count > 0 ? count : 0)) - 1, rest = held & all;
            ones = ones && rest == all, zeros = zeros && !rest;
            bytes += count / 8;
            count = 0, fill();
        } while (count && bytes <= most);
        return (ones || zeros) && bytes <= most;
    }
};

struct Band {
    i64 first, last;
    bool refines;
};

// One block of a sequential scan.
SP_SMALL bool walk_block(ScanBits& bits, const u16* dc, const u16* ac) {
    const i64 size = bits.symbol(dc);
    if (size < 0 || size > 16) return false;
    bits.take(size);
    for (i64 k = 1; k < 64; ++k) {
        const i64 symbol = bits.symbol(ac), run = symbol >> 4, length = symbol & 15;
        if (symbol < 0) return false;
        if (!length && run != 15) break;
        k += run;
        if (length && k > 63) return false;
        bits.take(length);
    }
    return true;
}

// One block of a progressive scan of some frequencies. coded: bit k, whether that one is not zero so far.
SP_SMALL bool walk_band(ScanBits& bits, const u16* ac, Band band, i64& run_of_ends, u64& coded) {
    i64 k = band.first;
    if (!run_of_ends) {
        for (; k <= band.last; ++k) {
            const i64 symbol = bits.symbol(ac), length = symbol & 15;
            i64 run = symbol >> 4;
            if (symbol < 0 || (band.refines && length > 1)) return false;
            if (!length && run != 15) {
                run_of_ends = (i64(1) << run) + bits.take(run);
                break;
            }
            if (length) bits.take(length);
            if (!band.refines) {
                k += run;
            } else {
                for (; k <= band.last; ++k) {
                    if (coded >> k & 1) bits.take(1);
                    else if (--run < 0) break;
                }
            }
            if (!length) continue;
            if (k > band.last) return false;
            coded |= u64(1) << k;
        }
    }
    if (!run_of_ends) return true;
    if (band.refines)
        for (; k <= band.last; ++k)
            if (coded >> k & 1) bits.take(1);
    --run_of_ends;
    return true;
}

// components: [C] of a scan: blocks across and down in a unit, rows of `tables` of its first and of its other
// frequencies. across: units in a row; stride: blocks in a row of `coded`, which one component with frequencies of its
// own has. restart: units between two restart markers, 0: none. result: [3] WHOLE or DAMAGED, units that are sound,
// where the scan ends.
void walk_jpeg_scan(Array1<const u8> data, i64 start, Rows<const i32, 4> components, Array2<const u16> tables,
                    i64 across, i64 down, i64 stride, i64 restart, i64 first, i64 last, bool progressive, bool refines,
                    i64 most_skipped, Array1<u64> coded, Array1<i64> result, i64 thread, i64) {
    if (thread) return;
    ScanBits bits{data, start, 0, 0, false};
    const Band band{first, last, refines};
    const i64 units = across * down;
    i64 run_of_ends = 0, unit = 0;
    bool sound = true;
    for (; unit < units; ++unit) {
        if (restart && unit && unit % restart == 0) {
            // Fill bytes may stand before a marker.
            sound = bits.ends(most_skipped);
            while (bits.at + 1 < data.shape[0] && data(bits.at + 1) == 255) ++bits.at;
            const i64 expected = 0xd0 + (unit / restart - 1) % 8;
            sound = sound && bits.at + 1 < data.shape[0] && data(bits.at + 1) == expected;
            if (!sound) break;
            bits = ScanBits{data, bits.at + 2, 0, 0, false};
            run_of_ends = 0;
        }
        for (i64 c = 0; c < components.shape[0] && sound; ++c) {
            const i32* component = components.row(c);
            const u16 *dc = tables.row(component[2]), *ac = tables.row(component[3]);
            for (i64 block = 0; block < component[0] * component[1] && sound; ++block) {
                if (!progressive) {
                    sound = walk_block(bits, dc, ac);
                } else if (first > 0) {
                    sound = walk_band(bits, ac, band, run_of_ends, coded(unit / across * stride + unit % across));
                } else if (refines) {
                    bits.take(1);
                } else {
                    const i64 size = bits.symbol(dc);
                    sound = size >= 0 && size <= 16;
                    bits.take(size < 0 ? 0 : size);
                }
            }
        }
        sound = sound && bits.count >= 0;
        if (!sound) break;
    }
    sound = sound && bits.ends(most_skipped);
    result(0) = sound ? WHOLE : DAMAGED, result(1) = unit, result(2) = bits.at;
}

// Bytes that a strip of LZW (TIFF 6.0, section 13) unpacks to, up to `most`, as lengths of its strings alone; whether
// all its codes stand for something.
void measure_lzw(Array1<const u8> data, i64 most, Array1<i64> result, i64 thread, i64) {
    if (thread) return;
    constexpr i64 CLEAR = 256, END = 257, FIRST = 258, CODES = 4096;
    i32 length[CODES];
    for (i64 k = 0; k < CODES; ++k) length[k] = 1;
    i64 next = FIRST, width = 9, before = -1, unpacked = 0, count = 0, at = 0;
    u32 held = 0;
    bool sound = true;
    while (unpacked <= most) {
        while (count < width && at < data.shape[0]) held = held << 8 | data(at++), count += 8;
        if (count < width) break;
        const i64 code = held >> (count - width) & ((1 << width) - 1);
        count -= width;
        if (code == END) break;
        if (code == CLEAR) {
            next = FIRST, width = 9, before = -1;
            continue;
        }
        // A code that is being made is the string before it and that one's first byte.
        sound = code <= (before < 0 ? CLEAR : next);
        if (!sound) break;
        if (before >= 0 && next < CODES) length[next++] = length[before] + 1;
        unpacked += length[code], before = code;
        if (next + 1 >= i64(1) << width && width < 12) ++width;
    }
    result(0) = unpacked, result(1) = sound ? WHOLE : DAMAGED;
}

} }  // namespace sp

SP_KERNELS_TO_BASE(pictures,
    small_kernel<&walk_jpeg_scan>("walk_jpeg_scan"),
    small_kernel<&measure_lzw>("measure_lzw")
)
