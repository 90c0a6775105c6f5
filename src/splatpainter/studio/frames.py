"""Rows on the wire: the binary frames of snapshots, deltas and previews. Knows no session.

Little endian. Header, eight u32: magic, format, flags, version_from, version_to, rows_total, count, K.
Then, one array after the other:
  indices   u32[count]           absent in a snapshot, whose rows are 0 .. count - 1
  means     f32[count][3]        }
  scales    f32[count][3]        } absent with COLORS_ONLY; scales are linear
  quats     f32[count][4]        } w, x, y, z, unit length
  opacities f32[count]           0..1
  sh        f32[count][K][3]     coefficient after coefficient, red green blue; colour = 0.5 + sum_k Y_k sh_k
A delta turns version_from into version_to; rows_total is the number of rows afterwards (it may shrink after an undo:
rows from there on no longer exist). A preview changes no version: its rows are shown until the next frame names them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from splatpainter.splats import SH_COUNTS, Splats

MAGIC = 0x53504C44
FORMAT = 1
SNAPSHOT = 1
"""All rows; forget what was there."""
PREVIEW = 2
"""Not part of the asset: version_from = version_to = the version that is previewed on (or put back)."""
COLORS_ONLY = 4
"""Only indices, opacities and sh travel."""
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
    """[C] rows; with COLORS_ONLY the geometry is empty arrays of shape [C, 0]."""


def snapshot(splats: Splats, version: int) -> bytes:
    """All rows."""
    return pack(splats, None, len(splats), version, version)


def delta(splats: Splats, rows: np.ndarray, version_from: int, version_to: int) -> bytes:
    """The given rows ([C] ascending) of the whole asset `splats`, which is at version_to."""
    return pack(splats.take(rows), rows, len(splats), version_from, version_to)


def preview(some: Splats, rows: np.ndarray, total: int, version: int) -> bytes:
    """Colours and opacities to show for given rows ([C] ascending; `some` has C rows) of an asset of `total` rows."""
    return pack(some, rows, total, version, version, PREVIEW | COLORS_ONLY)


def pack(
    some: Splats, rows: np.ndarray | None, total: int, version_from: int, version_to: int, flags: int = 0
) -> bytes:
    """A frame of the C rows of `some`, which are `rows` of an asset of `total` rows (None: all of it, a snapshot).

    Values that the screen cannot show (NaN, infinite) travel as rows of opacity 0."""
    flags |= SNAPSHOT * (rows is None)
    shown = some.finite
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


def _bytes(values: np.ndarray, shown: np.ndarray) -> bytes:
    if not shown.all():
        values = np.where(shown.reshape(-1, *[1] * (values.ndim - 1)), values, 0)
    return np.ascontiguousarray(values, "<f4").tobytes()
