"""Records of a run, and what they come to: one row per method and block with means, bootstrap intervals and medians.

Every object counts the same: a figure is first averaged over the object's cases, then over objects. The interval is
the percentile bootstrap (Efron 1979) over objects, because cases of one object are not independent. Knows no methods
and no tables but by their names, columns and files.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import numpy as np

from splatbench.cases import Case, Record, records
from splatpainter.metrics.bootstrap import interval

RUN_FILE = "run.json"
"""Written by the runner at the end of a run."""
MEASURED = "measured"


class MethodLabel(Protocol):
    """What a report needs of a method (methods.Method has it)."""

    @property
    def label(self) -> str: ...
    @property
    def sees_truth(self) -> bool: ...


class TableLayout(Protocol):
    """What a report needs of a table (tables.BenchTable has it)."""

    @property
    def title(self) -> str: ...
    @property
    def columns(self) -> tuple: ...
    @property
    def split_by(self) -> str: ...


@dataclass(frozen=True)
class MethodNames:
    """The methods of one report: how they are called, in which order they stand, and which mark is theirs."""

    order: tuple[str, ...]
    """Names of methods that occur in it, in the order of the tables."""
    labels: dict[str, str]
    unranked: frozenset[str]
    """Methods that see the truth, and the row in which nothing is done: never marked as a table's best."""

    @staticmethod
    def of(
        methods: Mapping[str, MethodLabel], names: Iterable[str], labels: Mapping[str, str] | None = None
    ) -> MethodNames:
        """methods: all that are installed, in order. names: those that occur; names that are not among `methods` come
        last, sorted, and are their own labels. labels: what a run called them, with the weights that it had."""
        names = set(names)
        order = (*(name for name in methods if name in names), *sorted(names - set(methods)))
        called = {name: methods[name].label if name in methods else name for name in order}
        called |= {name: label for name, label in (labels or {}).items() if name in called}
        informed = {name for name in order if name in methods and methods[name].sees_truth}
        return MethodNames(order, called, frozenset(informed | {"nothing"}))

    def style(self, name: str) -> int:
        """Number of the method's colour and shape (plots.MARKS)."""
        return self.order.index(name)


def method_names(
    records: Iterable[Record],
    methods: Mapping[str, MethodLabel] | None = None,
    labels: Mapping[str, str] | None = None,
) -> MethodNames:
    """The methods of these records. methods: by name, in order; None: those of this package; labels: as of
    MethodNames."""
    if methods is None:
        from splatbench.methods import all_methods

        methods = all_methods()
    return MethodNames.of(methods, (r.method for r in records), labels)


def table_layout(folder: Path, tables: Mapping[str, TableLayout] | None = None) -> TableLayout:
    """The table whose results lie in a folder of its name. tables: by name; None: those of this package. Raises
    ValueError where there is no such table."""
    from splatbench import tables as package

    names = package.NAMES if tables is None else tuple(tables)
    if folder.name not in names:
        raise ValueError(f"{folder}: expected the folder of one of {', '.join(names)}")
    return package.table(folder.name) if tables is None else tables[folder.name]


# ---- what a run left in its folder


@dataclass(frozen=True)
class StoredRun:
    """One table's results."""

    records: tuple[Record, ...]
    notes: tuple[str, ...] | None
    """Notes of the runner; None: no run has finished there yet."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Method -> what the run called it: rows are named by the weights that made them."""


def read_run(folder: Path) -> StoredRun:
    """What a run left in OUT/TABLE: records of cases that it asked for and that are still those on disk; all records
    before a first run has finished. Raises ValueError for files that are not the runner's."""
    stored = tuple(records(folder))
    if not (folder / RUN_FILE).is_file():
        return StoredRun(stored, None)
    try:
        values = json.loads((folder / RUN_FILE).read_bytes())
        labels, notes = set(values["labels"]), tuple(str(note) for note in values["notes"])
        called = {str(name): str(label) for name, label in dict(values.get("methods", {})).items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{folder / RUN_FILE}: expected what `splatpainter bench` writes ({error!r})") from None
    digests = {label: _case_digest(folder / "cases" / label) for label in {r.label for r in stored} & labels}
    current = (r for r in stored if r.label in labels and r.fingerprint.startswith(digests[r.label]))
    return StoredRun(tuple(current), notes, called)


def _case_digest(case: Path) -> str:
    """What fingerprints of answers to this case begin with; "" where the case itself is not here."""
    return Case.digest(case) if (case / "case.json").is_file() and (case / "case.npz").is_file() else ""


# ---- rows


@dataclass(frozen=True)
class Estimate:
    """The mean of one figure over objects."""

    mean: float
    """May be infinite (PSNR of equal pictures)."""
    low: float | None
    """Lower end of the 95 % interval; None with fewer than two objects, which say nothing about others."""
    high: float | None
    objects: int
    """Objects that had this figure."""
    cases: int


@dataclass(frozen=True)
class SummaryRow:
    """One method in one block of a table."""

    method: str
    """Name of the method."""
    block: str
    """Value of the fact that splits the table, as text; "" where the table is not split."""
    state: str
    """"measured" where any case has figures; else why none has: "not installed: ...", "error: ..."."""
    cases: int
    """Cases with figures."""
    all_cases: int
    """Cases of this block that any method has a record of."""
    objects: int
    """Objects with figures."""
    figures: dict[str, Estimate] = field(default_factory=dict)
    """Column key -> figure; keys that no case has a number for are left out."""
    setup_seconds: float | None = None
    """Median over cases, as edit_seconds."""
    edit_seconds: float | None = None
    peak_mib: float | None = None
    """Largest memory of the cases."""
    rows: int | None = None
    """Gaussians of the edited asset, median, as appended."""
    rows_equal: float | None = None
    """Share of the asset's Gaussians that kept their bits, mean, 0..1."""
    appended: int | None = None
    numbers: dict[str, float] = field(default_factory=dict)
    """Means of Record.numbers over the cases that have them."""
    errors: tuple[tuple[str, int], ...] = ()
    """(reason, number of cases) of the cases without figures, most frequent first."""
    notes: tuple[str, ...] = ()
    """Notes of the cases with figures, each once."""


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
        cases = len({r.label for r in within})
        for method in methods:
            if answers := [r for r in within if r.method == method]:
                rows.append(_summary_row(method, block, cases, answers))
    return rows


def block_of(record: Record, split_by: str) -> str:
    """The block that a record belongs to."""
    value = record.facts.get(split_by, "") if split_by else ""
    return f"{value:g}" if isinstance(value, float) else str(value)


def blocks(records: Iterable[Record], split_by: str) -> list[str]:
    """The blocks of a table, numbers by size and then words as they come."""
    names = list(dict.fromkeys(block_of(r, split_by) for r in records))
    numbers = {name: as_number(name) for name in names}
    return sorted(names, key=lambda name: (0, numbers[name]) if numbers[name] is not None else (1, 0.0))


def as_number(text: str) -> float | None:
    """The finite number that a text is, or None."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def leading(columns: Sequence[Any], rows: Sequence[SummaryRow]) -> list[Any]:
    """The first column (tables.Column) that these rows have figures for, and those of other groups with its label."""
    measured = [column for column in columns if any(column.key in row.figures for row in rows)]
    return [column for column in measured if column.label == measured[0].label]


def best_methods(rows: Sequence[SummaryRow], column: Any, names: MethodNames) -> set[str]:
    """Methods whose mean is the best of a block's rows. Methods that see the truth, or did not answer every case, do
    not compete; nobody is best alone."""
    means = {
        row.method: row.figures[column.key].mean
        for row in rows
        if column.key in row.figures and row.cases == row.all_cases and row.method not in names.unranked
    }
    if not column.better or len(means) < 2:
        return set()
    best = max(means.values()) if column.better == "higher" else min(means.values())
    return {method for method, mean in means.items() if mean == best}


def estimate(values: Mapping[str, Sequence[float | None]], seed: int = 0) -> Estimate | None:
    """Object -> figures of its cases. None where there is none; None and NaN among figures are left out."""
    numbers = {name: [v for v in given if v is not None and not math.isnan(v)] for name, given in values.items()}
    numbers = {name: given for name, given in numbers.items() if given}
    if not numbers:
        return None
    means = np.array([np.mean(given) for given in numbers.values()], np.float64)
    low, high = interval(means, seed=seed) or (None, None)
    return Estimate(float(means.mean()), low, high, len(means), sum(map(len, numbers.values())))


def _summary_row(method: str, block: str, cases: int, records: Sequence[Record]) -> SummaryRow:
    measured = [r for r in records if r.has_figures]
    reasons = Counter(r.missing or f"error: {r.error}" for r in records if not r.has_figures)
    figures = {}
    for key in dict.fromkeys(key for r in measured for key in r.figures):
        by_object: dict[str, list[float | None]] = {}
        for r in measured:
            by_object.setdefault(r.name, []).append(r.figures.get(key))
        if (mean := estimate(by_object)) is not None:
            figures[key] = mean
    numbers = {}
    for key in dict.fromkeys(key for r in measured for key in r.numbers):
        numbers[key] = float(np.mean([r.numbers[key] for r in measured if key in r.numbers]))
    gaussians, appended = _median(r.rows for r in measured), _median(r.appended for r in measured)
    equal = _numbers(r.rows_equal for r in measured)
    return SummaryRow(
        method=method,
        block=block,
        state=MEASURED if measured else reasons.most_common(1)[0][0],
        cases=len(measured),
        all_cases=cases,
        objects=len({r.name for r in measured}),
        figures=figures,
        setup_seconds=_median(r.setup_seconds for r in measured),
        edit_seconds=_median(r.edit_seconds for r in measured),
        peak_mib=max(_numbers(r.peak_mib for r in measured), default=None),
        rows=None if gaussians is None else round(gaussians),
        rows_equal=float(np.mean(equal)) if equal else None,
        appended=None if appended is None else round(appended),
        numbers=numbers,
        errors=tuple(reasons.most_common()),
        notes=tuple(dict.fromkeys(r.note for r in measured if r.note)),
    )


def _numbers(values: Iterable[float | None]) -> list[float]:
    return [float(v) for v in values if v is not None]


def _median(values: Iterable[Any]) -> float | None:
    numbers = _numbers(values)
    return median(numbers) if numbers else None


# ---- quality on the way of methods that take steps


@dataclass(frozen=True)
class CurvePoint:
    """What a method had after so many steps."""

    steps: float
    seconds: float
    """Median over cases."""
    mean: float
    """Mean of the figure, over cases."""


def curve_points(records: Sequence[Record], method: str, key: str) -> list[CurvePoint]:
    """The figure `key` on the way (Record.curve) at the step counts that all cases of the method with a curve have, in
    order; steps at which a case lacks the figure are left out."""
    curves = [{p["steps"]: p for p in r.curve} for r in records if r.method == method and r.has_figures and r.curve]
    if not curves:
        return []
    points = []
    for steps in sorted(s for s in set.intersection(*(set(curve) for curve in curves)) if s is not None):
        at_step = [curve[steps] for curve in curves]
        seconds = [p["seconds"] for p in at_step if p["seconds"] is not None]
        values = [v for p in at_step if (v := p.get(key)) is not None and math.isfinite(v)]
        if len(values) == len(at_step) and seconds:
            points.append(CurvePoint(steps, median(seconds), float(np.mean(values))))
    return points


def best_point(points: Sequence[CurvePoint], better: str) -> CurvePoint | None:
    """The point with the best figure, the earliest of equals; None where there is none, or nothing is better."""
    if not points or not better:
        return None
    sign = 1.0 if better == "higher" else -1.0
    return max(points, key=lambda point: (sign * point.mean, -point.steps))
