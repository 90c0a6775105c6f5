"""Sparse differences of assets: the rows that changed and the rows that came, as values and as bytes. Pure.

T changed rows, A appended rows, N rows below, K SH coefficients.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from splatpainter.receipts import changed_rows
from splatpainter.splats import ATTRIBUTES, SH_COUNTS, Splats

PART = 1 << 20
"""Bytes before compression of one part of a stored delta: what reading or writing one holds in memory at a time."""
MOST_ROWS = 1 << 27
"""Rows of an asset that a delta may speak of."""
UNPACKED_FREE_BYTES = 512 << 20
"""Bytes that any delta may unpack to, ..."""
UNPACKED_RATIO = 100
"""... or so many for each packed byte that was read. Numbers of rows (8 bytes each) pack 1000 times, and the floats of
real rows 1.1 to 5 times."""


@dataclass(frozen=True)
class Delta:
    """What has to be done to N rows."""

    count: int
    """N."""
    rows: np.ndarray = field(repr=False)
    """[T] int64 ascending: rows whose values change."""
    values: Splats = field(repr=False)
    """T rows: their new values."""
    appended: Splats = field(repr=False)
    """A rows, which become rows N, N + 1, ..."""
    parents: np.ndarray = field(repr=False)
    """[A] int64 the row below that each appended row was made from, -1: none."""

    def apply(self, below: Splats) -> Splats:
        """The rows after. Arrays in which no bit changes are shared with `below`."""
        assert len(below) == self.count, f"delta of {self.count} rows on {len(below)}"
        written = {}
        for name in ATTRIBUTES:
            old, new = getattr(below, name), getattr(self.values, name)
            if np.array_equal(_bits(old[self.rows]), _bits(new)):
                continue
            written[name] = old.copy()
            written[name][self.rows] = new
        result = replace(below, **written) if written else below
        if not len(self.appended):
            return result
        tail = replace(self.appended, source=below.source, origin=self.origins(below))
        return result.append(tail)

    def origins(self, below: Splats) -> np.ndarray | None:
        """[A] int64 the source row that each appended row comes from, by way of its parent."""
        if below.origin is None:
            return None
        return np.where(self.parents >= 0, below.origin[np.maximum(self.parents, 0)], -1)


def between(before: Splats, after: Splats, parents: np.ndarray | None = None) -> Delta:
    """The delta that makes `after` of `before`. parents: [A], default none."""
    n = len(before)
    rows = changed_rows(before, after)
    tail = np.arange(n, len(after))
    known = np.full(len(tail), -1, np.int64) if parents is None else parents.astype(np.int64)
    return Delta(n, rows, bare(after.take(rows)), bare(after.take(tail)), known)


def bare(splats: Splats) -> Splats:
    """The rows without the file they came from."""
    return replace(splats, source=None, origin=None)


def no_delta(below: Splats) -> Delta:
    """Changes nothing."""
    none = np.zeros(0, np.int64)
    return Delta(len(below), none, bare(below.take(none)), bare(below.take(none)), none)


def encode(delta: Delta) -> Iterator[bytes]:
    """Parts of zstd with checksums, made one at a time: a JSON head, then rows, parents and the attributes of the
    changed and of the appended rows, little-endian float32, one after the other."""
    import zstandard

    pack = zstandard.ZstdCompressor(level=3, write_checksum=True).compress
    head = {"count": delta.count, "rows": len(delta.rows), "appended": len(delta.appended)}
    head["coefficients"] = int(delta.values.sh.shape[1])
    yield pack(json.dumps({"version": 1, **head}).encode())
    steps = np.diff(delta.rows, prepend=0)  # small numbers, most of them 1
    for column in (steps, delta.parents, *_columns(delta.values), *_columns(delta.appended)):
        data = np.ascontiguousarray(column).reshape(-1).view(np.uint8)
        for start in range(0, max(len(data), 1), PART):
            yield pack(data[start : start + PART].tobytes())


def decode(parts: Iterable[bytes], where: str = "delta") -> Delta:
    """The inverse of `encode`. Raises ValueError naming `where` for anything that `encode` does not write."""
    import zstandard

    decompress = zstandard.ZstdDecompressor().decompress
    source = iter(parts)
    packed = unpacked = 0

    def unpack(part: bytes) -> bytes:
        nonlocal packed, unpacked
        # A frame that says its size is given that much memory, whatever max_output_size is.
        size = zstandard.frame_content_size(part)
        if not 0 <= size <= PART:
            raise ValueError("a part is too large")
        packed, unpacked = packed + len(part), unpacked + size
        if unpacked > max(UNPACKED_FREE_BYTES, UNPACKED_RATIO * packed):
            raise ValueError(f"{packed} bytes unpack to more than {unpacked >> 20} MiB")
        return decompress(part, max_output_size=PART)

    def column(count: int, dtype: str) -> np.ndarray:
        size = count * np.dtype(dtype).itemsize
        pieces, got = [], 0
        while got < size or not pieces:
            piece = unpack(next(source))
            pieces.append(piece)
            got += len(piece)
            if len(piece) < PART and got < size:
                raise ValueError("a part is too short")
        if got != size:
            raise ValueError(f"expected {size} bytes, got {got}")
        return np.frombuffer(b"".join(pieces), dtype)

    try:
        head = json.loads(unpack(next(source)))
        if head["version"] != 1 or head["coefficients"] not in SH_COUNTS:
            raise ValueError(f"unknown layout {head}")
        n, t, a, k = (int(head[name]) for name in ("count", "rows", "appended", "coefficients"))
        if not (0 <= t <= n <= MOST_ROWS and 0 <= a <= MOST_ROWS):
            raise ValueError(f"impossible numbers of rows {head}")
        rows = column(t, "<i8").cumsum()
        parents = column(a, "<i8").copy()
        if t and not (rows[0] >= 0 and rows[-1] < n and (np.diff(rows) > 0).all()):
            raise ValueError("rows are not ascending")
        if a and not (parents.min() >= -1 and parents.max() < n):
            raise ValueError("parents are out of range")
        values, appended = _rows(column, t, k), _rows(column, a, k)
        if next(source, None) is not None:
            raise ValueError("more parts than expected")
        return Delta(n, rows, values, appended, parents)
    except StopIteration:
        raise ValueError(f"{where}: damaged (parts are missing)") from None
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError, zstandard.ZstdError) as error:
        raise ValueError(f"{where}: damaged ({error})") from None


def _columns(splats: Splats) -> Iterator[np.ndarray]:
    for name in ATTRIBUTES:
        yield np.asarray(getattr(splats, name), "<f4")


def _rows(column, count: int, k: int) -> Splats:
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (k, 3)}
    arrays = {}
    for name in ATTRIBUTES:
        size = int(np.prod(shapes[name], dtype=np.int64))
        arrays[name] = column(count * size, "<f4").reshape(count, *shapes[name]).copy()
    return Splats(**arrays)


def _bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32).view(np.uint32)
