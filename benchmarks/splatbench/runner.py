"""Cases x methods: make the cases that are not on disk, let every method answer those it has not, write the table.

Everything is a file (cases.py), so that a run goes on where another one stopped, several machines fill one folder, and
the table depends on what was answered, not on how. The work is done by worker processes: ground truth by several,
methods one at a time, for their seconds are compared. Jobs of the workers (process.py):

    make   values {"task", "protocol", "setup", "out"}, items {"label", "name", "settings", "stamp"}
    edit   values {"task", "protocol", "method", "version", "budget", "out", "perceptual", "machine"},
           items {"label", "name", "fingerprint", "facts"}

What fails is said in the record (edit) or in the worker's message (make), and the next case begins.
"""

from __future__ import annotations

import json
import math
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatbench import methods as registry
from splatbench import tables, timing
from splatbench.cases import (
    Budget,
    Case,
    CaseKey,
    CaseStore,
    Record,
    RunConfig,
    Setup,
    fingerprint,
    records,
    to_json,
)
from splatbench.methods import EditResult, EditTask, Method
from splatbench.notes import RunState, complete, notes
from splatbench.process import WorkerJob, Workers, answer_jobs, forget_peak, one_line, peak_mib
from splatbench.report import tables as report_tables
from splatbench.report.summary import RUN_FILE, MethodNames, SummaryRow, summarize
from splatbench.tables import BenchTable
from splatpainter.image_files import write_png
from splatpainter.io import files
from splatpainter.kernels.parallel import threads
from splatpainter.splats import Splats, changed_rows, rows_sha256
from splatpainter.system import jsonio

WORKER: tuple[str, ...] = (sys.executable, "-c", "from splatbench.runner import work; work()")
Say = Callable[[str], None]


@dataclass(frozen=True)
class RunResult:
    """Results of a run."""

    folder: Path
    """OUT/TABLE."""
    rows: list[SummaryRow]
    table: str
    """Markdown."""
    notes: list[str]
    """Lines below the table."""
    complete: bool
    """Whether all rows that could run have all figures, for as many objects as asked."""


def run(config: RunConfig, report: Say) -> RunResult:
    """Make, measure, write the table. say: gets a line whenever something is done.

    Raises ValueError before any work: unknown table or method, data that gives no case, a folder with cases of another
    setup (unless all is to be made again)."""
    table, methods = tables.table(config.protocol), registry.all_methods()
    if unknown := sorted(set(config.methods) - set(methods)):
        raise ValueError(f"bench {config.protocol}: expected methods of {', '.join(methods)}, got {unknown[0]!r}")
    chosen = [methods[name] for name in methods if name in config.methods]
    keys = table.keys(config.setup)
    shard_keys = of_shard(keys, config.shard)
    store = CaseStore(config.out, config.protocol)
    machine = timing.machine()
    store.claim(config.setup, config.redo, store.folder / RUN_FILE)
    with Workers(WORKER) as workers:
        _make_cases(config, store, shard_keys, workers, report)
        ready = [key.label for key in shard_keys if store.has(key, config.setup)]
        _answer_cases(config, store, ready, chosen, machine, workers, report)
    return write_table(config, store, keys, shard_keys, methods, machine)


def of_shard(keys: Sequence[CaseKey], shard: tuple[int, int]) -> list[CaseKey]:
    """The cases of every n-th object from the k-th on: cases of one object share their ground truth."""
    objects = list(dict.fromkeys(key.name for key in keys))
    chosen = set(objects[shard[0] :: shard[1]])
    return [key for key in keys if key.name in chosen]


def write_table(
    config: RunConfig,
    store: CaseStore,
    keys: Sequence[CaseKey],
    shard_keys: Sequence[CaseKey],
    methods: dict[str, Method],
    machine: str,
) -> RunResult:
    """The table of everything in the folder that belongs to these cases, also from earlier runs and other machines."""
    table = tables.table(config.protocol)
    digests = {key.label: store.digest(key.label) for key in keys if store.has(key, config.setup)}
    current = [
        r for r in records(store.folder) if r.label in digests and r.fingerprint.startswith(f"{digests[r.label]}-")
    ]
    perceptual = config.perceptual is not None
    versions = {
        name: _version(m, config.budget) for name, m in methods.items() if any(r.method == name for r in current)
    }

    def is_outdated(record: Record) -> bool:
        if record.method not in versions:  # a method that is no more
            return True
        expected = fingerprint(digests[record.label], versions[record.method], config.budget, perceptual)
        return record.fingerprint != expected

    labels = {name: method.label for name, method in methods.items()}
    state = RunState(
        config=config,
        objects=tuple(dict.fromkeys(key.name for key in keys)),
        shard_labels=frozenset(key.label for key in shard_keys),
        failed=store.failures([key.label for key in keys if key.label not in digests]),
        records=tuple(current),
        outdated=tuple(r for r in current if r.has_figures and is_outdated(r)),
        table=table,
        labels=labels,
    )
    rows = summarize(current, table.split_by, tuple(methods))
    names = MethodNames.of(methods, (r.method for r in current), labels)
    layout = report_tables.grid(config.protocol, table.columns, rows, names, table.split_by)
    lines = notes(state)
    store.folder.mkdir(parents=True, exist_ok=True)
    figures, means = report_tables.case_figures(current), report_tables.mean_figures(config.protocol, rows)
    report_tables.write_tables(store.folder, table.title, layout, figures, means, lines)
    about = {
        "protocol": config.protocol,
        "title": table.title,
        "setup": to_json(config.setup),
        "budget": to_json(config.budget),
        "perceptual": perceptual,
        "labels": [key.label for key in keys],
        "machine": machine,
        "notes": lines,
        "methods": {name: labels[name] for name in names.order if name in labels},
    }
    with files.writing(store.folder / RUN_FILE) as file:
        file.write(json.dumps(about, indent=1).encode())
    return RunResult(store.folder, rows, report_tables.markdown(layout), lines, complete(state))


# What the runner asks of its workers.


def _make_cases(config: RunConfig, store: CaseStore, keys: Sequence[CaseKey], workers: Workers, report: Say) -> None:
    by_object: dict[str, list[dict[str, Any]]] = {}
    for key in keys:
        if not store.has(key, config.setup):
            item = {**asdict(key), "stamp": store.stamp(key, config.setup)}
            by_object.setdefault(key.name, []).append(item)
    if not by_object:
        return
    count = min(config.processes, len(by_object))
    objects = list(by_object.values())
    values = {
        "task": "make",
        "protocol": config.protocol,
        "setup": to_json(config.setup),
        "out": str(config.out.absolute()),
    }
    share = None if count == 1 else max(1, threads() // count)
    jobs = []
    for k in range(count):
        items = tuple(item for items in objects[k::count] for item in items)
        jobs.append(WorkerJob(f"cases {k}", values, items, store.logs / f"cases-{k}.log", share))
    names = {item["label"]: item["name"] for items in objects for item in items}
    for number, event in enumerate(workers.run(jobs, count), 1):
        reason = event.message or event.crash
        if reason:
            store.save_failure(event.label, names[event.label], reason)
        report(f"{config.protocol}: case {number} of {len(names)}: {event.label}" + (f": {reason}" if reason else ""))


def _answer_cases(
    config: RunConfig,
    store: CaseStore,
    labels: Sequence[str],
    chosen: Sequence[Method],
    machine: str,
    workers: Workers,
    report: Say,
) -> None:
    cases = [(label, store.digest(label), *store.describe(label)) for label in labels]
    side_by_side = config.parallel_methods and config.processes > 1 and len(chosen) > 1
    where = f"{machine}; {config.processes} methods side by side" if side_by_side else machine
    blanks: dict[tuple[str, str], Record] = {}
    jobs = []
    for method in chosen:
        version, missing = _version(method, config.budget), _missing(method, config.budget)
        pending = []
        for label, digest, name, facts in cases:
            print_ = fingerprint(digest, version, config.budget, config.perceptual is not None)
            blank = Record(config.protocol, method.name, label, name, print_, facts=facts, machine=where)
            if missing:
                store.save_record(replace(blank, missing=missing))
            elif not store.is_current(blank, config.redo):
                pending.append(blank)
                blanks[method.name, label] = blank
        if missing:
            report(f"{config.protocol}: {method.name}: {missing}")
        if pending:
            jobs.append(edit_job(config, store, method, version, pending, where, side_by_side))
    for number, event in enumerate(workers.run(jobs, config.processes if side_by_side else 1), 1):
        if event.crash:
            store.save_record(replace(blanks[event.job.name, event.label], error=event.crash))
        reason = event.crash or event.message
        line = f"{config.protocol}: {number} of {len(blanks)}: {event.job.name} on {event.label}"
        report(line + (f": {reason}" if reason else ""))


def edit_job(
    config: RunConfig,
    store: CaseStore,
    method: Method,
    version: str,
    blanks: Iterable[Record],
    machine: str,
    side_by_side: bool,
) -> WorkerJob:
    """One method on the cases of these records, which have no figures yet."""
    budget = config.budget if config.budget.scratch else replace(config.budget, scratch=store.logs)
    values = {
        "task": "edit",
        "protocol": config.protocol,
        "method": method.name,
        "version": version,
        "budget": to_json(budget),
        "out": str(config.out.absolute()),
        "perceptual": None if config.perceptual is None else str(config.perceptual.absolute()),
        "machine": machine,
    }
    items = tuple({k: getattr(blank, k) for k in ("label", "name", "fingerprint", "facts")} for blank in blanks)
    share = max(1, threads() // config.processes) if side_by_side else None
    return WorkerJob(method.name, values, items, store.logs / f"{method.name}.log", share)


def _missing(method: Method, budget: Budget) -> str:
    try:
        return method.missing(budget)
    except ValueError as error:  # e.g. a file of adapters that cannot be read
        return f"cannot run: {one_line(error)}"


def _version(method: Method, budget: Budget) -> str:
    try:
        return method.version(budget)
    except ValueError as error:
        return f"none: {one_line(error)}"


# What the workers do.


def work(ready: Callable[[], None] | None = None) -> None:
    """Do the job on stdin. ready: called before the first edit, so that no method pays for loading what all share."""

    def begin(values: dict[str, Any]) -> Callable[[dict[str, Any]], str]:
        if values["task"] == "make":
            return _maker(values)
        (load_kernels if ready is None else ready)()
        return _editor(values)

    answer_jobs(begin)


def load_kernels() -> None:
    """Load the compiled kernels."""
    from splatpainter.kernels import library

    library.current()


def _maker(values: dict[str, Any]) -> Callable[[dict[str, Any]], str]:
    table, setup = tables.table(values["protocol"]), jsonio.build(Setup, values["setup"], "setup")
    store = CaseStore(Path(values["out"]), values["protocol"])

    def make(item: dict[str, Any]) -> str:
        try:
            case = table.make(CaseKey(item["label"], item["name"], item["settings"]), setup)
            unedited = [EditResult(case.asset, 0.0, 0.0)] * len(case.steps)
            store.save(case, item["stamp"], table.pictures(case, unedited))
        except Exception as error:
            return _logged(item["label"], error)
        return ""

    return make


def _editor(values: dict[str, Any]) -> Callable[[dict[str, Any]], str]:
    table, budget = tables.table(values["protocol"]), jsonio.build(Budget, values["budget"], "budget")
    store = CaseStore(Path(values["out"]), values["protocol"])
    method = registry.all_methods()[values["method"]]
    perceptual = None
    if values["perceptual"] is not None:
        from splatpainter.metrics import Lpips

        perceptual = Lpips.load("alex", values["perceptual"])
    machine = values["machine"] + _gpu(budget)

    def edit(item: dict[str, Any]) -> str:
        label = item["label"]
        record = Record(values["protocol"], method.name, label, item["name"], item["fingerprint"], facts=item["facts"])
        record = replace(record, machine=machine)
        path = store.record_path(method.name, label)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            if method.version(budget) != values["version"]:
                raise ValueError(f"{method.name}: its weights or settings changed since the run began; start it again")
            case = store.load(label)
            results, peak = edited(case, method, budget)
            record = measured(record, table, case, results, perceptual, peak)
            write_png(path.with_suffix(".png"), np.asarray(table.pictures(case, results)["result"]))
        except Exception as error:
            record = replace(record, error=_logged(label, error), figures={}, curve=[])
        record.write(path)
        return record.error

    return edit


def edited(case: Case, method: Method, budget: Budget) -> tuple[list[EditResult], float]:
    """(what the method made of each step, each begun from the one before, peak memory in MiB meanwhile or NaN).

    Raises what the method raises, and ValueError where it wrote into the asset that it was given."""
    forget_peak()  # scoring the case before is not the method's
    results: list[EditResult] = []
    asset, state = case.asset, None
    for step in case.steps:
        before = rows_sha256(asset)
        task = EditTask(case.protocol, asset, case.base, step, case.true_views if method.sees_truth else None, state)
        result = method.edit(task, budget)
        if rows_sha256(asset) != before:
            raise ValueError(f"{method.name}: changed the asset in place; its answer cannot be compared")
        result = replace(result, splats=result.splats.numpy())
        results.append(result)
        asset, state = result.splats, result.state
    return results, peak_mib()


def measured(
    record: Record, table: BenchTable, case: Case, results: Sequence[EditResult], perceptual: Any | None, peak: float
) -> Record:
    """The record with all its figures. Seconds of set-up and of edits are sums over the steps."""
    keeps = all(result.keeps_gaussians for result in results)
    last = results[-1]
    numbers = {key: value for result in results for key, value in result.numbers.items()}
    points = []
    for seconds, steps, splats in last.curve:
        then = [*results[:-1], replace(last, splats=splats.numpy(), curve=())]
        points.append({"seconds": seconds, "steps": steps, **_figures(table.score(case, then, perceptual))})
    return replace(
        record,
        figures=_figures(table.score(case, results, perceptual)),
        setup_seconds=sum(result.setup_seconds for result in results),
        edit_seconds=sum(result.edit_seconds for result in results),
        peak_mib=None if math.isnan(peak) else peak,
        rows=len(last.splats),
        rows_equal=share_equal(case.asset, last.splats) if keeps else None,
        appended=len(last.splats) - len(case.asset) if keeps else None,
        numbers={key: float(value) for key, value in numbers.items()},
        note="; ".join(dict.fromkeys(result.note for result in results if result.note)),
        curve=points,
    )


def share_equal(before: Splats, after: Splats) -> float:
    """Share of the Gaussians of `before` whose every attribute kept its bits in the same one of `after`, which has at
    least as many. Raises ValueError where it has fewer."""
    if len(after) < len(before):
        raise ValueError(f"rows equal: an answer that keeps Gaussians has {len(after)} of the asset's {len(before)}")
    return 1.0 - len(changed_rows(before.numpy(), after.numpy())) / len(before) if len(before) else 1.0


def _figures(values: dict[str, float | None]) -> dict[str, float | None]:
    """NaN becomes None: there is no number."""
    return {k: None if v is None or math.isnan(v) else float(v) for k, v in values.items()}


def _gpu(budget: Budget) -> str:
    if budget.device != "cuda":
        return ""
    import torch

    return f"; {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""


def _logged(label: str, error: Exception) -> str:
    print(f"{label}:", file=sys.stderr)
    traceback.print_exc()
    return one_line(error)
