"""The one rule of all readers for files that lie: what is unpacked is counted while it is unpacked.

1. Only regular files are opened (files.reading), and of text (headers, JSON) only so much is parsed as a limit allows.
2. A size that a file declares is compared with the file's real size before anything is allocated for it. Data that are
   not packed have to be there (files.take). Packed data may unpack to `free_bytes` and `max_ratio` bytes more per byte
   of the file (`allow`), and rows may take `free_row_bytes` of memory and `max_row_ratio` bytes more per byte of the
   file (`allow_rows`), however little they pack to: BOUNDS has these numbers.
3. Nothing is unpacked beyond what was declared, and what is more or less than declared is refused. What unpacks to more
   than `two_pass_bytes` is unpacked twice, first without being kept, so that a damaged end costs time but no memory.
4. Work is linear in the bytes that are really there: no loop in Python over a count that only a header vouches for.

A refusal is a ValueError with one line that names the file. Table of limits and what was measured: docs/formats.md.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO

from splatpainter.io.files import printable
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class BoundThresholds:
    """What a file may unpack to. Source: ratios of real files, as each entry says; limits of memory are taste."""

    free_bytes: int = 16 << 20
    """Bytes that any file may unpack to, however small it is (a synthetic asset of equal rows packs very well)."""
    max_ratio: int = 32
    """Limit beyond free_bytes: unpacked bytes per byte of the file. Real splat files pack 1.2 to 5 times, gzip 1032 at
    most."""
    free_row_bytes: int = 64 << 20
    """Bytes that the rows of any packed file may take in memory: 1.2 million of SH degree 0, 0.28 million of degree
    3."""
    max_row_ratio: int = 96
    """Limit beyond free_row_bytes: bytes of rows in memory per byte of the file. Scans take 10 to 20; rows on a regular
    grid, all of one size and rotation, with colours of their own and empty SH bands up to degree 3, take 58."""
    max_tail_bytes: int = 16 << 20
    """Bytes that may follow the rows (extensions, notes of other programs)."""
    max_entries: int = 4096
    """Files in a zip, of which SOG needs 8; a directory of them takes ten times its bytes in memory."""
    two_pass_bytes: int = 256 << 20
    """Bytes: what unpacks to more is unpacked once for nothing but its length before memory is taken for it."""
    piece_bytes: int = 1 << 20
    """Bytes that are unpacked at a time where they are only counted."""


BOUNDS = BoundThresholds()


def allow(packed: int, unpacked: int, where: Path | str, what: str) -> None:
    """Raise ValueError where `packed` bytes cannot honestly hold `unpacked` bytes."""
    if unpacked > BOUNDS.free_bytes + BOUNDS.max_ratio * packed:
        raise ValueError(
            f"{where}: {what} claims {unpacked} bytes from {packed} packed ones; the file is damaged or hostile"
        )


def allow_rows(packed: int, rows: int, coefficients: int, where: Path | str, ratio: int = BOUNDS.max_row_ratio) -> None:
    """Raise ValueError where a file of `packed` bytes cannot honestly hold `rows` rows of so many SH coefficients."""
    needed = rows * 4 * (11 + 3 * coefficients)
    if needed > BOUNDS.free_row_bytes + ratio * packed:
        raise ValueError(
            f"{where}: {rows} rows would take {needed} bytes of memory, the file has {packed}; it is damaged or hostile"
        )


class Gunzip:
    """A gzip member read in pieces of known size."""

    def __init__(self, data: bytes, where: Path | str):
        self._data, self._where = data, where
        self._left: bytes | memoryview = data
        self._stream = zlib.decompressobj(31)

    def take(self, count: int, what: str) -> bytes:
        """The next `count` bytes, which the caller has judged. Raises ValueError: damaged or truncated."""
        if count > BOUNDS.two_pass_bytes:
            self._prove(count, what)
        piece = self._upto(count)
        if len(piece) < count:
            raise self._short(count, len(piece), what)
        return piece

    def rest(self) -> tuple[bytes, bytes]:
        """What follows inside the gzip member, and what follows the member in the file."""
        piece = self._upto(BOUNDS.max_tail_bytes + 1)
        if len(piece) > BOUNDS.max_tail_bytes:
            raise ValueError(
                f"{self._where}: more than {BOUNDS.max_tail_bytes} bytes follow the rows; "
                "the file is damaged or hostile"
            )
        if not self._stream.eof:
            raise ValueError(f"{self._where}: truncated: the gzip stream does not end")
        return piece, self._stream.unused_data

    def _short(self, count: int, available: int, what: str) -> ValueError:
        return ValueError(f"{self._where}: truncated: {what} needs {count} bytes, the gzip stream holds {available}")

    def _prove(self, count: int, what: str) -> None:
        stream, left, available = self._stream.copy(), memoryview(self._left), 0
        try:
            while available < count and not stream.eof:
                # Little input at a time: zlib copies what it did not consume.
                piece = stream.decompress(stream.unconsumed_tail or left[: BOUNDS.piece_bytes], BOUNDS.piece_bytes)
                if not stream.unconsumed_tail:
                    if not left and not piece:
                        break
                    left = left[BOUNDS.piece_bytes :]
                available += len(piece)
        except zlib.error as error:
            raise ValueError(f"{self._where}: damaged gzip stream ({error})") from None
        if available < count:
            raise self._short(count, available, what)

    def _upto(self, count: int) -> bytes:
        pieces, available = [], 0
        try:
            while available < count and not self._stream.eof:
                piece = self._stream.decompress(self._left, count - available)  # all input at once: b"" means no more
                if not piece:
                    break
                self._left = self._stream.unconsumed_tail
                available += len(piece)
                pieces.append(piece)
        except zlib.error as error:
            raise ValueError(f"{self._where}: damaged gzip stream ({error})") from None
        return b"".join(pieces)


def inflate(data: bytes | memoryview, size: int, where: Path | str, what: str) -> bytes:
    """One raw deflate stream of exactly `size` unpacked bytes. Raises ValueError: damaged, other size, more input."""
    stream = zlib.decompressobj(-15)
    try:
        out = stream.decompress(data, size + 1)  # 0 would mean: without limit
        # The last block's end mark may still be unread when the last byte is out.
        if len(out) == size and not stream.eof:
            out += stream.decompress(stream.unconsumed_tail, 1)
    except zlib.error as error:
        raise ValueError(f"{where}: damaged: {what} ({error})") from None
    if len(out) != size or not stream.eof or stream.unused_data:
        raise ValueError(f"{where}: damaged: {what} should unpack to {size} bytes, its deflate stream does not")
    return out


def zip_directory(file: BinaryIO, where: Path | str) -> list[zipfile.ZipInfo]:
    """What the directory of a zip lists. Raises ValueError: not a zip, damaged, more than BOUNDS.max_entries files."""
    marks = 0
    while piece := file.read(BOUNDS.piece_bytes):
        marks += piece.count(b"PK\x01\x02")  # ahead of every entry of a directory
        if marks > BOUNDS.max_entries:  # before zipfile makes an object of each
            raise ValueError(f"{where}: a zip of more than {BOUNDS.max_entries} files; it is damaged or hostile")
    try:
        return zipfile.ZipFile(file).infolist()
    except (zipfile.BadZipFile, struct.error, OSError, NotImplementedError, ValueError, OverflowError) as error:
        # OSError: it seeks where a lying directory sends it; struct.error: cut extra fields.
        file.seek(0)
        if str(error) == "File is not a zip file" and file.read(4) == b"PK\x03\x04":  # its directory comes last
            raise ValueError(f"{where}: damaged zip: it is cut off before its directory; get the file again") from None
        raise ValueError(f"{where}: damaged zip ({printable(' '.join(str(error).split()), 120)})") from None


def unzstd(data: bytes | memoryview, size: int, where: Path | str, what: str) -> bytes:
    """One zstd frame of exactly `size` unpacked bytes, which the caller has judged. Raises ValueError: damaged, other
    size."""
    from splatpainter.io import zstd

    try:
        declared = zstd.declared_size(data)
        if declared not in (None, size):
            raise ValueError(f"{where}: {what} should unpack to {size} bytes, its zstd frame says {declared}")
        if size == 0:
            return b""
        if size > BOUNDS.two_pass_bytes:
            _prove_zstd(data, size, where, what)
        out = zstd.unpack(data, size)
    except zstd.ZstdError as error:
        raise ValueError(f"{where}: damaged zstd stream: {what} ({error})") from None
    if len(out) != size:
        raise ValueError(f"{where}: {what} should unpack to {size} bytes, got {len(out)}")
    return out


def _prove_zstd(data: bytes | memoryview, size: int, where: Path | str, what: str) -> None:
    from splatpainter.io import zstd

    available = 0
    for piece in zstd.pieces(data, BOUNDS.piece_bytes):
        available += len(piece)
        if available > size:
            break
    if available != size:
        raise ValueError(f"{where}: {what} should unpack to {size} bytes, got {available}")
