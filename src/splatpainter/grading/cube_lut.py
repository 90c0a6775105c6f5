"""Look-up tables of colour in `.cube` files (Adobe, "Cube LUT Specification" 1.0, 2013; DaVinci Resolve's variant).

    TITLE "film"           # text; ignored
    LUT_3D_SIZE 33         # or LUT_1D_SIZE 1024; Resolve writes both: the 1D table shapes what the 3D table reads
    DOMAIN_MIN 0 0 0       # input of the first entry, DOMAIN_MAX that of the last, per channel
    DOMAIN_MAX 1 1 1       # Resolve: LUT_1D_INPUT_RANGE 0 1, LUT_3D_INPUT_RANGE 0 1, for all channels
    0.0 0.0 0.0            # entries: red runs fastest, then green, then blue

Values between entries are linear (1D) or tetrahedral (3D: a cell's six tetrahedra around its grey diagonal, after
Kasson, Plouffe and Nin, "Tetrahedral interpolation technique for color space conversion", 1993): greys stay grey.
"""

from __future__ import annotations

import io
import math
import struct
from dataclasses import field
from pathlib import Path

import numpy as np

from splatpainter.image_files import bytes_of_png, bytes_to_png
from splatpainter.io import files
from splatpainter.system.quick_dataclass import dataclass

MAX_1D_SIZE, MAX_3D_SIZE = 65536, 129
"""Entries of a table along an axis: what the specification allows, and the largest cube that grading programs write."""
MAX_CUBE_BYTES = 128 << 20
"""Most bytes of a file: 129^3 entries of 60 characters."""
MAX_OTHER_LINES = 10_000
"""Keywords, comments and empty lines of a file."""
MAX_VALUE = 1e6
"""Largest absolute value of an entry or a domain; tables of light go to about 100."""
SIZES = {"LUT_1D_SIZE": MAX_1D_SIZE, "LUT_3D_SIZE": MAX_3D_SIZE}
RANGES = {"DOMAIN_MIN": 3, "DOMAIN_MAX": 3, "LUT_1D_INPUT_RANGE": 2, "LUT_3D_INPUT_RANGE": 2}
"""Keyword -> how many numbers follow it."""
Domain = tuple[tuple[float, float, float], tuple[float, float, float]]
MIN_DOMAIN = 1e-6
"""Least distance between the lowest and the highest input of a table."""
MAGIC, HEAD_BYTES = b"CLUT", 60
"""Beginning of the tables in a project: sizes and domains, then entries of three float32."""
MIN_INTEGER_SCALE = 255
"""Of a table of whole numbers: from here on they are levels of 8, 10, 12 or 16 bits, and no colours of 0..1."""
UNIT: Domain = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


@dataclass(frozen=True)
class CubeLut:
    """A table of colours: call it with display colours [..., 3] to have the like, 0..1."""

    name: str
    """Name for receipts: that of its file."""
    shaper: np.ndarray | None = field(default=None, repr=False)
    """[S, 3] float32: the 1D table, applied first; one column per channel."""
    cube: np.ndarray | None = field(default=None, repr=False)
    """[B, G, R, 3] float32: the 3D table."""
    shaper_domain: Domain = UNIT
    """(lowest, highest) input per channel of the 1D table."""
    cube_domain: Domain = UNIT

    def __call__(self, colors: np.ndarray) -> np.ndarray:
        out = np.asarray(colors, np.float32)
        if self.shaper is not None:
            # Resolve's order: the 1D table shapes what the 3D table reads.
            out = _shaped(_position(out, self.shaper_domain, len(self.shaper)), self.shaper)
        if self.cube is not None:
            flat = _position(out, self.cube_domain, len(self.cube)).reshape(-1, 3)
            out = _tetrahedral(flat, self.cube).reshape(out.shape)
        return out.clip(0, 1)

    def describe(self) -> str:
        return f"LUT {self.name}"

    def to_png(self) -> bytes:
        """The tables as PNG, for a project to keep."""
        sizes = [0 if table is None else len(table) for table in (self.shaper, self.cube)]
        domains = np.array([*self.shaper_domain, *self.cube_domain], "<f4").tobytes()
        tables = [table.astype("<f4").tobytes() for table in (self.shaper, self.cube) if table is not None]
        return bytes_to_png(b"".join([MAGIC, struct.pack("<II", *sizes), domains, *tables]))

    @staticmethod
    def from_png(png: bytes, name: str) -> CubeLut:
        """The inverse. Raises ValueError naming `name`."""
        try:
            # A project may come from anywhere: its tables are checked as a file's are.
            data = bytes_of_png(png, HEAD_BYTES + 12 * (MAX_1D_SIZE + MAX_3D_SIZE**3))
            if data[:4] != MAGIC:
                raise ValueError("it is another picture")
            size_1d, size_3d = struct.unpack_from("<II", data, 4)
            count = size_1d + size_3d**3
            if 1 in (size_1d, size_3d) or size_1d > MAX_1D_SIZE or size_3d > MAX_3D_SIZE or not count:
                raise ValueError(f"its header gives sizes of {size_1d} and {size_3d}")
            domains = np.frombuffer(data, "<f4", 12, 12).astype(np.float64)
            table = np.frombuffer(data, "<f4", 3 * count, HEAD_BYTES).reshape(count, 3).astype(np.float32)
            low, high = domains.reshape(2, 2, 3).swapaxes(0, 1)
            if not (np.abs(table) <= MAX_VALUE).all() or not (np.abs(domains) <= MAX_VALUE).all():
                raise ValueError("a number in it is not finite or too large")
            if (high - low < MIN_DOMAIN).any():
                raise ValueError("a domain is empty")
        except (ValueError, struct.error) as error:
            raise ValueError(f"{name}: expected the table of a LUT ({error})") from None
        ends = [(_triple(domains[at : at + 3]), _triple(domains[at + 3 : at + 6])) for at in (0, 6)]
        cube = table[size_1d:].reshape(size_3d, size_3d, size_3d, 3) if size_3d else None
        return CubeLut(name, table[:size_1d] if size_1d else None, cube, ends[0], ends[1])


def read_cube(path: Path) -> CubeLut:
    """Raises ValueError naming the file and the line: unreadable, too large, unknown keywords, no or wrong numbers,
    another number of entries than the size says. Sizes are judged before anything is allocated for them."""
    data = files.read_head(path, MAX_CUBE_BYTES + 1)
    if len(data) > MAX_CUBE_BYTES:
        raise ValueError(f"{path}: expected a .cube table of at most {MAX_CUBE_BYTES >> 20} MiB, got more")
    return parse_cube(_text(data, path), path)


def _text(data: bytes, path: Path) -> str:
    """Raises ValueError: no text. Titles and comments are in whatever encoding a program wrote them."""
    encodings = ["utf-16"] if data.startswith((b"\xff\xfe", b"\xfe\xff")) else ["utf-8-sig", "latin-1"]
    for encoding in encodings:
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if text.isascii() or "SIZE" in text.upper():  # latin-1 decodes any bytes
            return text
    raise ValueError(f"{path}: expected a .cube table (text), got other bytes")


def parse_cube(text: str, where: Path | str) -> CubeLut:
    """As `read_cube`, for a file's text."""
    header: dict[str, tuple[float, ...]] = {}
    table = np.zeros((0, 3), np.float32)
    count = limit = 0
    # Line by line, so that every error names its line.
    for number, raw in enumerate(io.StringIO(text, newline=None), 1):
        at = f"{where}:{number}"
        line = raw.split("#", 1)[0].strip()
        if not line:
            if number > count + MAX_OTHER_LINES:
                raise ValueError(f"{at}: expected at most {MAX_OTHER_LINES} lines that are no entries")
            continue
        keyword = line.split(None, 1)[0].upper()
        # Numbers never begin with a letter; unknown keywords are errors, as they may change what entries mean.
        if keyword[0].isalpha():
            if count:
                raise ValueError(f"{at}: expected keywords before the entries, got {_quoted(keyword)}")
            if keyword != "TITLE":
                _keyword(header, keyword, line.split()[1:], at)
                limit = _entry_count(header)
            continue
        if count == limit:
            expected = (
                f"{limit} entries, as its size says" if limit else "LUT_1D_SIZE or LUT_3D_SIZE before the entries"
            )
            raise ValueError(f"{at}: expected {expected}, got {_quoted(line)}")
        if not count:
            # Allocated at the first entry, when its size has been judged.
            table = np.empty((limit, 3), np.float32)
        table[count] = _numbers(line.split(), 3, at)
        count += 1
    # What only the end of the file tells.
    if not limit:
        raise ValueError(f"{where}: expected a .cube table with LUT_1D_SIZE or LUT_3D_SIZE, got neither")
    if count != limit:
        raise ValueError(f"{where}: expected {limit} entries, as its size says, got {count}")
    largest = float(table.max())
    if largest >= MIN_INTEGER_SCALE and (table == np.round(table)).all():
        raise ValueError(
            f"{where}: its entries are whole numbers up to {largest:g}; expected colours of 0..1: divide them by "
            f"{(1 << int(largest).bit_length()) - 1}, or export it again as .cube of floats"
        )
    size_1d, size_3d = (int(header.get(name, (0.0,))[0]) for name in SIZES)
    shared = (_three(header.get("DOMAIN_MIN", (0.0,))), _three(header.get("DOMAIN_MAX", (1.0,))))
    domains: list[Domain] = []
    for name in ("LUT_1D_INPUT_RANGE", "LUT_3D_INPUT_RANGE"):
        low, high = (_three(header[name][:1]), _three(header[name][1:])) if name in header else shared
        if any(b - a < MIN_DOMAIN for a, b in zip(low, high, strict=True)):
            raise ValueError(f"{where}: expected a domain whose highest input is above its lowest, got {low} to {high}")
        domains.append((low, high))
    return CubeLut(
        Path(where).name,
        table[:size_1d] if size_1d else None,
        table[size_1d:].reshape(size_3d, size_3d, size_3d, 3) if size_3d else None,
        domains[0],
        domains[1],
    )


def _keyword(header: dict[str, tuple[float, ...]], keyword: str, words: list[str], at: str) -> None:
    if keyword in header:
        raise ValueError(f"{at}: {keyword} was given twice")
    if keyword in SIZES:
        if len(words) != 1 or not words[0].isascii() or not words[0].isdigit() or len(words[0]) > 9:
            raise ValueError(f"{at}: expected a whole number after {keyword}, got {_quoted(' '.join(words))}")
        if not 2 <= int(words[0]) <= SIZES[keyword]:
            raise ValueError(f"{at}: expected {keyword} from 2 to {SIZES[keyword]}, got {words[0]}")
        header[keyword] = (float(words[0]),)
    elif keyword in RANGES:
        header[keyword] = _numbers(words, RANGES[keyword], at)
    else:
        listed = ", ".join(["TITLE", *SIZES, *RANGES])
        raise ValueError(f"{at}: unknown keyword {_quoted(keyword)}; expected one of {listed}, or three numbers")


def _entry_count(header: dict[str, tuple[float, ...]]) -> int:
    return int(header.get("LUT_1D_SIZE", (0.0,))[0]) + int(header.get("LUT_3D_SIZE", (0.0,))[0]) ** 3


def _numbers(words: list[str], count: int, at: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) and abs(value) <= MAX_VALUE for value in values):
        raise ValueError(f"{at}: expected {count} numbers, got {_quoted(' '.join(words))}")
    return values


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    red, green, blue = values.tolist()
    return red, green, blue


def _three(values: tuple[float, ...]) -> tuple[float, float, float]:
    red, green, blue = values * 3 if len(values) == 1 else values
    return red, green, blue


def _quoted(text: str) -> str:
    return ascii(text[:40])


def _position(colors: np.ndarray, domain: Domain, size: int) -> np.ndarray:
    """Colours as positions 0..size - 1 in a table."""
    low, high = (np.asarray(end, np.float32) for end in domain)
    return ((colors - low) / (high - low)).clip(0, 1) * np.float32(size - 1)


def _shaped(position: np.ndarray, table: np.ndarray) -> np.ndarray:
    first = np.minimum(position.astype(np.int64), len(table) - 2)
    share = position - first
    channel = np.arange(3)
    return (1 - share) * table[first, channel] + share * table[first + 1, channel]


def _tetrahedral(position: np.ndarray, cube: np.ndarray) -> np.ndarray:
    """[M, 3] of positions [M, 3]: from the cell's first corner along the axes in the order of their shares, the largest
    first, to its last corner."""
    first = np.minimum(position.astype(np.int64), len(cube) - 2)
    share = position - first
    # Six tetrahedra a cell: walking along the largest share first stays inside the right one.
    order = np.argsort(-share, axis=1, kind="stable")
    corner = first.copy()
    each = np.arange(len(corner))
    out = cube[corner[:, 2], corner[:, 1], corner[:, 0]]
    for k in range(3):
        before = cube[corner[:, 2], corner[:, 1], corner[:, 0]]
        axis = order[:, k]
        corner[each, axis] += 1
        step = cube[corner[:, 2], corner[:, 1], corner[:, 0]] - before
        out = out + share[each, axis][:, None] * step
    return out
