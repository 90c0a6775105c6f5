"""What a table's reader must know besides its figures, in lines, and whether anything that was asked is lacking."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from splatbench.records import Record
from splatbench.report import published, summary
from splatbench.report.tables import seconds
from splatbench.tables import Setup, Table

if TYPE_CHECKING:
    from splatbench.runner import Asked

SIDE_BY_SIDE = re.compile(r"; (\d+) methods side by side")
LOAD = re.compile(r"; load [\d.]+ at the start")
SHOWN = 5
"""Objects that failed with a line of their own."""


@dataclass(frozen=True)
class Told:
    """What a run and the runs before it left."""

    asked: Asked
    objects: tuple[str, ...]
    """Names by which the table asks for objects."""
    own: frozenset[str]
    """Labels of this shard's cases."""
    failed: dict[str, tuple[str, str]]
    """Label of a case that could not be made -> (object, reason)."""
    records: tuple[Record, ...]
    """All that belong to the table."""
    outdated: tuple[Record, ...]
    """Those of them that were made with another budget or other weights than this run's."""
    table: Table
    labels: dict[str, str]
    """Method -> its name in tables."""


def lines(told: Told) -> list[str]:
    """Lines for below the table, those about data first."""
    found = [_setup(told), *chosen(told.asked.setup)]
    count, wanted = len(told.objects), told.asked.setup.objects
    if count < wanted:
        found.append(f"{wanted} objects were asked for, {count} are there")
    found += _failed(told.failed)
    k, n = told.asked.shard
    if n > 1:
        found.append(f"this run did part {k} of {n}; the table has what all parts have done so far")
    found += _gaps(told)
    if without_lpips(told):
        found.append("LPIPS: n/a, for its weights were not given (--perceptual-weights)")
    found += [f"LPIPS: {line}" for line in _lpips_gaps(told)]
    found += _machines(told)
    old = Counter(r.method for r in told.outdated)
    for method, number in old.items():
        found.append(
            f"{_label(told, method)}: {number} answers come from an earlier run with another budget or weights"
        )
    found += _curves(told)
    found += _rows(told)
    if published.rows(told.asked.protocol):
        found.append(f"{published.MARK}: the paper's own figures, which no row here can be compared with")
        if any(row.views is None for row in published.rows("relight")) and told.asked.protocol == "relight":
            found.append("the paper does not say how many relit views its own rows of other systems had")
    return list(dict.fromkeys(found))


def complete(told: Told) -> bool:
    """Whether this run's part of the table has every figure that it could: as many objects as asked, all cases made,
    LPIPS measured, no error in a row. A row that cannot run here counts where it was asked for by name, or where it
    is there and only the machine will not do."""
    if len(told.objects) < told.asked.setup.objects or any(label in told.own for label in told.failed):
        return False
    mine = [r for r in told.records if r.label in told.own and r.method in told.asked.methods]
    if any(r.error or r.missing.startswith("needs") or (r.missing and told.asked.named) for r in mine):
        return False
    return not without_lpips(told) and not _lpips_gaps(told)


def without_lpips(told: Told) -> bool:
    """Whether the table has an LPIPS column that this run did not fill."""
    return told.asked.perceptual is None and any("lpips" in c.key for c in told.table.columns)


def chosen(setup: Setup) -> list[str]:
    """How objects and lights were chosen."""
    from splatbench.objects import environments, objects
    from splatbench.splat_cases import is_splat_folder

    found: list[str] = []
    if is_splat_folder(setup.data):
        return found
    for choose in (objects, environments):
        try:
            found += choose(setup).notes
        except ValueError:  # a protocol that needs none
            continue
    return found


def _setup(told: Told) -> str:
    setup, budget = told.asked.setup, told.asked.budget
    truth = f"path traced, {setup.samples} paths per pixel" if setup.truth == "traced" else "of dense surfels"
    count = len({r.name for r in told.records})
    return (
        f"{count} objects, pictures of {setup.size} px, truth {truth}; assets from {setup.base_views} views, at most "
        f"{setup.rows:,} rows, {setup.asset_steps:,} steps; {budget.steps:,} steps for methods that optimise; "
        f"{budget.device}; seed {setup.seed}"
    )


def _failed(failed: dict[str, tuple[str, str]]) -> list[str]:
    told = (reason if name in reason else f"{name}: {reason}" for name, reason in failed.values())
    found = [f"left out: {line}" for line in dict.fromkeys(told)]
    if len(found) > SHOWN:
        found = [*found[:SHOWN], f"and {len(found) - SHOWN} more left out"]
    return found


def _gaps(told: Told) -> list[str]:
    """Per method, why it has no figures for some cases."""
    found = []
    for method in dict.fromkeys(r.method for r in told.records):
        own = [r for r in told.records if r.method == method]
        for reason, number in Counter(r.missing for r in own if r.missing).items():
            found.append(f"{_label(told, method)}: {reason}" + (f" ({number} cases)" if number < len(own) else ""))
        for reason, number in Counter(r.error for r in own if r.error).most_common():
            found.append(f"{_label(told, method)}: error in {number} of {len(own)} cases: {reason}")
    counts = Counter(r.method for r in told.records)
    most = max(counts.values(), default=0)
    for method, number in counts.items():
        if number < most:
            found.append(f"{_label(told, method)}: {most - number} of {most} cases have not been run")
    return found


def _lpips_gaps(told: Told) -> list[str]:
    """Rows of an earlier run without LPIPS."""
    if told.asked.perceptual is None:
        return []
    keys = [c.key for c in told.table.columns if "lpips" in c.key]
    bare = Counter(r.method for r in told.records if keys and r.whole and all(r.figures.get(k) is None for k in keys))
    return [f"{_label(told, method)}: n/a in {number} cases" for method, number in bare.items()]


def _machines(told: Told) -> list[str]:
    whole = [r.machine for r in told.records if r.whole]
    found = []
    if any(SIDE_BY_SIDE.search(machine) for machine in whole):
        found.append("seconds were measured with several methods side by side: they compare less well")
    names = list(dict.fromkeys(SIDE_BY_SIDE.sub("", LOAD.sub("", machine)) for machine in whole if machine))
    if len(names) > 1:
        found.append(f"seconds come from {len(names)} machines: they compare only within one")
    return found + [f"machine: {name}" for name in names]


def _rows(told: Told) -> Iterable[str]:
    """What the methods say of themselves."""
    for method in dict.fromkeys(r.method for r in told.records):
        said = dict.fromkeys(r.note for r in told.records if r.method == method and r.whole and r.note)
        shown = list(said)[:3]
        if shown:
            more = f"; and {len(said) - 3} other remarks" if len(said) > 3 else ""
            yield f"{_label(told, method)}: " + "; ".join(shown) + more


def _curves(told: Told) -> Iterable[str]:
    """The best that methods which take steps had on their way, and when: more steps may make novel views worse."""
    for method in dict.fromkeys(r.method for r in told.records if r.curve):
        own = [r for r in told.records if r.method == method]
        for block in summary.blocks(own, told.table.split_by):
            within = [r for r in own if summary.block_of(r, told.table.split_by) == block]
            part = f"{told.table.split_by} {block}" if block else ""
            rows = summary.summarize(within)
            for column in summary.leading(told.table.columns, rows):
                way = summary.curve_points(within, method, column.key)
                best, end = summary.best_point(way, column.better), rows[0].figures.get(column.key)
                if best is None or end is None or rows[0].edit_seconds is None:
                    continue
                where = ", ".join(filter(None, [column.group[:1].lower() + column.group[1:], part]))
                shown = f"{best.mean:.{column.digits}f} after {best.steps:g} steps ({seconds(best.seconds)} s)"
                final = f"{end.mean:.{column.digits}f} at the end ({seconds(rows[0].edit_seconds)} s)"
                name = f"best {column.label}{f' ({where})' if where else ''}"
                yield f"{_label(told, method)}, on the way: {name} {shown}, {final}"


def _label(told: Told, method: str) -> str:
    return told.labels.get(method, method)
