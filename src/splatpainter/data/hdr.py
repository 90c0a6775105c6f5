"""Radiance .hdr pictures (RGBE, Ward 1991): flat, old and new run lengths. Reading only.

Layout: text lines up to an empty one, a size line "-Y h +X w", then per pixel four bytes r, g, b, e (value = byte *
2^(e - 136)), each row either plain, with (1, 1, 1, n) repeats, or as 2, 2, w >> 8, w & 255 and four planes of runs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatpainter.io import files

LARGEST = 1 << 27
"""Pixels; a larger size line is a fault of the file."""


def read_hdr(path: str | Path) -> np.ndarray:
    """[h, w, 3] float32 linear radiance, first row on top. Raises ValueError, one line that names the file."""
    path = Path(path)
    return decode_hdr(files.read_all(path), str(path))


def decode_hdr(data: bytes, where: str = "hdr") -> np.ndarray:
    """The bytes of a .hdr file -> [h, w, 3] float32. Raises ValueError naming `where`."""
    height, width, flip_rows, flip_columns, start = _header(data, where)
    body = np.frombuffer(data, np.uint8, offset=start)
    rgbe = np.empty((height, width, 4), np.uint8)
    place = 0
    for row in range(height):
        place = _scanline(body, place, rgbe[row], f"{where}: row {row} of {height}")
    if flip_rows:
        rgbe = rgbe[::-1]
    if flip_columns:
        rgbe = rgbe[:, ::-1]
    scale = np.ldexp(np.float32(1), rgbe[..., 3].astype(np.int32) - 136)
    scale[rgbe[..., 3] == 0] = 0
    return rgbe[..., :3].astype(np.float32) * scale[..., None]


def _header(data: bytes, where: str) -> tuple[int, int, bool, bool, int]:
    """(height, width, rows run upwards, columns run leftwards, first byte of the pixels)."""
    end = data.find(b"\n\n", 0, 1 << 16)
    if data[:2] != b"#?" or end < 0:
        raise ValueError(f"{where}: is not a Radiance .hdr picture (expected '#?RADIANCE' and a header)")
    for line in data[:end].split(b"\n"):
        if line.startswith(b"FORMAT=") and line.strip() != b"FORMAT=32-bit_rle_rgbe":
            raise ValueError(f"{where}: expected FORMAT=32-bit_rle_rgbe, got {line.decode('latin-1').strip()}")
    stop = data.find(b"\n", end + 2, end + 200)
    words = data[end + 2 : max(stop, end + 2)].split()
    sound = len(words) == 4 and words[0] in (b"-Y", b"+Y") and words[2] in (b"+X", b"-X")
    if not sound or not (words[1].isdigit() and words[3].isdigit()):
        raise ValueError(f"{where}: expected a size line like '-Y 256 +X 512', got {data[end + 2 : end + 40]!r}")
    height, width = int(words[1]), int(words[3])
    if not 0 < height * width <= LARGEST:
        raise ValueError(f"{where}: expected 1 to {LARGEST:,} pixels, the size line says {width} x {height}")
    return height, width, words[0] == b"+Y", words[2] == b"-X", stop + 1


def _scanline(body: np.ndarray, place: int, out: np.ndarray, where: str) -> int:
    """Decodes one row into out [w, 4] and returns where the next one starts."""
    width = len(out)
    head = body[place : place + 4]
    if len(head) < 4:
        raise ValueError(f"{where}: the file ends too early")
    if 8 <= width < 32768 and head[0] == 2 and head[1] == 2 and head[2] < 128:
        if int(head[2]) << 8 | int(head[3]) != width:
            raise ValueError(
                f"{where}: expected a run-length row of {width} pixels, got {int(head[2]) << 8 | int(head[3])}"
            )
        return _planes(body, place + 4, out, where)
    return _flat(body, place, out, where)


def _planes(body: np.ndarray, place: int, out: np.ndarray, where: str) -> int:
    width = len(out)
    for channel in range(4):
        filled = 0
        while filled < width:
            if place + 1 >= len(body):
                raise ValueError(f"{where}: the file ends too early")
            count = int(body[place])
            if count > 128:  # a run of one value
                count -= 128
                values, place = body[place + 1 : place + 2], place + 2
            else:
                values, place = body[place + 1 : place + 1 + count], place + 1 + count
                if len(values) < count:
                    raise ValueError(f"{where}: the file ends too early")
            if count == 0 or filled + count > width:
                raise ValueError(f"{where}: a run of {count} pixels does not fit the row")
            out[filled : filled + count, channel] = values
            filled += count
    return place


def _flat(body: np.ndarray, place: int, out: np.ndarray, where: str) -> int:
    """Plain pixels, among them (1, 1, 1, n): the pixel before again n times (n counts on in base 256)."""
    width = len(out)
    plain = body[place : place + 4 * width].reshape(-1, 4) if place + 4 * width <= len(body) else None
    if plain is not None and not (plain[:, :3] == 1).all(1).any():
        out[:] = plain
        return place + 4 * width
    filled, shift = 0, 0
    while filled < width:
        pixel = body[place : place + 4]
        if len(pixel) < 4:
            raise ValueError(f"{where}: the file ends too early")
        place += 4
        if (pixel[:3] == 1).all():
            count = int(pixel[3]) << shift
            if filled == 0 or shift > 24 or filled + count > width:
                raise ValueError(f"{where}: a repeat of {count} pixels does not fit the row")
            out[filled : filled + count] = out[filled - 1]
            filled, shift = filled + count, shift + 8
        else:
            out[filled] = pixel
            filled, shift = filled + 1, 0
    return place
