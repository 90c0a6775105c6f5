"""Numbers packed into words and pixels, and the order of rows in which they pack well. Knows no format and no rows.

Words hold unsigned fractions of a range, and unit quaternions as their three smaller components. Images carry numbers
in lossless WebP, and say their size before they are decoded.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from splatpainter.array_types import Bytes, Ids
from splatpainter.io.files import printable
from splatpainter.kernels.parallel import each
from splatpainter.transforms import row_norm

MORTON_BITS = 21
"""Bits an axis: three of them fill a 64-bit key."""
MORTON_ROWS = 1 << 14
"""Rows whose keys are made at a time: their float64 and their words stay in the cache."""


def unpack_fields(words: np.ndarray, bits: Sequence[int]) -> Ids:
    """[N] uint32 -> [N, len(bits)] int64 fields, the first one in the highest bits (of the lowest sum(bits))."""
    shifts = np.cumsum([0, *reversed(bits)])[:-1][::-1]
    fields = [(words >> np.uint32(s)).astype(np.int64) & ((1 << b) - 1) for s, b in zip(shifts, bits, strict=True)]
    return np.stack(fields, 1)


def pack_fields(fields: np.ndarray, bits: Sequence[int]) -> np.ndarray:
    """[N, len(bits)] non-negative integers that fit -> [N] uint32, the inverse of unpack_fields."""
    words = np.zeros(len(fields), np.uint32)
    for k, width in enumerate(bits):
        words = (words << np.uint32(width)) | fields[:, k].astype(np.uint32)
    return words


def quantise(values: np.ndarray, low: np.ndarray, high: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Values -> nearest of 0..levels between low and high (clamped; an empty or infinite range gives 0), int64. All
    broadcast."""
    with np.errstate(invalid="ignore", over="ignore"):  # of ranges that a file may hold and no value can lie in
        span, above = high - low, values - low
    usable = (span > 0) & np.isfinite(span)
    steps = np.divide(above, span, out=np.zeros(np.broadcast(values, span).shape), where=usable)
    return np.floor(np.clip(steps, 0, 1) * levels + 0.5).astype(np.int64)


def pack_quats(quats: np.ndarray) -> np.ndarray:
    """[N, 4] non-zero quaternions -> [N] uint32 of 2-10-10-10 bits: the place of the largest component, then the other
    three in order, each 0..1023 for -1/sqrt(2)..1/sqrt(2)."""
    unit = quats / row_norm(quats.astype(np.float64))[:, None]
    rows = np.arange(len(unit))
    largest = np.abs(unit).argmax(1)
    unit = np.where(unit[rows, largest] < 0, -1, 1)[:, None] * unit
    rest = np.arange(3) + (np.arange(3) >= largest[:, None])
    small = np.clip(np.floor((unit[rows[:, None], rest] / np.sqrt(2) + 0.5) * 1023 + 0.5), 0, 1023)
    return pack_fields(np.concatenate([largest[:, None], small], 1), (2, 10, 10, 10))


def image_size(data: bytes, where: Path | str) -> tuple[int, int]:
    """Width and height in pixels from the header of a WebP or PNG file; nothing is decoded.

    Pillow allocates a WebP canvas when it opens the file, so the size has to be known before that.
    """
    try:
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            kind = data[12:16]
            if kind == b"VP8L" and data[20] == 0x2F:
                (bits,) = struct.unpack_from("<I", data, 21)
                return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
            if kind == b"VP8X":
                width, high, height, top = struct.unpack_from("<HBHB", data, 24)
                return (width | high << 16) + 1, (height | top << 16) + 1
            if kind == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
                width, height = struct.unpack_from("<HH", data, 26)
                return width & 0x3FFF, height & 0x3FFF
        elif data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR":
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
    except (struct.error, IndexError):
        raise ValueError(f"{where}: truncated image") from None
    raise ValueError(f"{where}: expected a WebP or PNG image, found {bytes(data[:12])!r}")


def is_lossy_webp(data: bytes) -> bool:
    """Whether the pixels of a WebP file are lossy ("VP8 " chunk), from its chunks alone; other files are not."""
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        return False
    at = 12
    while at + 8 <= len(data):
        if data[at : at + 4] == b"VP8 ":
            return True
        at += 8 + int.from_bytes(data[at + 4 : at + 8], "little")
        at += at & 1
    return False


def decode_image(data: bytes, where: Path | str) -> Bytes:
    """[height, width, 4] uint8 RGBA. The caller has judged `image_size`. Raises ValueError: a damaged image."""
    return decode_images([(data, where)])[0]


def decode_images(images: Sequence[tuple[bytes, Path | str]]) -> list[Bytes]:
    """The same of several (data, where), by all threads."""
    with warnings.catch_warnings():
        # Sizes were judged against the row count; Pillow's own limit is for pictures.
        warnings.simplefilter("ignore")
        return each(lambda image: _decoded(*image), images)


def _decoded(data: bytes, where: Path | str) -> Bytes:
    # By its own name, or Pillow imports its readers of forty other formats to look for this one.
    from PIL import Image, WebPImagePlugin  # noqa: F401

    expected = image_size(data, where)
    try:
        with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
            if image.size != expected:
                raise ValueError(f"its header says {expected}, its content {image.size} pixels")
            return np.asarray(image if image.mode == "RGBA" else image.convert("RGBA"))
    except (
        OSError,
        ValueError,
        SyntaxError,
        EOFError,
        RuntimeError,
        ArithmeticError,
        AttributeError,
        LookupError,
        TypeError,
        struct.error,
        zlib.error,
        Image.DecompressionBombError,
    ) as error:  # Pillow's parsers of damaged chunks raise all of these
        raise ValueError(f"{where}: damaged image ({printable(' '.join(str(error).split()), 120)})") from None


def encode_image(pixels: np.ndarray) -> bytes:
    """[height, width, 4] uint8 -> lossless WebP that gives back every byte."""
    from PIL import Image, WebPImagePlugin  # noqa: F401

    out = io.BytesIO()
    # exact: WebP otherwise rewrites the colour of pixels whose alpha is 0, and here those bytes are data.
    Image.fromarray(np.ascontiguousarray(pixels)).save(out, "WEBP", lossless=True, exact=True, quality=60, method=3)
    return out.getvalue()


def morton_order(means: np.ndarray) -> Ids:
    """[N] int64 row indices along the Z-order curve over the bounding box of `means` [N, 3]; equal places keep their
    order, rows that are not finite come last.

    `splats.take(morton_order(splats.means))` before writing a new compressed PLY makes its chunks small in space, and
    so their 11-bit positions fine (docs/formats.md has numbers); it also changes row indices, so it is never automatic.
    """
    finite = np.asarray(np.isfinite(means).all(1))
    keys = np.full(len(means), np.iinfo(np.uint64).max, np.uint64)
    if not finite.any():
        return np.arange(len(means))
    # Axis by axis: numpy's own way along the longer axis takes several times longer.
    axes = (means if finite.all() else means[finite]).T
    low = np.array([axis.min() for axis in axes], np.float64)
    span = np.maximum(np.array([axis.max() for axis in axes], np.float64) - low, np.finfo(np.float64).tiny)

    def fill(start: int) -> None:
        rows = slice(start, start + MORTON_ROWS)
        with np.errstate(all="ignore"):  # of rows that are not finite, which keep the last key
            cells = ((means[rows].astype(np.float64) - low) / span * (2**MORTON_BITS - 1)).astype(np.uint64)
        x, y, z = (_spread(axis) for axis in cells.T)
        np.copyto(keys[rows], x | (y << np.uint64(1)) | (z << np.uint64(2)), where=finite[rows])

    # Blocks stay in the cache, and threads share them.
    each(fill, range(0, len(means), MORTON_ROWS))
    return stable_order(keys)


def stable_order(keys: np.ndarray) -> Ids:
    """np.argsort(keys, kind="stable") of [N] uint64 keys that hardly ever agree in their upper bits, in half its
    time."""
    # The place in the lower bits makes every number another one: they are sorted as they are, without a second array.
    low_bits = np.uint64((1 << max(len(keys) - 1, 0).bit_length()) - 1)
    numbers = keys & ~low_bits
    numbers |= np.arange(len(keys), dtype=np.uint64)
    numbers.sort()
    order = (numbers & low_bits).astype(np.int64)
    # Keys that differ in those lower bits alone stand in their own order as yet: they are sorted among themselves, and
    # stay where they stand as a group, as the upper bits of other groups are others.
    numbers &= ~low_bits
    tied = np.flatnonzero(numbers[1:] == numbers[:-1])
    if len(tied):
        standing = np.union1d(tied, tied + 1)
        rows = order[standing]
        order[standing] = rows[np.argsort(keys[rows], kind="stable")]
    return order


def _spread(values: np.ndarray) -> np.ndarray:
    """Two zero bits between the bits of 21-bit numbers, by halving the gaps (five doublings)."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values
