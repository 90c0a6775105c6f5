"""Pictures of which a part was never written, or was damaged, that decoders make pixels of without a word.

Known before anything is decoded: a PNG whose chunks have other sums than they say, a TIFF whose pages or tags lie
behind its end, strips of it that unpack to more or less than they hold or not at all (libtiff fills up and goes on), a
JPEG whose packed pixels make no sense (jpeg_data.py), and a JPEG or WebP that ends in zeros (disk space set aside by a
download).
"""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np

from splatpainter.image_files import PNG_MAGIC
from splatpainter.io.foreign_files import COPY_AGAIN
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.pictures.jpeg_data import damage_of_jpeg
from splatpainter.system.quick_dataclass import dataclass

TIFF_MAGICS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""Little and big endian, then the same of BigTIFF."""
JPEG_MAGIC = b"\xff\xd8\xff"
RAW_MARK = b"CR"
"""Behind the head of Canon's raw photographs, which are named as such."""


@dataclass(frozen=True)
class TiffCodes:
    """Numbers of TIFF 6.0 and BigTIFF, and what is looked at."""

    width: int = 256
    height: int = 257
    bits: int = 258
    compression: int = 259
    photometric: int = 262
    strip_offsets: int = 273
    samples: int = 277
    rows_per_strip: int = 278
    strip_bytes: int = 279
    planar: int = 284
    tile_width: int = 322
    tile_height: int = 323
    tile_offsets: int = 324
    tile_bytes: int = 325
    jpeg_tables: int = 347
    needed: tuple[int, ...] = (258, 273, 279, 320, 324, 325, 347)
    """Tags with many values without which there is no picture."""
    uncompressed: int = 1
    lzw: int = 5
    jpeg: int = 7
    deflate: tuple[int, ...] = (8, 32946)
    packbits: int = 32773
    """Compression: runs of bytes."""
    old_jpeg: int = 6
    """Compression that keeps its pixels elsewhere."""
    ycbcr: int = 6
    """Photometric: brightness and thinned colours, whose strips have another size."""
    max_entries: int = 4096
    """Tags of a page that are looked at. Source: taste."""
    max_runs: int = 1 << 22
    """Runs that are counted, about half a second."""
    max_jpeg_bytes: int = 1 << 28
    """Bytes of a JPEG that are walked."""
    max_zeros: int = 256
    """Zero bytes at the end of a compressed picture, from which that was never written: entropy coding has none."""


CODES = TiffCodes()
TYPES = {1: "B", 2: "B", 3: "H", 4: "I", 6: "b", 7: "B", 8: "h", 9: "i", 16: "Q", 17: "q", 18: "Q"}
"""TIFF type of integers -> struct's letter."""


def check_complete(path: Path) -> None:
    """Raises ValueError, one line, of a picture file that is not whole; other files are none of its business."""
    if not path.is_file():  # a FIFO would block for ever
        return
    try:
        with open(path, "rb") as file:
            head = file.read(16)
            size = file.seek(0, 2)
            if head[:4] in TIFF_MAGICS:
                _check_tiff(file, size, path)
            elif head.startswith(PNG_MAGIC):
                _check_png(file, path)
            elif head.startswith(JPEG_MAGIC):
                file.seek(0)
                if damage := damage_of_jpeg(file.read(CODES.max_jpeg_bytes)):
                    raise ValueError(f"{path}: damaged picture ({damage}); {COPY_AGAIN}")
            unwritten = _ends_unwritten(file, head, size)
    except OSError:  # which the reader says
        return
    if unwritten:
        raise ValueError(f"{path}: damaged picture (it ends in zero bytes, as no such file does); {COPY_AGAIN}")


def _ends_unwritten(file: BinaryIO, head: bytes, size: int) -> bool:
    """Whether the end of a JPEG or WebP was never written. Some cameras pad what is whole with zeros."""
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        end = min(8 + int.from_bytes(head[4:8], "little"), size)
        file.seek(max(end - CODES.max_zeros, 0))
        return end > CODES.max_zeros and not any(file.read(CODES.max_zeros))
    if not head.startswith(JPEG_MAGIC):
        return False
    # Back to the last byte that is none: the end of a whole JPEG is marked.
    end, block = size, b""
    while end > 0 and not (block := block.rstrip(b"\0")):
        start = max(end - (1 << 16), 0)
        file.seek(start)
        block, end = file.read(end - start), start
    block = block.rstrip(b"\0")
    return size - (end + len(block)) >= CODES.max_zeros and not block.endswith(b"\xff\xd9")


def _check_png(file: BinaryIO, path: Path) -> None:
    """Every chunk that pixels depend on says its sum, which decoders may leave aside."""
    file.seek(len(PNG_MAGIC))
    while len(head := file.read(8)) == 8:
        length, kind = struct.unpack(">I4s", head)
        if kind == b"IEND":
            return
        if not kind[:1].isupper():  # text and the like, which whoever uses it judges
            file.seek(length + 4, 1)
            continue
        # In pieces: a header can claim any length.
        total, left = zlib.crc32(kind), length
        while left and (piece := file.read(min(left, 1 << 20))):
            total, left = zlib.crc32(piece, total), left - len(piece)
        stored = file.read(4)
        if len(stored) == 4 and int.from_bytes(stored, "big") != total:
            name = kind.decode("ascii", "replace")
            raise ValueError(
                f"{path}: damaged picture (its {name} chunk has another checksum than it says); {COPY_AGAIN}"
            )


def _check_tiff(file: BinaryIO, size: int, path: Path) -> None:
    tags = first_page(file, size, path)
    tiled = CODES.tile_offsets in tags
    offsets = tags.get(CODES.tile_offsets if tiled else CODES.strip_offsets, ())
    counts = tags.get(CODES.tile_bytes if tiled else CODES.strip_bytes, ())
    end = max((at + count for at, count in zip(offsets, counts, strict=False)), default=0)
    if end > size:
        raise ValueError(f"{path}: damaged picture (cut off: {size:,} bytes of at least {end:,}); {COPY_AGAIN}")
    (compression, *_) = tags.get(CODES.compression, (CODES.uncompressed,))
    walked = compression == CODES.packbits or compression == CODES.lzw or compression in CODES.deflate
    if compression != CODES.jpeg and (not walked or tags.get(CODES.photometric) == (CODES.ycbcr,)):
        return
    part, cost = "tile" if tiled else "strip", 0
    sizes = _part_bytes(tags, tiled)
    tables = bytes(tags.get(CODES.jpeg_tables, ()))
    for number, (at, count, expected) in enumerate(zip(offsets, counts, sizes, strict=False)):
        file.seek(at)
        data = file.read(count)
        if compression == CODES.jpeg:
            if damage := damage_of_jpeg(data, tables):
                raise ValueError(f"{path}: damaged picture ({part} {number}: {damage}); {COPY_AGAIN}")
            continue
        if compression == CODES.packbits:
            unpacked, made = _unpacked_bytes(data, expected)
            cost += made
        elif compression == CODES.lzw:
            unpacked = _bytes_of_lzw(data, max(sizes))
        else:
            unpacked = _bytes_of_deflate(data, max(sizes))
        # Some programs fill up the last strip.
        if unpacked != expected and not (expected < max(sizes) == unpacked and number == len(sizes) - 1):
            actual = "does not unpack" if unpacked < 0 else f"unpacks to {unpacked:,} bytes, expected {expected:,}"
            raise ValueError(f"{path}: damaged picture ({part} {number} {actual}); copy it again, or save it again")
        if cost > CODES.max_runs:
            return


def first_page(file: BinaryIO, size: int, path: Path) -> dict[int, tuple[int, ...]]:
    """Tag -> its integers, of a TIFF's first page; tags that make no sense are left out. Raises ValueError: damaged."""
    file.seek(0)
    head = file.read(16)
    order, big = "<" if head[:2] == b"II" else ">", head[2:4] in (b"+\0", b"\0+")
    entry, count_type, offset_type = (20, "Q", "Q") if big else (12, "H", "I")
    try:
        (at,) = struct.unpack_from(order + offset_type, head, 8 if big else 4)
        file.seek(min(at, size))
        (count,) = struct.unpack(order + count_type, file.read(struct.calcsize(count_type)))
    except struct.error:
        raise ValueError(
            f"{path}: damaged picture (cut off: its page list lies behind its end); {COPY_AGAIN}"
        ) from None
    if not count and head[8:10] != RAW_MARK:
        raise ValueError(f"{path}: damaged picture (its first page has no tags); {COPY_AGAIN}")
    entries = file.read(entry * min(count, CODES.max_entries))
    if len(entries) < entry * min(count, CODES.max_entries):
        raise ValueError(f"{path}: damaged picture (cut off within its page list); {COPY_AGAIN}")
    tags: dict[int, tuple[int, ...]] = {}
    for start in range(0, len(entries), entry):
        tag, kind, values = struct.unpack_from(order + "HH" + offset_type, entries, start)
        letter, inline = TYPES.get(kind), entries[start + 4 + struct.calcsize(offset_type) : start + entry]
        if letter is None or values > size:
            continue
        length = values * struct.calcsize(letter)
        if length > len(inline):
            file.seek(min(struct.unpack(order + offset_type, inline)[0], size))
            inline = file.read(length)
            if len(inline) < length and tag in CODES.needed:
                raise ValueError(f"{path}: damaged picture (cut off within what its first page says); {COPY_AGAIN}")
        if len(inline) >= length:
            tags[tag] = struct.unpack_from(f"{order}{values}{letter}", inline)
    # How many bytes a strip has may be left out, where they are not packed.
    is_readable = {CODES.width, CODES.height} <= {*tags} and {CODES.strip_offsets, CODES.tile_offsets} & {*tags}
    if not is_readable and tags.get(CODES.compression) != (CODES.old_jpeg,) and head[8:10] != RAW_MARK:
        raise ValueError(
            f"{path}: damaged picture (its first page says no size, or not where its pixels are); {COPY_AGAIN}"
        )
    return tags


def _part_bytes(tags: dict[int, tuple[int, ...]], tiled: bool) -> list[int]:
    """Bytes of each strip or tile of a page before they were packed."""

    def first(tag: int, default: int) -> int:
        return tags[tag][0] if tags.get(tag) else default

    width, height, planes = first(CODES.width, 0), first(CODES.height, 0), first(CODES.samples, 1)
    bits = tags.get(CODES.bits, (1,))
    one_plane = first(CODES.planar, 1) == 1
    pixel_bits = (sum(bits) if len(bits) > 1 else first(CODES.bits, 1) * planes) if one_plane else first(CODES.bits, 1)
    count = len(tags.get(CODES.tile_offsets if tiled else CODES.strip_offsets, ()))
    if tiled:
        row = -(-first(CODES.tile_width, 0) * pixel_bits // 8)
        return [row * first(CODES.tile_height, 0)] * count
    rows = max(min(first(CODES.rows_per_strip, height), height), 1)
    edges = [*range(0, height, rows), height]
    strips = [(bottom - top) * -(-width * pixel_bits // 8) for top, bottom in pairwise(edges)]
    return strips * (1 if one_plane else planes)


def _unpacked_bytes(data: bytes, expected: int) -> tuple[int, int]:
    """(bytes that PackBits unpack to, runs); no more than one run beyond those expected. What lies behind them counts,
    but for one byte that pads."""
    at = unpacked = runs = 0
    end = len(data)
    while at < end and unpacked < expected:
        head = data[at]
        if head < 128:  # that many bytes and one as they are
            unpacked, at = unpacked + head + 1, at + head + 2
        elif head > 128:  # one byte, repeated
            unpacked, at = unpacked + 257 - head, at + 2
        else:
            at += 1
        runs += 1
    if at > end:  # the last run lacks some of its bytes
        unpacked -= at - end
    return unpacked + max(end - at - 1, 0), runs


def _bytes_of_lzw(data: bytes, most: int) -> int:
    """Bytes that a part packed by LZW unpacks to, a few more than `most` at most; -1 where its codes make no sense."""
    if data[:1] == b"\0" and data[1:2] and data[1] & 1:  # the old way round, which libtiff judges
        return most
    result = np.zeros(2, np.int64)
    run(kernels.measure_lzw, readonly(np.frombuffer(data, np.uint8), np.uint8), most, result)
    unpacked, broken = result.tolist()
    return -1 if broken else unpacked


def _bytes_of_deflate(data: bytes, most: int) -> int:
    """Bytes that a zlib stream unpacks to, `most` and one at most; -1 where it is damaged or does not end."""
    stream = zlib.decompressobj()
    try:
        unpacked = len(stream.decompress(data, most + 1))
        stream.decompress(stream.unconsumed_tail, 1)  # the sum of what it holds comes last
    except zlib.error:
        return -1
    return unpacked if stream.eof else -1
