"""zstd frames, by the module that Python has since 3.14, or its backport, which is a fiftieth of other packages' size.

Knows no format. What a frame claims to hold is looked at before it is unpacked.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

if sys.version_info >= (3, 14):
    from compression import zstd as codec
else:
    from backports import zstd as codec

ZstdError = codec.ZstdError
"""Raised for what is no sound frame."""


def pack(data: bytes, level: int, checksum: bool = False) -> bytes:
    """One frame that says its size. level: 1 (fast) to 22 (small); checksum: of the content, 4 bytes."""
    parameter = codec.CompressionParameter
    return codec.compress(data, options={parameter.compression_level: level, parameter.checksum_flag: int(checksum)})


def declared_size(frame: bytes | memoryview) -> int | None:
    """Bytes that a frame says it holds; None where it does not say. Raises ZstdError: no frame."""
    return codec.get_frame_info(frame).decompressed_size


def unpack(frame: bytes | memoryview, most: int) -> bytes:
    """The content of one frame. Raises ZstdError: damaged, cut off, with bytes behind it, or of more than `most`
    bytes, of which no more than `most` and one are ever held."""
    decompressor = codec.ZstdDecompressor()
    out = decompressor.decompress(frame, max_length=most + 1)
    if len(out) > most:
        raise ZstdError(f"holds more than {most} bytes")
    if not decompressor.eof:
        raise ZstdError("cut off")
    if decompressor.unused_data:
        raise ZstdError(f"{len(decompressor.unused_data)} bytes behind the frame")
    return out


def pieces(frame: bytes | memoryview, size: int) -> Iterator[bytes]:
    """The content of one frame, at most `size` bytes at a time. Raises ZstdError: damaged."""
    decompressor = codec.ZstdDecompressor()
    piece = decompressor.decompress(frame, max_length=size)
    while piece:
        yield piece
        piece = b"" if decompressor.eof else decompressor.decompress(b"", max_length=size)
