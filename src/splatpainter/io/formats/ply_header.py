"""The header of PLY: text that names tables ("elements") of binary records or of lines of text (ply_rows.py).

Layout: "ply", "format ...", then comments, elements and their properties in any order, then "end_header";
lines end in LF, CRLF or CR, all as the first one does, and a mark of UTF-8 (BOM) may stand ahead. It is parsed line by
line, and edited without touching the lines that do not change.

Knows nothing of Gaussians; ply.py and compressed_ply.py do.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

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
