"""What a table's reader must know besides its figures, in lines, and whether anything that was asked is lacking."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from splatbench.cases import Record, RunConfig, Setup
from splatbench.report import published, summary
from splatbench.report.tables import seconds
from splatbench.tables import BenchTable

SIDE_BY_SIDE = re.compile(r"; (\d+) methods side by side")
LOAD = re.compile(r"; load [\d.]+ at the start")
MAX_FAILURES = 5
"""Objects that failed with a line each."""
MAX_REMARKS = 3
"""Most remarks of one method."""


@dataclass(frozen=True)
class RunState:
    """What a run and the runs before it left."""

    config: RunConfig
    objects: tuple[str, ...]
    """Names by which the table asks for objects."""
    shard_labels: frozenset[str]
    """Labels of this shard's cases."""
    failed: dict[str, tuple[str, str]]
    """Label of a case that could not be made -> (object, reason)."""
    records: tuple[Record, ...]
    """All that belong to the table."""
    outdated: tuple[Record, ...]
    """Those of them that were made with another budget or other weights than this run's."""
    table: BenchTable
    labels: dict[str, str]
    """Method -> its name in tables."""


def notes(state: RunState) -> list[str]:
    """Lines for below the table, those about data first."""
    lines = [_setup(state), *chosen(state.config.setup)]
    count, expected = len(state.objects), state.config.setup.objects
    if count < expected:
        lines.append(f"{expected} objects were asked for, {count} are there")
    lines += _failed(state.failed)
    k, n = state.config.shard
    if n > 1:
        lines.append(f"this run did part {k} of {n}; the table has what all parts have done so far")
    lines += _gaps(state)
    if without_lpips(state):
        lines.append("LPIPS: n/a, for its weights were not given (--perceptual-weights)")
    lines += [f"LPIPS: {line}" for line in _lpips_gaps(state)]
    lines += _machines(state)
    outdated = Counter(r.method for r in state.outdated)
    for method, number in outdated.items():
        lines.append(
            f"{_label(state, method)}: {number} answers come from an earlier run with another budget or weights"
        )
    lines += _curves(state)
    lines += _remarks(state)
    if published.rows(state.config.protocol):
        lines.append(f"{published.MARK}: the paper's own figures, which no row here can be compared with")
        if any(row.views is None for row in published.rows("relight")) and state.config.protocol == "relight":
            lines.append("the paper does not say how many relit views its own rows of other systems had")
    return list(dict.fromkeys(lines))


def complete(state: RunState) -> bool:
    """Whether this run's part of the table has every figure that it could: as many objects as asked, all cases made,
    LPIPS measured, no error in a row. A row that cannot run here counts where it was asked for by name, or where it
    is there and only the machine will not do."""
    if len(state.objects) < state.config.setup.objects or any(label in state.shard_labels for label in state.failed):
        return False
    owned = [r for r in state.records if r.label in state.shard_labels and r.method in state.config.methods]
    if any(r.error or r.missing.startswith("needs") or (r.missing and state.config.named) for r in owned):
        return False
    return not without_lpips(state) and not _lpips_gaps(state)


def without_lpips(state: RunState) -> bool:
    """Whether the table has an LPIPS column that this run did not fill."""
    return state.config.perceptual is None and any("lpips" in c.key for c in state.table.columns)


def chosen(setup: Setup) -> list[str]:
    """How objects and lights were chosen."""
    from splatbench.objects import environments, is_splat_folder, objects

    lines: list[str] = []
    if not is_splat_folder(setup.data):
        for choose in (objects, environments):
            with contextlib.suppress(ValueError):  # a table that needs none
                lines += choose(setup).notes
    return lines


def _setup(state: RunState) -> str:
    setup, budget = state.config.setup, state.config.budget
    truth = f"path traced, {setup.samples} paths per pixel" if setup.truth == "traced" else "of dense surfels"
    count = len({r.name for r in state.records})
    return (
        f"{count} objects, pictures of {setup.size} px, truth {truth}; assets from {setup.base_views} views, at most "
        f"{setup.rows:,} Gaussians, {setup.asset_steps:,} steps; {budget.steps:,} steps for methods that optimise; "
        f"{budget.device}; seed {setup.seed}"
    )


def _failed(failed: dict[str, tuple[str, str]]) -> list[str]:
    reasons = (reason if name in reason else f"{name}: {reason}" for name, reason in failed.values())
    lines = [f"left out: {line}" for line in dict.fromkeys(reasons)]
    more = len(lines) - MAX_FAILURES
    return lines if more <= 0 else [*lines[:MAX_FAILURES], f"and {more} more left out"]


def _gaps(state: RunState) -> list[str]:
    """Per method, why it has no figures for some cases."""
    lines = []
    for method in dict.fromkeys(r.method for r in state.records):
        of_method = [r for r in state.records if r.method == method]
        for reason, number in Counter(r.missing for r in of_method if r.missing).items():
            lines.append(
                f"{_label(state, method)}: {reason}" + (f" ({number} cases)" if number < len(of_method) else "")
            )
        for reason, number in Counter(r.error for r in of_method if r.error).most_common():
            lines.append(f"{_label(state, method)}: error in {number} of {len(of_method)} cases: {reason}")
    counts = Counter(r.method for r in state.records)
    full = max(counts.values(), default=0)
    for method, number in counts.items():
        if number < full:
            lines.append(f"{_label(state, method)}: {full - number} of {full} cases have not been run")
    return lines


def _lpips_gaps(state: RunState) -> list[str]:
    """Rows of an earlier run without LPIPS."""
    if state.config.perceptual is None:
        return []
    keys = [c.key for c in state.table.columns if "lpips" in c.key]
    bare = Counter(
        r.method for r in state.records if keys and r.has_figures and all(r.figures.get(k) is None for k in keys)
    )
    return [f"{_label(state, method)}: n/a in {number} cases" for method, number in bare.items()]


def _machines(state: RunState) -> list[str]:
    machines = [r.machine for r in state.records if r.has_figures]
    lines = []
    if any(SIDE_BY_SIDE.search(machine) for machine in machines):
        lines.append("seconds were measured with several methods side by side: they compare less well")
    names = list(dict.fromkeys(SIDE_BY_SIDE.sub("", LOAD.sub("", machine)) for machine in machines if machine))
    if len(names) > 1:
        lines.append(f"seconds come from {len(names)} machines: they compare only within one")
    return lines + [f"machine: {name}" for name in names]


def _remarks(state: RunState) -> Iterable[str]:
    """Remarks of the methods about their answers."""
    for method in dict.fromkeys(r.method for r in state.records):
        remarks = list(dict.fromkeys(r.note for r in state.records if r.method == method and r.has_figures and r.note))
        if remarks:
            more = len(remarks) - MAX_REMARKS
            ending = f"; and {more} other remarks" if more > 0 else ""
            yield f"{_label(state, method)}: " + "; ".join(remarks[:MAX_REMARKS]) + ending


def _curves(state: RunState) -> Iterable[str]:
    """The best that methods which take steps had on their way, and when: more steps may make novel views worse."""
    for method in dict.fromkeys(r.method for r in state.records if r.curve):
        of_method = [r for r in state.records if r.method == method]
        for block in summary.blocks(of_method, state.table.split_by):
            within = [r for r in of_method if summary.block_of(r, state.table.split_by) == block]
            part = f"{state.table.split_by} {block}" if block else ""
            rows = summary.summarize(within)
            for column in summary.leading(state.table.columns, rows):
                points = summary.curve_points(within, method, column.key)
                best, end = summary.best_point(points, column.better), rows[0].figures.get(column.key)
                if best is None or end is None or rows[0].edit_seconds is None:
                    continue
                where = ", ".join(filter(None, [column.group[:1].lower() + column.group[1:], part]))
                reached = f"{best.mean:.{column.digits}f} after {best.steps:g} steps ({seconds(best.seconds)} s)"
                final = f"{end.mean:.{column.digits}f} at the end ({seconds(rows[0].edit_seconds)} s)"
                name = f"best {column.label}{f' ({where})' if where else ''}"
                yield f"{_label(state, method)}, on the way: {name} {reached}, {final}"


def _label(state: RunState, method: str) -> str:
    return state.labels.get(method, method)
