"""The rows of a PLY file, packed records or lines of text: both offer the same verbs (columns, doubles, stored, block,
relayout, len), so that ply.py need not know which it holds.

N rows, P properties. Knows nothing of Gaussians.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.io.files import printable
from splatpainter.kernels.arrays import aligned
from splatpainter.system.quick_dataclass import dataclass

TEXT_PIECE_BYTES = 1 << 20
"""Bytes of text that are searched for line ends at a time."""
MAX_BLOCK_WORDS = 1 << 18
"""Words of text that are objects at a time; each takes fifty bytes."""
MAX_NUMBER_CHARACTERS = 512
"""Most characters of a number in text; the longest that C prints of a double has 330."""
_IS_BLANK = np.isin(np.arange(256), np.frombuffer(b" \t\n\r\v\f", np.uint8))
BLOCK_ROWS = 4096
"""Rows handled at a time: a block of wide rows (248 bytes at SH degree 3) stays in the cache while it is split."""


class Block(Protocol):
    """Some rows on their way into a file: they begin as copies, values are put into them, bytes come out."""

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        """Set property `name` of `rows` ([K] ids) to `values` ([K] floats)."""
        ...

    def put_floats(self, names: Sequence[str], values: np.ndarray, before: np.ndarray, rows: np.ndarray) -> bool:
        """Set properties to values ([M, K] float32) where they differ in any bit from the rows ([M], -1: none) of
        `before` ([N, K] float32). False, and nothing is done, where not all properties of a row are float32."""
        ...

    def stored(self) -> memoryview: ...


class Rows(Protocol):
    """The rows of one file."""

    def __len__(self) -> int: ...

    def columns(self, plan: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
        """Key -> [N, number of its properties] float32 values; float32 properties keep every bit, NaN payloads too."""
        ...

    def doubles(self, names: Sequence[str]) -> Floats:
        """[N, number of names] float64 values of properties."""
        ...

    def stored(self) -> memoryview:
        """The bytes of all rows, as they stand."""
        ...

    def block(self, rows: np.ndarray | slice) -> Block:
        """Copies of the given rows ([M] int64, -1 for a row of zeros; or some that follow each other), in that
        order."""
        ...

    def relayout(self, layout: Sequence[tuple[str, str, str | None]]) -> Rows:
        """The same rows with other properties: (name, numpy type code, old name or None for zero) each."""
        ...


@dataclass(frozen=True)
class BinaryRows:
    """Packed records."""

    records: np.ndarray
    """[N] structured."""
    order: str
    """Byte order, "<" or ">"."""

    def __len__(self) -> int:
        return len(self.records)

    def floats(self) -> Floats | None:
        """[N, P] float32 view of rows that hold nothing else in this machine's byte order; None for others."""
        return _as_floats(self.records)

    def column_numbers(self, names: Sequence[str]) -> Ids:
        """[K] int64 columns of properties, counted from 0."""
        return _column_numbers(self.records, names)

    def columns(self, plan: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
        return {key: self._columns(names) for key, names in plan.items()}

    def _columns(self, names: Sequence[str]) -> np.ndarray:
        out = np.empty((len(self), len(names)), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become inf, as they should
            for start in range(0, len(self), BLOCK_ROWS):
                part = self.records[start : start + BLOCK_ROWS]
                for k, name in enumerate(names):
                    out[start : start + BLOCK_ROWS, k] = part[name]
        return out

    def doubles(self, names: Sequence[str]) -> np.ndarray:
        out = np.empty((len(self), len(names)), np.float64)
        for k, name in enumerate(names):
            out[:, k] = self.records[name]
        return out

    def stored(self) -> memoryview:
        return self.records.view(np.uint8).data

    def block(self, rows: np.ndarray | slice) -> BinaryBlock:
        if isinstance(rows, slice):
            return BinaryBlock(self.records[rows], is_copy=False)
        copies = np.zeros(len(rows), self.records.dtype)
        copied, width = rows >= 0, self.records.dtype.itemsize
        if width and copied.any():
            # As bytes: thirty times faster than records of many fields.
            stored, taken = (values.view(np.uint8).reshape(-1, width) for values in (self.records, copies))
            if copied.all():
                np.take(stored, rows, axis=0, out=taken, mode="clip")
            else:
                taken[copied] = np.take(stored, rows[copied], axis=0)
        return BinaryBlock(copies)

    def relayout(self, layout: Sequence[tuple[str, str, str | None]]) -> BinaryRows:
        records = np.zeros(len(self), np.dtype([(name, self.order + code) for name, code, _ in layout]))
        with np.errstate(over="ignore", invalid="ignore"):
            for name, _, old in layout:
                if old is not None:
                    records[name] = self.records[old]
        return BinaryRows(records, self.order)


@dataclass
class BinaryBlock:
    records: np.ndarray
    is_copy: bool = True
    """False: these are the records of the file itself, which are copied before anything is put into them."""

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        column = self._writable()[name]
        column[rows] = as_type(values, column.dtype)

    def put_floats(self, names: Sequence[str], values: np.ndarray, before: np.ndarray, rows: np.ndarray) -> bool:
        if _as_floats(self.records) is None:
            return False
        from splatpainter.kernels.rows import put

        matrix = _as_floats(self._writable())
        assert matrix is not None
        put(matrix, _column_numbers(self.records, names), values, before, rows)
        return True

    def stored(self) -> memoryview:
        return self.records.view(np.uint8).data

    def _writable(self) -> np.ndarray:
        if not self.is_copy:
            # As bytes, too: numpy copies records field by field. In memory of the block before the last one.
            stored = self.records.view(np.uint8)
            copy = aligned(stored.shape, stored.dtype)
            copy[:] = stored
            self.records, self.is_copy = copy.view(self.records.dtype), True
        return self.records


def as_slice(rows: np.ndarray) -> slice | None:
    """Rows ([M] int64, -1 for none) as a slice; None where they are not one behind the other."""
    first = int(rows[0]) if len(rows) else 0
    if first < 0 or not (rows[1:] - rows[:-1] == 1).all():
        return None
    return slice(first, first + len(rows))


@functools.lru_cache(maxsize=4)
def _numbered(layout: np.dtype) -> Mapping[str, int]:
    """Column of each property of a record, counted from 0."""
    return {name: k for k, name in enumerate(layout.names or ())}


def _column_numbers(records: np.ndarray, names: Sequence[str]) -> Ids:
    """[K] int64 columns of properties."""
    columns = _numbered(records.dtype)
    return np.array([columns[name] for name in names], np.int64)


@functools.lru_cache(maxsize=4)
def _is_of_floats(layout: np.dtype) -> bool:
    """Whether records hold float32 of this machine's byte order and nothing else."""
    fields = layout.names or ()
    return bool(fields) and all(layout[name] == np.float32 for name in fields)


def _as_floats(records: np.ndarray) -> Floats | None:
    """[N, P] float32 view of such records; None for others."""
    if not _is_of_floats(records.dtype):
        return None
    return records.view(np.float32).reshape(len(records), len(_numbered(records.dtype)))


@dataclass(frozen=True)
class TextRows:
    """Lines of numbers, one line a row."""

    data: bytes
    starts: Ids
    """[N + 1] int64: row i is data[starts[i]:starts[i + 1]], line ending included."""
    properties: tuple[tuple[str, str], ...]
    """(name, numpy type code) in the order of a line."""
    newline: bytes
    where: str
    """File name for errors."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    def line(self, row: int) -> bytes:
        return self.data[self.starts[row] : self.starts[row + 1]]

    def columns(self, plan: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
        return self._columns(plan, np.float32)

    def doubles(self, names: Sequence[str]) -> np.ndarray:
        return self._columns({"": names}, np.float64)[""]

    def _columns(self, plan: Mapping[str, Sequence[str]], dtype: type) -> dict[str, np.ndarray]:
        index = {name: k for k, (name, _) in enumerate(self.properties)}
        picks = {key: [index[name] for name in names] for key, names in plan.items()}
        out = {key: np.empty((len(self), len(names)), dtype) for key, names in plan.items()}
        with np.errstate(over="ignore", invalid="ignore"):
            step = max(1, min(BLOCK_ROWS, MAX_BLOCK_WORDS // max(1, len(self.properties))))
            for start in range(0, len(self), step):
                stop = min(start + step, len(self))
                numbers = self._numbers(start, stop)
                for key, values in out.items():
                    values[start:stop] = numbers[:, picks[key]]
        return out

    def _numbers(self, start: int, stop: int) -> Floats:
        """[stop - start, P] float64. Words are counted and measured before they become objects."""
        text = self.data[self.starts[start] : self.starts[stop]]
        # Whether a byte separates words; one more ahead, so that a word may begin at once.
        blank = np.concatenate([[True], _IS_BLANK[np.frombuffer(text, np.uint8)]])
        begins = ~blank[1:] & blank[:-1]
        counts = np.add.reduceat(begins, self.starts[start:stop] - self.starts[start], dtype=np.int64)
        wrong = np.flatnonzero(counts != len(self.properties))
        if len(wrong):
            raise ValueError(
                f"{self.where}: row {start + wrong[0]} of element 'vertex': expected {len(self.properties)} values, "
                f"found {counts[wrong[0]]}"
            )
        longest = int(np.diff(np.flatnonzero(blank), append=len(blank)).max(initial=0)) - 1
        words = text.split()
        try:
            if longest > MAX_NUMBER_CHARACTERS:
                raise ValueError
            return np.array(words, np.float64).reshape(stop - start, len(self.properties))
        except ValueError:
            for k, word in enumerate(words):
                if len(word) > MAX_NUMBER_CHARACTERS or not _is_number(word):
                    row, excerpt = start + k // len(self.properties), printable(word[:40].decode("latin-1"))
                    raise ValueError(f"{self.where}: row {row}: expected a number, got {excerpt!r}") from None
            raise

    def stored(self) -> memoryview:
        return memoryview(self.data)[self.starts[0] : self.starts[-1]]

    def block(self, rows: np.ndarray | slice) -> TextBlock:
        rows = np.arange(len(self))[rows] if isinstance(rows, slice) else rows
        zero = b" ".join([b"0"] * len(self.properties)) + self.newline
        lines = [zero if row < 0 else self.line(row) for row in rows]
        return TextBlock(lines, self.properties, self.newline)

    def relayout(self, layout: Sequence[tuple[str, str, str | None]]) -> TextRows:
        index = {name: k for k, (name, _) in enumerate(self.properties)}
        picks = [None if old is None else index[old] for _, _, old in layout]
        lines = []
        for row in range(len(self)):
            words = self.line(row).split()
            lines.append(b" ".join(b"0" if k is None else words[k] for k in picks) + self.newline)
        starts = np.cumsum([0, *map(len, lines)], dtype=np.int64)
        return TextRows(b"".join(lines), starts, tuple((n, c) for n, c, _ in layout), self.newline, self.where)


@dataclass(frozen=True)
class TextBlock:
    lines: list[bytes]
    properties: tuple[tuple[str, str], ...]
    newline: bytes

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        column = next(k for k, (n, _) in enumerate(self.properties) if n == name)
        code = np.dtype(self.properties[column][1])
        for row, value in zip(rows, as_type(values, code), strict=True):
            # Separators are kept: only the one word changes.
            words = re.split(rb"(\s+)", self.lines[row])
            words[2 * column + (2 if words[0] == b"" else 0)] = str(value).encode()
            self.lines[row] = b"".join(words)

    def put_floats(self, names: Sequence[str], values: np.ndarray, before: np.ndarray, rows: np.ndarray) -> bool:
        return False

    def stored(self) -> memoryview:
        return memoryview(b"".join(self.lines))


def text_rows(
    data: bytes, skip: int, count: int, properties: Iterable[tuple[str, str]], newline: bytes, path: Path
) -> TextRows:
    """Rows of a text body: `skip` lines of earlier elements, then `count` lines, every one with a line ending. Empty
    lines ahead of all are stepped over, as other readers do.

    Raises ValueError when lines are missing, before anything is allocated for them.
    """
    columns = tuple(properties)
    short = ValueError(
        f"{path}: truncated: {skip + count} lines of data expected for element 'vertex' and those before it, of "
        f"{len(columns)} values each for 'vertex'; the file has fewer"
    )
    # A line of the shortest numbers has as many separators as digits, its end among them.
    if skip > len(data) or count * 2 * max(len(columns), 1) > len(data):
        raise short
    last = newline[-1]
    empty = re.match(rb"[\r\n]*(?=[^\r\n])", data)
    start = _behind_lines(data, empty.end() if empty else 0, skip, last)
    if start is None:
        raise short
    starts = np.empty(count + 1, np.int64)
    starts[0], count_so_far = start, 1
    for offset in range(start, len(data), TEXT_PIECE_BYTES):
        if count_so_far > count:
            break
        piece = np.frombuffer(data, np.uint8, min(TEXT_PIECE_BYTES, len(data) - offset), offset)
        ends = np.flatnonzero(piece == last)[: count + 1 - count_so_far] + (offset + 1)
        starts[count_so_far : count_so_far + len(ends)] = ends
        count_so_far += len(ends)
    if count_so_far <= count:
        raise short
    return TextRows(data, starts, columns, newline, str(path))


def _behind_lines(data: bytes, begin: int, count: int, last: int) -> int | None:
    """Offset behind the first `count` lines from `begin` on, None where there are fewer. last: byte that ends one."""
    for offset in range(begin, len(data), TEXT_PIECE_BYTES):
        if not count:
            return offset
        piece = np.frombuffer(data, np.uint8, min(TEXT_PIECE_BYTES, len(data) - offset), offset) == last
        lines = int(np.count_nonzero(piece))
        if lines >= count:
            return offset + int(np.flatnonzero(piece)[count - 1]) + 1
        count -= lines
    return None if count else len(data)


def as_type(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Float values as a property's type: integers are rounded and clamped to their range (NaN becomes 0)."""
    if dtype.kind == "f":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(np.nan_to_num(values.astype(np.float64))), limits.min, limits.max).astype(dtype)


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
