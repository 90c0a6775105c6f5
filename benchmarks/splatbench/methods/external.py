"""Systems outside this package, where a user has them: one row each, else "not installed".

A row is: write what the system reads, run its commands in its own environment, read back what it made (adapters/).
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

from splatbench.adapters import adapters_file, coordinate_frames, systems
from splatbench.adapters.systems import AdapterJob, AdapterPlan, Commands, System
from splatbench.cases import Budget
from splatbench.methods import EditResult, EditTask, Method
from splatbench.process import run_command
from splatpainter.splats import Splats

VERSION = "1"
"""Version of what the systems are given."""
LOG = "log.txt"
"""Log file of a job's folder, which stays after a failure; with a scratch folder the log stays in any case."""


def missing(system: System, budget: Budget) -> str:
    """Why the system is not run here, or ""."""
    try:
        section = adapters_file.section(budget.adapters, system.name)
        if section is None:
            return adapters_file.absent(budget.adapters, system.name)
    except ValueError as error:
        return str(error)
    return system.missing(section) or adapters_file.problem(section, system.needs, adapters_file.has_cuda_gpu)


def version(system: System, budget: Budget) -> str:
    """Changes with the section, the commit of the checkout, and this package's files."""
    return f"{VERSION}-{adapters_file.digest(budget.adapters, system.name)}"


def edit(system: System, work: EditTask, budget: Budget) -> EditResult:
    """The asset as the system edits it. Raises ValueError: it is not there (`missing`), it fails or takes too long (the
    last line of its log, and where that is), what it leaves is not an asset in the asset's place."""
    reason = missing(system, budget)
    if reason:
        raise ValueError(reason)
    section = adapters_file.section(budget.adapters, system.name)
    assert section is not None
    if budget.scratch is not None:
        budget.scratch.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{system.name}-", dir=budget.scratch)).resolve()
    failed = True
    try:
        done = _edit(system, work, section, budget.seed, folder)
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


def _edit(system: System, work: EditTask, section: adapters_file.AdapterSection, seed: int, folder: Path) -> EditResult:
    start = time.perf_counter()
    job = AdapterJob(work, section, folder, seed, coordinate_frames.Cube.of(work.asset))
    for path in (job.inputs, job.workplace):
        path.mkdir()
    values = systems.write_common(job)
    plan = system.plan(job)
    plan = systems.with_user_command(plan, job, values | plan.values)
    setup = time.perf_counter() - start + _run(plan.setup, job)
    seconds = _run(plan.edit, job)
    plan.check()
    exporting = _run(plan.export, job)
    if not plan.result.is_file():
        raise ValueError(
            f"{system.label} ended without an error but wrote no {plan.result.relative_to(job.out)} in {job.out} "
            f"(log: {folder / LOG})"
        )
    splats = coordinate_frames.read_result(plan.result, plan.frame(), seed)
    coordinate_frames.check_position(splats, job.cube, plan.result)
    numbers = {"export_seconds": exporting, "rows": float(len(splats))}
    similarity = unchanged(work, splats)
    if similarity is not None:
        numbers["unmasked_db"] = similarity
    return EditResult(splats, setup, seconds, keeps_gaussians=False, numbers=numbers, note=_note(plan, section))


def unchanged(work: EditTask, splats: Splats) -> float | None:
    """PSNR of the result's renders against the asset's in the edited views, where one of them shows something and the
    mask is not: how well the frames fit, and what the system left as it was. At most 100; None: no such pixel."""
    from splatpainter.metrics import psnr
    from splatpainter.rendering import render

    cameras = list(work.step.edited.cameras)
    before, after = render(work.asset, cameras), render(splats, cameras)
    covered = (before.alphas[..., 0] > 0.01) | (after.alphas[..., 0] > 0.01)
    outside = covered & np.logical_not(work.step.masks)
    if not outside.any():
        return None
    width = outside.shape[-1]  # all views as one tall picture
    tall = [np.clip(view.colors, 0, 1).reshape(-1, width, 3) for view in (before, after)]
    return min(psnr(tall[0], tall[1], outside.reshape(-1, width)), 100.0)


def _run(commands: Commands, job: AdapterJob) -> float:
    section = job.section
    limits = {"timeout": section.timeout_seconds, "environment": section.environment, "python": section.python}
    return sum(run_command(command, job.workplace, job.folder / LOG, **limits) for command in commands)


def _note(plan: AdapterPlan, section: adapters_file.AdapterSection) -> str:
    commit = adapters_file.commit(section.repository)
    where = f"; checkout {commit[:7]}" if commit else ""
    return f"{plan.note}{where}{'; command of the adapters file' if section.command else ''}"


METHODS = tuple(
    Method(
        name=system.name,
        label=system.label,
        edit=partial(edit, system),
        protocols=system.protocols,
        missing=partial(missing, system),
        version=partial(version, system),
    )
    for system in systems.SYSTEMS
)
