"""Records of many cases as one row per method and block: means, bootstrap intervals, medians. Knows no protocol.

Every object counts the same: a figure is first averaged over the object's cases, then over objects. The interval is
the percentile bootstrap (Efron 1979) over objects, because cases of one object are not independent.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np

from splatbench.records import Record
from splatpainter.metrics.bootstrap import interval

MEASURED = "measured"


@dataclass(frozen=True)
class Estimate:
    """The mean of one figure over objects."""

    mean: float
    """May be infinite (PSNR of equal pictures)."""
    low: float | None
    """Lower end of the 95 % interval; None with fewer than two objects, which say nothing about others."""
    high: float | None
    objects: int
    """How many had this figure."""
    cases: int


@dataclass(frozen=True)
class SummaryRow:
    """One method in one block of a table."""

    method: str
    """Its name."""
    block: str
    """Value of the fact that splits the table, as text; "" where the table is not split."""
    state: str
    """"measured" where any case has figures; else why none has: "not installed: ...", "error: ..."."""
    cases: int
    """With figures."""
    asked: int
    """Cases of this block that any method has a record of."""
    objects: int
    """With figures."""
    figures: dict[str, Estimate] = field(default_factory=dict)
    """Column key -> figure; keys that no case has a number for are left out."""
    setup_seconds: float | None = None
    """Median over cases, as edit_seconds."""
    edit_seconds: float | None = None
    peak_mib: float | None = None
    """Largest."""
    rows: int | None = None
    """Median, as appended."""
    rows_equal: float | None = None
    """Mean, 0..1."""
    appended: int | None = None
    numbers: dict[str, float] = field(default_factory=dict)
    """Means of Record.numbers over the cases that have them."""
    errors: tuple[tuple[str, int], ...] = ()
    """(what was said, in how many cases) of the cases without figures, most frequent first."""
    notes: tuple[str, ...] = ()
    """Of the cases with figures, each once."""


def summarize(records: Iterable[Record], split_by: str = "", order: Sequence[str] = ()) -> list[SummaryRow]:
    """One row per method and block, block by block; blocks by value, methods as in `order`, others after them as they
    come. A method without a record in a block has no row there.

    split_by: name of a fact; cases without it are in block "".
    """
    records = list(records)
    methods = [name for name in order if any(r.method == name for r in records)]
    methods = list(dict.fromkeys([*methods, *(r.method for r in records)]))
    rows = []
    for block in blocks(records, split_by):
        within = [r for r in records if block_of(r, split_by) == block]
        asked = len({r.label for r in within})
        for method in methods:
            if own := [r for r in within if r.method == method]:
                rows.append(_row(method, block, asked, own))
    return rows


def block_of(record: Record, split_by: str) -> str:
    """The block that a record belongs to."""
    value = record.facts.get(split_by, "") if split_by else ""
    return f"{value:g}" if isinstance(value, float) else str(value)


def blocks(records: Iterable[Record], split_by: str) -> list[str]:
    """The blocks of a table, numbers by size and then words as they come."""
    found = list(dict.fromkeys(block_of(r, split_by) for r in records))
    return sorted(found, key=lambda text: (0, float(text)) if _is_number(text) else (1, 0.0))


def leading(columns: Sequence[Any], rows: Sequence[SummaryRow]) -> list[Any]:
    """The first column (protocols.Column) that these rows have figures for, and those of other groups that are called
    the same."""
    told = [column for column in columns if any(column.key in row.figures for row in rows)]
    return [column for column in told if column.label == told[0].label]


def estimate(values: Mapping[str, Sequence[float | None]], seed: int = 0) -> Estimate | None:
    """Object -> figures of its cases. None where there is none; None and NaN among figures are left out."""
    kept = {name: [v for v in told if v is not None and not math.isnan(v)] for name, told in values.items()}
    kept = {name: told for name, told in kept.items() if told}
    if not kept:
        return None
    means = np.array([np.mean(told) for told in kept.values()], np.float64)
    low, high = interval(means, seed=seed) or (None, None)
    return Estimate(float(means.mean()), low, high, len(means), sum(map(len, kept.values())))


def _row(method: str, block: str, asked: int, records: Sequence[Record]) -> SummaryRow:
    whole = [r for r in records if r.whole]
    said = Counter(r.missing or f"error: {r.error}" for r in records if not r.whole)
    figures = {}
    for key in dict.fromkeys(key for r in whole for key in r.figures):
        by_object: dict[str, list[float | None]] = {}
        for r in whole:
            by_object.setdefault(r.name, []).append(r.figures.get(key))
        if (found := estimate(by_object)) is not None:
            figures[key] = found
    numbers = {}
    for key in dict.fromkeys(key for r in whole for key in r.numbers):
        numbers[key] = float(np.mean([r.numbers[key] for r in whole if key in r.numbers]))
    rows, appended = _middle(r.rows for r in whole), _middle(r.appended for r in whole)
    equal = _numbers(r.rows_equal for r in whole)
    return SummaryRow(
        method=method,
        block=block,
        state=MEASURED if whole else said.most_common(1)[0][0],
        cases=len(whole),
        asked=asked,
        objects=len({r.name for r in whole}),
        figures=figures,
        setup_seconds=_middle(r.setup_seconds for r in whole),
        edit_seconds=_middle(r.edit_seconds for r in whole),
        peak_mib=max(_numbers(r.peak_mib for r in whole), default=None),
        rows=None if rows is None else round(rows),
        rows_equal=float(np.mean(equal)) if equal else None,
        appended=None if appended is None else round(appended),
        numbers=numbers,
        errors=tuple(said.most_common()),
        notes=tuple(dict.fromkeys(r.note for r in whole if r.note)),
    )


def _numbers(values: Iterable[float | None]) -> list[float]:
    return [float(v) for v in values if v is not None]


def _middle(values: Iterable[Any]) -> float | None:
    kept = _numbers(values)
    return median(kept) if kept else None


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
