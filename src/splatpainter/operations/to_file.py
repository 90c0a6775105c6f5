"""Operations from file to file: read once, applied in order, written, read again and compared, and only then under the
name that was asked for, beside one receipt that names each.

    done = apply_to_file(Path("vase.ply"), [Paint(["view.png"]), Grade(exposure=0.3)], Path("new.ply"))
    done.receipt.operations, done.verification.ok

Nothing is spent before what can be wrong was looked at: options, then the names of the outputs, then the files that
operations read and the sources that they ask (the asset is read meanwhile), then the asset.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any

from splatpainter.doubts import doubts
from splatpainter.io import files, read, write
from splatpainter.kernels.parallel import beside
from splatpainter.operations.file_options import AS_USUAL, FileOptions, Worder, check_to_file
from splatpainter.operations.operation import (
    AS_PYTHON,
    Operation,
    Report,
    ReportedView,
    Tools,
)
from splatpainter.operations.source_answers import answers_line, interruptible, keeping_answers
from splatpainter.output_paths import placed, receipt_of
from splatpainter.painter import Asset
from splatpainter.receipts import Receipt, Verification, prove, read_receipt
from splatpainter.splats import Axes, Splats
from splatpainter.system.memory import return_idle_memory
from splatpainter.system.quick_dataclass import dataclass

MODE_OF_SEVERAL, MAX_NOTE = "operations", 2000
"""Mode of a receipt of several operations, and the most characters of its note."""


@dataclass(frozen=True)
class AppliedOperation:
    """One operation of several, as it went."""

    operation: Operation
    receipt: Receipt = field(repr=False)
    """Of it alone, on the asset as the operations before it left it."""
    views: tuple[ReportedView, ...] = ()
    """Of the receipt's views, in their order."""


@dataclass(frozen=True)
class ProvedFile:
    """A file that operations made, read again and compared."""

    receipt: Receipt
    """From the file that was read to the one that was written."""
    verification: Verification
    steps: tuple[AppliedOperation, ...]
    applied: Receipt = field(repr=False)
    """The receipt before the file was written: without what its format rounds and lacks."""
    doubts: tuple[str, ...] = ()
    """What looks wrong about the asset that was read."""


@dataclass(frozen=True)
class AppliedOperations:
    """What operations made of a file, and nothing written yet."""

    original: Splats
    edited: Asset
    """With the receipt of all operations."""
    steps: tuple[AppliedOperation, ...]
    doubts: tuple[str, ...]
    read_seconds: float


Stage = Callable[[str], None]
"""Called with the name of what begins: reading, the kinds, writing, verifying."""


def apply_to_file(
    asset: Path,
    operations: Sequence[Operation],
    out: Path,
    options: FileOptions = AS_USUAL,
    *,
    tools: Tools | None = None,
    report: Report | None = None,
    stage: Stage = lambda name: None,
    wording: Worder = lambda operation: AS_PYTHON,
    complain: Callable[[str], None] | None = None,
) -> ProvedFile:
    """Read an asset, apply the operations in their order, write it with its receipt. complain: takes lines about what
    was saved where it was interrupted; None: as warnings.

    Raises ValueError, one line, with nothing changed: options, names, files, an operation that cannot be made, a full
    disk; SourceError; RuntimeError: the file does not prove the receipt."""
    report = report or Report()
    # All that can be refused for nothing is refused before a byte is read or a picture is paid for.
    check_to_file(asset, operations, out, options, wording)
    # Answers of services were paid for: whatever happens from here on, they are kept beside OUT.
    tools, sources = interruptible(replace(tools or Tools(), asset=asset))
    with keeping_answers(sources, out, complain or report.warn):
        applied = apply_to_asset(asset, operations, options, tools, report, stage, wording)
        receipt_path = options.receipt or receipt_of(out)
        receipt, verification = write_proved(
            applied.original, applied.edited, out, receipt_path, options.axes, stage, applied.read_seconds
        )
    for source in sources:  # of views that the receipt's note names
        for line in answers_line(source.write_answers(out, report.answers)):
            report.warn(line)
    assert applied.edited.receipt is not None
    return ProvedFile(receipt, verification, applied.steps, applied.edited.receipt, applied.doubts)


def apply_to_asset(
    asset: Path,
    operations: Sequence[Operation],
    options: FileOptions,
    tools: Tools,
    report: Report,
    stage: Stage = lambda name: None,
    wording: Worder = lambda operation: AS_PYTHON,
) -> AppliedOperations:
    """The first half of `apply_to_file`: all but writing."""
    # Files of all operations are looked at first: a wrong picture of the last one must not cost the first ones' time.
    # The asset is read meanwhile; what is wrong with it comes after what is wrong with them.
    reading = beside(lambda: _read(asset, options))
    ready = [operation.ready(replace(tools, wording=wording(operation))) for operation in operations]
    stage("reading")
    splats, doubtful, read_seconds = reading()
    for line in doubtful:
        report.warn(f"{asset}: {line}")
    # Each operation sees the asset as those before it left it, with its surface as it was when it was read.
    edited, steps = Asset(splats), []
    for operation, act in zip(operations, ready, strict=True):
        stage(operation.kind)
        heard = Report(report.warn)
        edited = operation.act(act, edited, heard)
        assert edited.receipt is not None
        steps.append(AppliedOperation(operation, edited.receipt, tuple(heard.views)))
        report.views += heard.views
        report.answers += heard.answers
    # One proof from the first bytes to the last: what an operation changed and the next changed back did not change.
    edited = replace(edited, receipt=receipt_of_all(splats, edited.splats, steps))
    return AppliedOperations(splats, edited, tuple(steps), tuple(doubtful), read_seconds)


def _read(asset: Path, options: FileOptions) -> tuple[Splats, list[str], float]:
    """(the asset, what looks wrong about it, seconds that reading took)."""
    clock = time.perf_counter()
    splats = read(asset, axes=options.in_axes, lenient=options.lenient)
    seconds = time.perf_counter() - clock
    return splats, doubts_of(splats), seconds


def doubts_of(splats: Splats) -> list[str]:
    """What looks wrong about an asset that was read; nothing of one that cannot be drawn, which operations refuse."""
    return [doubt.line for doubt in doubts(splats)] if splats.drawable.any() else []


def receipt_of_all(before: Splats, after: Splats, steps: Sequence[AppliedOperation]) -> Receipt:
    """One receipt of operations that were applied one after the other; of one alone, its own."""
    # One operation has its own receipt, with all that it says; several need one for all.
    receipts = [step.receipt for step in steps]
    if len(steps) == 1:
        return receipts[0]
    from splatpainter.source_edits.edit import joined_receipt  # of several alone

    # Where several sources were asked none stands for all; each entry of `operations` names its own.
    sources = [receipt.source for receipt in receipts if receipt.source is not None]
    notes = [f"{step.operation.kind}: {step.receipt.note}" for step in steps if step.receipt.note]
    return replace(
        joined_receipt(before, after, receipts),
        asset_sha256=before.sha256,
        mode=MODE_OF_SEVERAL,
        method=", ".join(step.operation.kind for step in steps),
        preset=next((receipt.preset for receipt in receipts if receipt.preset), ""),
        precision=next((receipt.precision for receipt in receipts if receipt.precision), ""),
        source=sources[0] if len(sources) == 1 else None,
        note="; ".join(notes)[:MAX_NOTE],
        operations=tuple(_entry(step) for step in steps),
    )


def _entry(step: AppliedOperation) -> dict[str, Any]:
    """What a receipt of several says of one."""
    # Enough to see what each did; its full receipt would repeat the hashes of the whole.
    receipt = step.receipt
    entry = {"kind": step.operation.kind, "mode": receipt.mode, "method": receipt.method, "preset": receipt.preset}
    entry |= {"touched_rows": len(receipt.touched), "appended_rows": receipt.appended_rows, "note": receipt.note}
    return entry | ({} if receipt.source is None else {"source": receipt.source})


def write_proved(
    original: Splats,
    edited: Asset,
    out: Path,
    receipt_path: Path,
    axes: Axes = "auto",
    stage: Callable[[str], None] = lambda name: None,
    read_seconds: float = 0.0,
) -> tuple[Receipt, Verification]:
    """Write an edited asset and its receipt, which then says how long reading, editing, writing and verifying took.
    Raises ValueError: a full disk, no permission; RuntimeError: the file does not prove the receipt."""
    assert edited.receipt is not None
    clock = time.perf_counter()
    # Left in reverse order: OUT takes its name first, the receipt, which is on disk by then, after it.
    with files.writing(receipt_path) as file, placed(out) as partial:
        stage("writing")
        write(partial, edited.splats, axes=axes)
        written = time.perf_counter()
        stage("verifying")
        # What the edit has left amid the heap is nearly as much as the file that is read now.
        return_idle_memory()
        receipt, verification = prove(original, partial, edited.receipt, axes, edited.splats)
        timings = {"write": written - clock, "verify": time.perf_counter() - written}
        # An asset that has a history keeps it: the receipt beside it is carried on.
        earlier = _receipt_beside(original)
        if earlier is not None:
            from splatpainter.scene.merge import carried  # most assets have none

            receipt = carried(receipt, earlier)
        receipt = replace(receipt, seconds={"read": read_seconds, **receipt.seconds, **timings})
        file.write(receipt.to_json().encode())
        # On the disk before OUT has its name: a file without its receipt would be one that nobody can check.
        file.flush()
        os.fsync(file.fileno())
    return receipt, verification


def _receipt_beside(original: Splats) -> Receipt | None:
    """The receipt of the asset that is edited; None where there is none that can be read."""
    # An asset without a file has no receipt beside it.
    if original.source is None:
        return None
    path = receipt_of(Path(original.source.path))
    # One that cannot be read is no history; the edit itself must not fail for it.
    try:
        return read_receipt(path) if path.is_file() else None
    except (ValueError, OSError):
        return None


def proved_record(out: Path, receipt_path: Path, receipt: Receipt, verification: Verification) -> dict[str, Any]:
    """What --json says of an edited asset."""
    return {
        "out": out,
        "receipt_file": receipt_path,
        "verified": verification.ok,
        "same_rows": verification.same,
        "compared": verification.exact,
        "frame": verification.axes,
        "receipt": json.loads(receipt.to_json()),
    }
