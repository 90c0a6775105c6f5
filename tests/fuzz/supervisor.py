"""Starts workers, gives each target its time, and notices crashes and hangs; a summary at the end."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

from .target import make_target
from .worker import FIELDS, save_failure, work

START_SECONDS = 300.0
"""Wall time until a worker's first input: it may have to compile kernels."""
INPUTS_PER_PROCESS = 40_000
"""Then a fresh process goes on, so that leaks do not add up."""


@dataclass
class Tally:
    """What became of a target's inputs."""

    inputs: int = 0
    opened: int = 0
    refused: int = 0
    failures: int = 0
    seconds: float = 0.0
    """Wall time of trying inputs, over all workers."""
    slowest_us: int = 0
    slowest_seed: int = 0
    peak_kib: int = 0
    crashes: int = 0
    next_seed: int = 0


@dataclass
class Job:
    """A worker at work."""

    target: str
    process: SpawnProcess
    shared: Any
    seconds: float
    born: float
    begun: float | None = None
    """When it tried its first input."""
    moved: float = 0.0
    """When its count of inputs last changed."""
    seen: int = -1
    ended: str = ""
    """Why the supervisor ended it."""

    def value(self, name: str) -> int:
        return self.shared[FIELDS.index(name)]


@dataclass
class Plan:
    """What to run."""

    targets: Sequence[str]
    seconds: float
    """Wall time of the run."""
    jobs: int = 1
    first_seed: int = 0
    most_inputs: int | None = None
    """Of each target."""
    out: Path = Path("out/fuzz")
    hang_seconds: float = 60.0
    """Wall time of one input after which its worker is ended (the CPU limit of a target is much lower)."""
    most_crashes: int = 20
    """Of one target; then it is left."""
    tallies: dict[str, Tally] = field(default_factory=dict)


def run(plan: Plan, say=print) -> dict[str, Tally]:
    """Run the plan: every target gets the same part of the time, in turn."""
    plan.out.mkdir(parents=True, exist_ok=True)
    plan.tallies = {name: Tally(next_seed=plan.first_seed) for name in plan.targets}
    share = plan.seconds * plan.jobs / len(plan.targets)
    waiting = list(plan.targets)
    jobs: list[Job] = []
    try:
        while waiting or jobs:
            while waiting and len(jobs) < plan.jobs:
                name = waiting.pop(0)
                jobs.append(_start(plan, name, share - plan.tallies[name].seconds))
            time.sleep(0.05)
            for job in list(jobs):
                _watch(job, plan.hang_seconds)
                if job.process.is_alive():
                    continue
                jobs.remove(job)
                if _collect(plan, job, share):
                    waiting.insert(0, job.target)
                else:
                    say(_line(job.target, plan.tallies[job.target]), flush=True)
    finally:
        for job in jobs:
            job.process.kill()
            job.process.join()
    return plan.tallies


def _start(plan: Plan, name: str, seconds: float) -> Job:
    tally = plan.tallies[name]
    count = INPUTS_PER_PROCESS
    if plan.most_inputs is not None:
        count = min(count, plan.most_inputs - tally.inputs)
    context = multiprocessing.get_context("spawn")
    shared = context.RawArray("q", len(FIELDS))
    arguments = (name, tally.next_seed, 1, count, seconds, str(plan.out), shared)
    process = context.Process(target=work, args=arguments, daemon=True)
    process.start()
    return Job(name, process, shared, seconds, time.monotonic())


def _watch(job: Job, hang_seconds: float) -> None:
    """End a worker that does not move."""
    now = time.monotonic()
    if not job.value("started"):
        if now - job.born > START_SECONDS:
            job.ended = f"no input within {START_SECONDS:.0f} s"
            job.process.kill()
        return
    if job.begun is None:
        job.begun = now
    if job.value("inputs") != job.seen:
        job.seen, job.moved = job.value("inputs"), now
    elif now - job.moved > hang_seconds and job.process.is_alive():
        job.ended = f"hang: more than {hang_seconds:.0f} s"
        job.process.kill()


def _collect(plan: Plan, job: Job, share: float) -> bool:
    """Add up what a worker did; True where its target is to go on."""
    job.process.join()
    tally, died = plan.tallies[job.target], job.process.exitcode != 0
    for name in ("inputs", "opened", "refused", "failures"):
        setattr(tally, name, getattr(tally, name) + job.value(name))
    tally.peak_kib = max(tally.peak_kib, job.value("peak_kib"))
    if job.value("slowest_us") > tally.slowest_us:
        tally.slowest_us, tally.slowest_seed = job.value("slowest_us"), job.value("slowest_seed")
    now = time.monotonic()
    tally.seconds += now - (job.begun or now)
    tally.next_seed += job.value("inputs") + (1 if died else 0)
    if died:
        tally.crashes += 1
        tally.failures += 1
        why = job.ended or f"the process died (exit code {job.process.exitcode})"
        seed = job.value("seed") if job.value("started") else -1
        _save_crash(plan.out, job.target, seed, why)
        if not job.value("started"):
            return False  # it cannot even begin
        tally.inputs += 1
    enough = plan.most_inputs is not None and tally.inputs >= plan.most_inputs
    return not enough and tally.crashes < plan.most_crashes and tally.seconds < share - 1


def _save_crash(out: Path, name: str, seed: int, why: str) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        target = None if seed < 0 else make_target(name, Path(folder))
        save_failure(out, target, name, seed, why, "")
        if target is not None:
            target.close()


def summary(tallies: dict[str, Tally]) -> str:
    """A table, one line a target."""
    head = f"{'target':<15}{'inputs':>10}{'opened':>10}{'refused':>10}{'failures':>9}{'inputs/s':>9}{'MiB':>6}  slowest"
    total = Tally(*(sum(getattr(t, n) for t in tallies.values()) for n in ("inputs", "opened", "refused", "failures")))
    total.seconds = sum(t.seconds for t in tallies.values())
    total.peak_kib = max(t.peak_kib for t in tallies.values())
    return "\n".join([head, *(_line(name, tally) for name, tally in tallies.items()), _line("all", total)])


def _line(name: str, tally: Tally) -> str:
    rate = tally.inputs / tally.seconds if tally.seconds > 0 else 0.0
    slow = f"{tally.slowest_us / 1e3:.0f} ms (seed {tally.slowest_seed})" if tally.slowest_us else ""
    counts = f"{tally.inputs:>10,}{tally.opened:>10,}{tally.refused:>10,}{tally.failures:>9,}"
    return f"{name:<15}{counts}{rate:>9.0f}{tally.peak_kib >> 10:>6}  {slow}"


def faults(out: Path) -> list[dict[str, Any]]:
    """Distinct faults of a run: same target, same place in the code; with how many inputs show them."""
    seen: dict[str, dict[str, Any]] = {}
    for file in sorted(out.glob("*/fault.json")):
        record = json.loads(file.read_text(encoding="utf-8"))
        about = "".join(letter for letter in record["fault"].split(":")[0] if not letter.isdigit())
        key = json.dumps([record["target"], record["where"], about])
        seen.setdefault(key, {**record, "count": 0})["count"] += 1
    return list(seen.values())
