"""INRIA PLY, the format that 3D Gaussian training writes: read in every variant met in the wild, written back exactly.

Vertex properties, in any order and of any scalar type: x y z, f_dc_0..2, f_rest_0..3(K-1)-1 (channel-major: all red,
then green, then blue; none for degree 0), opacity (logit), scale_0..2 (natural log), rot_0..3 (w x y z). Without
f_dc_*, red green blue (0..255 as uchar, or in any other type that holds such numbers, else 0..1) are the base colour.
Everything else in the file is kept as it is.

Positions that float32 cannot hold (Splats.offset) are read and written as doubles; a new file of such has double x y z.

Writing over a PLY source: output row i begins as the bytes of source row origin[i] (zeros for -1), and a property is
encoded anew where, and only where, its value in `Splats` differs in any bit from what the source decoded to.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.io import files, positions
from splatpainter.io.formats import activations
from splatpainter.io.formats.ply_header import Element, Header, element_size, make_header, read_header
from splatpainter.io.formats.ply_rows import BinaryRows, Rows, as_slice, text_rows
from splatpainter.io.formats.reuse import differs, row_problems
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import ahead, run
from splatpainter.kernels.row_bits import differing, row_bits
from splatpainter.splats import ATTRIBUTES, SH_COUNTS, ColorSpace, Source, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max

DEGREES = {3 * (count - 1): degree for count, degree in SH_COUNTS.items()}
"""Number of f_rest_* properties -> SH degree."""
MIP_COMMENT = "SplatRenderMode: mip"
PLAIN_COMMENT = "SplatRenderMode: default"
SPACE_COMMENT = "SplatColorSpace: "
"""Ours: PLY itself cannot say that colours are linear."""
FLOAT32_HOLDS = ("f4", "i1", "u1", "i2", "u2")
"""Types of which float32 holds every number."""
MIN_BYTE_COLOR = 16.0
"""Largest colour of float properties from which they are taken as 0..255: light of a display is 1, of HDR a few."""
BLOCK_ROWS = 1 << 14
"""Rows encoded at a time when writing: 4 MB at SH degree 3, which stay in the cache."""
NEW_BLOCK_ROWS = 1 << 15
"""The same of Gaussians that were in no file."""


@dataclass(frozen=True)
class PlyFile:
    """Source.detail of a PLY file."""

    header: Header
    before: bytes
    """Elements ahead of the vertices."""
    rows: Rows
    after: bytes
    """Elements behind the vertices, and whatever follows them."""
    unended: bool = False
    """A text file whose last line has no line ending (`rows` have one)."""
    color_span: float | None = None
    """What full red is in the file, where colours stand in for f_dc_*; None where they do not."""


POINT_COLORS = ("red", "green", "blue")
"""Of the points of a cloud: bytes, or floats 0..1."""


def read_ply(path: Path, lenient: bool = False, offset: positions.Offset | None = None) -> Splats:
    """Read an INRIA PLY file (not a compressed one, see compressed_ply.py). lenient: also one whose elements behind the
    vertices are cut short; what is left of them is kept. offset: of the means; None: the one that they need.

    Raises ValueError with one line: broken header, truncated data, a mesh or point cloud, a wrong number of f_rest_*.
    """
    with files.reading(path) as file:
        # What the header says is judged before the body is read.
        header = read_header(file, path)
        vertex = header.element("vertex")
        if vertex is None:
            raise ValueError(f"{path}: a PLY file without element 'vertex'; expected Gaussian splats")
        plan = columns_of(vertex.names, path, header)
        if vertex.has_lists:
            raise ValueError(f"{path}: element 'vertex' has a list property; expected single values only")
        record, problems = _read_body(file, header, vertex, path, lenient)
        record = replace(record, color_span=_color_span(record.rows, plan["sh"], vertex))
    splats = _decode(record, plan, offset)
    # What is kept but not understood is told, so that nobody has to wonder where it went.
    gaussian_names = {name for names in plan.values() for name in names} | {"nx", "ny", "nz"}
    extra = [name for name in vertex.names if name not in gaussian_names]
    if extra:
        listed = _named(extra) + (", ..." if len(extra) > 8 else "")
        problems.append(f"extra vertex properties (kept as they are): {listed}")
    other_elements = [e.name for e in header.elements if e.name != "vertex"]
    if other_elements:
        problems.append(f"extra elements (kept as they are): {_named(other_elements)}")
    problems += row_problems(splats)
    problems += _rounding_problem(record, splats)
    problems += _range_problem(record, vertex)
    source = Source(str(path), "ply", splats, functools.partial(_sha256, record), record, tuple(problems))
    return replace(splats, source=source, origin=np.arange(len(splats), dtype=np.int64))


def read_ply_points(path: Path) -> tuple[Floats, Floats]:
    """([M, 3] float64 points, [M, 3] their colours 0..1) of a PLY file of a point cloud, as INRIA's trainer (input.ply)
    and nerfstudio (sparse_pc.ply) write it; grey where it has no colours, without points that are not finite. Raises
    ValueError with one line: broken header, truncated data, no points."""
    with files.reading(path) as file:
        header = read_header(file, path)
        vertex = header.element("vertex")
        if vertex is None or not {"x", "y", "z"} <= set(vertex.names) or vertex.has_lists:
            raise ValueError(f"{path}: expected a point cloud with x, y and z of each point")
        record, _ = _read_body(file, header, vertex, path, lenient=True)
    points = record.rows.doubles(("x", "y", "z"))
    colors = np.full(points.shape, 0.5)
    if set(POINT_COLORS) <= set(vertex.names):
        is_float = vertex.dtype("=")[POINT_COLORS[0]].kind == "f"
        colors = np.clip(record.rows.doubles(POINT_COLORS) / (1 if is_float else 255), 0, 1)
    finite = np.isfinite(points).all(1) & np.isfinite(colors).all(1)
    return points[finite], colors[finite]


def _range_problem(record: PlyFile, vertex: Element) -> list[str]:
    """Numbers of a text that their type does not hold: other programs read others there."""
    integers = [one for one in vertex.properties if one.type[0] in "iu"]
    if record.header.format != "ascii" or not integers:
        return []
    values = record.rows.doubles([one.name for one in integers])
    limits = [np.iinfo(one.type) for one in integers]
    low, high = (np.array([getattr(limit, side) for limit in limits], np.float64) for side in ("min", "max"))
    beyond = (values < low) | (values > high)
    if not beyond.any():
        return []
    row, column = (int(index) for index in np.argwhere(beyond)[0])
    what = f"row {row}: {integers[column].name} is {values[row, column]:.6g}"
    limit = f"{limits[column].min} to {limits[column].max}"
    return [f"{int(beyond.sum())} integers beyond their type ({what}, expected {limit}): read as they stand"]


def write_ply(path: Path, splats: Splats) -> None:
    """Write a PLY file: over a PLY source exactly (see above), otherwise in INRIA's property order, little endian.

    Splats of another SH degree than their source's: the f_rest_* lines of its header are replaced (float, in the old
    ones' place), every other property keeps its bytes. `antialiased` and `color_space` are said in a comment where the
    source says otherwise. Raises ValueError when the file cannot be written.
    """
    # Over a PLY file its own layout, whatever that is; else INRIA's.
    source = splats.source
    if source is not None and source.format == "ply" and splats.origin is not None:
        record, old, origin = source.detail, source.splats, splats.origin
    else:
        doubles = splats.offset != positions.NO_OFFSET
        record, old, origin = _standard(splats.sh_degree, doubles), None, np.full(len(splats), -1, np.int64)
    # The old rows as they would be in the new layout, so that shared coefficients compare as unchanged.
    if old is not None and old.sh_degree != splats.sh_degree:
        record = _with_degree(record, splats.sh_degree)
        coefficients = np.zeros((len(old), splats.sh.shape[1], 3), np.float32)
        shared = min(old.sh.shape[1], splats.sh.shape[1])
        coefficients[:, :shared] = old.sh[:, :shared]
        old = replace(old, sh=coefficients)
    header = record.header.with_counts({"vertex": len(splats)})
    header = settled_comments(header, splats, old)
    with files.writing(path) as file:
        file.write(header.raw)
        file.write(record.before)
        for last, block in ahead(_encode(splats, record, old, np.asarray(origin, np.int64))):
            file.write(block[: -len(header.newline)] if last and record.unended else block)
        file.write(record.after)


def columns_of(names: Sequence[str], path: Path, header: Header | None = None) -> dict[str, tuple[str, ...]]:
    """Attribute of `Splats` -> the vertex properties that hold its values, in the attribute's own (C) order.

    Raises ValueError when the properties are not those of Gaussian splats or the f_rest_* do not fit an SH degree.
    """
    present = set(names)
    # Some exporters have colours in place of SH of band 0.
    base = ("f_dc_0", "f_dc_1", "f_dc_2")
    if not present.intersection(base) and present.issuperset(("red", "green", "blue")):
        base = ("red", "green", "blue")
    plan = {
        "means": ("x", "y", "z"),
        "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
        "scales": ("scale_0", "scale_1", "scale_2"),
        "opacities": ("opacity",),
        "sh": base,
    }
    # What kind of file it may be instead is what its owner wants to know.
    missing = [name for required in plan.values() for name in required if name not in present]
    if missing == ["scale_2"]:
        raise ValueError(f"{path}: no scale_2: a file of 2D Gaussians (surfels); expected 3D Gaussians")
    if missing and present.issuperset(f"scalar_{name}" for name in missing):
        raise ValueError(
            f"{path}: its properties are called scalar_{missing[0]} and so on, as CloudCompare saves them; take "
            "scalar_ off the names in its header (LC_ALL=C sed -i 's/^property float scalar_/property float /' FILE)"
        )
    if missing:
        what = "a mesh" if header is not None and header.element("face") else "not a Gaussian splat file"
        listed = ", ".join(missing[:6]) + (", ..." if len(missing) > 6 else "")
        raise ValueError(f"{path}: a PLY file, but {what}: its vertices lack {listed}")
    rest = _rest_count(present, path)
    if rest:
        plan["sh"] += tuple(f"f_rest_{c * (rest // 3) + k}" for k in range(rest // 3) for c in range(3))
    return plan


def comment_settings(comments: Sequence[str]) -> tuple[bool, ColorSpace]:
    """(antialiased, color_space) that header comments ask for: Brush's `SplatRenderMode: mip | default`, Postshot's
    `antialiased [0 | 1]`, our `SplatColorSpace: linear`. The last one of a kind wins, as in Brush."""
    antialiased, space = False, "srgb"
    for comment in comments:
        words = comment.lower().replace(":", " ").replace("=", " ").split()
        if len(words) == 2 and words[0] == "splatrendermode":
            antialiased = words[1] == "mip"
        elif words and words[0] == "antialiased" and len(words) <= 2:
            antialiased = words[1:] in ([], ["1"], ["true"])
        elif words == ["splatcolorspace", "linear"] or words == ["splatcolorspace", "srgb"]:
            space = words[1]
    return antialiased, "linear" if space == "linear" else "srgb"


def settled_comments(header: Header, splats: Splats, old: Splats | None) -> Header:
    """The header with comments for what `splats` says otherwise than the file does (`old`: as decoded, None if new)."""
    if splats.antialiased != (old is not None and old.antialiased):
        header = header.with_comment(MIP_COMMENT if splats.antialiased else PLAIN_COMMENT)
    if splats.color_space != (old.color_space if old is not None else "srgb"):
        header = header.with_comment(SPACE_COMMENT + splats.color_space)
    return header


def _rest_count(names: set[str], path: Path) -> int:
    # A number that fits no degree means that the order of coefficients cannot be known either.
    rest = {name for name in names if re.fullmatch(r"f_rest_[0-9]{1,4}", name)}
    if len(rest) not in DEGREES:
        expected, degree = next(((n, d) for n, d in DEGREES.items() if n >= len(rest)), max(DEGREES.items()))
        raise ValueError(f"{path}: expected {expected} f_rest_* properties for SH degree {degree}, found {len(rest)}")
    gap = next((k for k in range(len(rest)) if f"f_rest_{k}" not in rest), None)
    if gap is not None:
        raise ValueError(f"{path}: expected f_rest_0 to f_rest_{len(rest) - 1}, but f_rest_{gap} is missing")
    return len(rest)


def _read_body(file: BinaryIO, header: Header, vertex: Element, path: Path, lenient: bool) -> tuple[PlyFile, list[str]]:
    # Sizes of what stands ahead tell where the rows begin, sizes behind whether the file was cut off.
    ahead = header.elements[: header.elements.index(vertex)]
    behind = header.elements[len(ahead) + 1 :]
    start = file.tell()
    available = os.fstat(file.fileno()).st_size - start
    problems: list[str] = []
    if header.format == "ascii":
        body = file.read()
        complete = body if not body or body.endswith(header.newline[-1:]) else body + header.newline
        pairs = [(p.name, p.type) for p in vertex.properties]
        rows = text_rows(complete, sum(e.count for e in ahead), vertex.count, pairs, header.newline, path)
        after = body[rows.starts[-1] :]
        end = header.newline[-1:]
        lines = after.count(end) + (after != b"" and not after.endswith(end))
        extra_lines = lines - sum(e.count for e in behind)
        if lines < sum(e.count for e in behind if e.properties):
            _cut_short("what follows element 'vertex' is", lenient, path, problems)
        elif extra_lines > 0 and after.strip():
            problems.append(f"{extra_lines} lines behind the last element (kept as they are)")
        return PlyFile(header, body[: rows.starts[0]], rows, after, len(complete) > len(body) and not after), problems
    # Binary: elements with lists have to be walked through, as only their lengths say how long they are.
    skipped = 0
    for element in ahead:
        file.seek(start + skipped)
        skipped += element_size(file, header, element, available - skipped, path)
    size = element_size(file, header, vertex, available - skipped, path)
    file.seek(start)
    before = file.read(skipped)
    # In memory of its own: aligned, and safe when this very file is later replaced by a save.
    records = files.read_array(file, vertex.dtype(header.order), vertex.count)
    # All rows are there. What is cut off behind them may be forgiven.
    rest = available - skipped - size
    for element in behind:
        try:
            file.seek(start + available - rest)
            rest -= element_size(file, header, element, rest, path)
        except ValueError:
            _cut_short(f"element '{files.printable(element.name)}' is", lenient, path, problems)
            rest = 0
            break
    if rest:
        problems.append(f"{rest} trailing bytes (kept as they are)")
    file.seek(start + skipped + size)
    return PlyFile(header, before, BinaryRows(records, header.order), file.read()), problems


def _cut_short(what: str, lenient: bool, path: Path, problems: list[str]) -> None:
    if not lenient:
        raise ValueError(
            f"{path}: truncated: {what} cut short; all rows are there (--lenient, or lenient=True, opens it anyway)"
        )
    problems.append(f"{what} cut short (kept as it is)")


def _named(names: Sequence[str]) -> str:
    return ", ".join(files.printable(name, 40) for name in names[:8])


def _pieces(record: PlyFile) -> list[bytes | memoryview]:
    """The bytes of the file, one piece after the other."""
    stored = record.rows.stored()
    stored = stored[: -len(record.header.newline)] if record.unended else stored
    return [record.header.raw, record.before, stored, record.after]


def _sha256(record: PlyFile) -> str:
    digest = hashlib.sha256()
    for piece in _pieces(record):
        digest.update(piece)
    return digest.hexdigest()


def is_copy(record: PlyFile, path: Path) -> bool:
    """Whether a file holds the very bytes of the one that this was read from. Raises ValueError: it cannot be read."""
    return files.holds(path, _pieces(record))


def _decode(record: PlyFile, plan: Mapping[str, tuple[str, ...]], offset: positions.Offset | None) -> Splats:
    # Positions that float32 cannot hold are read again as doubles, relative to a point amid them.
    rows, span = record.rows, record.color_span
    values = _activated(rows, plan)
    scales = values["scales"]
    if offset is None:
        coarse = positions.is_coarse(values["means"], scales)
        offset = positions.offset_of(rows.doubles(plan["means"]), scales) if coarse else positions.NO_OFFSET
    if offset != positions.NO_OFFSET:
        values["means"] = positions.relative(rows.doubles(plan["means"]), offset)
    sh = values["sh"]
    if span is not None:
        sh[:, :3] = activations.color_to_dc(sh[:, :3] / np.float32(span))
    antialiased, space = comment_settings(record.header.comments)
    return Splats(
        means=values["means"],
        quats=values["quats"],
        scales=scales,
        opacities=values["opacities"],
        sh=sh.reshape(len(rows), len(plan["sh"]) // 3, 3),
        antialiased=antialiased,
        color_space=space,
        offset=offset,
    )


def _activated(rows: Rows, plan: Mapping[str, tuple[str, ...]]) -> dict[str, np.ndarray]:
    """Attribute -> values of the rows: scales and opacities activated, the others as the file has them."""
    if not isinstance(rows, BinaryRows) or (matrix := rows.floats()) is None:
        values = rows.columns(plan)
        scales, opacities = activations.exp(values["scales"]), activations.sigmoid(values["opacities"][:, 0])
        return values | {"scales": scales, "opacities": opacities}
    # As nearly every file is: all of a row while it is at hand.
    out = {name: np.empty((len(rows), len(names)), np.float32) for name, names in plan.items()}
    out["opacities"] = out["opacities"][:, 0]
    bits = [out[name] if name in ("scales", "opacities") else out[name].view(np.uint32) for name in ATTRIBUTES]
    run(kernels.unpack_ply_rows, row_bits(matrix), rows.column_numbers(_in_order(plan)), *bits)
    return out


def _in_order(plan: Mapping[str, tuple[str, ...]]) -> list[str]:
    """The properties of a plan, attribute by attribute."""
    return [name for attribute in ATTRIBUTES for name in plan[attribute]]


def _rounding_problem(record: PlyFile, splats: Splats) -> list[str]:
    """A line about Gaussians that lie so far from the others that their positions, finer in the file, are rounded."""
    stored = stored_positions(record) if record.header.format != "ascii" else None
    if stored is None:
        return []
    with np.errstate(all="ignore"):
        apart = splats.world_means - stored
        moves = np.sqrt((apart * apart).sum(1)) / row_max(splats.scales)
    moves = moves[np.isfinite(moves)]  # other rows are not drawn
    far = int((moves > 1).sum())
    if not far:
        return []
    most = float(moves.max())
    return [
        f"{far} Gaussians lie so far from the others that float32 rounds their positions by up to {most:.2g} sizes of "
        "a Gaussian (the file keeps its own numbers where they are not edited)"
    ]


def stored_positions(record: PlyFile) -> Floats | None:
    """[N, 3] float64 positions as the file has them, where its numbers may be finer than float32; else None."""
    vertex = record.header.element("vertex")
    kinds = {p.name: p.type for p in vertex.properties} if vertex is not None else {}
    if record.header.format != "ascii" and all(kinds[name] in FLOAT32_HOLDS for name in "xyz"):
        return None
    return record.rows.doubles("xyz")


def _encode(
    splats: Splats, record: PlyFile, old: Splats | None, origin: np.ndarray
) -> Iterator[tuple[bool, memoryview]]:
    """(is it the last block, bytes) for BLOCK_ROWS rows at a time; the bytes of the block before the last one may be
    others by then."""
    vertex = record.header.element("vertex")
    assert vertex is not None
    plan = columns_of(vertex.names, Path("source"))
    span = record.color_span
    if len(splats) and old is None and span is None and splats.offset == positions.NO_OFFSET:
        yield from _encode_new(splats, plan, record.rows)
        return
    # Block by block: first the bytes that rows have from the source, then over them the values that changed.
    before = splats if old is None else old  # without old rows none of them is asked for
    arrays, old_arrays = (
        {name: getattr(all_rows, name).reshape(-1, len(names)) for name, names in plan.items()}
        for all_rows in (splats, before)
    )
    same = {name for name in plan if getattr(before, name) is getattr(splats, name)}
    for start in range(0, len(splats), BLOCK_ROWS):
        rows = origin[start : start + BLOCK_ROWS]
        run_of_rows = as_slice(rows)
        block = record.rows.block(rows if run_of_rows is None else run_of_rows)
        for attribute, names in plan.items():
            if attribute in same and run_of_rows is not None and run_of_rows.start == start:
                continue
            new, olds = arrays[attribute][start : start + BLOCK_ROWS], old_arrays[attribute]
            if _is_stored_as_it_is(attribute, splats, span) and block.put_floats(names, new, olds, rows):
                continue
            # Single values, not rows: of a row that was recoloured the position keeps its bytes.
            ids, changed = _changed(new, olds, rows, run_of_rows)
            for k in np.flatnonzero(changed.any(0)):
                where = ids[changed[:, k]]
                values = _to_file(attribute, new[where, k], span if k < 3 else None)
                if attribute == "means" and splats.offset[k]:
                    values = values.astype(np.float64) + splats.offset[k]
                block.put(names[k], where, values)
        yield start + BLOCK_ROWS >= len(splats), block.stored()


def _changed(new: np.ndarray, before: np.ndarray, rows: np.ndarray, run_of_rows: slice | None) -> tuple[Ids, Bools]:
    """([A] ids of rows of `new` ([M, K]), [A, K] which of their values are not those of the rows of `before` ([N, K])
    that they come from): all that differ. rows: [M] int64, -1 for none; run_of_rows: the same as a slice, if one."""
    if run_of_rows is not None:
        before = before[run_of_rows]
        ids = np.flatnonzero(differing(before, new))
        return ids, differs(new[ids], before[ids])
    changed, has_source = np.ones(new.shape, bool), rows >= 0
    changed[has_source] = differs(new[has_source], before[rows[has_source]])
    return np.arange(len(new)), changed


def _encode_new(splats: Splats, plan: Mapping[str, tuple[str, ...]], layout: Rows) -> Iterator[tuple[bool, memoryview]]:
    """The same of Gaussians of no file, in float properties."""
    assert isinstance(layout, BinaryRows)
    columns, width = layout.column_numbers(_in_order(plan)), len(layout.records.dtype.names or ())
    buffers = [np.zeros((min(len(splats), NEW_BLOCK_ROWS), width), np.uint32) for _ in range(2)]
    limits = (activations.MIN_SCALE, activations.MIN_OPACITY, activations.MAX_OPACITY)

    for start in range(0, len(splats), NEW_BLOCK_ROWS):
        rows = slice(start, start + NEW_BLOCK_ROWS)
        means, quats, scales, opacities, sh = (readonly(getattr(splats, name)[rows], np.float32) for name in ATTRIBUTES)
        colors = sh.reshape(len(sh), sh.shape[1] * sh.shape[2])
        records = buffers[start // NEW_BLOCK_ROWS % 2][: len(means)]
        bits = means.view(np.uint32), quats.view(np.uint32), scales, opacities, colors.view(np.uint32)
        run(kernels.pack_ply_rows, *bits, columns, *limits, records)
        yield rows.stop >= len(splats), records.view(np.uint8).data


def _is_stored_as_it_is(attribute: str, splats: Splats, span: float | None) -> bool:
    """Whether a file of floats holds the very bits of an attribute."""
    if attribute == "means":
        return not any(splats.offset)
    return attribute == "quats" or (attribute == "sh" and span is None)


def _to_file(attribute: str, values: np.ndarray, span: float | None) -> np.ndarray:
    if attribute == "scales":
        return activations.log(values)
    if attribute == "opacities":
        return activations.logit(values)
    if attribute == "sh" and span is not None:
        return activations.dc_to_color(values) * np.float32(span)
    return values


def _color_span(rows: Rows, names: Sequence[str], vertex: Element) -> float | None:
    """What full red is in the file, where colours stand in for f_dc_*; None where they do not.

    By the type of the property: 1 of floats, the largest number of integers. But writers store bytes in wider types:
    where the largest colour says so, it is 255."""
    if names[0] != "red":
        return None
    # A byte can only mean 255; of wider types the values tell.
    code = next(p.type for p in vertex.properties if p.name == "red")
    if code == "u1":
        return 255.0
    with np.errstate(invalid="ignore"):
        colors = rows.columns({"sh": names[:3]})["sh"]
        most = float(np.nanmax(colors, initial=0.0)) if len(colors) else 0.0
    if code[0] == "f":
        return 255.0 if MIN_BYTE_COLOR < most <= 255 else 1.0
    span = float(np.iinfo(code).max)
    return 255.0 if span > 255 and 1 < most <= 255 else span


def _standard(degree: int, doubles: bool = False) -> PlyFile:
    """INRIA's own layout, without rows. doubles: of positions, which float32 cannot hold."""
    # INRIA's layout has normals, which hold zeros.
    rest = 3 * (degree + 1) ** 2 - 3
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(rest))]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    kinds = [("double" if doubles and name in ("x", "y", "z") else "float", name) for name in names]
    header = make_header("binary_little_endian", (), [("vertex", 0, kinds)])
    return PlyFile(header, b"", BinaryRows(np.zeros(0, header.elements[0].dtype("<")), "<"), b"")


def _with_degree(record: PlyFile, degree: int) -> PlyFile:
    """The same file with f_rest_* for another SH degree: shared coefficients keep their bits, new ones are zero."""
    vertex = record.header.element("vertex")
    assert vertex is not None
    # Everything but f_rest_* keeps its place among the others.
    old = sorted((n for n in vertex.names if re.fullmatch(r"f_rest_[0-9]{1,4}", n)), key=lambda n: int(n[7:]))
    old_bands, new_bands = len(old) // 3, (degree + 1) ** 2 - 1
    remaining = [n for n in vertex.names if n not in old]
    first = vertex.names.index(old[0]) if old else None
    # Behind f_dc_2 where there were none; all together where the first one stood.
    position = len([n for n in vertex.names[:first] if n not in old]) if old else _after_base(remaining)
    names: list[tuple[str, str, str | None]] = [
        (p.name, p.type, p.name) for p in vertex.properties if p.name in remaining
    ]
    rest: list[tuple[str, str, str | None]] = [
        (f"f_rest_{c * new_bands + k}", "f4", f"f_rest_{c * old_bands + k}" if k < old_bands else None)
        for c in range(3)
        for k in range(new_bands)
    ]
    header = record.header.with_properties(
        "vertex", old, [("float", name) for name, _, _ in rest], remaining[position - 1] if position else None
    )
    return replace(record, header=header, rows=record.rows.relayout(names[:position] + rest + names[position:]))


def _after_base(names: Sequence[str]) -> int:
    return names.index("f_dc_2") + 1 if "f_dc_2" in names else len(names)
