"""Rows on the wire: the binary frames of snapshots, deltas and previews. Knows no session.

Little endian. Header, eight u32: magic, format, flags, version_from, version_to, rows_total, count, K.
Then, one array after the other:
  indices   u32[count]           absent in a snapshot, whose rows are 0 .. count - 1
  means     f32[count][3]        }
  scales    f32[count][3]        } absent with COLORS_ONLY; scales are linear
  quats     f32[count][4]        } w, x, y, z, unit length
  opacities f32[count]           0..1
  sh        f32[count][K][3]     coefficient after coefficient, red green blue; colour = 0.5 + sum_k Y_k sh_k
or, with PACKED (texels.py), only
  indices   u32[count]           absent where count = rows_total: all rows
  base      f16[count][3]        0.5 + Y_0 sh_0, and two bytes more where that makes whole words
  codes     u32[count][K - 1]    the other coefficients; K = 1: they stay as they are
A delta turns version_from into version_to; rows_total is the number of rows afterwards (it may shrink after an undo:
rows from there on no longer exist). A preview changes no version: its rows are shown until the next frame names them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from splatpainter.server.texels import base_halves, harmonic_codes, sh_of
from splatpainter.splats import SH_COUNTS, Splats

MAGIC = 0x53504C44
FORMAT = 1
SNAPSHOT = 1
"""All rows; forget what was there."""
PREVIEW = 2
"""Not part of the asset: version_from = version_to = the version that is previewed on (or put back)."""
COLORS_ONLY = 4
"""Only indices, opacities and sh travel."""
PACKED = 8
"""Only colours travel, as the screen's textures hold them."""
HEADER = struct.Struct("<8I")


@dataclass(frozen=True)
class SplatFrame:
    """A frame taken apart, for clients in Python and for tests."""

    flags: int
    version_from: int
    version_to: int
    rows_total: int
    rows: np.ndarray
    """[C] row indices."""
    splats: Splats
    """[C] rows; with COLORS_ONLY the geometry is empty arrays of shape [C, 0], with PACKED also the opacities."""


def snapshot(splats: Splats, version: int) -> bytes:
    """All rows."""
    return pack(splats, None, len(splats), version, version)


def delta(splats: Splats, rows: np.ndarray, version_from: int, version_to: int, recolored: bool = False) -> bytes:
    """The given rows ([C] ascending) of the whole asset `splats`, which is at version_to. recolored: means, scales and
    rotations are as they were."""
    return pack(splats.take(rows), rows, len(splats), version_from, version_to, COLORS_ONLY * recolored)


def preview(some: Splats, rows: np.ndarray, total: int, version: int) -> bytes:
    """Colours and opacities to show for given rows ([C] ascending; `some` has C rows) of an asset of `total` rows."""
    return pack(some, rows, total, version, version, PREVIEW | COLORS_ONLY)


def tints(sh: np.ndarray, rows: np.ndarray, total: int, version: int) -> bytes:
    """Colours to show for given rows ([C] ascending) of an asset of `total` rows, as near as a screen shows them. sh:
    [C, K, 3], or [C, 1, 3] where only base colours change."""
    head = HEADER.pack(MAGIC, FORMAT, PREVIEW | PACKED, version, version, total, len(rows), sh.shape[1])
    index = b"" if len(rows) == total else np.asarray(rows, "<u4").tobytes()
    base = base_halves(sh).astype("<f2").tobytes()
    return b"".join([head, index, base, b"\0" * (-len(base) % 4), harmonic_codes(sh).astype("<u4").tobytes()])


def pack(
    some: Splats, rows: np.ndarray | None, total: int, version_from: int, version_to: int, flags: int = 0
) -> bytes:
    """A frame of the C rows of `some`, which are `rows` of an asset of `total` rows (None: all of it, a snapshot).

    Values that the screen cannot show (NaN, infinite) travel as rows of opacity 0."""
    flags |= SNAPSHOT * (rows is None)
    shown = some.drawable
    bands = int(some.sh.shape[1])
    parts = [HEADER.pack(MAGIC, FORMAT, flags, version_from, version_to, total, len(some), bands)]
    if rows is not None:
        parts.append(np.asarray(rows, "<u4").tobytes())
    if not flags & COLORS_ONLY:
        norm = np.linalg.norm(some.quats, axis=1, keepdims=True)
        quats = some.quats / np.where(shown[:, None] & (norm > 0), norm, 1)
        parts += [_bytes(some.means, shown), _bytes(some.scales, shown), _bytes(quats, shown)]
    parts += [_bytes(np.clip(some.opacities, 0, 1), shown), _bytes(some.sh, shown)]
    return b"".join(parts)


def unpack(data: bytes) -> SplatFrame:
    """The inverse of `pack`. Raises ValueError where the bytes are no frame."""
    if len(data) < HEADER.size:
        raise ValueError(f"frame: expected at least {HEADER.size} bytes, got {len(data)}")
    magic, form, flags, first, last, total, count, bands = HEADER.unpack_from(data)
    if magic != MAGIC or form != FORMAT or bands not in SH_COUNTS:
        raise ValueError(f"frame: expected magic {MAGIC:#x}, format {FORMAT}, got {magic:#x}, {form}, K = {bands}")
    if flags & PACKED:
        return _unpacked(data)
    snapshot, colors = bool(flags & SNAPSHOT), bool(flags & COLORS_ONLY)
    widths = [0 if snapshot else 1, *((0, 0, 0) if colors else (3, 3, 4)), 1, 3 * bands]
    wanted = HEADER.size + 4 * count * sum(widths)
    if len(data) != wanted:
        raise ValueError(f"frame: expected {wanted} bytes for {count} rows, got {len(data)}")
    ends = HEADER.size + 4 * count * np.cumsum([0, *widths])
    kinds = ["<u4", *["<f4"] * 5]
    arrays = [
        np.frombuffer(data, kind, count * width, int(start)).reshape(count, width)
        for kind, width, start in zip(kinds, widths, ends[:-1], strict=True)
    ]
    rows = np.arange(count) if snapshot else arrays[0][:, 0].astype(np.int64)
    splats = Splats(arrays[1], arrays[3], arrays[2], arrays[4][:, 0], arrays[5].reshape(count, bands, 3))
    return SplatFrame(flags, first, last, total, rows, splats)


def _unpacked(data: bytes) -> SplatFrame:
    """`unpack` of `tints`."""
    _, _, flags, first, last, total, count, bands = HEADER.unpack_from(data)
    index = 0 if count == total else 4 * count
    base = 6 * count + (-6 * count) % 4
    wanted = HEADER.size + index + base + 4 * count * (bands - 1)
    if len(data) != wanted:
        raise ValueError(f"frame: expected {wanted} bytes for {count} rows, got {len(data)}")
    at = HEADER.size + index
    rows = np.frombuffer(data, "<u4", count, HEADER.size).astype(np.int64) if index else np.arange(count)
    halves = np.frombuffer(data, "<f2", 3 * count, at).reshape(count, 3)
    codes = np.frombuffer(data, "<u4", count * (bands - 1), at + base).reshape(count, bands - 1)
    none = np.zeros((count, 0), np.float32)
    return SplatFrame(flags, first, last, total, rows, Splats(none, none, none, none, sh_of(halves, codes)))


def _bytes(values: np.ndarray, shown: np.ndarray) -> bytes:
    if not shown.all():
        values = np.where(shown.reshape(-1, *[1] * (values.ndim - 1)), values, 0)
    return np.ascontiguousarray(values, "<f4").tobytes()
