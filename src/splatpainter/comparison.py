"""Two assets, part by part: rows as they are stored, and everything else that their files hold.

Knows no receipt: what may differ is judged there. Files of one format are compared as they are stored (io/contents.py),
rows also by value, because a value may lie in two places (a word and the range or codebook that it refers to).
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import FORMATS, option, read, write
from splatpainter.io.contents import Contents, contents, fields_differ, rows_differ
from splatpainter.io.formats.ply_rows import TextRows
from splatpainter.io.write_options import AS_IT_IS, WriteOptions
from splatpainter.order_statistics import distinct, without
from splatpainter.splats import Source, Splats, changed_rows
from splatpainter.system.quick_dataclass import dataclass

CHUNK_ROWS = 256
"""Rows that share a row of a table that follows the rows."""
MAX_NAMES, MAX_LINES = 8, 6
"""Names in a line, and lines about one part."""
STORED = "every byte of every stored row"
VALUES = "every value of every row, bit for bit"
STORED_AND_VALUES = "every stored byte and every value of every row"


@dataclass(frozen=True)
class Comparison:
    """Two assets, in the edited one's own format."""

    original_sha256: str
    before: Splats = field(repr=False)
    """The original, as its rows are in the format of the edited file."""
    after: Splats = field(repr=False)
    differs: np.ndarray = field(repr=False)
    """[D] int64 ascending rows of `before` that `after` does not hold unchanged at their places."""
    exact: str
    """How the rows were compared."""
    problems: tuple[str, ...] = ()
    """What differs besides rows, one line each: no edit changes it."""
    unexpected_fields: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    """Stored properties that are no Gaussian's value, and do differ -> [D] rows."""
    differences: tuple[str, ...] = ()
    """Stored properties in which rows differ, one line."""
    compared: tuple[str, ...] = ()
    not_compared: tuple[str, ...] = ()


def compare(original: Splats, edited: Splats, options: WriteOptions = AS_IT_IS) -> Comparison:
    """Compare two assets; `edited` as it was read from its file, written with `options`. Where the original is of no
    file, or of one that differs from the edited one by more than rows, only rows are compared, in the edited one's
    format."""
    assert edited.source is not None
    if (
        original.source is None
        or original.source.format != edited.source.format
        or original.source.axes != edited.source.axes
        or options != AS_IT_IS
    ):
        return _compare_converted(original, edited, options)
    # Bytes of rows can be compared where both are stored in the same layout, else decoded values.
    old, new = contents(original.source), contents(edited.source)
    exact, stored = VALUES, old is not None and new is not None and same_layout(old, new)
    unexpected: dict[str, np.ndarray] = {}
    names: list[str] = []
    if old is not None and new is not None and stored:
        plain = edited.source.format in ("ply", "splat")  # a value lies in one place: equal bytes are equal values
        exact = STORED if plain else STORED_AND_VALUES
        by_value = np.zeros(0, np.int64) if plain else changed_rows(original, edited)
        rows, names, unexpected = _stored_rows(old, new, by_value)
    else:
        rows = changed_rows(original, edited)
    # Besides rows: whatever the two files hold that no edit changes.
    missing = len(edited) < len(original)
    problems, compared = _other_parts(original.source, edited.source, old, new, rows)
    unseen = tuple(filter(None, [new.unseen if new is not None else "header, sections and padding"]))
    if not stored and new is not None and new.tables:
        unseen += ("the stored bytes of the rows, whose layout differs",)
    # Equal in all that was compared, and still other files: something lies where nobody looked, and that must be said.
    nothing = not (problems or unexpected or len(rows) or missing) and len(edited) == len(original)
    if nothing and original.source.sha256 != edited.source.sha256:
        problems.append(f"the files differ in bytes that are not compared: {'; '.join(unseen) or 'unknown'}")
    if missing:
        rows = np.arange(len(original))
    differences = (f"changed rows differ in {_some(names)}",) if names else ()
    return Comparison(
        original.sha256, original, edited, rows, exact, tuple(problems), unexpected, differences, compared, unseen
    )


def same_layout(old: Contents, new: Contents) -> bool:
    """Whether rows are stored alike, so that their bytes can be compared."""

    def layout(part: Contents) -> list[Any]:
        kinds = [None if isinstance(t.records, TextRows) else t.records.dtype for t in part.tables]
        return [part.settings.get("format"), kinds, [t.fields for t in part.tables]]

    return bool(old.tables) and layout(old) == layout(new)


def listed(rows: np.ndarray) -> str:
    """The first of these row numbers, as text."""
    return ", ".join(map(str, rows[:5].tolist())) + (", ..." if len(rows) > 5 else "")


def _compare_converted(original: Splats, edited: Splats, options: WriteOptions) -> Comparison:
    """Rows alone: another format, a copy turned to other axes, or one with options has other headers and elements."""
    assert edited.source is not None
    key, source = edited.source.format, original.source
    # The original is written as the edited one is, so that what the format rounds is rounded on both sides.
    before = _converted(original, edited, options)
    turned = source is not None and source.format == key and source.axes != edited.source.axes
    words = [f"the original converted to {key}", "of the same axes" if turned else ""]
    words.append("with the same options" if options != AS_IT_IS else "")
    how = " ".join(filter(None, words)) + ", then "
    assert before.source is not None
    differing = "axes" if turned else "formats" if source is None or source.format != key else "options"
    unseen = (f"header, other elements and trailing bytes, as the {differing} differ",)
    if len(edited) < len(before):
        return Comparison(original.sha256, before, edited, np.arange(len(before)), how + VALUES, not_compared=unseen)
    old, new = contents(before.source), contents(edited.source)
    plain = key in ("ply", "splat") and old is not None and new is not None and same_layout(old, new)
    plain = plain and before.source.flips == edited.source.flips
    if plain and old is not None and new is not None:
        rows = _stored_rows(old, new, np.zeros(0, np.int64))[0]
    else:
        rows = changed_rows(before, edited)
    exact = STORED if plain else VALUES
    return Comparison(original.sha256, before, edited, rows, how + exact, not_compared=unseen)


def _converted(before: Splats, after: Splats, options: WriteOptions) -> Splats:
    """`before` as its rows would be in the format of `after`. Raises ValueError, naming the file, where it cannot
    hold them."""
    assert after.source is not None
    entry = FORMATS[after.source.format]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("converted" + (entry.suffixes[0] if entry.suffixes else ""))
        # Words are rounded in the axes of the edited file: -1 and 1 are not rounded alike.
        axes = option(after.source.axes)
        try:
            write(path, before, axes=axes, options=options)
        except ValueError as error:
            reason = str(error).removeprefix(f"{path}: ").partition("; write ")[0]
            name = before.source.path if before.source is not None else "the original"
            raise ValueError(
                f"{name}: cannot be compared with {after.source.path} as {after.source.format}: {reason}"
            ) from None
        return read(path, axes=axes, offset=after.offset)


def _stored_rows(
    old: Contents, new: Contents, by_value: np.ndarray
) -> tuple[np.ndarray, list[str], dict[str, np.ndarray]]:
    """(rows that differ as stored or by value, names of the properties of Gaussians in which they do, other properties
    that differ with their rows)."""
    rows, names, unexpected = by_value, [], {}
    # Several tables: a SOG or glTF file keeps the attributes of a row in different places.
    for one, two in zip(old.tables, new.tables, strict=True):
        if one.first != two.first:  # of another row: values tell
            continue
        differing = rows_differ(one, two, min(len(one), len(two)))
        rows = distinct(np.concatenate([rows, one.first + differing]))
        for name, where in fields_differ(one, two, differing).items():
            if name in one.edited:
                names.append(name)
            else:
                unexpected[name] = one.first + where
    return rows, names, unexpected


def _other_parts(
    original: Source, edited: Source, old: Contents | None, new: Contents | None, rows: np.ndarray
) -> tuple[list[str], tuple[str, ...]]:
    """(what differs besides the rows' values, what was compared)."""
    if old is None or new is None:
        return [], ()
    problems = _layout_problems(old, new)
    for name in [*old.settings, *(key for key in new.settings if key not in old.settings)]:
        problems += _setting_problems(name, old.settings.get(name), new.settings.get(name))
    for name in [*old.blocks, *(key for key in new.blocks if key not in old.blocks)]:
        problems += _block_problems(name, old.blocks.get(name), new.blocks.get(name))
    for name, table in old.follows_rows.items():
        problems += _chunk_problems(name, table, new.follows_rows[name], rows, len(original.splats), len(edited.splats))
    compared = tuple(filter(None, [", ".join(old.settings), ", ".join(old.blocks), ", ".join(old.follows_rows)]))
    return problems, compared


def _layout_problems(old: Contents, new: Contents) -> list[str]:
    """Properties that were dropped, added, retyped or put in another order."""
    before, after = (dict(f for t in part.tables for f in t.fields) for part in (old, new))
    out = []
    if dropped := [name for name in before if name not in after]:
        out.append(f"dropped properties: {_some(dropped)}")
    if added := [name for name in after if name not in before]:
        out.append(f"added properties: {_some(added)}")
    if retyped := [f"{n} from {before[n]} to {after[n]}" for n in before if n in after and before[n] != after[n]]:
        out.append(f"retyped properties: {_some(retyped)}")
    if [name for name in before if name in after] != [name for name in after if name in before]:
        out.append("the properties stand in another order")
    return out


def _setting_problems(name: str, before: Any, after: Any) -> list[str]:
    if before == after:
        return []
    if isinstance(before, tuple) and isinstance(after, tuple):
        missing, new = _without(before, after), _without(after, before)
        lines = [f"{name}: {_quoted(line)} is missing" for line in missing] + [
            f"{name}: {_quoted(line)} is new" for line in new
        ]
        return lines[:MAX_LINES] or [f"{name}: its lines stand in another order"]
    if name in ("JSON", "meta.json") and isinstance(before, str) and isinstance(after, str):
        return [f"{name} differs at {_json_path(json.loads(before), json.loads(after))}"]
    return [f"{name}: {_quoted(before)} became {_quoted(after)}"]


def _block_problems(name: str, before: bytes | None, after: bytes | None) -> list[str]:
    if before == after or (not before and not after):
        return []
    if before is None or after is None or len(before) != len(after):
        return [f"{_quoted(name)[1:-1]}: {len(before or b'')} bytes became {len(after or b'')}"]
    at = next(k for k, (a, b) in enumerate(zip(before, after, strict=True)) if a != b)
    return [f"{_quoted(name)[1:-1]} differs at its byte {at}"]


def _chunk_problems(
    name: str, old: np.ndarray, new: np.ndarray, rows: np.ndarray, before: int, after: int
) -> list[str]:
    """Chunks that differ although none of their rows does and none was appended to them."""
    count = min(len(old), len(new))
    if old.shape[1] != new.shape[1]:
        return [f"{name}: {old.shape[1]} bytes a row became {new.shape[1]}"]
    # Extremes of a chunk follow its rows. They may change where one of its rows did, or where rows were appended to it.
    differing = np.flatnonzero((old[:count] != new[:count]).any(1))
    moved = np.append(distinct(rows // CHUNK_ROWS), [before // CHUNK_ROWS] if after != before else [])
    unexpected = without(differing, moved)
    return (
        [f"{name}: its rows {listed(unexpected)} differ although no Gaussian of them does"] if len(unexpected) else []
    )


def _without(lines: tuple[str, ...], excluded: tuple[str, ...]) -> list[str]:
    rest = list(excluded)
    out = []
    for line in lines:
        if line in rest:
            rest.remove(line)
        else:
            out.append(line)
    return out


def _json_path(before: Any, after: Any, where: str = "") -> str:
    """The first place at which two trees differ, and how."""
    if isinstance(before, dict) and isinstance(after, dict):
        # In order of names, as writers of JSON may shuffle keys; the first place alone is told.
        for key in sorted({*before, *after}):
            if key not in before or key not in after:
                return f"{where}.{_quoted(key)[1:-1]} ({'new' if key not in before else 'missing'})"[:200]
            if before[key] != after[key]:
                return _json_path(before[key], after[key], f"{where}.{_quoted(key)[1:-1]}")
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for k, (one, two) in enumerate(zip(before, after, strict=True)):
            if one != two:
                return _json_path(one, two, f"{where}[{k}]")
    return f"{where[:200] or 'its root'} ({_quoted(before)} became {_quoted(after)})"


def _quoted(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _some(names: list[str]) -> str:
    text = ", ".join(_quoted(name)[1:-1] for name in names[:MAX_NAMES])
    return text + (f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else "")
