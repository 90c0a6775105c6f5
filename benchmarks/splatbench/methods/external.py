"""Systems outside this package, where a user has them: one row each, else "not installed".

A row is: write what the system reads, run its commands in its own environment, read back what it made (external/).
Set-up is the writing and the system's own preparation; the edit is its command; turning its result into a readable file
counts as neither. No row has a figure unless the system really ran.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from splatbench.adapters import config, dge, instruct_gs2gs, relitlrm, vinedresser, voxhammer
from splatbench.adapters.plans import Commands, Job, Plan, System, common, overridden
from splatbench.methods import Budget, Done, Method, Work
from splatpainter.splats import Splats

SYSTEMS = (voxhammer.SYSTEM, vinedresser.SYSTEM, dge.SYSTEM, instruct_gs2gs.SYSTEM, relitlrm.SYSTEM)
VERSION = "1"
"""Of what the systems are given."""
LOG = "log.txt"
"""Of a job's folder, which stays after a failure; with a scratch folder the log stays in any case."""


def missing(system: System, budget: Budget) -> str:
    """Why the system is not run here, or ""."""
    try:
        own = None if budget.adapters is None else config.section(budget.adapters, system.name)
        if own is None:
            return config.absent(budget.adapters, system.name)
    except ValueError as error:
        return str(error)
    return system.missing(own) or config.problem(own, system.needs, config.has_cuda_gpu)


def version(system: System, budget: Budget) -> str:
    """Changes with the section, the commit of the checkout, and this package's files."""
    try:
        own = None if budget.adapters is None else config.section(budget.adapters, system.name)
    except ValueError:
        own = None
    return f"{VERSION}-{own.digest() if own else 'none'}"


def edit(system: System, work: Work, budget: Budget) -> Done:
    """The asset as the system edits it. Raises ValueError: it is not there (`missing`), it fails or takes too long (the
    last line of its log, and where that is), what it leaves is not an asset in the asset's place."""
    why = missing(system, budget)
    if why:
        raise ValueError(why)
    assert budget.adapters is not None
    own = config.section(budget.adapters, system.name)
    assert own is not None
    if budget.scratch is not None:
        budget.scratch.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{system.name}-", dir=budget.scratch)).resolve()
    failed = True
    try:
        done = _edit(system, work, own, budget.seed, folder)
        failed = False
        return done
    finally:
        if not (folder / LOG).exists() or (budget.scratch is None and not failed):
            shutil.rmtree(folder, ignore_errors=True)
        elif not failed:
            _keep_only(folder / LOG)


def _keep_only(log: Path) -> None:
    """Remove what else is in its folder: renders and results are tens of megabytes per case."""
    for path in log.parent.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        elif path != log:
            path.unlink(missing_ok=True)


def _edit(system: System, work: Work, own: config.Section, seed: int, folder: Path) -> Done:
    from splatbench.adapters import exchange, results

    start = time.perf_counter()
    job = Job(work, own, folder, seed, exchange.Cube.of(work.asset))
    for place in (job.inputs, job.workplace):
        place.mkdir()
    values = common(job)
    plan = system.plan(job)
    plan = overridden(plan, job, values | plan.values)
    setup = time.perf_counter() - start + _run(plan.setup, job)
    seconds = _run(plan.edit, job)
    plan.check()
    exporting = _run(plan.export, job)
    if not plan.result.is_file():
        raise ValueError(
            f"{system.label} ended well but left no {plan.result.relative_to(job.out)} in {job.out} "
            f"(log: {folder / LOG})"
        )
    splats = results.read(plan.result, plan.frame(), seed)
    results.check_place(splats, job.cube, plan.result)
    numbers = {"export_seconds": exporting, "rows": float(len(splats))}
    kept = unchanged(work, splats)
    if kept is not None:
        numbers["unmasked_db"] = kept
    return Done(splats, setup, seconds, keeps_rows=False, numbers=numbers, note=_note(plan, own))


def unchanged(work: Work, splats: Splats) -> float | None:
    """PSNR of the result's renders against the asset's in the edited views, where one of them shows something and the
    mask is not: how well the frames fit, and what the system left as it was. At most 100; None: no such pixel."""
    from splatpainter.metrics import psnr
    from splatpainter.rendering import render

    cameras = list(work.step.edited.cameras)
    before, after = render(work.asset, cameras), render(splats, cameras)
    shown = (before.alphas[..., 0] > 0.01) | (after.alphas[..., 0] > 0.01)
    outside = shown & np.logical_not(work.step.masks)
    if not outside.any():
        return None
    width = outside.shape[-1]  # all views as one tall picture
    tall = [np.clip(drawn.colors, 0, 1).reshape(-1, width, 3) for drawn in (before, after)]
    return min(psnr(tall[0], tall[1], outside.reshape(-1, width)), 100.0)


def _run(commands: Commands, job: Job) -> float:
    from splatbench.adapters import call

    own = job.own
    limits = {"timeout": own.timeout_seconds, "environment": own.environment, "python": own.python}
    return sum(call.run(command, job.workplace, job.folder / LOG, **limits) for command in commands)


def _note(plan: Plan, own: config.Section) -> str:
    commit = config.commit(own.repository)
    where = f"; checkout {commit[:7]}" if commit else ""
    return f"{plan.note}{where}{'; command of the adapters file' if own.command else ''}"


METHODS = tuple(
    Method(
        name=system.name,
        label=system.label,
        edit=partial(edit, system),
        protocols=system.protocols,
        missing=partial(missing, system),
        version=partial(version, system),
    )
    for system in SYSTEMS
)
