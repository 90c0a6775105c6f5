"""PlayCanvas compressed PLY: chunks of 256 consecutive rows, each row four 32-bit words, optional 8-bit SH.

    element chunk   ceil(N / 256) rows of floats: min and max of x y z, of scale_x.. (natural log), of r g b
                    (0.5 + C0 dc); files of older versions have no r g b: their range is 0..1
    element vertex  uint packed_position (11-10-11 bits, fractions of the chunk's range), packed_rotation (2-10-10-10,
                    smallest three of w x y z), packed_scale (11-10-11), packed_color (8-8-8 and opacity 8)
    element sh      uchar f_rest_*, channel-major: 0 is -4, 255 is 4, v between is 8 ((v + 0.5) / 256 - 0.5)

Writing over such a source, a value that did not change keeps its bits, as long as its row stays in the chunk it came
from and the chunk's range of that value stays; the range stays while all values of the chunk fit in it.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatpainter.io import files
from splatpainter.io.formats import activations, packing
from splatpainter.io.formats.ply import DEGREES, comment_settings, settled_comments
from splatpainter.io.formats.ply_header import Element, Header, element_size, make_header, read_header
from splatpainter.io.formats.reuse import differs, drawable_rows, row_problems, unchanged
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import each, run
from splatpainter.splats import ATTRIBUTES, SH_C0, Source, Splats
from splatpainter.system.quick_dataclass import dataclass

GAUSSIANS_PER_CHUNK = 256
PACKED_ROWS = 64 * GAUSSIANS_PER_CHUNK
"""Rows that one thread packs or unpacks at a time."""
AXES = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")
WORDS = ("packed_position", "packed_scale", "packed_color")
BITS = (11, 10, 11), (11, 10, 11), (8, 8, 8, 8)
LOG_SCALES = (-20.0, 20.0)
"""Log-scales are cut to this before packing: one row with scale 0 would take all precision from its chunk."""


@dataclass(frozen=True)
class CompressedPlyFile:
    """Source.detail of a compressed PLY file."""

    header: Header
    tables: Mapping[str, np.ndarray]
    """Element name -> structured rows, in the order of the file."""
    after: bytes


def read_compressed_ply(path: Path) -> Splats:
    """Read a compressed PLY file. Raises ValueError with one line: truncated data, missing properties, wrong counts."""
    with files.reading(path) as file:
        header = read_header(file, path)
        _check(header, path)
        left = os.fstat(file.fileno()).st_size - file.tell()
        tables, digest = {}, hashlib.sha256(header.raw)
        for element in header.elements:
            size = element_size(file, header, element, left, path)
            data = file.read(size)
            digest.update(data)
            left -= size
            rows = element.count if element.properties else 0  # rows without properties have no bytes
            tables[element.name] = np.frombuffer(data, element.dtype(header.order), rows)
        after = file.read()
        digest.update(after)
    splats = _decode(header, tables)
    problems = [f"{len(after)} trailing bytes (kept as they are)"] if after else []
    extra = [e.name for e in header.elements if e.name not in ("chunk", "vertex", "sh")]
    if extra:
        problems.append(f"extra elements (kept as they are): {', '.join(files.printable(n, 40) for n in extra[:8])}")
    if "min_r" not in (tables["chunk"].dtype.names or ()):
        problems.append("an older file without colour ranges: base colours are limited to 0..1")
    problems += row_problems(splats)
    contents = CompressedPlyFile(header, tables, after)
    source = Source(str(path), "compressed.ply", splats, digest.hexdigest(), contents, tuple(problems))
    return replace(splats, source=source, origin=np.arange(len(splats), dtype=np.int64))


def write_compressed_ply(path: Path, splats: Splats) -> None:
    """Write a compressed PLY file, rows in their order (a new file has tighter ranges when near rows stand together).

    Rows that cannot be drawn become transparent, unless they are unchanged rows of such a source.
    Raises ValueError when the file cannot be written.
    """
    # Over a file of this format its own header, tables and tail are the beginning; else an empty standard one.
    source = splats.source
    if source is not None and source.format == "compressed.ply" and splats.origin is not None:
        record, old, origin = source.detail, source.splats, np.asarray(splats.origin, np.int64)
    else:
        record, old, origin = _standard(), None, np.full(len(splats), -1, np.int64)
    count, rest = len(splats), 3 * splats.sh.shape[1] - 3
    header = record.header
    if rest != len(_rest_names(record.tables)):
        names = [("uchar", f"f_rest_{k}") for k in range(rest)]
        header = header.with_element("sh", count, names if rest else (), behind="vertex")
    # The header first, as it says how the tables are laid out.
    header = header.with_counts({"chunk": -(-count // GAUSSIANS_PER_CHUNK), "vertex": count, "sh": count})
    header = settled_comments(header, splats, old)
    tables = dict(record.tables)
    same = unchanged(splats, "compressed.ply")
    untouched = same is not None and same.identity  # then nothing is packed again: NaN ranges would not come back
    if not untouched:
        tables["chunk"], tables["vertex"] = _pack(splats, old, origin, record)
    if rest and not untouched:
        element = header.element("sh")
        assert element is not None
        tables["sh"] = _pack_sh(splats, old, origin, record, element.dtype(header.order))
    with files.writing(path) as file:
        file.write(header.raw)
        for element in header.elements:
            file.write(tables[element.name].tobytes())
        file.write(record.after)


def _check(header: Header, path: Path) -> None:
    if header.format == "ascii":
        raise ValueError(f"{path}: expected a binary compressed PLY, got a text one")
    # Every property that the decoder reads is asked for here, so that it need not doubt.
    floats = [f"{side}_{axis}" for axis in (*AXES[0], *AXES[1]) for side in ("min", "max")]
    _need(header, "chunk", floats, "f4", path)
    vertex = _need(header, "vertex", ["packed_rotation", *WORDS], "u4", path)
    chunk = header.element("chunk")
    assert chunk is not None
    colors = [f"{side}_{axis}" for axis in AXES[2] for side in ("min", "max")]
    if set(colors).intersection(chunk.names):
        _need(header, "chunk", colors, "f4", path)
    if chunk.count != -(-vertex.count // GAUSSIANS_PER_CHUNK):
        raise ValueError(
            f"{path}: expected {-(-vertex.count // GAUSSIANS_PER_CHUNK)} chunks for {vertex.count} rows, "
            f"found {chunk.count}"
        )
    sh = header.element("sh")
    if sh is not None:
        names = [n for n in sh.names if n.startswith("f_rest_")]
        if len(names) not in DEGREES:
            raise ValueError(f"{path}: expected 9, 24, 45 or 72 f_rest_* properties in element 'sh', got {len(names)}")
        _need(header, "sh", [f"f_rest_{k}" for k in range(len(names))], "u1", path)
        if sh.count != vertex.count:
            raise ValueError(f"{path}: expected {vertex.count} rows in element 'sh', found {sh.count}")
    lists = next((e.name for e in header.elements if e.has_lists), None)
    if lists is not None:
        raise ValueError(f"{path}: element '{files.printable(lists)}' has a list property; expected single values only")


def _need(header: Header, name: str, properties: list[str], code: str, path: Path) -> Element:
    element = header.element(name)
    if element is None:
        raise ValueError(f"{path}: a compressed PLY file without element '{name}'")
    types = {p.name: p.type for p in element.properties if p.counter is None}
    wrong = [n for n in properties if types.get(n) != code]
    if wrong:
        kind = {"f4": "float", "u4": "uint", "u1": "uchar"}[code]
        raise ValueError(f"{path}: element '{name}' of a compressed PLY file lacks '{kind} {wrong[0]}'")
    return element


def _decode(header: Header, tables: Mapping[str, np.ndarray]) -> Splats:
    vertex, count = tables["vertex"], len(tables["vertex"])
    antialiased, space = comment_settings(header.comments)
    names = _rest_names(tables)
    out = Splats(
        means=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        sh=np.empty((count, 1 + len(names) // 3, 3), np.float32),
        antialiased=antialiased,
        color_space=space,
    )
    # Words are fractions of the range of their chunk. Blocks of whole chunks, to bound what the exponentials take.
    chunks, order = _range_table(tables["chunk"]), (WORDS[0], "packed_rotation", *WORDS[1:])

    def unpack(start: int) -> None:
        rows = slice(start, start + PACKED_ROWS)
        words = np.stack([vertex[word][rows] for word in order], 1).astype(np.uint32, copy=False)
        log_scales = np.empty((len(words), 3), np.float64)
        ranges = readonly(chunks[start // GAUSSIANS_PER_CHUNK :], np.float32)
        run(
            kernels.unpack_chunks, readonly(words, np.uint32), ranges, SH_C0,
            out.means[rows], log_scales, out.sh[rows], out.opacities[rows], out.quats[rows],
        )  # fmt: skip
        with np.errstate(over="ignore", invalid="ignore"):  # which threads do not inherit
            out.scales[rows] = portable.exp(log_scales)

    each(unpack, range(0, count, PACKED_ROWS))
    if names:
        # The middle of each of 256 steps, but the ends exactly: as PlayCanvas decodes them.
        values = (np.arange(256) + 0.5) / 256
        values[0], values[255] = 0, 1
        decoded = readonly(((values - 0.5) * 8).astype(np.float32), np.float32)
        run(kernels.unpack_sh_bytes, readonly(_bytes_of(tables["sh"], names), np.uint8), decoded, out.sh)
    return out


def _bytes_of(table: np.ndarray, names: list[str]) -> np.ndarray:
    """[N, number of names] of a table of bytes, side by side."""
    if list(table.dtype.names or ()) == names and table.dtype.itemsize == len(names):
        return table.view(np.uint8).reshape(len(table), len(names))
    return np.stack([table[name] for name in names], 1)


def _pack(
    splats: Splats, old: Splats | None, origin: np.ndarray, record: CompressedPlyFile
) -> tuple[np.ndarray, np.ndarray]:
    """The chunk and vertex tables of `splats`."""
    drawable = drawable_rows(splats) if len(splats) else splats
    if old is None and _is_standard(record):
        return _new_tables(drawable, record)
    # Chunks know nothing of one another, so that threads pack runs of them.

    def packed(start: int) -> tuple[np.ndarray, np.ndarray]:
        rows = slice(start, start + PACKED_ROWS)
        with np.errstate(all="ignore"):  # which threads do not inherit
            return _pack_rows(_part(splats, rows), _part(drawable, rows), old, origin[rows], record)

    chunks, vertex = zip(*each(packed, range(0, max(len(splats), 1), PACKED_ROWS)), strict=True)
    return np.concatenate(chunks), np.concatenate(vertex)


def _is_standard(record: CompressedPlyFile) -> bool:
    """Whether the tables are as `_standard` has them."""
    standard = _standard().tables
    return all(record.tables[name].dtype == standard[name].dtype for name in ("chunk", "vertex"))


def _new_tables(drawable: Splats, record: CompressedPlyFile) -> tuple[np.ndarray, np.ndarray]:
    """The chunk and vertex tables of rows without a source."""
    count = len(drawable)
    ranges = np.empty((-(-count // GAUSSIANS_PER_CHUNK), 18), np.float32)
    words = np.empty((count, 4), np.uint32)
    log_scales = np.clip(activations.log(drawable.scales), *LOG_SCALES)
    arrays = (drawable.means, log_scales, drawable.sh, drawable.opacities, drawable.quats)
    run(kernels.pack_chunks, *(readonly(values, np.float32) for values in arrays), SH_C0, ranges, words)
    chunk, vertex = record.tables["chunk"].dtype, record.tables["vertex"].dtype
    return ranges.view(chunk).reshape(-1), words.view(vertex).reshape(-1)


def rounded_means(means: np.ndarray) -> np.ndarray:
    """[N, 3] float32 the centres as a new file has them, of finite ones [N, 3] in this order."""
    rounded = np.empty((len(means), 3), np.float32)
    run(kernels.round_in_chunks, readonly(means, np.float32), rounded)
    return rounded


def _part(splats: Splats, rows: slice) -> Splats:
    """Rows without their file."""
    return replace(splats, **{name: getattr(splats, name)[rows] for name in ATTRIBUTES}, source=None, origin=None)


def _pack_rows(
    splats: Splats, drawable: Splats, old: Splats | None, origin: np.ndarray, record: CompressedPlyFile
) -> tuple[np.ndarray, np.ndarray]:
    """The tables of rows that begin at a chunk. drawable: the same without values that cannot be packed."""
    count = len(splats)
    starts = np.arange(0, count, GAUSSIANS_PER_CHUNK)
    chunk = np.arange(count) // GAUSSIANS_PER_CHUNK
    # A chunk may keep the ranges of the source chunk that its first row comes from; -1 where that row is new.
    source_chunks = np.where(origin[starts] >= 0, origin[starts] // GAUSSIANS_PER_CHUNK, -1) if count else starts
    # Words of a row mean something only in the range of their chunk: they are kept where row and range both stay.
    chunks = _copies(record.tables["chunk"], source_chunks)
    vertex = _copies(record.tables["vertex"], origin)
    same_chunk = (origin >= 0) & (np.where(origin >= 0, origin // GAUSSIANS_PER_CHUNK, -1) == source_chunks[chunk])
    values = (
        drawable.means.astype(np.float64),
        np.clip(activations.log(drawable.scales), *LOG_SCALES).astype(np.float64),
        activations.dc_to_color(drawable.sh[:, 0]).astype(np.float64),
    )
    masks = _same(splats, old, origin)
    for group, attribute in enumerate(("means", "scales", "base")):
        axes, word = AXES[group], WORDS[group]
        # A range stays if all new values of the chunk fit into it; else it is that of the values, and all are packed
        # anew.
        low, high = _ranges(chunks, axes)
        keep_mask = masks[attribute] & same_chunk[:, None]
        fits = _fits(values[group], keep_mask, low[chunk], high[chunk], _levels(group))
        keep = _all(fits, starts) & (source_chunks >= 0)[:, None]
        if f"min_{axes[0]}" not in (chunks.dtype.names or ()):
            keep[:] = True  # fixed range 0..1: values beyond it are cut
        minima, maxima = _reduce(np.minimum, values[group], starts), _reduce(np.maximum, values[group], starts)
        low, high = np.where(keep, low, minima), np.where(keep, high, maxima)
        fields = packing.quantise(values[group], low[chunk], high[chunk], _levels(group))
        packed = _fields(vertex, group)
        fields = np.where(keep_mask & keep[chunk], packed[:, :3], fields)
        if group == 2:
            alpha = np.floor(drawable.opacities.astype(np.float64) * 255 + 0.5).astype(np.int64)
            fields = np.column_stack([fields, np.where(masks["opacities"], packed[:, 3], alpha)])
        vertex[word] = packing.pack_fields(fields, BITS[group])
        for k, axis in enumerate(axes):
            if f"min_{axis}" in (chunks.dtype.names or ()):
                chunks[f"min_{axis}"] = np.where(keep[:, k], chunks[f"min_{axis}"], low[:, k].astype(np.float32))
                chunks[f"max_{axis}"] = np.where(keep[:, k], chunks[f"max_{axis}"], high[:, k].astype(np.float32))
    # Rotations have no range: each stays by itself.
    turned = ~masks["quats"].all(1)
    vertex["packed_rotation"][turned] = packing.pack_quats(drawable.quats[turned])
    return chunks, vertex


def _pack_sh(
    splats: Splats, old: Splats | None, origin: np.ndarray, record: CompressedPlyFile, dtype: np.dtype
) -> np.ndarray:
    bands = splats.sh.shape[1] - 1
    old_bands = len(_rest_names(record.tables)) // 3
    names = [f"f_rest_{k}" for k in range(3 * bands)]
    # [N, 3 (K - 1)], channel by channel.
    codes = np.empty((len(splats), len(names)), np.uint8)
    run(kernels.pack_sh_bytes, readonly(splats.sh, np.float32), codes)
    # What did not change keeps its byte, as a value decoded and encoded again may come out as another.
    if old is not None:
        has_source = origin >= 0
        for k, band, channel in ((k, 1 + k % bands, k // bands) for k in range(len(names))):
            if band <= old_bands:
                before = record.tables["sh"][f"f_rest_{channel * old_bands + band - 1}"]
                keep_mask = has_source.copy()
                keep_mask[has_source] = ~differs(
                    splats.sh[has_source, band, channel], old.sh[origin[has_source], band, channel]
                )
                codes[keep_mask, k] = before[origin[keep_mask]]
    if list(dtype.names or ()) == names and dtype.itemsize == len(names):
        return codes.view(dtype).reshape(len(splats))
    table = np.zeros(len(splats), dtype)
    for k, name in enumerate(names):
        table[name] = codes[:, k]
    return table


def _same(splats: Splats, old: Splats | None, origin: np.ndarray) -> dict[str, np.ndarray]:
    """Attribute (and "base", the DC colour) -> mask of the values that still are, bit for bit, their source row's."""
    # By bits: a value that an edit computed to the same bits counts as unchanged.
    has_source = origin >= 0
    current = {name: getattr(splats, name) for name in ("means", "quats", "scales", "opacities")} | {
        "base": splats.sh[:, 0]
    }
    masks = {name: np.zeros(values.shape, bool) for name, values in current.items()}
    if old is not None:
        for name, values in current.items():
            before = old.sh[:, 0] if name == "base" else getattr(old, name)
            masks[name][has_source] = ~differs(values[has_source], before[origin[has_source]])
    return masks


def _fits(
    values: np.ndarray, keep_mask: np.ndarray, low: np.ndarray, high: np.ndarray, levels: np.ndarray
) -> np.ndarray:
    # Half a step beyond the end still rounds to the end; NaN ranges fit nothing.
    with np.errstate(invalid="ignore"):
        slack = (high - low) / levels / 2
        return keep_mask | ((values >= low - slack) & (values <= high + slack))


def _all(mask: np.ndarray, starts: np.ndarray) -> np.ndarray:
    return _reduce(np.logical_and, mask, starts)


def _reduce(ufunc: np.ufunc, values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    return ufunc.reduceat(values, starts) if len(starts) else values[:0]


def _copies(table: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows of a table ([M] indices, -1 for a row of zeros)."""
    out = np.zeros(len(rows), table.dtype)
    out[rows >= 0] = table[rows[rows >= 0]]
    return out


def _range_table(chunks: np.ndarray) -> np.ndarray:
    """[C, 18] float32: of positions, scales and colours three minima and three maxima."""
    columns = []
    for axes in AXES:
        columns += [side.astype(np.float32).T for side in _ranges(chunks, axes)]
    return np.ascontiguousarray(np.concatenate(columns).T)


def _ranges(chunks: np.ndarray, axes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """([C, 3], [C, 3]) float64 minima and maxima."""
    if f"min_{axes[0]}" not in (chunks.dtype.names or ()):
        return np.zeros((len(chunks), 3)), np.ones((len(chunks), 3))
    low, high = (np.stack([chunks[f"{side}_{axis}"] for axis in axes], 1) for side in ("min", "max"))
    return low.astype(np.float64), high.astype(np.float64)


def _fields(vertex: np.ndarray, group: int) -> np.ndarray:
    return packing.unpack_fields(vertex[WORDS[group]].astype(np.uint32), BITS[group])


def _levels(group: int) -> np.ndarray:
    return (1 << np.array(BITS[group][:3])) - 1


def _rest_names(tables: Mapping[str, np.ndarray]) -> list[str]:
    names = tables["sh"].dtype.names or () if "sh" in tables else ()
    return [f"f_rest_{k}" for k in range(sum(n.startswith("f_rest_") for n in names))]


def _standard() -> CompressedPlyFile:
    floats = [f"{side}_{axis}" for axes in AXES for side in ("min", "max") for axis in axes]
    words = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    tables = [("chunk", 0, [("float", n) for n in floats]), ("vertex", 0, [("uint", n) for n in words])]
    header = make_header("binary_little_endian", (), tables)
    return CompressedPlyFile(header, {e.name: np.zeros(0, e.dtype("<")) for e in header.elements}, b"")
