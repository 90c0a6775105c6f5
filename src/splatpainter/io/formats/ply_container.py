"""The container of PLY: a text header, then tables ("elements") of binary records or of lines of text.

Layout of the header: "ply", "format ...", then comments, elements and their properties in any order, then "end_header";
lines end in LF, CRLF or CR, all as the first one does, and a mark of UTF-8 (BOM) may stand ahead. It is parsed line by
line, and edited without touching the lines that do not change. Rows of both kinds offer the same four verbs (columns,
block, relayout, len), so that ply.py need not know which it holds.

N rows, P properties. Knows nothing of Gaussians; ply.py and compressed_ply.py do.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.io.files import BOM, MAX_HEADER_BYTES, printable
from splatpainter.system.quick_dataclass import dataclass

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
    "int64": "i8",
    "uint64": "u8",
}
"""PLY scalar type -> numpy type code without byte order."""
WINDOW_BYTES = 1 << 20
"""Bytes of an element with lists that are looked at together."""
MIN_RUN = 16
"""Rows of equal list lengths from which on numpy is faster than a loop."""
MAX_UNEVEN_LISTS = 1 << 24
"""Lists that are stepped over one by one, because the rows around them are of other lengths: about 5 s of work."""
ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
UTF16 = (b"\xff\xfe", b"\xfe\xff")
TEXT_PIECE_BYTES = 1 << 20
"""Bytes of text that are searched for line ends at a time."""
MAX_BLOCK_WORDS = 1 << 18
"""Words of text that are objects at a time; each takes fifty bytes."""
MAX_NUMBER_CHARACTERS = 512
"""Most characters of a number in text; the longest that C prints of a double has 330."""
_IS_BLANK = np.isin(np.arange(256), np.frombuffer(b" \t\n\r\v\f", np.uint8))
BLOCK_ROWS = 4096
"""Rows handled at a time: a block of wide rows (248 bytes at SH degree 3) stays in the cache while it is split."""
PICKED_ROWS = 1 << 12
"""Rows that a thread splits into columns at a time: 1 MB at SH degree 3."""


@dataclass(frozen=True)
class Property:
    """One value (or list of values) of every row of an element."""

    name: str
    type: str
    """numpy type code without byte order, e.g. "f4"."""
    counter: str | None = None
    """Type code of a list's length; None for a single value."""


@dataclass(frozen=True)
class Element:
    """A table of the file; tables follow each other in header order."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(p.name for p in self.properties)

    @property
    def has_lists(self) -> bool:
        return any(p.counter for p in self.properties)

    def dtype(self, order: str) -> np.dtype:
        """Packed row type in byte order "<" or ">"; only for elements without lists."""
        assert not self.has_lists
        return np.dtype([(p.name, order + p.type) for p in self.properties])


@dataclass(frozen=True)
class Header:
    """A parsed header and its exact bytes."""

    lines: tuple[bytes, ...]
    """Every line with its line ending, from "ply" to "end_header"."""
    format: str
    """ascii, binary_little_endian or binary_big_endian."""
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    """Without the leading word; obj_info lines are not among them."""

    @property
    def raw(self) -> bytes:
        return b"".join(self.lines)

    @property
    def order(self) -> str:
        """numpy byte order of binary data."""
        return ORDERS[self.format]

    @property
    def newline(self) -> bytes:
        first = self.lines[0]
        return b"\r\n" if first.endswith(b"\r\n") else first[-1:]

    def element(self, name: str) -> Element | None:
        return next((e for e in self.elements if e.name == name), None)

    def with_counts(self, counts: Mapping[str, int]) -> Header:
        """Only the numbers in the given elements' lines change, and only where they differ."""
        lines = []
        for line in self.lines:
            match = re.match(rb"(\s*element\s+(\S+)\s+)(\S+)(.*)", line, re.DOTALL)
            count = counts.get(match[2].decode("latin-1")) if match else None
            if match and count is not None and int(match[3]) != count:
                line = match[1] + str(count).encode() + match[4]
            lines.append(line)
        return _parse(lines, Path("header"))

    def with_properties(
        self, element: str, drop: Sequence[str], add: Sequence[tuple[str, str]], after: str | None
    ) -> Header:
        """Without the properties `drop` of an element, and with `add` (PLY type, name) behind its property `after`
        (None: ahead of all)."""
        lines, inside = [], False
        dropped = set(drop)
        for line in self.lines:
            words = _words(line)
            if words and words[0] == "element":
                inside = words[1] == element
            if inside and words and words[0] == "property" and words[-1] in dropped:
                continue
            lines.append(line)
            anchor = (
                words[:2] == ["element", element] if after is None else words[:1] + words[-1:] == ["property", after]
            )
            if inside and anchor:
                lines += [f"property {kind} {name}".encode() + self.newline for kind, name in add]
        return _parse(lines, Path("header"))

    def with_element(self, name: str, count: int, properties: Sequence[tuple[str, str]], behind: str) -> Header:
        """Without the element `name`; where there are `properties` (PLY type, name), with it anew, behind another."""
        lines, current = [], ""
        new = [f"element {name} {count}", *(f"property {kind} {prop}" for kind, prop in properties)]
        for line in self.lines:
            words = _words(line)
            starts = bool(words) and words[0] in ("element", "end_header")
            if starts and current == behind and properties:
                lines += [text.encode() + self.newline for text in new]
            if starts:
                current = words[1] if words[0] == "element" else ""
            if current != name or (words and words[0] not in ("element", "property")):
                lines.append(line)
        return _parse(lines, Path("header"))

    def with_comment(self, text: str) -> Header:
        """The header with one more comment, last, where it overrides earlier ones of its kind."""
        line = b"comment " + text.encode() + self.newline
        return _parse([*self.lines[:-1], line, self.lines[-1]], Path("header"))


def read_header(file: BinaryIO, path: Path) -> Header:
    """Parse the header at the start of `file` and leave the file just behind it.

    Raises ValueError: not a PLY file, no end_header within 1 MiB, unknown types, counts that are not numbers.
    """
    lines: list[bytes] = []
    left = MAX_HEADER_BYTES
    begin = file.tell()
    end = b"\r" if _ends_in_cr(file.read(16)) else b"\n"
    file.seek(begin)
    raw = file.read(left) if end == b"\r" else b""
    header = io.BytesIO(raw.replace(b"\r", b"\n")) if raw else file  # of lines as readline knows them
    while left > 0:
        line = header.readline(left)
        if raw:
            line = raw[header.tell() - len(line) : header.tell()]
        left -= len(line)
        if not lines and line.removeprefix(BOM).strip() != b"ply":
            if line[:2] in UTF16:
                raise ValueError(f"{path}: is text in UTF-16; save it as ASCII or UTF-8")
            raise ValueError(f"{path}: expected a PLY file beginning with 'ply', got {line[:16]!r}")
        if not line.endswith(end):
            break
        lines.append(line)
        if line.strip() == b"end_header":
            file.seek(begin + sum(map(len, lines)))
            return _parse(lines, path)
    where = "the first 1 MiB" if left <= 0 else "the file"
    raise ValueError(f"{path}: expected a PLY header closed by 'end_header' (and a line end), found none in {where}")


def _ends_in_cr(head: bytes) -> bool:
    """Whether the lines of a header end in CR alone, as on the first Macs: so does its first one."""
    return re.match(rb"[^\r\n]*\r[^\n]", head) is not None


def make_header(format: str, comments: Sequence[str], elements: Sequence[tuple[str, int, Sequence[tuple[str, str]]]]):
    """A new header: elements are (name, count, [(PLY type, property name)])."""
    lines = ["ply", f"format {format} 1.0", *(f"comment {c}" for c in comments)]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {kind} {prop}" for kind, prop in properties)]
    return _parse([line.encode() + b"\n" for line in [*lines, "end_header"]], Path("header"))


def element_size(file: BinaryIO, header: Header, element: Element, available: int, path: Path) -> int:
    """Bytes that a binary element takes from the current place of `file`, which is left anywhere.

    available: bytes left in the file. Raises ValueError when the element claims more; nothing large is allocated.
    """
    if not element.has_lists:
        size = element.count * (element.dtype(header.order).itemsize if element.properties else 0)
    else:
        size = _walk_lists(file, header, element, available, path)
    if size > available:
        raise ValueError(
            f"{path}: truncated: {element.count} rows of element '{printable(element.name)}' need "
            f"{'more' if element.has_lists else size} bytes, {available} are left in the file"
        )
    return size


def _walk_lists(file: BinaryIO, header: Header, element: Element, available: int, path: Path) -> int:
    """Bytes of an element with lists, or more than `available`.

    Every row has at least one list length, so a lying count runs out of bytes before it runs long. Runs of rows whose
    lists are as long as those of the row before (a mesh of triangles) are compared at once.
    """
    # Bytes between list lengths are the same in every row, so a row is stepped over list by list.
    lists, tail = _lists_of(element, header.order)
    longest = max(counter.itemsize for _, counter, _ in lists)
    steps = [(ahead, _COUNTERS[counter.str].unpack_from, counter.itemsize, width) for ahead, counter, width in lists]
    file_start = file.tell()
    window, base, last = b"", 0, -1
    at, row, stepped, patience = 0, 0, 0, MIN_RUN

    def walk(count: int) -> list[tuple[int, int]]:
        """Step over so many rows one by one; (offset, length) of every list of the last one."""
        nonlocal window, base, last, at
        seen: list[tuple[int, int]] = []
        for k in range(count):
            for ahead, unpack, counter_bytes, width in steps:
                at += ahead
                if at > last:  # no whole list length is left of the window
                    if at > available:
                        return []
                    file.seek(file_start + at)
                    window, base = file.read(min(WINDOW_BYTES, available - at)).ljust(longest, b"\0"), at
                    last = base + len(window) - longest
                (length,) = unpack(window, at - base)
                if k == count - 1:
                    seen.append((at, length))
                at += counter_bytes + width * length if length > 0 else counter_bytes
            at += tail
            if at > available:
                return []
        return seen

    # One row by steps, then as many as look like it at once.
    while row < element.count and at <= available:
        first = at
        seen = walk(1)
        row, stepped = row + 1, stepped + len(lists)
        fitting = min((base + len(window) - at) // (at - first), element.count - row, (available - at) // (at - first))
        run = 0
        if seen and first >= base and fitting >= MIN_RUN:
            equal = np.ones(fitting, bool)
            for (offset, length), (_, counter, _) in zip(seen, lists, strict=True):
                equal &= np.ndarray(fitting, counter, window, at - base + offset - first, at - first) == length
            run = fitting if equal.all() else int(np.argmin(equal))
            at, row = at + run * (at - first), row + run
        # Uneven rows are not compared again soon: a failed try costs as much as many steps.
        patience = MIN_RUN if run >= MIN_RUN else min(2 * patience, 1 << 16)
        if run < MIN_RUN and at <= available:
            count = min(patience, element.count - row)
            walk(count)
            row, stepped = row + count, stepped + count * len(lists)
        if stepped > MAX_UNEVEN_LISTS:
            name = printable(element.name)
            raise ValueError(
                f"{path}: element '{name}' has more than {MAX_UNEVEN_LISTS} lists of uneven length; expected fewer"
            )
    return at


_COUNTERS = {
    np.dtype(order + code).str: struct.Struct(order + letter)
    for order in "<>"
    for code, letter in (("i1", "b"), ("u1", "B"), ("i2", "h"), ("u2", "H"), ("i4", "i"), ("u4", "I"), ("i8", "q"))
} | {np.dtype(order + "u8").str: struct.Struct(order + "Q") for order in "<>"}
"""numpy type string -> how struct reads it, which is faster for single values."""


def _lists_of(element: Element, order: str) -> tuple[list[tuple[int, np.dtype, int]], int]:
    """(bytes ahead of a list's length, type of the length, bytes of an entry) of every list, and the bytes behind."""
    lists, ahead = [], 0
    for prop in element.properties:
        width = np.dtype(prop.type).itemsize
        if prop.counter is None:
            ahead += width
        else:
            lists.append((ahead, np.dtype(order + prop.counter), width))
            ahead = 0
    return lists, ahead


def _parse(lines: Sequence[bytes], path: Path) -> Header:
    fmt = ""
    tables: dict[str, tuple[int, dict[str, Property]]] = {}
    comments: list[str] = []
    last = ""
    for number, line in enumerate(lines[1:-1], 2):
        text = line.decode("latin-1").strip()
        words = _words(line)
        kind = words[0] if words else ""
        where = f"{path}: header line {number}"
        if kind == "format":
            fmt = words[1] if len(words) > 1 else ""
            if fmt not in ORDERS:
                raise ValueError(f"{where}: expected format {', '.join(ORDERS)}, got {printable(text)!r}")
        elif kind == "comment":
            comments.append(text[len("comment") :].strip())
        elif kind == "element":
            last, count = _element(words, text, where)
            if last in tables:
                raise ValueError(f"{where}: element {printable(last)!r} occurs twice")
            tables[last] = (count, {})
        elif kind == "property":
            prop = _property(words, text, where)
            if not tables:
                raise ValueError(f"{where}: a property before any element: {printable(text)!r}")
            if prop.name in tables[last][1]:
                raise ValueError(
                    f"{where}: property {printable(prop.name)!r} occurs twice in element {printable(last)!r}"
                )
            tables[last][1][prop.name] = prop
        elif kind not in ("", "obj_info"):
            raise ValueError(
                f"{where}: expected format, comment, obj_info, element or property, got {printable(text)!r}"
            )
    if not fmt:
        raise ValueError(f"{path}: the PLY header has no format line")
    elements = tuple(Element(name, count, tuple(props.values())) for name, (count, props) in tables.items())
    return Header(tuple(lines), fmt, elements, tuple(comments))


def _words(line: bytes) -> list[str]:
    # Split as bytes: str.split would also split at the non-breaking spaces of latin-1.
    return [word.decode("latin-1") for word in line.split()]


def _element(words: list[str], text: str, where: str) -> tuple[str, int]:
    # 15 digits hold every real count; int() refuses thousands of digits with a message of its own.
    if len(words) != 3 or not re.fullmatch(r"[0-9]{1,15}", words[2]):
        raise ValueError(
            f"{where}: expected 'element NAME COUNT' with a count of 1 to 15 digits, got {printable(text)!r}"
        )
    return words[1], int(words[2])


def _property(words: list[str], text: str, where: str) -> Property:
    listed = len(words) == 5 and words[1] == "list"
    if not listed and (len(words) != 3 or words[1] == "list"):
        raise ValueError(
            f"{where}: expected 'property TYPE NAME' or 'property list TYPE TYPE NAME', got {printable(text)!r}"
        )
    for kind in words[2:4] if listed else words[1:2]:
        if kind not in TYPES:
            raise ValueError(
                f"{where}: unknown property type {printable(kind, 40)!r}; expected one of {', '.join(TYPES)}"
            )
    if not listed:
        return Property(words[2], TYPES[words[1]])
    if TYPES[words[2]][0] == "f":
        raise ValueError(f"{where}: a list length must be an integer, got {printable(text)!r}")
    return Property(words[4], TYPES[words[3]], TYPES[words[2]])


# ---- rows


class Block(Protocol):
    """Some rows on their way into a file: they begin as copies, values are put into them, bytes come out."""

    def put(self, name: str, rows: np.ndarray, values: np.ndarray) -> None:
        """Set property `name` of `rows` (bool mask) to `values` (floats, one for each row that is set)."""
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
        matrix = _as_floats(self.records)
        if matrix is None:
            return {key: self._columns(names) for key, names in plan.items()}
        from splatpainter.kernels.parallel import each
        from splatpainter.kernels.rows import pick

        picks = {key: _column_numbers(self.records, names) for key, names in plan.items()}
        out = {key: np.empty((len(self), len(names)), np.float32) for key, names in plan.items()}

        def split(start: int) -> None:  # so that every record is fetched once for all columns
            part = slice(start, start + PICKED_ROWS)
            for key, columns in picks.items():
                pick(matrix[part], columns, out[key][part])

        each(split, range(0, len(self), PICKED_ROWS))
        return out

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

    def block(self, rows: np.ndarray) -> BinaryBlock:
        first = int(rows[0]) if len(rows) else 0
        if first >= 0 and np.array_equal(rows, np.arange(first, first + len(rows))):
            return BinaryBlock(self.records[first : first + len(rows)], is_copy=False)
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
            # As bytes, too: numpy copies records field by field.
            self.records, self.is_copy = self.records.view(np.uint8).copy().view(self.records.dtype), True
        return self.records


def _column_numbers(records: np.ndarray, names: Sequence[str]) -> Ids:
    """[K] int64 columns of properties, counted from 0."""
    fields = {name: k for k, name in enumerate(records.dtype.names or ())}
    return np.array([fields[name] for name in names], np.int64)


def _as_floats(records: np.ndarray) -> Floats | None:
    """[N, P] float32 view of records that hold nothing else in this machine's byte order; None for others."""
    fields = records.dtype.names or ()
    if not fields or any(records.dtype[name] != np.float32 for name in fields):
        return None
    return records.view(np.float32).reshape(len(records), len(fields))


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

    def block(self, rows: np.ndarray) -> TextBlock:
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
        for row, value in zip(np.flatnonzero(rows), as_type(values, code), strict=True):
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
