"""Cases x methods: make the cases that are not on disk, let every method answer those it has not, write the table.

Everything is a file (stock.py, records.py), so that a run goes on where another one stopped, several machines fill one
folder, and the table depends on what was answered, not on how. Ground truth may be made by several processes; methods
run one at a time, for their seconds are compared.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from splatbench import case_store as stock
from splatbench import methods as registry
from splatbench import tables as protocols
from splatbench import timing
from splatbench.methods import Budget, Method
from splatbench.notes import Told, complete, lines
from splatbench.process import WorkerJob, Workers, one_line
from splatbench.records import Record, records
from splatbench.report import tables
from splatbench.report.summary import RUN_FILE, MethodNames, SummaryRow, summarize
from splatbench.tables import Key, Setup
from splatbench.worker import SETUP_PATHS, to_json
from splatpainter.io import files
from splatpainter.kernels.parallel import threads

Redo = Literal["nothing", "errors", "all"]
"""Which records that are up to date are made anew."""
COMMAND: tuple[str, ...] = (sys.executable, "-m", "splatbench.worker")
SETUP = "setup.json"
"""In OUT/PROTOCOL: what its cases were made with."""


@dataclass(frozen=True)
class Finished:
    """What a run left."""

    folder: Path
    """OUT/PROTOCOL."""
    rows: list[SummaryRow]
    table: str
    """Markdown."""
    notes: list[str]
    """Lines below the table."""
    complete: bool
    """Whether all rows that could run have all figures, for as many objects as asked."""


@dataclass(frozen=True)
class Asked:
    """One run; the same for all its parts."""

    protocol: str
    setup: Setup
    methods: Sequence[str]
    """Names, in any order."""
    budget: Budget
    out: Path
    processes: int = 1
    """That make ground truth at once."""
    shard: tuple[int, int] = (0, 1)
    """(k, n): only the objects k, k + n, ...; machines with the other k fill the same folder."""
    redo: Redo = "nothing"
    perceptual: Path | None = None
    """Folder of the LPIPS-Alex weights; None: no LPIPS."""
    parallel_methods: bool = False
    """Methods run side by side, `processes` at a time: their seconds say less, and the table says so."""
    named: bool = False
    """The methods were asked for one by one: one that cannot run here then leaves the table incomplete."""


def run(asked: Asked, say: Callable[[str], None]) -> Finished:
    """Make, measure, write the table. say: gets a line whenever something is done.

    Raises ValueError before any work: unknown protocol or method, data that gives no case, a folder with cases of
    another setup (unless all is to be made again)."""
    table = protocols.table(asked.protocol)
    known = registry.all_methods()
    chosen = [known[name] for name in known if name in asked.methods]
    if missing := sorted(set(asked.methods) - set(known)):
        raise ValueError(f"bench {asked.protocol}: expected methods of {', '.join(known)}, got {missing[0]!r}")
    keys = table.keys(asked.setup)
    own = of_shard(keys, asked.shard)
    folder = asked.out / asked.protocol
    machine = timing.machine()
    _claim(asked, folder)
    with Workers(COMMAND) as children:
        _make(asked, own, children, say)
        made = [key for key in own if _made(asked, key)]
        _answer(asked, made, chosen, machine, children, say)
    return report(asked, keys, own, known, folder, machine)


def of_shard(keys: Sequence[Key], shard: tuple[int, int]) -> list[Key]:
    """The cases of every n-th object from the k-th on: cases of one object share their ground truth."""
    names = list(dict.fromkeys(key.name for key in keys))
    own = set(names[shard[0] :: shard[1]])
    return [key for key in keys if key.name in own]


def fingerprint(digest: str, version: str, budget: Budget, perceptual: bool) -> str:
    """Of a record: digest of its case, and 16 hex digits of what else decides its figures: the method's version, the
    budget, whether LPIPS was measured."""
    told = [version, budget.steps, budget.device, budget.seed, budget.curve, perceptual]
    return f"{digest}-{hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]}"


def report(
    asked: Asked, keys: Sequence[Key], own: Sequence[Key], known: dict[str, Method], folder: Path, machine: str
) -> Finished:
    """The table of everything in the folder that belongs to these cases, also from earlier runs and other machines."""
    table = protocols.table(asked.protocol)
    digests = {key.label: stock.digest(asked.out, asked.protocol, key.label) for key in keys if _made(asked, key)}
    current = [r for r in records(folder) if r.label in digests and r.fingerprint.startswith(f"{digests[r.label]}-")]
    versions = {m.name: _version(m, asked.budget) for m in known.values() if any(r.method == m.name for r in current)}
    told = Told(
        asked=asked,
        objects=tuple(dict.fromkeys(key.name for key in keys)),
        own=frozenset(key.label for key in own),
        failed=stock.failures(asked.out, asked.protocol, [key.label for key in keys if key.label not in digests]),
        records=tuple(current),
        outdated=tuple(r for r in current if r.whole and r.fingerprint != _wanted(asked, r, digests, versions)),
        table=table,
        labels={name: method.label for name, method in known.items()},
    )
    rows = summarize(current, table.split_by, tuple(known))
    names = MethodNames.of(known, (r.method for r in current))
    layout = tables.grid(asked.protocol, table.columns, rows, names, table.split_by)
    notes = lines(told)
    folder.mkdir(parents=True, exist_ok=True)
    figures, means = tables.case_figures(current), tables.mean_figures(asked.protocol, rows)
    tables.write_tables(folder, table.title, layout, figures, means, notes)
    about = {
        "protocol": asked.protocol,
        "title": table.title,
        "setup": to_json(asked.setup),
        "budget": to_json(asked.budget),
        "perceptual": asked.perceptual is not None,
        "labels": [key.label for key in keys],
        "machine": machine,
        "notes": notes,
    }
    with files.writing(folder / RUN_FILE) as file:
        file.write(json.dumps(about, indent=1).encode())
    return Finished(folder, rows, tables.markdown(layout), notes, complete(told))


def _claim(asked: Asked, folder: Path) -> None:
    """Note the setup that the folder's cases are of. Raises ValueError where it holds those of another one: hours of
    path tracing are not to be lost by a word. Numbers of objects and places of files may differ."""
    own, there = to_json(asked.setup), _claimed(folder)
    compared = [name for name in own if name in there and name not in ("objects", *SETUP_PATHS)]
    if other := [f"{name} {there[name]}, not {own[name]}" for name in compared if there[name] != own[name]]:
        if asked.redo != "all":
            raise ValueError(
                f"bench {asked.protocol}: {folder} holds cases of another setup ({'; '.join(other)}); "
                "take another --out, or --redo all to make them anew"
            )
    folder.mkdir(parents=True, exist_ok=True)
    with files.writing(folder / SETUP) as file:
        file.write(json.dumps(own, indent=1).encode())


def _claimed(folder: Path) -> dict[str, Any]:
    """The setup that was noted; of folders without a note, that of the last run that ended; {}: none is known."""
    for path, inside in ((folder / SETUP, False), (folder / RUN_FILE, True)):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            told = json.loads(path.read_bytes())
            return dict(told["setup"] if inside else told)
    return {}


def _made(asked: Asked, key: Key) -> bool:
    folder = stock.case_folder(asked.out, asked.protocol, key.label)
    return stock.is_made(folder, stock.stamp(asked.protocol, key, asked.setup))


def _make(asked: Asked, keys: Sequence[Key], children: Workers, say: Callable[[str], None]) -> None:
    wanted: dict[str, list[dict[str, Any]]] = {}
    for key in keys:
        if not _made(asked, key):
            stamp = stock.stamp(asked.protocol, key, asked.setup)
            wanted.setdefault(key.name, []).append({**asdict(key), "stamp": stamp})
    if not wanted:
        return
    count = min(asked.processes, len(wanted))
    objects = list(wanted.values())
    job = {
        "task": "make",
        "protocol": asked.protocol,
        "setup": to_json(asked.setup),
        "out": str(asked.out.absolute()),
    }
    share = None if count == 1 else max(1, threads() // count)
    log = asked.out / asked.protocol / "logs"
    plans = [
        WorkerJob(
            f"cases {k}", job, tuple(item for items in objects[k::count] for item in items), log / f"cases-{k}.log"
        )
        for k in range(count)
    ]
    plans = [replace(plan, threads=share) for plan in plans]
    names = {item["label"]: item["name"] for items in objects for item in items}
    for number, event in enumerate(children.run(plans, count), 1):
        reason = event.message or event.crash
        if reason:
            stock.fail(asked.out, asked.protocol, event.label, names[event.label], reason)
        say(f"{asked.protocol}: case {number} of {len(names)}: {event.label}" + (f": {reason}" if reason else ""))


def _answer(
    asked: Asked,
    keys: Sequence[Key],
    chosen: Sequence[Method],
    machine: str,
    children: Workers,
    say: Callable[[str], None],
) -> None:
    cases = []
    for key in keys:
        place = asked.out, asked.protocol, key.label
        cases.append((key.label, stock.digest(*place), *stock.about(*place)))
    side_by_side = asked.parallel_methods and asked.processes > 1 and len(chosen) > 1
    where = f"{machine}; {asked.processes} methods side by side" if side_by_side else machine
    blanks: dict[tuple[str, str], Record] = {}
    plans = []
    for method in chosen:
        version, why = _version(method, asked.budget), _missing(method, asked.budget)
        for label, digest, name, facts in cases:
            print_ = fingerprint(digest, version, asked.budget, asked.perceptual is not None)
            blank = Record(asked.protocol, method.name, label, name, print_, facts=facts, machine=where)
            if why:
                _write(asked, replace(blank, missing=why))
            elif not _up_to_date(asked, blank):
                blanks[method.name, label] = blank
        if why:
            say(f"{asked.protocol}: {method.name}: {why}")
        own = [blank for (name, _), blank in blanks.items() if name == method.name]
        if own:
            plans.append(_plan(asked, method, version, own, where, side_by_side))
    for number, event in enumerate(children.run(plans, asked.processes if side_by_side else 1), 1):
        if event.crash:
            _write(asked, replace(blanks[event.job.name, event.label], error=event.crash))
        reason = event.crash or event.message
        line = f"{asked.protocol}: {number} of {len(blanks)}: {event.job.name} on {event.label}"
        say(line + (f": {reason}" if reason else ""))


def _plan(
    asked: Asked, method: Method, version: str, blanks: Iterable[Record], machine: str, side_by_side: bool
) -> WorkerJob:
    logs = asked.out / asked.protocol / "logs"
    budget = asked.budget if asked.budget.scratch else replace(asked.budget, scratch=logs)
    job = {
        "task": "edit",
        "protocol": asked.protocol,
        "method": method.name,
        "version": version,
        "budget": to_json(budget),
        "out": str(asked.out.absolute()),
        "perceptual": None if asked.perceptual is None else str(asked.perceptual.absolute()),
        "machine": machine,
    }
    items = [{k: getattr(blank, k) for k in ("label", "name", "fingerprint", "facts")} for blank in blanks]
    log = logs / f"{method.name}.log"
    return WorkerJob(
        method.name, job, tuple(items), log, max(1, threads() // asked.processes) if side_by_side else None
    )


def _record_path(asked: Asked, record: Record) -> Path:
    return asked.out / asked.protocol / "records" / record.method / f"{record.label}.json"


def _write(asked: Asked, record: Record) -> None:
    """A record without figures; the picture of an older one goes."""
    path = _record_path(asked, record)
    path.with_suffix(".png").unlink(missing_ok=True)
    record.write(path)


def _up_to_date(asked: Asked, blank: Record) -> bool:
    if asked.redo == "all" or not os.path.exists(_record_path(asked, blank)):
        return False
    try:
        there = Record.read(_record_path(asked, blank))
    except ValueError:
        return False
    wanted = there.whole or (asked.redo == "nothing" and not there.missing)
    return wanted and there.fingerprint == blank.fingerprint


def _wanted(asked: Asked, record: Record, digests: dict[str, str], versions: dict[str, str]) -> str:
    if record.method not in versions:  # a method that is no more
        return ""
    return fingerprint(digests[record.label], versions[record.method], asked.budget, asked.perceptual is not None)


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
