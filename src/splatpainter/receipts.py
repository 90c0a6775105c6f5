"""Receipts: which rows an edit changed, and the proof that it changed no other. Knows no renderer and no network.

A row is untouched when every attribute has the same bits as before. Files prove it by being read again, before they
take the place of anything (`prove`) or at any time later: `verify` compares two files part by part (comparison.py), and
their rows against the receipt where there is one.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.comparison import Comparison, compare, listed
from splatpainter.io import (
    FORMATS,
    axes_are_news,
    axes_line,
    files,
    format_of_name,
    option,
    read,
    written_axes,
)
from splatpainter.io.losses import loss_line, measure
from splatpainter.io.write_options import AS_IT_IS, WriteOptions
from splatpainter.kernels import library
from splatpainter.kernels.arrays import set_pixels
from splatpainter.kernels.parallel import beside
from splatpainter.kernels.row_bits import differing
from splatpainter.order_statistics import without
from splatpainter.splats import ATTRIBUTES, Axes, Splats, row_blocks, rows_sha256
from splatpainter.system.old_names import formerly, formerly_called
from splatpainter.system.quick_dataclass import dataclass

MAX_RECEIPT_BYTES = 256 << 20
"""Bytes of a receipt that are read."""
MAX_RECEIPT_ROWS = 1 << 27
"""Rows of an asset that a receipt may speak of."""

MAX_CARRIED, MAX_CARRIED_CHARACTERS, MAX_CARRIED_DEPTH = 100, 4000, 10
"""Entries of a list or an object, and characters of a text, that say where an edit's pictures came from."""


@dataclass(frozen=True)
class ViewScore:
    """How one edited view fared, in dB (PSNR over 8-bit-range colours 0..1; None where there is no such pixel)."""

    psnr_before: float | None
    """Render before against the edited view, inside the mask (where the asset covers the pixel: alpha > 0.5)."""
    psnr_after: float | None
    """Render after against the edited view, inside the mask."""
    psnr_outside: float | None
    """Render after against render before, outside of what this picture and the others of the edit paint there."""


@dataclass(frozen=True)
class Pixelation:
    """What a receipt claims of rows that were made unreadable (operations/pixelate.py), and `verify` checks in the
    file: SH above degree 0 is zero, and there are so few colours, or places."""

    rows: np.ndarray = field(repr=False)
    """[P] int64 ascending."""
    cells: int
    colors: int
    """How many different colours they have."""
    style: str
    """cells: no more colours than cells; blur: colours that run between those of cells."""
    size: float
    """Edge of a cell, world units."""
    inner: int
    """How many of the rows are hidden ones behind the region."""
    merged: bool
    """Whether all rows of a cell are at one place, of one size."""

    def record(self) -> dict[str, Any]:
        """JSON object, without the rows."""
        names = ("cells", "colors", "style", "size", "inner", "merged")
        return {**{name: getattr(self, name) for name in names}, "rows": len(self.rows)}

    def problems(self, splats: Splats) -> list[str]:
        """What of it does not hold of a file, one line each."""
        lines = []
        sh = splats.sh[self.rows]
        if (sh[:, 1:] != 0).any():
            lines.append(f"SH above degree 0 is not cleared in {int((sh[:, 1:] != 0).any((1, 2)).sum())} rows")
        colors = len(np.unique(sh[:, 0], axis=0))
        if colors > self.colors:
            lines.append(f"{len(self.rows)} pixelated rows have {colors} colours, the receipt says {self.colors}")
        positions = len(np.unique(splats.means[self.rows], axis=0)) if self.merged else 0
        if positions > self.cells:
            lines.append(f"{len(self.rows)} merged rows are at {positions} places, the receipt says {self.cells}")
        return lines


@dataclass(frozen=True)
class Receipt:
    """What an edit did. `to_json` is the object that is written."""

    asset_sha256: str
    asset_rows: int
    output_sha256: str
    output_rows: int
    mode: str
    method: str
    preset: str
    touched: np.ndarray = field(repr=False)
    """[T] int64 ascending rows of the asset whose values changed; they keep their places."""
    appended_rows: int
    """New rows, all at the end."""
    untouched_sha256_before: str
    """Hash of the attributes of all rows but the touched ones, before (splats.rows_sha256)."""
    untouched_sha256_after: str
    views: tuple[ViewScore, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    note: str = ""
    """One line about how the method was chosen, or what the format cannot hold."""
    replaced: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    """[R] int64 ascending, part of `touched`: rows whose places Gaussians of a sheet took."""
    removed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    """[E] int64 ascending, part of `touched`: rows that were emptied: of opacity 0, or of the smallest that a format
    holds."""
    aside: tuple[tuple[float | None, float], ...] = ()
    """Per view of a local edit, where asked for: (PSNR in dB of the edit seen from the side, against the picture moved
    there over the surface; None where nothing can be compared, share 0..1 of the paint that was)."""
    limited_px: tuple[float, ...] = ()
    """Per view, edited pixels' worth of paint that its limits left out."""
    precision: str = ""
    """Arithmetic of the networks, "float32" or "bfloat16" (nn.precision); "" where none ran, and not in the JSON."""
    dropped: dict[str, Any] | None = None
    """Where hidden Gaussians were left out for good: of the original, asset (its SHA-256), rows (how many it had), and
    left_out (how many are gone), and appended_left_out. `asset_rows` are then those that remain, renumbered."""
    source: dict[str, Any] | None = None
    """For an edit by a picture source (source_edits/edit.py): its name, prompt and strictness, and per view its model,
    seed, cost, SHA-256 of the pictures sent and received, and what was corrected. None: pictures were given."""

    merge: dict[str, Any] | None = None
    """For an asset that several files were merged into, and of its edits: sources, one object per file (name, sha256,
    format, rows, first: the row that it begins at, placement, seam), and notes (scene/merge.py)."""
    merge_touched: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    """[M] int64 ascending: rows that edits of the merged asset touched before this one."""
    options: WriteOptions = AS_IT_IS
    """What the file was to hold less or otherwise than the asset; it is compared with the original written so."""
    core: str = ""
    """Version of the native core that computed it (kernels.library.version); "" in older receipts."""
    pixelation: Pixelation | None = None
    """What is claimed of rows that were made unreadable; None: none were, or another operation changed some later."""
    operations: tuple[dict[str, Any], ...] = ()
    """Where several operations were applied one after the other, each: its kind and what its receipt said (mode,
    method, preset, touched_rows, appended_rows, note, source). None: the receipt is of one."""

    @property
    def untouched_rows(self) -> int:
        return self.asset_rows - len(self.touched)

    def summary(self) -> dict[str, Any]:
        """What `to_json` writes, without the rows."""
        record = {
            "asset": {"sha256": self.asset_sha256, "rows": self.asset_rows},
            "output": {"sha256": self.output_sha256, "rows": self.output_rows},
            "mode": self.mode,
            "method": self.method,
            "preset": self.preset,
            "touched_rows": len(self.touched),
            "appended_rows": self.appended_rows,
            "replaced_rows": len(self.replaced),
            "removed_rows": len(self.removed),
            "untouched_sha256_before": self.untouched_sha256_before,
            "untouched_sha256_after": self.untouched_sha256_after,
            "views": [{k: _finite(v) for k, v in asdict(view).items()} for view in self.views],
            "seconds": {k: round(v, 4) for k, v in self.seconds.items()},
            "note": self.note,
        }
        # What an edit has nothing to say of is left out: receipts of the same edit stay the same text while fields are
        # added for others.
        if self.aside:
            record["aside"] = [{"psnr": _finite(psnr), "covered": round(share, 3)} for psnr, share in self.aside]
        if any(self.limited_px):
            record["limited_px"] = list(self.limited_px)
        if self.precision:
            record["precision"] = self.precision
        if self.core:
            record["core"] = self.core
        if self.dropped is not None:
            record["dropped"] = self.dropped
        if self.source is not None:
            record["source"] = self.source
        if self.pixelation is not None:
            record["pixelation"] = self.pixelation.record()
        if self.operations:
            record["operations"] = list(self.operations)
        if self.options != AS_IT_IS:
            record["options"] = self.options.chosen
        if self.merge is not None:
            record["merge"] = self.merge
            if len(self.merge_touched):
                record["merge_touched_rows"] = len(self.merge_touched)
        return record

    def to_json(self) -> str:
        """Indented JSON; `touched_runs` are [first, count] runs of touched rows."""
        record = self.summary()
        # Rows go in by hand, in one line each: indented, every number of a million rows would have a line of its own.
        text = json.dumps(record, indent=2).removesuffix("\n}")
        for name in ("touched", "replaced", "removed", "merge_touched"):
            rows = getattr(self, name)
            if name == "touched" or len(rows):
                runs = json.dumps(to_runs(rows).tolist(), separators=(",", ":"))
                text += f',\n  "{name}_runs": {runs}'
        if self.pixelation is not None:
            runs = json.dumps(to_runs(self.pixelation.rows).tolist(), separators=(",", ":"))
            text += f',\n  "pixelated_runs": {runs}'
        return text + "\n}\n"

    @staticmethod
    def from_json(text: str, where: str = "receipt") -> Receipt:
        """Parse `to_json`. Raises ValueError naming `where` and what is wrong."""
        try:
            data: dict[str, Any] = json.loads(text)
            # Nothing here is believed: a receipt may come from anybody, and its texts are printed, its rows become
            # memory.
            touched, replaced, removed = (_rows(data, name) for name in ("touched", "replaced", "removed"))
            if not (np.isin(replaced, touched).all() and np.isin(removed, touched).all()):
                raise ValueError("replaced or removed rows are not among the touched ones")
            return Receipt(
                _text(data["asset"]["sha256"]),
                int(data["asset"]["rows"]),
                _text(data["output"]["sha256"]),
                int(data["output"]["rows"]),
                _text(data["mode"]),
                _text(data["method"]),
                _text(data["preset"]),
                touched,
                int(data["appended_rows"]),
                _text(data["untouched_sha256_before"]),
                _text(data["untouched_sha256_after"]),
                tuple(ViewScore(**{k: _number(v, none=True) for k, v in view.items()}) for view in data["views"]),
                {_text(name): _number(value) for name, value in dict(data["seconds"]).items()},
                _text(data.get("note", ""), 4000),
                replaced,
                removed,
                tuple((_number(s["psnr"], none=True), _number(s["covered"])) for s in data.get("aside", ())),
                tuple(float(_number(value)) for value in data.get("limited_px", ())),
                _text(data.get("precision", "")),
                None if data.get("dropped") is None else dict(_plain(data["dropped"])),
                None if data.get("source") is None else dict(_plain(data["source"])),
                None if data.get("merge") is None else dict(_plain(data["merge"])),
                _rows(data, "merge_touched"),
                WriteOptions.from_record(dict(data.get("options", {}))),
                _text(data.get("core", "")),
                _pixelation(data),
                tuple(dict(_plain(operation)) for operation in data.get("operations", ())),
            )
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            # What a parser says of bad JSON is a sentence; KeyError and others are only understood with their names.
            reason = " ".join((str(error) if isinstance(error, ValueError) else repr(error)).split())
            raise ValueError(f"{where}: expected a receipt of splatpainter, as JSON ({reason[:300]})") from None


def read_receipt(path: Path) -> Receipt:
    """Raises ValueError: missing, unreadable, not a receipt."""
    data = files.read_head(path, MAX_RECEIPT_BYTES)
    return Receipt.from_json(data.decode(errors="replace"), str(path))


def _rows(data: dict[str, Any], name: str) -> np.ndarray:
    """[T] int64 the rows of a receipt's list; none where an older receipt has no such list. Raises ValueError."""
    count = int(data.get(f"{name}_rows", 0))
    runs = data["touched_runs"] if name == "touched" else data.get(f"{name}_runs", [])
    # Rows of earlier edits of a merged asset may be appended ones, which the asset itself does not have.
    total = data["output" if name == "merge_touched" else "asset"]["rows"]
    rows = from_runs(np.array(runs, np.int64).reshape(-1, 2), int(total))
    if len(rows) != count:
        raise ValueError(f"{name}_rows is {count}, its runs hold {len(rows)}")
    return rows


def _pixelation(data: dict[str, Any]) -> Pixelation | None:
    """What a receipt claims of pixelated rows. Raises ValueError."""
    record = data.get("pixelation")
    if record is None:
        return None
    rows = from_runs(np.array(data.get("pixelated_runs", []), np.int64).reshape(-1, 2), int(data["output"]["rows"]))
    if len(rows) != int(record["rows"]):
        raise ValueError(f"pixelation has {record['rows']} rows, its runs hold {len(rows)}")
    numbers = (int(record["cells"]), int(record["colors"]), _text(record["style"]), float(_number(record["size"])))
    return Pixelation(rows, *numbers, int(record["inner"]), bool(record["merged"]))


def _text(value: Any, max_length: int = 200) -> str:
    """A value of a receipt that is printed some time: one line. Raises ValueError."""
    text = str(value) if isinstance(value, str | int) else ""
    if not text.isprintable() or len(text) > max_length or not isinstance(value, str | int):
        raise ValueError(f"expected a line of text, got {repr(value)[:80]}")
    return text


def _plain(value: Any, depth: int = MAX_CARRIED_DEPTH) -> Any:
    """A value of JSON that is only carried along: finite, and no longer or deeper than receipts need. Raises
    ValueError."""
    if depth and isinstance(value, dict) and len(value) <= MAX_CARRIED:
        return {_text(key): _plain(item, depth - 1) for key, item in value.items()}
    if depth and isinstance(value, list) and len(value) <= MAX_CARRIED:
        return [_plain(item, depth - 1) for item in value]
    if value is None or isinstance(value, bool) or (isinstance(value, str) and len(value) <= MAX_CARRIED_CHARACTERS):
        return value
    return _number(value)


def can_carry(source: dict[str, Any]) -> bool:
    """Whether a receipt with this `source` can be read again: no deeper or longer than receipts need."""
    try:
        _plain(source)
    except ValueError:
        return False
    return True


def _number(value: Any, none: bool = False) -> Any:
    """A finite number as it is, or (none) null. Raises ValueError."""
    if value is None and none:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {repr(value)[:80]}")
    return value


def _finite(value: float | None) -> float | None:
    """JSON has no infinity: identical pictures are 999 dB."""
    return None if value is None else round(min(value, 999.0), 3)


def to_runs(rows: np.ndarray) -> np.ndarray:
    """[T] ascending row indices -> [R, 2] (first, count) of consecutive runs."""
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    # A run ends where the next row is not the next number.
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    first = np.concatenate([[0], breaks])
    return np.stack([rows[first], np.diff(np.append(first, len(rows)))], 1)


def from_runs(runs: np.ndarray, rows: int) -> np.ndarray:
    """The inverse of `to_runs`. Raises ValueError for runs outside 0..rows or not ascending, and for rows beyond
    MOST_ROWS (a short text may claim any number, and here it becomes memory)."""
    if rows > MAX_RECEIPT_ROWS:
        raise ValueError(f"expected at most {MAX_RECEIPT_ROWS} rows, got {rows}")
    ends = runs.sum(1)
    wild = ((runs < 0) | (runs > rows)).any()  # their sums could wrap around
    if len(runs) and (wild or (runs[:, 1] < 1).any() or (runs[1:, 0] < ends[:-1]).any() or ends[-1] > rows):
        raise ValueError(f"touched_runs do not fit {rows} rows")
    return np.concatenate([np.arange(a, a + n) for a, n in runs]) if len(runs) else np.zeros(0, np.int64)


def untouched_hashes(before: Splats, after: Splats, touched: np.ndarray, *, compared: bool = False) -> tuple[str, str]:
    """Hashes of all rows but `touched`, before and after; from the arrays themselves, nothing is assumed. compared:
    `touched` is what `changed_rows` found among all rows, so that no bit of the others differs."""
    # All rows that are not listed, so that a row which was forgotten in the list shows in the hash.
    keep = np.ones(len(before), bool)
    keep[touched] = False
    rows = np.flatnonzero(keep)
    digest = rows_sha256(before, rows)
    if compared or all(_same_bits(getattr(before, name), getattr(after, name), rows) for name in ATTRIBUTES):
        return digest, digest  # bytes that are equal have one hash
    return digest, rows_sha256(after, rows)


def _same_bits(before: np.ndarray, after: np.ndarray, rows: np.ndarray) -> bool:
    """Whether two arrays hold the same bytes in these rows."""
    # Edits share the arrays that they do not change: most comparisons end here.
    if before is after:
        return True
    if before.dtype != after.dtype or before.shape[1:] != after.shape[1:]:
        return False
    if before.dtype == np.float32:
        return not differing(before, after, rows).any()

    def taken(values: np.ndarray, ids: np.ndarray) -> np.ndarray:
        # As bytes, as a NaN equals itself and -0 is not 0 there.
        return values.take(ids, 0).reshape(-1).view(np.uint8)

    return all(np.array_equal(taken(before, ids), taken(after, ids)) for ids in row_blocks(rows))


@dataclass(frozen=True)
class Verification:
    """Outcome of comparing an edited file with its original."""

    ok: bool
    rows: int
    """Rows of the original."""
    same: int
    """Rows of the original that the edited file holds unchanged, at their places."""
    changed: int
    appended: int
    problems: tuple[str, ...]
    """Why it is not ok, one line each."""
    exact: str
    """How the rows were compared."""
    differences: tuple[str, ...] = ()
    """Stored properties in which changed rows differ."""
    compared: tuple[str, ...] = ()
    """What was compared besides the rows."""
    not_compared: tuple[str, ...] = ()
    """What was not."""
    axes: str = ""
    """Which way the numbers of the edited file point, and who says so."""
    axes_are_news: bool = False
    """Whether people should hear of it (`io.axes_are_news`)."""
    frame = formerly_called("axes")
    frame_is_news = formerly_called("axes_are_news")
    lost: str = ""
    """What the file does not hold of what was written into it (io/losses.py), where that was measured."""

    @property
    def how_same(self) -> str:
        """How strongly equal the same rows are."""
        return "byte-identical" if "byte" in self.exact else "identical in value, bit for bit"


@formerly(axes="frame", out_axes="out_frame")
def verify(
    original: str | os.PathLike[str],
    edited: str | os.PathLike[str],
    receipt: Receipt | None = None,
    *,
    axes: Axes = "auto",
    out_axes: Axes = "auto",
) -> Verification:
    """Compare two files: rows as they are stored, header, other elements, trailing bytes.

    ok is False when rows are missing, when anything differs that no edit changes (header settings, other properties
    and elements, trailing bytes) or, with a receipt, when any row differs that the receipt does not list, or the
    receipt is of other files. Without a receipt rows whose Gaussians differ are only counted.
    Files of different formats are compared by converting the original to the edited file's format first; then only
    rows are.
    axes, out_axes: axes of the numbers in the original and in the edited file, as in io.read. Where only one of two
    files of one format says them (or is told), they are those of the other too, unless more rows are the same where it
    is taken for what it would be taken for alone: then the one is a copy of the other in other axes.
    Raises ValueError when a file cannot be read."""
    # Both relative to one offset, so that equal positions are equal numbers.
    before = read(original, axes=axes, lenient=True)
    after = read(edited, axes=out_axes, lenient=True, offset=before.offset)
    assert before.source is not None and after.source is not None
    options = AS_IT_IS if receipt is None else receipt.options
    # Where axes cannot be in doubt, there is one way to compare.
    if before.source.format != after.source.format or before.source.axes == after.source.axes:
        return check(compare(before, after, options), receipt)
    # One of the two says its axes and the other only has its format's default: taken for those of the first, they would
    # be alike if the one was made from the other.
    if out_axes == "auto" and after.source.axes_from == "format":
        alike = compare(
            before, read(edited, axes=option(before.source.axes), lenient=True, offset=before.offset), options
        )
    elif axes == "auto" and before.source.axes_from == "format":
        alike = compare(
            read(original, axes=option(after.source.axes), lenient=True, offset=after.offset), after, options
        )
    else:
        return check(compare(before, after, options), receipt)
    if len(alike.differs):
        # Not alike so: perhaps the default was right. Whichever leaves fewer rows different is believed.
        with contextlib.suppress(ValueError):  # rows that the other axes' words cannot hold
            apart = compare(before, after, options)
            alike = apart if len(apart.differs) < len(alike.differs) else alike
    return check(alike, receipt)


def check(comparison: Comparison, receipt: Receipt | None = None) -> Verification:
    """Judge a comparison, against the receipt of the edit where there is one."""
    before, after, differs = comparison.before, comparison.after, comparison.differs
    axes = "" if after.source is None else axes_line(after.source)
    # First whether the receipt speaks of these files at all, then rows, then what no edit may change.
    problems = _wrong_files(receipt, comparison.original_sha256, after) if receipt is not None else []
    if before.sh.shape[1] != after.sh.shape[1]:
        problems.append(f"SH degree {before.sh_degree} became {after.sh_degree}")
    missing = len(before) - len(after)
    if missing > 0:
        problems.append(f"{missing} rows are missing")
    # A row that differs is no fault; that the receipt does not list it is.
    elif receipt is not None:
        unlisted = without(differs, receipt.touched)
        if len(unlisted):
            problems.append(f"{len(unlisted)} rows differ that the receipt does not list: {listed(unlisted)}")
        if -missing != receipt.appended_rows:
            problems.append(f"{-missing} rows appended, the receipt says {receipt.appended_rows}")
    for name, rows in comparison.unexpected_fields.items():
        judged = rows if receipt is None else np.intersect1d(rows, receipt.touched)  # the others are told of above
        if len(judged):
            problems.append(f"{name}, which no edit changes, differs in {len(judged)} rows: {listed(judged)}")
    if receipt is not None and receipt.pixelation is not None and not _is_lossy(after):
        problems += receipt.pixelation.problems(after)
    problems += comparison.problems
    return Verification(
        not problems,
        len(before),
        len(before) - len(differs),
        len(differs),
        max(-missing, 0),
        tuple(problems),
        comparison.exact,
        comparison.differences,
        comparison.compared,
        comparison.not_compared,
        axes,
        after.source is not None and axes_are_news(after.source),
    )


def _is_lossy(splats: Splats) -> bool:
    """Whether it comes from a file of a format that rounds."""
    return splats.source is not None and bool(FORMATS[splats.source.format].lossy)


def _wrong_files(receipt: Receipt, original: str, after: Splats) -> list[str]:
    out = []
    if receipt.asset_sha256 != original:
        out.append(
            f"the receipt is of another original (sha256 {receipt.asset_sha256[:12]}..., not {original[:12]}...)"
        )
    if receipt.output_sha256 not in ("", after.sha256):  # "": straight from Painter.apply, of no file yet
        out.append(
            f"the edited file changed since (sha256 {after.sha256[:12]}..., receipt {receipt.output_sha256[:12]}...)"
        )
    return out


def prove(
    original: Splats, written: Path, receipt: Receipt, axes: Axes = "auto", intended: Splats | None = None
) -> tuple[Receipt, Verification]:
    """The receipt of the file at `written`, which has `receipt.options`, and the outcome of checking the one against
    the other.

    A format that rounds may encode rows anew that the edit left alone. Such rows are different in the file, so they
    are listed as touched, and the note says how many and why. For a format that keeps everything this is a fault.
    An original that is no file, and any for a file with options, is compared as that format holds it. axes: what the
    file was written with. intended: what was written into it, to be measured against what the file holds; the receipt's
    note says what is lost.
    Raises RuntimeError where the file does not prove the receipt."""
    # The file is read anew from the disk: what was meant to be written proves nothing.
    key = format_of_name(written)
    taken = axes if key is None else written_axes(original, key, axes)
    # Lenient: what a lenient original had cut off is kept. Of one offset, so that equal positions have equal means.
    edited = read(written, axes=taken, lenient=True, offset=original.offset)
    assert edited.source is not None
    entry = FORMATS[edited.source.format]
    # All of the file is read for its hash while its rows are compared.
    hashing = beside(lambda: edited.sha256)
    comparison = compare(original, edited, receipt.options)
    rounded = without(comparison.differs, receipt.touched)
    notes = [receipt.note, *receipt.options.lines(original)]
    if len(rounded) and entry.lossy:
        touched = np.union1d(receipt.touched, rounded)
        before, after = untouched_hashes(comparison.before, edited, touched)
        receipt = replace(receipt, touched=touched, untouched_sha256_before=before, untouched_sha256_after=after)
        notes.append(f"{len(rounded)} rows that the edit left alone were rounded anew by {entry.key}")
    if original.source is None or original.source.format != entry.key:
        notes.append(f"rows are compared with the original converted to {entry.key}")
    if entry.lossy:
        notes.append(f"dB are of the rows before {entry.key} rounds them")
    lost = ""
    if intended is not None:
        intended = receipt.options.applied(intended)
        lost = loss_line(intended, entry.key, measure(intended, edited))
    notes.append(f"lost in {entry.key}: {lost}" if lost else "")
    receipt = replace(
        receipt,
        output_sha256=hashing(),
        core=library.version(),
        output_rows=len(edited),
        note="; ".join(filter(None, notes)),
    )
    verification = check(
        comparison, receipt if original.source else replace(receipt, asset_sha256=comparison.original_sha256)
    )
    verification = replace(verification, lost=lost)
    if not verification.ok:
        raise RuntimeError(f"the written file does not match its receipt: {'; '.join(verification.problems)}")
    return receipt, verification


def score(pixels: np.ndarray, other: np.ndarray, mask: np.ndarray) -> float | None:
    """PSNR in dB over the masked pixels of two [H, W, 3] pictures, clipped to 0..1; inf if equal, None if empty."""
    masked = np.flatnonzero(mask.any(1))
    if not len(masked):
        return None
    # The masked pixels that differ alone, in the rows that have any: around a dab they are a few of a million.
    first, last = int(masked[0]), int(masked[-1]) + 1
    differs, some = pixels[first:last] != other[first:last], mask[first:last]
    rows = np.flatnonzero(some.any(1) & differs.reshape(len(some), -1).any(1))
    channels = differs[rows]
    row, column = set_pixels(some[rows] & (channels[..., 0] | channels[..., 1] | channels[..., 2]))
    at = (first + rows[row]) * mask.shape[1] + column
    one, two = (np.clip(picture.reshape(-1, 3).take(at, 0), 0, 1).astype(np.float64) for picture in (pixels, other))
    error = float(((one - two) ** 2).sum()) / (3 * int(mask.sum()))
    return math.inf if error == 0 else -10 * math.log10(error)


def scores(images: Sequence[tuple[np.ndarray, ...]]) -> tuple[ViewScore, ...]:
    """One ViewScore per (render before, render after, edited picture, what was painted there by it or by another
    picture of the edit, scored part of its mask)."""
    from splatpainter.kernels.parallel import each  # receipts are read without kernels

    pairs = [
        pair
        for before, after, edited, mask, scored in images
        for pair in ((before, edited, scored), (after, edited, scored), (after, before, ~mask))
    ]
    values = each(lambda pair: score(*pair), pairs)
    return tuple(ViewScore(*values[3 * k : 3 * k + 3]) for k in range(len(images)))


class StageClock:
    """Seconds per stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def record_time(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now
