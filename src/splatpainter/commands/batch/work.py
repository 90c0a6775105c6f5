"""One job of a batch: its edits by the code of the commands, one after the other, each proved; resumable anywhere.

A step is an operation as `splatpainter edit` applies it, from a file to a file in the job's folder. A step that is
done leaves its hash beside its file, so after a kill only what was in work is done again, and what a paid source has
answered is not asked for twice. What all variants of an asset begin with is made once for all of them: they would pay
for a source's picture each, and get different ones. The last file takes its name at the end, with the receipt from the
asset to it: of one edit that of the operation, of several one of the whole way.
"""

from __future__ import annotations

import contextlib
import io
import json
import secrets
import shutil
import time
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatpainter.batch.plan import Job, JobStep
from splatpainter.batch.schema import IN_FILES
from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.color import to_display
from splatpainter.commands.parts.terminal import complain, warn
from splatpainter.image_files import to_uint8
from splatpainter.io import FORMATS, files, format_of_name, read
from splatpainter.operations.file_options import FileOptions
from splatpainter.operations.generate import Generate
from splatpainter.operations.operation import Report, Tools
from splatpainter.operations.painting_options import PictureSourceOptions
from splatpainter.operations.to_file import apply_to_file
from splatpainter.output_paths import receipt_of
from splatpainter.pictures.edit_files import camera_from
from splatpainter.receipts import Receipt, prove, read_receipt
from splatpainter.rendering import render
from splatpainter.session.project.asset_files import receipt_between
from splatpainter.session.project.lock import ProjectLock
from splatpainter.splats import Axes, Splats
from splatpainter.system.atomic import replace as replace_file
from splatpainter.system.atomic import sync_folder, write_text
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    pass

RECORD, BEFORE, AFTER = "record.json", "before.webp", "after.webp"
"""Files of a finished job's folder."""
COMMON = ".common"
"""Folder beside those of the jobs, for steps that variants have in common."""
TURN_SECONDS = 0.1
"""Seconds between looks at whether another worker has made such a step."""
MAX_RECORD_BYTES = 1 << 20
PREVIEW_QUALITY = 85
"""WebP quality of small pictures, 0..100."""


@dataclass(frozen=True)
class BatchWork:
    """number -> what became of that job; picklable, for workers. Raises nothing: a job that fails says why."""

    jobs: tuple[Job, ...]
    run: str = field(default_factory=lambda: secrets.token_hex(8))
    """Id of this run of the batch: what failed in it is not tried again for every variant."""

    def __call__(self, number: int) -> dict[str, Any]:
        job, start = self.jobs[number], time.perf_counter()
        lines = io.StringIO()
        # Lines of workers are caught and kept with their job, or nobody could tell whose they are.
        with contextlib.redirect_stderr(lines):  # bars and warnings of several workers on one terminal
            try:
                result = run_job(job, self.run)
            except (ValueError, OSError, MemoryError) as error:
                result = failure(job, f"{error}" if not isinstance(error, MemoryError) else "out of memory")
            except Exception as error:  # one bad asset stops nothing
                result = failure(job, f"fault in splatpainter: {type(error).__name__}: {error}")
        # Only warnings are kept: bars that were drawn over and over are no lines.
        warnings = [" ".join(line.split()) for line in lines.getvalue().splitlines() if "warning: " in line]
        return {**result, "warnings": warnings, "seconds": round(time.perf_counter() - start, 3)}


def failure(job: Job, reason: str) -> dict[str, Any]:
    return {**facts(job), "status": "failed", "error": " ".join(reason.split())}


def facts(job: Job) -> dict[str, Any]:
    return {"name": job.name, "asset": str(job.asset), "variant": job.variant, "out": str(job.out)}


def finished(job: Job, hashes: list[str]) -> dict[str, Any] | None:
    """The record of a job that is done: made by these edits from these bytes, with a result that is what its receipt
    says. None: it has to be done."""
    try:
        record = json.loads(files.read_head(job.folder / RECORD, MAX_RECORD_BYTES))
        receipt = read_receipt(receipt_of(job.out))
        # The very bytes: a result that was changed by hand is no longer what the receipt proves.
        if record["job_sha256"] != hashes[-1] or files.file_sha256(job.out) != receipt.output_sha256:
            return None
        return {**record, **facts(job)} if isinstance(record, dict) else None
    except (ValueError, OSError, KeyError, TypeError, RecursionError):
        # Whatever is wrong with a record, the job is simply done again.
        return None


def run_job(job: Job, run: str) -> dict[str, Any]:
    """Do what is left of a job. run: as in BatchWork. Raises ValueError: an edit that cannot be made; OSError."""
    # Done before, by these very edits from these very bytes: nothing to do. A changed picture is another job.
    hashes = job.hashes()
    if (record := finished(job, hashes)) is not None:
        return {**record, "status": "done", "resumed": True}
    # A result that no batch made may be somebody's work.
    if job.out.exists() and not (job.folder / RECORD).exists() and not job.overwrite:
        raise ValueError(
            f"{job.out}: already exists, and no batch made it; move it away, or replace it with --overwrite"
        )
    job.folder.mkdir(parents=True, exist_ok=True)
    _clear(job, hashes)
    # Each step reads the file of the one before: a killed batch goes on at the first step that is not proved.
    asset, axes = job.asset, job.axes
    for k, (step, digest) in enumerate(zip(job.steps, hashes, strict=True)):
        target = _step_file(job, k)
        if not _step_done(job, k, digest):
            if k < job.common:
                _copy(make_common(job, k, digest, asset, axes, run), target)
            else:
                run_step(step, asset, target, axes)
            write_text(job.folder / f"step-{k}.done", digest)
        # Numbers of one format keep their axes from file to file; another format has its own.
        axes = axes if format_of_name(target) == format_of_name(asset) else "auto"
        asset = target
    original = read(job.asset, axes=job.axes)
    # One receipt from the user's file to the result, whatever lay between.
    receipt = _receipt(job, original, asset)
    _previews(job, original, read(asset, axes=axes))
    record = {
        **facts(job),
        "status": "done",
        "job_sha256": hashes[-1],
        "receipt": str(receipt_of(job.out)),
        "edits": [step.kind for step in job.steps],
        "rows": receipt.asset_rows,
        "touched": len(receipt.touched),
        "appended": receipt.appended_rows,
        "note": receipt.note,
        "psnr": [view.psnr_after for view in receipt.views],
    }
    # The result comes last: a record counts only beside a result that is what the receipt says.
    write_text(receipt_of(job.out), receipt.to_json())
    write_text(job.folder / RECORD, json.dumps(record, indent=2) + "\n")
    replace_file(asset, job.out)
    sync_folder(job.out.parent)
    _clear(job, [])
    return {**record, "resumed": False}


def run_step(step: JobStep, asset: Path, target: Path, axes: Axes) -> None:
    """One edit, from file to file with a receipt beside it."""
    # A step may be left over from a run that was killed, so its file is replaced.
    options = FileOptions(in_axes=axes, overwrite=True)
    tools, report = Tools(aside=True), Report(warn)
    apply_to_file(asset, [step.step], target, options, tools=tools, report=report, complain=complain)


def make_common(job: Job, k: int, digest: str, asset: Path, axes: Axes, run: str) -> Path:
    """The file of a step that variants have in common, with its receipt; made by whoever comes first. Errors as of
    `run_step`; what failed in this run fails for all variants, and no source is asked again."""
    target = common_file(job, k, digest)
    failed = target.with_name(f"{target.name}.failed-{run}")
    target.parent.mkdir(parents=True, exist_ok=True)
    # Whoever comes first makes it; the others wait here, in other processes.
    while (lock := ProjectLock.take(target)) is None:
        time.sleep(TURN_SECONDS)
    # From here on nobody else makes this step, whatever happens in it.
    try:
        # A source that refused once would refuse, and be paid, for every variant.
        if failed.exists():
            raise ValueError(failed.read_text(encoding="utf-8"))
        # Another worker may have made it while this one waited.
        if not is_proved(target):
            try:
                run_step(job.steps[k], asset, target, axes)
            except ValueError as error:
                write_text(failed, str(error))
                raise
    finally:
        lock.release()
    return target


def common_file(job: Job, k: int, digest: str) -> Path:
    """Where it lies: by its hash, and in the format that this job wants."""
    # The ending decides the format, and variants may differ in it.
    _, _, ending = _step_file(job, k).name.partition(".")
    return job.folder.parent / COMMON / f"{digest[:32]}.{ending}"


def _copy(source: Path, target: Path) -> None:
    # The receipt goes with the file: without it the copy would count as not proved.
    shutil.copyfile(source, target)
    shutil.copyfile(receipt_of(source), receipt_of(target))


def calls_of(job: Job, counted: set[Path]) -> list[dict[str, Any]]:
    """What the sources of a job would be asked: per step, `source`, `calls` and `paid`; nothing is sent, and nothing
    counted that was asked before a kill. counted: steps that variants have in common and that are counted already;
    this job's are added."""
    out = []
    for k, (step, digest) in enumerate(zip(job.steps, job.hashes(), strict=True)):
        # What lies on the disk already, or is counted for another variant, is asked no more.
        common = common_file(job, k, digest)
        if _step_done(job, k, digest) or (k < job.common and (common in counted or is_proved(common))):
            continue
        # Only sources are asked; other operations cost time and no money.
        operation = step.step
        if isinstance(operation, Generate):
            operation.check(IN_FILES)
            task = operation.task(Tools(asset=job.asset))
            out.append(task.planned(read(job.asset, axes=job.axes).numpy())[0])
        elif isinstance(operation, PictureSourceOptions) and operation.source:
            calls, paid = operation.calls(), operation.opened_source(Tools()).capabilities.paid
            out.append({"source": operation.source, "calls": calls, "paid": paid})
        # Counted once for all variants, as it will be asked once.
        if k < job.common:
            counted.add(common)
    return out


def _receipt(job: Job, original: Splats, last: Path) -> Receipt:
    """Receipt from the asset to the result: of one edit that of the command, of several one that is proved anew."""
    # One edit has its own receipt already.
    if len(job.steps) == 1:
        return read_receipt(receipt_of(last))

    receipts = [read_receipt(receipt_of(_step_file(job, k))) for k in range(len(job.steps))]
    # Numbers of one format keep their axes from file to file; another format has its own.
    same = format_of_name(last) == format_of_name(job.asset)
    edited = read(last, axes=job.axes if same else "auto")
    notes = [f"{step.kind}: {receipt.note}" for step, receipt in zip(job.steps, receipts, strict=True) if receipt.note]
    # Proved anew and not summed up: a later edit may have put back what an earlier one changed.
    total = receipt_between(original, edited, receipts[-1].preset, f"{len(receipts)} edits; {'; '.join(notes)}"[:2000])
    # Each edit keeps its time, so that it can be seen which one was slow.
    seconds = {f"edit {k + 1}": sum(receipt.seconds.values()) for k, receipt in enumerate(receipts)}
    views = tuple(view for receipt in receipts for view in receipt.views)
    total = replace(total, mode="batch", method="edits", views=views, seconds=seconds)
    return prove(original, last, total, job.axes if same else "auto")[0]


def _step_file(job: Job, k: int) -> Path:
    """The file of a step: in the result's format at the end, before that in the asset's."""
    # The last step has the name that the result will have, so that only the folder changes.
    if k == len(job.steps) - 1:
        return job.folder / f"result.{job.out.name.removeprefix(job.name + '.')}"
    key = format_of_name(job.asset) or "ply"
    # A format that cannot be written, or a folder, goes on as PLY, which holds all of it.
    single = FORMATS[key].write is not None and not job.asset.is_dir()
    return job.folder / f"step-{k}{FORMATS[key].suffixes[0] if single else '.ply'}"


def _step_done(job: Job, k: int, digest: str) -> bool:
    """Whether a step was finished before, and its file is what its receipt says."""
    try:
        mark = files.read_head(job.folder / f"step-{k}.done", 100).decode(errors="replace")
    except (ValueError, OSError):
        return False
    # The mark alone is not enough: the file may have been changed or cut off since.
    return mark == digest and is_proved(_step_file(job, k))


def is_proved(target: Path) -> bool:
    """Whether a file is there and is what its receipt says."""
    try:
        return files.file_sha256(target) == read_receipt(receipt_of(target)).output_sha256
    except (ValueError, OSError):
        # What cannot be read proves nothing.
        return False


def _clear(job: Job, hashes: list[str]) -> None:
    """Remove what is no step of these edits: of others, of a run that was killed, or (no hashes) all but the record."""
    # Steps count up to the first that is not proved: those after it were made of something else.
    valid: set[str] = set()
    for k, digest in enumerate(hashes):
        if not _step_done(job, k, digest):
            break
        target = _step_file(job, k)
        valid |= {target.name, receipt_of(target).name, f"step-{k}.done"}
    # The record and the pictures of the last run stay until new ones are made.
    valid |= {RECORD, BEFORE, AFTER}
    for path in job.folder.iterdir():
        if path.name not in valid:
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                files.remove(path)


def _previews(job: Job, before: Splats, after: Splats) -> None:
    from PIL import Image

    # One camera and background for both, so that what differs is the edit.
    camera = replace(_preview_camera(job, before), background=(0.25, 0.25, 0.25))
    for name, splats in ((BEFORE, before), (AFTER, after)):
        pixels = to_uint8(to_display(render(splats, camera).colors[0].clip(0, 1), splats.color_space))
        with files.writing(job.folder / name) as file:
            Image.fromarray(pixels).save(file, "WEBP", quality=PREVIEW_QUALITY)


def _preview_camera(job: Job, splats: Splats) -> Camera:
    """Camera of the small pictures: that of the jobs file, else of the first edit that has one, else from the front."""
    names: list[str | Path] = [job.preview_camera]
    for step in job.steps:
        names += step.step.viewpoints()
    for name in filter(None, names):
        # A camera that cannot be read here is no reason to have no picture; the edit itself will say so.
        with contextlib.suppress(ValueError):
            return camera_from(Path(name)).with_longest_side(job.preview_px).relative_to(splats.offset)
    return orbit_cameras(splats, 1, size=job.preview_px)[0]
