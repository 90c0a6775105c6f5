"""Decompression that a hostile file cannot turn into a memory hole: every size is judged before it is allocated."""

from __future__ import annotations

import zlib
from pathlib import Path

ROOM = 16 << 20
"""Bytes that any file may unpack to, however small it is (a synthetic asset of equal rows packs very well)."""
RATIO = 64
"""Beyond ROOM, unpacked bytes per packed byte. Real splat files pack 1.2 to 5 times; gzip's own limit is 1032."""
TAIL = 16 << 20
"""Bytes that may follow the rows (extensions, notes of other programs)."""


def allow(packed: int, unpacked: int, where: Path | str, what: str) -> None:
    """Raise ValueError where `packed` bytes cannot honestly hold `unpacked` bytes."""
    if unpacked > ROOM + RATIO * packed:
        raise ValueError(
            f"{where}: {what} claims {unpacked} bytes from {packed} packed ones; the file is damaged or hostile"
        )


class Gunzip:
    """A gzip member read in pieces of known size."""

    def __init__(self, data: bytes, where: Path | str):
        self._data, self._where = data, where
        self._left: bytes | memoryview = data
        self._stream = zlib.decompressobj(31)

    def take(self, count: int, what: str) -> bytes:
        """The next `count` bytes. Raises ValueError: damaged, truncated, or more than the file can honestly hold."""
        allow(len(self._data), count, self._where, what)
        piece = self._upto(count)
        if len(piece) < count:
            raise ValueError(
                f"{self._where}: truncated: {what} needs {count} bytes, the gzip stream holds {len(piece)}"
            )
        return piece

    def rest(self) -> tuple[bytes, bytes]:
        """What follows inside the gzip member, and what follows the member in the file."""
        piece = self._upto(TAIL + 1)
        if len(piece) > TAIL:
            raise ValueError(f"{self._where}: more than {TAIL} bytes follow the rows; the file is damaged or hostile")
        if not self._stream.eof:
            raise ValueError(f"{self._where}: truncated: the gzip stream does not end")
        return piece, self._stream.unused_data

    def _upto(self, count: int) -> bytes:
        pieces, have = [], 0
        try:
            while have < count and not self._stream.eof:
                piece = self._stream.decompress(self._left, count - have)  # all input at once: b"" means no more
                if not piece:
                    break
                self._left = self._stream.unconsumed_tail
                have += len(piece)
                pieces.append(piece)
        except zlib.error as error:
            raise ValueError(f"{self._where}: damaged gzip stream ({error})") from None
        return b"".join(pieces)


def unzstd(data: bytes | memoryview, size: int, where: Path | str, what: str) -> bytes:
    """One zstd frame of exactly `size` unpacked bytes. Raises ValueError: damaged, other size, dishonest size."""
    import zstandard

    allow(len(data), size, where, what)
    try:
        declared = zstandard.frame_content_size(bytes(data[:18]))
        if declared not in (-1, size):
            raise ValueError(f"{where}: {what} should unpack to {size} bytes, its zstd frame says {declared}")
        if size == 0:
            return b""
        out = zstandard.ZstdDecompressor().decompress(bytes(data), max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise ValueError(f"{where}: damaged zstd stream: {what} ({error})") from None
    if len(out) != size:
        raise ValueError(f"{where}: {what} should unpack to {size} bytes, got {len(out)}")
    return out
