"""MP4 files with one AV1 track, made from the AVIF image sequences that Pillow writes.

An AVIF sequence and an MP4 film are the same kind of file (ISO base media, ISO/IEC 14496-12) around the same samples
(AV1 Codec ISO Media File Format Binding, v1.3.0): only the boxes around them differ. So the encoder is libaom, which
Pillow's wheels contain (BSD 2-clause, with the Alliance for Open Media's patent licence); nothing is encoded twice.
Browsers, VLC, ffmpeg and current systems play AV1; programs from before about 2020 do not.
"""

from __future__ import annotations

import struct
from fractions import Fraction

from splatpainter.system.quick_dataclass import dataclass

MATRIX = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
"""Identity, in 16.16 and 2.30 fixed point."""
CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
SAMPLE_ENTRY_BYTES = 86
"""Bytes of a VisualSampleEntry before its boxes, its own header included."""
MAX_TIMESCALE = 90_000
"""Ticks per second; frame rates are rounded to a fraction of no larger denominator."""


@dataclass(frozen=True)
class CodedFrames:
    """The coded frames of one track."""

    width: int
    height: int
    entry: bytes
    """The boxes of the AV1 sample entry: av1C (decoder configuration), colr."""
    frames: tuple[bytes, ...]
    """Frames in the order of decoding, which for AV1 is that of showing."""
    keys: tuple[int, ...]
    """Indices of frames at which a player can start."""


def avif_samples(data: bytes) -> CodedFrames:
    """Take an AVIF image sequence apart. Raises ValueError where it is none, or not as ISO 14496-12 wants."""
    try:
        # An AVIF sequence has an MP4's tables already: take its samples and decoder configuration.
        boxes = _boxes(data, 0, len(data))
        table = {kind: data[start:end] for kind, start, end in boxes}
        entry = table[b"stsd"][8:]
        if entry[4:8] != b"av01":
            raise ValueError(f"expected av01 samples, got {entry[4:8]!r}")
        width, height = struct.unpack_from(">HH", entry, 32)
        inner = _boxes(entry, SAMPLE_ENTRY_BYTES, struct.unpack_from(">I", entry)[0])
        decoder = b"".join(box(kind, entry[start:end]) for kind, start, end in inner if kind in (b"av1C", b"colr"))
        sizes = _sizes(table[b"stsz"])
        frames = []
        for offset, count in _chunks(table):
            for size in sizes[len(frames) : len(frames) + count]:
                # Offsets and sizes are claims of the file.
                if offset + size > len(data):
                    raise ValueError("a sample lies outside the file")
                frames.append(data[offset : offset + size])
                offset += size
        keys = tuple(range(len(frames)))
        if b"stss" in table:
            keys = tuple(number - 1 for number in struct.unpack_from(f">{_count(table[b'stss'])}I", table[b"stss"], 8))
    except (KeyError, struct.error, ValueError) as error:
        raise ValueError(f"AVIF sequence: damaged, or no sequence ({error})") from None
    if len(frames) != len(sizes) or not frames:
        raise ValueError(f"AVIF sequence: expected {len(sizes)} samples, got {len(frames)}")
    return CodedFrames(width, height, decoder, tuple(frames), keys)


def mp4(samples: CodedFrames, fps: float) -> bytes:
    """The film as an MP4 file whose index comes first, so that it plays while it loads. fps: frames per second."""
    # 29.97 is 30000/1001: film rates need a fraction.
    rate = Fraction(fps).limit_denominator(1001)
    scale, tick = rate.numerator, rate.denominator
    if not 0 < scale <= MAX_TIMESCALE or not tick:
        raise ValueError(f"MP4: expected frames per second above 0 and up to {MAX_TIMESCALE}, got {fps}")
    film = b"".join(samples.frames)
    head = box(b"ftyp", b"iso6" + struct.pack(">I", 512) + b"iso6" + b"av01" + b"mp41")
    # The index first, so that the film plays while it loads. Its length does not depend on the offset in it.
    index = _moov(samples, scale, tick, 0)
    start = len(head) + len(index) + 8
    if start + len(film) >= 1 << 32:
        raise ValueError("MP4: expected less than 4 GiB; make it shorter, smaller or of lower quality")
    return head + _moov(samples, scale, tick, start) + box(b"mdat", film)


def box(kind: bytes, *parts: bytes) -> bytes:
    """One box: its length, its kind, its content."""
    content = b"".join(parts)
    return struct.pack(">I4s", 8 + len(content), kind) + content


def _full(kind: bytes, *parts: bytes, version: int = 0, flags: int = 0) -> bytes:
    return box(kind, struct.pack(">I", version << 24 | flags), *parts)


def _moov(samples: CodedFrames, scale: int, tick: int, start: int) -> bytes:
    """The index. start: offset of the first sample in the file."""
    count = len(samples.frames)
    duration, milliseconds = count * tick, round(1000 * count * tick / scale)
    fields = struct.pack(">IIII", 0, 0, 1000, milliseconds), struct.pack(">IH10x", 0x10000, 0x100), MATRIX
    header = _full(b"mvhd", *fields, bytes(24), struct.pack(">I", 2))
    size = struct.pack(">II", samples.width << 16, samples.height << 16)
    track = _full(
        b"tkhd", struct.pack(">IIIII", 0, 0, 1, 0, milliseconds), bytes(8), struct.pack(">hhhH", 0, 0, 0, 0),
        MATRIX, size, flags=3,
    )  # fmt: skip
    media = _full(b"mdhd", struct.pack(">IIIIHH", 0, 0, scale, duration, 0x55C4, 0))  # language: undetermined
    handler = _full(b"hdlr", struct.pack(">I4s12x", 0, b"vide"), b"Video\0")
    where = box(b"dinf", _full(b"dref", struct.pack(">I", 1), _full(b"url ", flags=1)))
    name = b"\x03AV1".ljust(32, b"\0")
    visual = struct.pack(">6xH16xHHIIIH", 1, samples.width, samples.height, 72 << 16, 72 << 16, 0, 1)
    entry = box(b"av01", visual, name, struct.pack(">Hh", 24, -1), samples.entry)
    tables = (
        _full(b"stsd", struct.pack(">I", 1), entry),
        _full(b"stts", struct.pack(">III", 1, count, tick)),
        _full(b"stss", struct.pack(f">I{len(samples.keys)}I", len(samples.keys), *(key + 1 for key in samples.keys))),
        _full(b"stsc", struct.pack(">IIII", 1, 1, count, 1)),
        _full(b"stsz", struct.pack(f">II{count}I", 0, count, *map(len, samples.frames))),
        _full(b"stco", struct.pack(">II", 1, start)),
    )
    information = box(b"minf", _full(b"vmhd", bytes(8), flags=1), where, box(b"stbl", *tables))
    return box(b"moov", header, box(b"trak", track, box(b"mdia", media, handler, information)))


def _boxes(data: bytes, start: int, end: int) -> list[tuple[bytes, int, int]]:
    """(kind, start and end of the content) of the boxes in a range, and of those in CONTAINERS. Of two of one kind
    the first (the pictures; an alpha track comes after them)."""
    out: list[tuple[bytes, int, int]] = []
    while start + 8 <= end:
        size, kind = struct.unpack_from(">I4s", data, start)
        if size == 1:
            raise ValueError("boxes above 4 GiB are not read")
        stop = end if size == 0 else start + size
        if size and size < 8 or stop > end:
            raise ValueError(f"the box {kind!r} is longer than what holds it")
        # Of two boxes of a kind the first counts: an alpha track comes after the picture's.
        kinds = {kind for kind, _, _ in out}
        if kind in CONTAINERS and kind not in kinds:
            out += [(kind, start + 8, stop), *_boxes(data, start + 8, stop)]
        elif kind not in kinds:
            out.append((kind, start + 8, stop))
        start = stop
    return out


def _count(table: bytes) -> int:
    """Entries that a table of fixed-size entries claims, held against its bytes."""
    (count,) = struct.unpack_from(">I", table, 4)
    if count > len(table):
        raise ValueError(f"a table of {len(table)} bytes claims {count} entries")
    return count


def _sizes(table: bytes) -> tuple[int, ...]:
    same, count = struct.unpack_from(">II", table, 4)
    if count > 1 << 24:
        raise ValueError(f"claims {count} samples")
    return (same,) * count if same else struct.unpack_from(f">{count}I", table, 12)


def _chunks(table: dict[bytes, bytes]) -> list[tuple[int, int]]:
    """(offset in the file, number of samples) of every chunk."""
    kind, letter = (b"stco", "I") if b"stco" in table else (b"co64", "Q")
    offsets = struct.unpack_from(f">{_count(table[kind])}{letter}", table[kind], 8)
    runs = [struct.unpack_from(">III", table[b"stsc"], 8 + 12 * k) for k in range(_count(table[b"stsc"]))]
    out = []
    for k, offset in enumerate(offsets):
        fitting = [samples for first, samples, _ in runs if first <= k + 1]
        if not fitting:
            raise ValueError("chunks without samples")
        out.append((offset, fitting[-1]))
    return out
