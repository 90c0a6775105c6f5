"""The vertex rows of a PLY file as they stand in it: packed binary records, or lines of text.

Both kinds offer the same four verbs (columns, block, relayout, len), so that ply.py need not know which it holds.
N rows, P properties. Knows nothing of what a property means.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from splatpainter.io.files import printable

TEXT_PIECE = 1 << 20
"""Bytes of text that are searched for line ends at a time."""
MAX_BLOCK_WORDS = 1 << 18
"""Words of text that are objects at a time; each takes fifty bytes."""
MAX_NUMBER_CHARACTERS = 512
"""Of a number in text; the longest that C prints of a double has 330."""
_IS_BLANK = np.isin(np.arange(256), np.frombuffer(b" \t\n\r\v\f", np.uint8))
BLOCK = 4096
"""Rows handled at a time: a block of wide rows (248 bytes at SH degree 3) stays in the cache while it is split."""


class Block(Protocol):
    """Some rows on their way into a file: they begin as copies, values are put into them, bytes come out."""

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        """Set property `name` of `rows` (bool mask) to `values` (float32, one for each row that is set)."""
        ...

    def tobytes(self) -> bytes: ...


class Rows(Protocol):
    """The rows of one file."""

    def __len__(self) -> int: ...

    def columns(self, plan: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
        """Key -> [N, number of its properties] float32 values; float32 properties keep every bit, NaN payloads too."""
        ...

    def stored(self) -> memoryview:
        """The bytes of all rows, as they stand."""
        ...

    def block(self, rows: np.ndarray) -> Block:
        """Copies of the given rows ([M] int64, -1 for a row of zeros), in that order."""
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

    def columns(self, plan: Mapping[str, Sequence[str]]) -> dict[str, np.ndarray]:
        return {key: self._columns(names) for key, names in plan.items()}

    def _columns(self, names: Sequence[str]) -> np.ndarray:
        out = np.empty((len(self), len(names)), np.float32)
        own = self.records.dtype.names or ()
        if all(self.records.dtype[name] == np.float32 for name in own):
            # The usual file: a matrix of floats, gathered row by row, three times faster than column by column.
            matrix, picks = self.records.view(np.float32).reshape(-1, len(own)), [own.index(name) for name in names]
            for start in range(0, len(self), BLOCK):
                part = slice(start, start + BLOCK)
                np.take(matrix[part], picks, axis=1, out=out[part], mode="clip")
            return out
        with np.errstate(over="ignore", invalid="ignore"):  # doubles beyond float32 become inf, as they should
            for start in range(0, len(self), BLOCK):
                part = self.records[start : start + BLOCK]
                for k, name in enumerate(names):
                    out[start : start + BLOCK, k] = part[name]
        return out

    def stored(self) -> memoryview:
        return self.records.view(np.uint8).data

    def block(self, rows: np.ndarray) -> BinaryBlock:
        copies = np.zeros(len(rows), self.records.dtype)
        own = rows >= 0
        copies[own] = self.records[rows[own]]
        return BinaryBlock(copies)

    def relayout(self, layout: Sequence[tuple[str, str, str | None]]) -> BinaryRows:
        records = np.zeros(len(self), np.dtype([(name, self.order + code) for name, code, _ in layout]))
        with np.errstate(over="ignore", invalid="ignore"):
            for name, _, old in layout:
                if old is not None:
                    records[name] = self.records[old]
        return BinaryRows(records, self.order)


@dataclass(frozen=True)
class BinaryBlock:
    records: np.ndarray

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        column = self.records[name]
        column[rows] = as_type(values, column.dtype)

    def tobytes(self) -> bytes:
        return self.records.tobytes()


@dataclass(frozen=True)
class TextRows:
    """Lines of numbers, one line a row."""

    data: bytes
    starts: np.ndarray
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
        place = {name: k for k, (name, _) in enumerate(self.properties)}
        picks = {key: [place[name] for name in names] for key, names in plan.items()}
        out = {key: np.empty((len(self), len(names)), np.float32) for key, names in plan.items()}
        with np.errstate(over="ignore", invalid="ignore"):
            step = max(1, min(BLOCK, MAX_BLOCK_WORDS // max(1, len(self.properties))))
            for start in range(0, len(self), step):
                stop = min(start + step, len(self))
                numbers = self._numbers(start, stop)
                for key, values in out.items():
                    values[start:stop] = numbers[:, picks[key]]
        return out

    def _numbers(self, start: int, stop: int) -> np.ndarray:
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
                    row, said = start + k // len(self.properties), printable(word[:40].decode("latin-1"))
                    raise ValueError(f"{self.where}: row {row}: expected a number, got {said!r}") from None
            raise

    def stored(self) -> memoryview:
        return memoryview(self.data)[self.starts[0] : self.starts[-1]]

    def block(self, rows: np.ndarray) -> TextBlock:
        zero = b" ".join([b"0"] * len(self.properties)) + self.newline
        lines = [zero if row < 0 else self.line(row) for row in rows]
        return TextBlock(lines, self.properties, self.newline)

    def relayout(self, layout: Sequence[tuple[str, str, str | None]]) -> TextRows:
        place = {name: k for k, (name, _) in enumerate(self.properties)}
        picks = [None if old is None else place[old] for _, _, old in layout]
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
        place = next(k for k, (n, _) in enumerate(self.properties) if n == name)
        code = np.dtype(self.properties[place][1])
        for row, value in zip(np.flatnonzero(rows), as_type(values, code), strict=True):
            # Separators are kept: only the one word changes.
            words = re.split(rb"(\s+)", self.lines[row])
            words[2 * place + (2 if words[0] == b"" else 0)] = str(value).encode()
            self.lines[row] = b"".join(words)

    def tobytes(self) -> bytes:
        return b"".join(self.lines)


def text_rows(
    data: bytes, skip: int, count: int, properties: Iterable[tuple[str, str]], newline: bytes, path: Path
) -> TextRows:
    """Rows of a text body: `skip` lines of earlier elements, then `count` lines, every one with a line ending.

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
    start = _behind_lines(data, skip)
    if start is None:
        raise short
    starts = np.empty(count + 1, np.int64)
    starts[0], have = start, 1
    for place in range(start, len(data), TEXT_PIECE):
        if have > count:
            break
        piece = np.frombuffer(data, np.uint8, min(TEXT_PIECE, len(data) - place), place)
        ends = np.flatnonzero(piece == ord("\n"))[: count + 1 - have] + (place + 1)
        starts[have : have + len(ends)] = ends
        have += len(ends)
    if have <= count:
        raise short
    return TextRows(data, starts, columns, newline, str(path))


def _behind_lines(data: bytes, count: int) -> int | None:
    """Offset behind the first `count` lines, None where there are fewer."""
    for place in range(0, len(data), TEXT_PIECE):
        if not count:
            return place
        piece = np.frombuffer(data, np.uint8, min(TEXT_PIECE, len(data) - place), place) == ord("\n")
        lines = int(np.count_nonzero(piece))
        if lines >= count:
            return place + int(np.flatnonzero(piece)[count - 1]) + 1
        count -= lines
    return None if count else len(data)


def as_type(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Float32 values as a property's type: integers are rounded and clamped to their range (NaN becomes 0)."""
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
