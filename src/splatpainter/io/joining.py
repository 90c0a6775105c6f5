"""Files that hold the rows of several assets, one after the other.

Rows of PLY and .splat files stand by themselves, so each part's rows have the bytes that its own writer gives them:
those of its file, where it is of that format and nothing changed. Other formats share ranges, codebooks or palettes
among their rows and are written from the values.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import files, format_of_name, read, write
from splatpainter.io.formats.glb import with_bands
from splatpainter.io.formats.ply import PlyFile, settled_comments
from splatpainter.io.formats.ply_header import TYPES, Element, make_header
from splatpainter.io.formats.ply_rows import BinaryRows
from splatpainter.io.formats.splat import SplatFile
from splatpainter.io.positions import offset_of
from splatpainter.splats import ATTRIBUTES, Splats

ROWS_STAND_ALONE = ("ply", "splat")
"""Formats whose rows depend on no other row."""
TYPE_NAMES = {code: next(name for name, c in TYPES.items() if c == code) for code in TYPES.values()}


def concatenated(parts: Sequence[Splats]) -> Splats:
    """All Gaussians in order, without source, at the highest SH degree; bands that a part lacks are zeros. Flags are
    those of the first, and means relative to the offset of all, or to one amid them where they have several."""
    bands = max(part.sh.shape[1] for part in parts)
    if len({part.offset for part in parts}) > 1:
        offset = offset_of(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in ("world_means", "scales"))
        )
        parts = [part.relative_to(offset) for part in parts]
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ATTRIBUTES if name != "sh"}
    sh = np.concatenate([with_bands(part.sh, bands) for part in parts])
    return replace(parts[0], **columns, sh=sh, source=None, origin=None)


def write_joined(path: Path, parts: Sequence[Splats]) -> None:
    """Write the rows of several assets into one file, in order, at the highest SH degree among them. The name says the
    format. A PLY has the properties of all parts, in the order in which they come first; where a part lacks one, its
    rows have 0; of two types of one property, such as float and double, the wider one. Comments are those of the first
    part; other elements and trailing bytes are left out. Raises ValueError as `io.write`."""
    key = format_of_name(path)
    if key not in ROWS_STAND_ALONE:
        write(path, concatenated(parts))
        return
    bands = max(part.sh.shape[1] for part in parts)
    records = []
    with tempfile.TemporaryDirectory() as folder:
        for part in parts:
            if part.source is not None and part.source.splats.offset != part.offset:  # its file's rows cannot hold it
                part = replace(part, source=None, origin=None)
            single = Path(folder) / f"part{path.suffix.lower()}"
            record = _written(single, replace(part, sh=with_bands(part.sh, bands)))
            if isinstance(record, PlyFile) and "f_dc_0" not in _vertex(record).names:  # colours as red, green, blue
                record = _written(single, replace(part, sh=with_bands(part.sh, bands), source=None, origin=None))
            records.append(record)
    with files.writing(path) as file:
        if key == "splat":
            for record in records:
                assert isinstance(record, SplatFile)
                file.write(record.rows.tobytes())
            return
        rows = _one_layout(records)
        vertex = [(TYPE_NAMES[rows[0].dtype[name].str[1:]], name) for name in rows[0].dtype.names or ()]
        header = make_header(
            "binary_little_endian", records[0].header.comments, [("vertex", sum(map(len, rows)), vertex)]
        )
        file.write(settled_comments(header, parts[0], parts[0]).raw)
        for block in rows:
            file.write(block.tobytes())


def _written(path: Path, splats: Splats) -> Any:
    """What the reader keeps of a file of these rows."""
    write(path, splats, overwrite=True)
    source = read(path, lenient=True).source
    assert source is not None
    return source.detail


def _vertex(record: PlyFile) -> Element:
    vertex = record.header.element("vertex")
    assert vertex is not None
    return vertex


def _one_layout(records: Sequence[PlyFile]) -> list[np.ndarray]:
    """The rows of several PLY files as structured arrays of one type: float32 words keep their bits."""
    layout: dict[str, np.dtype] = {}
    for record in records:
        for entry in _vertex(record).properties:
            kind = np.dtype("<" + entry.type)
            before = layout.setdefault(entry.name, kind)
            if before.kind == kind.kind and before.itemsize < kind.itemsize:
                layout[entry.name] = kind
    out = []
    for record in records:
        rows = np.zeros(len(record.rows), np.dtype(list(layout.items())))
        for name in _vertex(record).names:
            with np.errstate(over="ignore", invalid="ignore"):
                if isinstance(record.rows, BinaryRows):
                    rows[name] = record.rows.records[name]
                else:
                    rows[name] = record.rows.columns({name: (name,)})[name][:, 0]
        out.append(rows)
    return out
