"""Whether the packed pixels of a JPEG (ITU T.81) are whole: decoders fill up what is damaged or lacks, and say nothing.

Every scan is walked code by code, and no pixels are made: where codes are none, coefficients lie behind the last one,
or data end before the blocks do, or go on behind them, something was lost. Bytes that were exchanged for others of the
same length are not known by it. Knows no files.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

import numpy as np

from splatpainter.image_files import MAX_PICTURE_PIXELS
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class JpegCodes:
    """Markers, and what a scan may have."""

    sequential: tuple[int, ...] = (0xC0, 0xC1)
    progressive: int = 0xC2
    frames: tuple[int, ...] = (0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)
    """All kinds of pictures; of those that are neither of the above nothing is said."""
    huffman: int = 0xC4
    restarts: int = 0xDD
    scan: int = 0xDA
    end: int = 0xD9
    alone: tuple[int, ...] = (0x01, *range(0xD0, 0xD9))
    """Markers without a length."""
    block_px: int = 8
    max_skipped: int = 16
    """Bytes behind a scan's last block that are taken for an encoder's own. Source: taste."""


CODES = JpegCodes()


@dataclass(frozen=True)
class _Component:
    across: int
    """Blocks in a unit of all components, which are squares of pixels."""
    down: int
    columns: int
    """Blocks that hold pixels of it."""
    rows: int


class _Frame:
    """The picture that scans are of."""

    def __init__(self, kind: int, body: bytes):
        _, height, width, count = struct.unpack_from(">BHHB", body)
        self.progressive = kind == CODES.progressive
        sizes = {body[6 + 3 * k]: (body[7 + 3 * k] >> 4, body[7 + 3 * k] & 15) for k in range(count)}
        most = [max(size[axis] for size in sizes.values()) for axis in (0, 1)]
        unit = [CODES.block_px * factor for factor in most]
        self.units = tuple(-(-pixels // size) for pixels, size in zip((width, height), unit, strict=True))
        self.components = {
            name: _Component(
                across,
                down,
                *(
                    math.ceil(math.ceil(pixels * part / all_parts) / CODES.block_px)
                    for pixels, part, all_parts in zip((width, height), (across, down), most, strict=True)
                ),
            )
            for name, (across, down) in sizes.items()
        }
        # Which frequencies of each block are known so far, a bit each.
        self.coded: dict[int, np.ndarray] = {}

    def coded_of(self, name: int) -> np.ndarray:
        component = self.components[name]
        if name not in self.coded:
            self.coded[name] = np.zeros(component.columns * component.rows, np.uint64)
        return self.coded[name]


def damage_of_jpeg(data: bytes, tables: bytes = b"") -> str:
    """What of a JPEG's packed pixels is damaged, in words; "" where nothing is, and where none can be told. tables: a
    JPEG of Huffman tables alone, as TIFF keeps them."""
    huffman: dict[int, np.ndarray] = {}
    if tables:
        _walk(tables, huffman)
    return _walk(data, huffman)


def _walk(data: bytes, tables: dict[int, np.ndarray]) -> str:
    values = readonly(np.frombuffer(data, np.uint8), np.uint8)
    frame: _Frame | None = None
    restart, at, size = 0, 2, len(data)
    try:
        while at + 4 <= size:
            if data[at] != 0xFF:
                return ""  # no marker where one belongs, which is the decoder's business
            kind = data[at + 1]
            if kind == 0xFF or kind in CODES.alone:  # filled up to a marker
                at += 1 if kind == 0xFF else 2
                continue
            if kind == CODES.end:
                return ""
            length = int.from_bytes(data[at + 2 : at + 4], "big")
            body, at = data[at + 4 : at + 2 + length], at + 2 + length
            if kind == CODES.huffman:
                tables.update(_tables(body))
            elif kind == CODES.restarts:
                restart = int.from_bytes(body[:2], "big")
            elif kind in CODES.frames:
                height, width = struct.unpack_from(">HH", body, 1)
                is_walked = kind in (*CODES.sequential, CODES.progressive) and body[0] == 8
                if not is_walked or not 0 < width * height <= MAX_PICTURE_PIXELS:  # a header can claim any size
                    return ""
                frame = _Frame(kind, body)
            elif kind == CODES.scan:
                if frame is None:
                    return ""
                damage, at = _scan(values, at, body, frame, tables, restart)
                if damage:
                    return damage
    except (IndexError, KeyError, struct.error, ValueError, ZeroDivisionError):  # headers of which no picture is made
        return ""
    return ""


def _tables(body: bytes) -> Mapping[int, np.ndarray]:
    """Class and number of a Huffman table -> [65536] uint16: what the next sixteen bits begin with."""
    out = {}
    while len(body) > 16:
        counts = np.frombuffer(body[1:17], np.uint8)
        symbols = np.frombuffer(body[17 : 17 + int(counts.sum())], np.uint8)
        lengths = np.repeat(np.arange(1, 17), counts)[: len(symbols)]
        entries = np.repeat(lengths * 256 + symbols, 1 << (16 - lengths))[: 1 << 16]
        out[body[0]] = np.append(entries, np.zeros((1 << 16) - len(entries))).astype(np.uint16)
        body = body[17 + len(symbols) :]
    return out


def _scan(
    values: np.ndarray, at: int, body: bytes, frame: _Frame, tables: Mapping[int, np.ndarray], restart: int
) -> tuple[str, int]:
    """(what is damaged, where the scan ends)."""
    names = [(body[1 + 2 * k], body[2 + 2 * k]) for k in range(body[0])]
    first, last, bits = body[1 + 2 * len(names) : 4 + 2 * len(names)]
    refines = bits >> 4 > 0
    single = len(names) == 1
    used = [frame.components[name] for name, _ in names]
    across, down = (used[0].columns, used[0].rows) if single else frame.units
    # A table that the scan does not use need not be there.
    uses_first, uses_rest = (
        (not frame.progressive or first == 0) and not refines,
        not frame.progressive or first > 0,
    )
    chosen, rows = [], []
    for (_, numbers), component in zip(names, used, strict=True):
        pair = [tables[numbers >> 4] if uses_first else None, tables[16 + (numbers & 15)] if uses_rest else None]
        rows.append([1, 1] if single else [component.across, component.down])
        for table in pair:
            rows[-1].append(len(chosen))
            chosen.append(np.zeros(1 << 16, np.uint16) if table is None else table)
    history = frame.progressive and first > 0
    if history and (not single or not 0 < first <= last < 64):
        return "", len(values)
    coded = frame.coded_of(names[0][0]) if history else np.zeros(1, np.uint64)
    result = np.zeros(3, np.int64)
    run(
        kernels.walk_jpeg_scan,
        values,
        at,
        np.array(rows, np.int32),
        np.stack(chosen),
        across,
        down,
        across,
        restart,
        first,
        last,
        frame.progressive,
        refines,
        CODES.max_skipped,
        coded,
        result,
    )
    broken, units, end = result.tolist()
    if not broken:
        return "", end
    share = 100 * units / max(across * down, 1)
    return f"its packed pixels make no sense from {share:.0f} % of the way down", end
