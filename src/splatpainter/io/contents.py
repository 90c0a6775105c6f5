"""What a file holds, part by part and as stored: the rows' own bytes or words by property, and everything else by name.

For comparing two files of one format (receipts.py). Nothing is decoded, so that values which only look alike differ.
"""

from __future__ import annotations

import copy
import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.array_types import Ids
from splatpainter.io.formats.ply_header import Element, Header, element_size
from splatpainter.io.formats.ply_rows import TextRows
from splatpainter.splats import Source
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.io.formats import gltf

BLOCK_ROWS = 1 << 14
"""Rows compared at a time, so that a comparison needs no memory of its own."""
GAUSSIAN = ("x", "y", "z", "opacity", "red", "green", "blue")
GAUSSIAN_STEMS = ("f_dc_", "f_rest_", "scale_", "rot_")
_NOTHING = "nothing"


@dataclass(frozen=True)
class StoredTable:
    """Stored rows: N rows of fields, of one kind of record."""

    records: Any
    """[N] structured array, [N, W] array, or TextRows."""
    fields: tuple[tuple[str, str], ...]
    """(name, type) of each stored property, in order."""
    edited: frozenset[str]
    """Names that hold the Gaussians' own values: no edit changes any other."""
    first: int = 0
    """Row of the asset that is row 0 here."""

    def __len__(self) -> int:
        return len(self.records)


@dataclass(frozen=True)
class Contents:
    """One file."""

    tables: tuple[StoredTable, ...] = ()
    """All with the same number of rows. Of no table: rows can only be compared by value."""
    settings: dict[str, Any] = field(default_factory=dict)
    """What a header says besides counts: name -> value."""
    blocks: dict[str, bytes] = field(default_factory=dict)
    """Other elements, extensions, trailing bytes: name -> bytes."""
    follows_rows: dict[str, np.ndarray] = field(default_factory=dict)
    """Tables that belong to several rows each (chunks of 256): name -> [M, bytes]; they change with their rows."""
    unseen: str = ""
    """What is left out here."""


def contents(source: Source) -> Contents | None:
    """The parts of a file as its reader kept them; None for formats whose reader keeps none."""
    made = _FORMATS.get(source.format)
    return None if made is None or source.detail is None else made(source.detail)


def rows_differ(old: StoredTable, new: StoredTable, count: int) -> Ids:
    """[D] int64 ascending: rows below `count` whose stored bytes differ. The tables have the same fields."""
    if isinstance(old.records, TextRows):
        # Rows of text have no fixed length, so they are compared line by line.
        rows = range(count)
        return np.array([row for row in rows if old.records.line(row) != new.records.line(row)], np.int64)
    # In blocks, as the comparison of all at once would be a copy of the whole file.
    differing = [np.zeros(0, np.int64)]
    for start in range(0, count, BLOCK_ROWS):
        part = slice(start, min(start + BLOCK_ROWS, count))
        one, two = _words(old.records[part]), _words(new.records[part])
        differing.append(start + np.flatnonzero((one != two).any(1)))
    return np.concatenate(differing)


def fields_differ(old: StoredTable, new: StoredTable, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Name of a property -> those of the rows in which its stored bytes differ; "white space" of text."""
    if isinstance(old.records, TextRows):
        return _words_of_text_differ(old, new, rows)
    if not len(rows):
        return {}
    out = {}
    for k, (name, _) in enumerate(old.fields):
        one, two = (_column(table, k, rows) for table in (old, new))
        differing = rows[(one != two).any(1)]
        if len(differing):
            out[name] = differing
    return out


def _column(table: StoredTable, k: int, rows: np.ndarray) -> np.ndarray:
    records = table.records
    values = records[table.fields[k][0]][rows] if records.dtype.names else records[rows, k, None]
    return np.ascontiguousarray(values).reshape(len(rows), -1).view(np.uint8).reshape(len(rows), -1)


def _words(records: np.ndarray) -> np.ndarray:
    """[n, words] of packed rows: 4 bytes at a time where they fit."""
    # Most rows are whole floats, and four bytes are compared as fast as one.
    size = records.dtype.itemsize * (records.shape[1] if records.ndim > 1 else 1)
    word = np.dtype(np.uint32 if size % 4 == 0 else np.uint8)
    flat = np.ascontiguousarray(records)
    return flat.view(np.uint8).reshape(len(flat), size).view(word) if size else np.zeros((len(flat), 1), np.uint8)


def _words_of_text_differ(old: StoredTable, new: StoredTable, rows: np.ndarray) -> dict[str, np.ndarray]:
    out: dict[str, list[int]] = {}
    # Few rows come here: those whose line is another already.
    for row in rows.tolist():
        one, two = (table.records.line(row).split() for table in (old, new))
        names = [name for (name, _), a, b in zip(old.fields, one, two, strict=False) if a != b]
        for name in names or ["white space"]:
            out.setdefault(name, []).append(row)
    return {name: np.array(differing, np.int64) for name, differing in out.items()}


# ---- formats


def _ply(record: Any) -> Contents:
    # What an edit may change stands apart from what it may not: other properties of the rows, elements, the header.
    vertex = record.header.element("vertex")
    names = tuple((p.name, p.type) for p in vertex.properties)
    gaussian_fields = frozenset(name for name in vertex.names if name in GAUSSIAN or name.startswith(GAUSSIAN_STEMS))
    stored = record.rows if isinstance(record.rows, TextRows) else record.rows.records
    at = record.header.elements.index(vertex)
    blocks = _elements(record.header, record.header.elements[:at], record.before, "")
    blocks |= _elements(record.header, record.header.elements[at + 1 :], record.after, "trailing bytes")
    settings = _header(record.header, ("vertex",)) | {"last line end": not record.unended}
    return Contents((StoredTable(stored, names, gaussian_fields),), settings, blocks)


def _compressed_ply(record: Any) -> Contents:
    tables, chunked, blocks = [], {}, {}
    for element in record.header.elements:
        values = record.tables[element.name]
        names = tuple((p.name, p.type) for p in element.properties)
        if element.name in ("vertex", "sh"):
            gaussian_fields = frozenset(n for n, _ in names if n.startswith(("packed_", "f_rest_")))
            tables.append(StoredTable(values, names, gaussian_fields))
        elif element.name == "chunk":
            chunked["chunk"] = _bytes_of(values)
        else:
            blocks[f"element {element.name}"] = values.tobytes()
    blocks["trailing bytes"] = record.after
    return Contents(tuple(tables), _header(record.header, ("vertex", "sh", "chunk")), blocks, chunked)


def _header(header: Header, counted: tuple[str, ...]) -> dict[str, Any]:
    """What the lines of a PLY header say, but for the rows' own count and their properties."""
    # The count of rows is left out, as an edit may append; their properties are compared by name elsewhere.
    lines, element = [], ""
    for line in header.lines[1:-1]:
        words = line.split()
        kind = words[0] if words else b""
        if kind == b"element":
            element = words[1].decode("latin-1")
            line = b" ".join(words[:2]) + b" *" if element in counted else line
        if kind == b"property" and element in counted[:1]:
            continue  # compared by name and type
        if kind != b"format":
            lines.append(line.rstrip(b"\r\n").decode("latin-1"))
    ends = sorted({line[len(line.rstrip(b"\r\n")) :] for line in header.lines})
    return {"format": header.format, "header": tuple(lines), "line ends": tuple(ends)}


def _elements(header: Header, elements: tuple[Element, ...], data: bytes, rest: str) -> dict[str, bytes]:
    """Bytes of other elements by name; what follows them is `rest`."""
    out, at = {}, 0
    for element in elements:
        if header.format == "ascii":
            end, left = at, element.count
            while left and end < len(data):  # the count may be a lie
                end, left = data.find(header.newline[-1:], end) + 1 or len(data), left - 1
        else:
            try:
                end = at + element_size(io.BytesIO(data[at:]), header, element, len(data) - at, Path("element"))
            except ValueError:  # cut short: its bytes are with those that follow
                break
        out[f"element {element.name}"] = data[at:end]
        at = end
    return out | ({rest: data[at:]} if rest else {})


def _splat(record: Any) -> Contents:
    names = tuple((name, str(record.rows.dtype[name])) for name in record.rows.dtype.names)
    return Contents(
        (StoredTable(record.rows, names, frozenset(record.rows.dtype.names)),), {}, {"trailing bytes": record.after}
    )


def _spz(file: Any) -> Contents:
    """The axes in which the rows were read is a setting; the extension that says it is no other difference."""
    from splatpainter.io.formats import spz  # only the format that is compared

    tables = []
    for name, words in file.streams.items():
        fields = tuple((f"{name} byte {k}", "u1") for k in range(words.shape[1]))
        tables.append(StoredTable(words, fields, frozenset(n for n, _ in fields)))
    settings = {"version": file.version, "fractional bits": file.fractional_bits, "flags": file.flags & ~spz.EXTENDED}
    settings["axes"] = spz.NAMES[file.axes - 1]
    settings["reserved bytes"] = bytes(file.reserved)
    blocks = {"extensions": spz.other_extensions(file), "trailing bytes": bytes(file.tail)}
    return Contents(tuple(tables), settings, blocks, unseen="how the streams are packed (gzip or zstd)")


def _sog(file: Any) -> Contents:
    tables = []
    for name, pixels in file.pixels.items():
        fields = tuple((f"{name} {channel}", "u1") for channel in "RGBA")
        tables.append(StoredTable(pixels, fields, frozenset(n for n, _ in fields)))
    # Ranges, codebooks and counts follow the rows, and are no settings of their own.
    meta = copy.deepcopy(file.meta)
    planes = set()
    for part in ("means", "scales", "quats", "sh0", "shN"):
        entry = meta.get(part)
        if isinstance(entry, dict):
            planes.update(name for name in entry.get("files", ()) if isinstance(name, str))
            for key in ("codebook", "files", "mins", "maxs", "count", "bands"):
                entry.pop(key, None)
    meta.pop("count", None)
    settings = {"meta.json": json.dumps(meta, sort_keys=True)}
    blocks = {name: data for name, data in file.container.files.items() if name not in planes | {"meta.json"}}
    return Contents(
        tuple(tables), settings, blocks, unseen="pixels beyond the rows, and how planes and bundle are packed"
    )


def _glb(file: Any) -> Contents:
    """Other JSON with what its accessors and buffer views mean in their places; our primitive's attributes as rows."""
    from splatpainter.io.formats import gltf, gltf_spz  # only the format that is compared
    from splatpainter.io.formats.glb import attribute_columns, attribute_name

    glb = file.glb
    # Numbers of accessors and places in the buffer change when a file is written anew. What they point to must not: so
    # each is replaced by what it means.
    doc = copy.deepcopy(glb.doc)
    tables = []
    for one in getattr(file, "primitives", (file,)):
        index = one.index if hasattr(one, "index") else one.primitive
        primitive, ours = doc["meshes"][one.mesh]["primitives"][index], set(one.names.values())
        # Rows of our primitives are compared as tables, with an edit's own attributes told from others.
        packed = gltf_spz.is_packed(primitive)
        for name, number in primitive.get("attributes", {}).items():
            if packed and gltf_spz.is_of_gaussians(name):
                continue
            try:
                values = np.array(gltf.accessor(glb, glb.binary, number, Path("accessor")))
            except ValueError:
                continue
            fields = tuple((f"{name} {k}", values.dtype.str) for k in range(values.shape[1]))
            edited = frozenset(n for n, _ in fields) if name in ours else frozenset()
            tables.append(StoredTable(values, fields, edited, getattr(one, "first", 0)))
        if packed:  # its values are those of the attributes that an edit makes of them
            unpacked = attribute_columns(gltf_spz.unpack(glb, primitive, Path("stream"), []))
            for semantic, column in unpacked.items():
                fields = tuple((f"{attribute_name(semantic)} {k}", "<f4") for k in range(column.shape[1]))
                tables.append(StoredTable(column, fields, frozenset(n for n, _ in fields), one.first))
            rest = set(primitive.get("attributes", {})) - set(gltf_spz.drop(doc, primitive))
            primitive["attributes"] = dict.fromkeys([*rest, *map(attribute_name, unpacked)])
        primitive["attributes"] = sorted(primitive.get("attributes", {}))
    # Everything else that belongs to the scene: other meshes, morph targets, indices.
    for mesh in doc["meshes"]:
        for other in mesh.get("primitives", []):
            for group in (other.get("attributes"), *other.get("targets", [])):
                for name in group if isinstance(group, dict) else ():
                    group[name] = _meant(glb, group[name])
            if "indices" in other:
                other["indices"] = _meant(glb, other["indices"])
    for key in ("accessors", "bufferViews", "buffers", "extensionsUsed"):
        doc.pop(key, None)
    # Pictures and other holders of bytes, by a digest of these.
    for holder in gltf.view_holders(doc):
        holder["bufferView"] = _view(glb, holder["bufferView"])
    settings = {"JSON": json.dumps(doc, sort_keys=True)}
    blocks = {f"chunk {kind:#010x}": bytes(data) for kind, data in glb.other_chunks} | {
        "trailing bytes": bytes(glb.tail)
    }
    return Contents(tuple(tables), settings, blocks, unseen="where the accessors lie in the buffer, and unused ones")


def _meant(glb: gltf.Glb, index: Any) -> Any:
    """What an accessor holds, wherever it lies."""
    from splatpainter.io.formats import gltf

    try:
        values = np.array(gltf.accessor(glb, glb.binary, index, Path("accessor")))
        item = glb.doc["accessors"][index]
    except ValueError:
        return "not readable"
    record = {key: value for key, value in item.items() if key not in ("bufferView", "byteOffset")}
    return [record, hashlib.sha256(values.tobytes()).hexdigest()]


def _view(glb: gltf.Glb, index: int) -> str:
    views = glb.doc.get("bufferViews", [])
    if not 0 <= index < len(views):
        return _NOTHING
    start = views[index].get("byteOffset", 0)
    data = glb.binary[start : start + views[index]["byteLength"]]
    record = {key: value for key, value in views[index].items() if key != "byteOffset"}
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode() + data).hexdigest()


def _bytes_of(values: np.ndarray) -> np.ndarray:
    size = values.dtype.itemsize
    return (
        np.ascontiguousarray(values).view(np.uint8).reshape(len(values), size) if size else np.zeros((0, 0), np.uint8)
    )


_FORMATS: dict[str, Callable[[Any], Contents]] = {
    "ply": _ply,
    "compressed.ply": _compressed_ply,
    "splat": _splat,
    "spz": _spz,
    "sog": _sog,
    "glb": _glb,
}
