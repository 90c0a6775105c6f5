"""`splatpainter batch`: many assets, many variants, one file that says what becomes of them."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_marks import Argument, Positional
from splatpainter.commands.parts.terminal import count, progress
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.batch.cluster import Results
    from splatpainter.batch.plan import Job, JobList

COMMAND = "splatpainter batch"
SUMMARY, PAGE, LOCK = "summary.json", "index.html", ".batch"
"""Files in the folder of results."""
RETRIES = 1
"""Retries of a job whose worker died, where another program follows the batch."""
MAX_LISTED = 10
"""Failed jobs that are named in the terminal; the summary names all."""


@dataclass(frozen=True)
class Config:
    """Make the results that a JOBS.yaml asks for: assets times variants, each by one or more edits (pictures, decals,
    new colours, a project's layers). Run it again after an interruption or a change: jobs that are done stay done.

    Every result has its receipt, as `edit` and `grade` write it. OUT/index.html shows all before and after, and
    summary.json says the same to programs. A job that fails stops no other; then the exit code is 1. The format, with
    an example: docs/guide/batch.md. Needs pip install 'splatpainter[batch]'.

    example:
      splatpainter batch shoes.yaml --workers 4
      splatpainter batch shoes.yaml --dry-run
    """

    jobs: Annotated[Positional[Path], Argument(metavar="JOBS.yaml")]
    """The jobs to do; paths in this file are relative to it."""
    workers: int = 1
    """Worker processes; with --ray and an address: how many jobs at a time (1: as many as the cluster has CPUs)."""
    ray: Annotated[tuple[str, ...] | None, Argument(metavar="[ADDRESS]", help_behavior_hint="")] = None
    """Spread jobs by Ray: over the cluster at ADDRESS (auto, HOST:PORT, ray://HOST:PORT), or a local Ray."""
    dry_run: bool = False
    """Check the file and print what would be done."""
    overwrite: bool = False
    """Replace results of the same names that no batch made."""
    events: bool = False
    """For programs: print a JSON line whenever a job starts or ends, and stop when stdin ends. What is done stays."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Plan, lock the folder, work, summarise."""
    from splatpainter.batch.plan import read_jobs
    from splatpainter.commands.batch.work import COMMON, BatchWork
    from splatpainter.output_paths import check_folder, made_folder

    # Options that do not go together are refused before the file of jobs is read.
    if config.workers < 1:
        raise ValueError(f"{COMMAND}: expected --workers of at least 1, got {config.workers}")
    if config.ray is not None and len(config.ray) > 1:
        raise ValueError(f"{COMMAND}: expected one address behind --ray, got {len(config.ray)}")
    if config.events and config.ray is not None:
        raise ValueError(f"{COMMAND}: expected --events or --ray, not both")
    plan = read_jobs(config.jobs, config.overwrite)
    # The folder is looked at before anything is loaded that takes long.
    check_folder(plan.out)
    if config.dry_run:
        # A dry run needs neither the folder nor what draws the page.
        return _dry_run(plan)
    from splatpainter.commands.batch.page import require_jinja, write_page

    require_jinja()
    # Two batches in one folder would take each other's half-done steps for their own.
    with made_folder(plan.out), _locked(plan.out):
        work = BatchWork(plan.jobs)
        records = follow_jobs(work, plan.jobs, config) if config.events else run_jobs(work, plan.jobs, config)
        write_summary(plan, records)
        write_page(plan, records)
        # Steps in common are kept while a job may still need them.
        if all(record["status"] == "done" for record in records):
            shutil.rmtree(plan.out / "jobs" / COMMON, ignore_errors=True)
    return _outcome(plan, records, config)


def run_jobs(work: Callable[[int], dict[str, Any]], jobs: tuple[Job, ...], config: Config) -> list[dict[str, Any]]:
    """Run the jobs here; returns their records, in order; jobs that no worker survived have failed."""
    records: list[dict[str, Any]] = [{}] * len(jobs)
    results = _results(work, len(jobs), config)
    # Records keep the order of the jobs, whichever ends first.
    try:
        for number, record in progress(results, len(jobs), "jobs"):
            records[number] = _record(jobs[number], record)
    finally:
        # Closed in any case: workers must not outlive an interruption.
        results.close()
    return records


def follow_jobs(work: Callable[[int], dict[str, Any]], jobs: tuple[Job, ...], config: Config) -> list[dict[str, Any]]:
    """As `run_jobs`, in processes of their own, with a JSON line on stdout for whatever happens. When stdin ends, jobs
    that are not done are ended; their status is "cancelled"."""
    from splatpainter.batch import cluster
    from splatpainter.commands.batch.work import facts

    # The studio holds the other end of stdin: when it goes, the jobs go.
    stopped = threading.Event()
    threading.Thread(target=_wait_for_end_of_stdin, args=(stopped,), daemon=True).start()
    waiting, started = list(range(len(jobs))), set[int]()
    # All are taken for cancelled until something else is known, so that an early end leaves no job without a word.
    records = [{**facts(job), "status": "cancelled", "error": "cancelled"} for job in jobs]
    results = cluster.run_in_pool(work, range(len(jobs)), config.workers, RETRIES, stopped.is_set)
    try:
        _say_started(waiting[: config.workers], started)
        # A place in the pool is free now, so the next of those that wait has begun.
        for number, record in results:
            records[number] = _record(jobs[number], record)
            waiting.remove(number)
            _say({"event": "ended", "job": number, "record": records[number]})
            _say_started(waiting[: config.workers], started)
    finally:
        results.close()
    return records


def _record(job: Job, result: Any) -> dict[str, Any]:
    from splatpainter.batch.cluster import LostTask
    from splatpainter.commands.batch.work import failure

    # A worker that died said nothing; its job has failed like any other.
    if isinstance(result, LostTask):
        return {**failure(job, result.reason), "warnings": [], "seconds": 0.0}
    return result


def _say(event: dict[str, Any]) -> None:
    print(json.dumps(event, default=str), flush=True)


def _say_started(numbers: list[int], started: set[int]) -> None:
    """Jobs are taken in their order, so the first of those that wait are in work."""
    for number in numbers:
        if number not in started:
            started.add(number)
            _say({"event": "started", "job": number})


def _wait_for_end_of_stdin(stopped: threading.Event) -> None:
    with contextlib.suppress(OSError):
        while os.read(0, 4096):  # no lock of sys.stdin's, which the end of the process would wait for
            pass
    stopped.set()


def _results(work: Callable[[int], dict[str, Any]], total: int, config: Config) -> Results[dict[str, Any]]:
    from splatpainter.batch import cluster

    numbers = range(total)
    # A local Ray has as many workers as were asked for; a cluster as many as it has places, unless told otherwise.
    if config.ray is not None:
        local = not config.ray
        workers = config.workers if local or config.workers > 1 else None
        return cluster.run_on_ray(work, numbers, None if local else config.ray[0], workers)
    if config.workers > 1:
        return cluster.run_in_pool(work, numbers, config.workers)
    return cluster.run_here(work, numbers)


def write_summary(plan: JobList, records: list[dict[str, Any]]) -> None:
    from splatpainter.system.atomic import write_text

    counts = count_states(records)
    summary = {"jobs_file": str(plan.file), **counts, "jobs": records}
    write_text(plan.out / SUMMARY, json.dumps(summary, indent=2) + "\n")


def count_states(records: list[dict[str, Any]]) -> dict[str, int]:
    """Jobs by what became of them; `cancelled` only where there are any."""
    counts = Counter(record["status"] for record in records)
    return {
        "done": counts["done"],
        "failed": counts["failed"],
        **{name: counts[name] for name in ("cancelled",) if counts[name]},
    }


def _outcome(plan: JobList, records: list[dict[str, Any]], config: Config) -> Outcome:
    if config.events:
        # The program that follows reads lines, and this is the last one.
        counts = count_states(records)
        return Outcome({}, [json.dumps({"event": "end", **counts})], 0 if counts["done"] == len(records) else 1)
    # A job that failed stops no other, but the exit code says that there was one.
    failed = [record for record in records if record["status"] != "done"]
    before = sum(bool(record.get("resumed")) for record in records)
    note = f", {before:,} of them there before" if before else ""
    lines = [f"{len(records) - len(failed):,} of {count(len(records), 'job')} done{note}"]
    # The first ones only; the page and the summary name all.
    lines += [f"failed: {record['name']}: {record['error']}" for record in failed[:MAX_LISTED]]
    lines += [f"... and {len(failed) - MAX_LISTED:,} more"] if len(failed) > MAX_LISTED else []
    lines.append(f"-> {plan.out / PAGE}")
    record = {"out": plan.out, "summary": plan.out / SUMMARY, "page": plan.out / PAGE, "jobs": records}
    record |= {"done": len(records) - len(failed), "failed": len(failed)}
    return Outcome(record, lines, 1 if failed else 0)


def _dry_run(plan: JobList) -> Outcome:
    """What would be done, and how often sources would be asked: of jobs that are not done, nothing counted that a
    killed run has asked already."""
    from splatpainter.commands.batch.work import calls_of, finished

    jobs, lines, totals = [], [], {True: 0, False: 0}
    counted: set[Path] = set()
    for job in plan.jobs:
        # Jobs are planned one by one, and one that cannot be done must not hide the others.
        calls: list[dict[str, Any]] = []
        try:
            # A job that cannot be done says so here, before anything is paid for the others.
            state, reason = ("done", "") if finished(job, job.hashes()) else ("to do", "")
            calls = calls_of(job, counted) if state == "to do" else []
        except (ValueError, OSError) as error:
            state, reason = "fails", str(error)
        for call in calls:
            totals[call["paid"]] += call["calls"]
        kinds = [step.kind for step in job.steps]
        entry = {"name": job.name, "asset": job.asset, "out": job.out, "edits": kinds, "state": state}
        entry["calls"] = [{name: call[name] for name in ("source", "calls", "paid")} for call in calls]
        jobs.append(entry | ({"error": reason} if reason else {}))
        lines.append(f"{state}: {job.asset} -> {job.out} ({', '.join(kinds)}){': ' + reason if reason else ''}")
    # Only what is left to do costs anything: what is done stays done.
    waiting = sum(entry["state"] == "to do" for entry in jobs)
    sources = [count(number, "paid call" if paid else "free call") for paid, number in totals.items() if number]
    lines.append(f"{waiting:,} of {count(len(jobs), 'job')} to do{': ' + ', '.join(sources) if sources else ''}")
    failing = any(entry["state"] == "fails" for entry in jobs)
    record = {"jobs": jobs, "to_do": waiting, "paid_calls": totals[True], "free_calls": totals[False]}
    return Outcome(record, lines, 1 if failing else 0)


class _locked:
    """Holds the folder of results, so that two batches do not write into each other."""

    def __init__(self, folder: Path) -> None:
        from splatpainter.session.project.lock import ProjectLock

        # Taken for the whole run and not for each job: steps of several jobs lie side by side.
        lock = ProjectLock.take(folder / LOCK)
        if lock is None:
            raise ValueError(f"{folder}: another batch is writing there; wait for it, or name another out")
        self._lock = lock

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        self._lock.release()
