"""Receipts: which rows an edit changed, and the proof that it changed no other. Knows no renderer and no network.

A row is untouched when every attribute has the same bits as before. Files prove it by being read again: `verify`
compares two files row by row, in the edited file's own format, and against the receipt where there is one.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatpainter.io import FORMATS, read, write
from splatpainter.splats import ATTRIBUTES, Splats, rows_sha256

BLOCK = 1 << 14
"""Rows compared at a time, so that a comparison needs no memory of its own."""
MOST_ROWS = 1 << 27
"""Rows of an asset that a receipt may speak of."""


@dataclass(frozen=True)
class ViewScore:
    """How one edited view fared, in dB (PSNR over 8-bit-range colours 0..1; None where there is no such pixel)."""

    psnr_before: float | None
    """Render before against the edited view, inside the mask (where the asset covers the pixel: alpha > 0.5)."""
    psnr_after: float | None
    """Render after against the edited view, inside the mask."""
    psnr_outside: float | None
    """Render after against render before, outside the mask."""


@dataclass(frozen=True)
class Receipt:
    """What an edit did. `to_json` is the object of design.md 5."""

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
    precision: str = ""
    """Arithmetic of the networks, "float32" or "bfloat16" (nn.precision); "" where none ran, and not in the JSON."""

    @property
    def untouched_rows(self) -> int:
        return self.asset_rows - len(self.touched)

    def to_json(self) -> str:
        """Indented JSON; `touched_runs` are [first, count] runs of touched rows."""
        record = {
            "asset": {"sha256": self.asset_sha256, "rows": self.asset_rows},
            "output": {"sha256": self.output_sha256, "rows": self.output_rows},
            "mode": self.mode,
            "method": self.method,
            "preset": self.preset,
            "touched_rows": len(self.touched),
            "appended_rows": self.appended_rows,
            "removed_rows": 0,
            "untouched_sha256_before": self.untouched_sha256_before,
            "untouched_sha256_after": self.untouched_sha256_after,
            "views": [{k: _finite(v) for k, v in asdict(view).items()} for view in self.views],
            "seconds": {k: round(v, 4) for k, v in self.seconds.items()},
            "note": self.note,
        }
        if self.precision:
            record["precision"] = self.precision
        text = json.dumps(record, indent=2)
        runs = json.dumps(to_runs(self.touched).tolist(), separators=(",", ":"))
        return text.removesuffix("\n}") + f',\n  "touched_runs": {runs}\n}}\n'

    @staticmethod
    def from_json(text: str, where: str = "receipt") -> Receipt:
        """Parse `to_json`. Raises ValueError naming `where` and what is wrong."""
        try:
            data: dict[str, Any] = json.loads(text)
            touched = from_runs(np.array(data["touched_runs"], np.int64).reshape(-1, 2), int(data["asset"]["rows"]))
            if len(touched) != int(data["touched_rows"]):
                raise ValueError(f"touched_rows is {data['touched_rows']}, its runs hold {len(touched)}")
            return Receipt(
                str(data["asset"]["sha256"]),
                int(data["asset"]["rows"]),
                str(data["output"]["sha256"]),
                int(data["output"]["rows"]),
                data["mode"],
                data["method"],
                data["preset"],
                touched,
                int(data["appended_rows"]),
                data["untouched_sha256_before"],
                data["untouched_sha256_after"],
                tuple(ViewScore(**view) for view in data["views"]),
                dict(data["seconds"]),
                data.get("note", ""),
                str(data.get("precision", "")),
            )
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise ValueError(f"{where}: expected a receipt of splatpainter, got {error!r}") from None


def _finite(value: float | None) -> float | None:
    """JSON has no infinity: identical pictures are 999 dB."""
    return None if value is None else round(min(value, 999.0), 3)


def to_runs(rows: np.ndarray) -> np.ndarray:
    """[T] ascending row indices -> [R, 2] (first, count) of consecutive runs."""
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    first = np.concatenate([[0], breaks])
    return np.stack([rows[first], np.diff(np.append(first, len(rows)))], 1)


def from_runs(runs: np.ndarray, rows: int) -> np.ndarray:
    """The inverse of `to_runs`. Raises ValueError for runs outside 0..rows or not ascending, and for rows beyond
    MOST_ROWS (a short text may claim any number, and here it becomes memory)."""
    if rows > MOST_ROWS:
        raise ValueError(f"expected at most {MOST_ROWS} rows, got {rows}")
    ends = runs.sum(1)
    wild = ((runs < 0) | (runs > rows)).any()  # their sums could wrap around
    if len(runs) and (wild or (runs[:, 1] < 1).any() or (runs[1:, 0] < ends[:-1]).any() or ends[-1] > rows):
        raise ValueError(f"touched_runs do not fit {rows} rows")
    return np.concatenate([np.arange(a, a + n) for a, n in runs]) if len(runs) else np.zeros(0, np.int64)


def changed_rows(before: Splats, after: Splats) -> np.ndarray:
    """[T] int64 ascending: rows that both have and of which any bit differs (NaN equals itself)."""
    n = min(len(before), len(after))
    changed = np.zeros(n, bool)
    for name in ATTRIBUTES:
        old, new = getattr(before, name), getattr(after, name)
        if old is new or n == 0:
            continue
        if old.shape[1:] != new.shape[1:]:
            return np.arange(n)
        found = np.flatnonzero(_bits(old[:n]) != _bits(new[:n]))  # a reduction along short rows takes longer
        changed[found // (old[:n].size // n)] = True
    return np.flatnonzero(changed)


def _bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32).view(np.uint32)


def untouched_hashes(before: Splats, after: Splats, touched: np.ndarray) -> tuple[str, str]:
    """Hashes of all rows but `touched`, before and after; from the arrays themselves, nothing is assumed."""
    keep = np.ones(len(before), bool)
    keep[touched] = False
    rows = np.flatnonzero(keep)
    return rows_sha256(before, rows), rows_sha256(after, rows)


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


@dataclass(frozen=True)
class Comparison:
    """Two assets, row by row, in the edited one's own format."""

    original_sha256: str
    before: Splats = field(repr=False)
    """The original, as its rows are in the format of the edited file."""
    after: Splats = field(repr=False)
    differs: np.ndarray = field(repr=False)
    """[D] int64 ascending rows of `before` that `after` does not hold unchanged at their places."""
    exact: str
    """How the rows were compared."""


def verify(
    original: str | os.PathLike[str], edited: str | os.PathLike[str], receipt: Receipt | None = None
) -> Verification:
    """Compare two files row by row. ok is False when rows are missing or, with a receipt, when any row differs that
    the receipt does not list, or the receipt is of other files. Without a receipt differing rows are only counted.

    Files of different formats are compared by converting the original to the edited file's format first.
    Raises ValueError when a file cannot be read."""
    return check(compare(read(original), read(edited)), receipt)


def compare(original: Splats, edited: Splats) -> Comparison:
    """Compare two assets as they were read from their files (both have a source)."""
    assert original.source is not None and edited.source is not None
    before, how = original, "every value of every row, bit for bit"
    if original.source.format != edited.source.format:
        how = f"the original converted to {edited.source.format}, then {how}"
        before = _converted(original, edited)
    if len(edited) < len(before):
        return Comparison(original.sha256, before, edited, np.arange(len(before)), how)
    raw = _stored_rows_differ(before, edited)
    if raw is not None:  # equal bytes of one layout are equal values
        return Comparison(original.sha256, before, edited, raw, "every byte of every stored row")
    return Comparison(original.sha256, before, edited, changed_rows(before, edited), how)


def check(found: Comparison, receipt: Receipt | None = None) -> Verification:
    """Judge a comparison, against the receipt of the edit where there is one."""
    before, after, differs = found.before, found.after, found.differs
    problems = _wrong_files(receipt, found.original_sha256, after) if receipt is not None else []
    if before.sh.shape[1] != after.sh.shape[1]:
        problems.append(f"SH degree {before.sh_degree} became {after.sh_degree}")
    if len(after) < len(before):
        problems.append(f"{len(before) - len(after)} rows are missing")
        return Verification(False, len(before), 0, 0, 0, tuple(problems), found.exact)
    if receipt is not None:
        strange = np.setdiff1d(differs, receipt.touched)
        if len(strange):
            shown = ", ".join(map(str, strange[:5])) + (", ..." if len(strange) > 5 else "")
            problems.append(f"{len(strange)} rows differ that the receipt does not list: {shown}")
        if len(after) - len(before) != receipt.appended_rows:
            problems.append(f"{len(after) - len(before)} rows appended, the receipt says {receipt.appended_rows}")
    return Verification(
        not problems,
        len(before),
        len(before) - len(differs),
        len(differs),
        len(after) - len(before),
        tuple(problems),
        found.exact,
    )


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


def _converted(before: Splats, after: Splats) -> Splats:
    """`before` as its rows would be in the format of `after`."""
    assert after.source is not None
    entry = FORMATS[after.source.format]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("converted" + (entry.suffixes[0] if entry.suffixes else ""))
        write(path, before)
        return read(path)


def _stored_rows_differ(before: Splats, after: Splats) -> np.ndarray | None:
    """[D] int64 ascending, for binary PLY files of one row layout: rows whose stored bytes differ (extra properties
    too); None otherwise."""
    assert before.source is not None and after.source is not None
    sources = (before.source, after.source)
    old, new = (getattr(getattr(s.detail, "rows", None), "records", None) for s in sources)
    if not (isinstance(old, np.ndarray) and isinstance(new, np.ndarray) and old.dtype == new.dtype):
        return None
    word = np.uint32 if old.dtype.itemsize % 4 == 0 else np.uint8
    found = [np.zeros(0, np.int64)]
    for start in range(0, len(old), BLOCK):
        mine = (
            np.ascontiguousarray(old[start : start + BLOCK])
            .view(word)
            .reshape(-1, old.dtype.itemsize // word(0).nbytes)
        )
        theirs = np.ascontiguousarray(new[start : start + len(mine)]).view(word).reshape(mine.shape)
        found.append(start + np.flatnonzero((mine != theirs).any(1)))
    return np.concatenate(found)


def score(pixels: np.ndarray, other: np.ndarray, mask: np.ndarray) -> float | None:
    """PSNR in dB over the masked pixels of two [H, W, 3] pictures, clipped to 0..1; inf if equal, None if empty."""
    if not mask.any():
        return None
    # The masked pixels that differ alone: around a dab they are a few of a million.
    chosen = mask & ((pixels[..., 0] != other[..., 0]) | (pixels[..., 1] != other[..., 1]))
    chosen |= mask & (pixels[..., 2] != other[..., 2])
    one, two = (np.clip(picture[chosen], 0, 1).astype(np.float64) for picture in (pixels, other))
    error = float(((one - two) ** 2).sum()) / (3 * int(mask.sum()))
    return math.inf if error == 0 else -10 * math.log10(error)


def scores(images: Sequence[tuple[np.ndarray, ...]]) -> tuple[ViewScore, ...]:
    """One ViewScore per (render before, render after, edited picture, mask, scored part of the mask)."""
    return tuple(
        ViewScore(score(before, edited, scored), score(after, edited, scored), score(after, before, ~mask))
        for before, after, edited, mask, scored in images
    )
