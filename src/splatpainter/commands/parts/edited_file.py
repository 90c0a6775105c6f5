"""What commands share that apply operations to a file: which file, how it is written, and what is said of it."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import splatpainter.session  # noqa: F401 - whose files regions and looks may name
from splatpainter.commands import Outcome
from splatpainter.commands.parts.option_marks import Argument
from splatpainter.commands.parts.option_parsing import AssetFile, AxesOption, InAxesOption, OutFile, option_name
from splatpainter.commands.parts.terminal import SourceBar, complain, count, decibels, seconds, stages, warn
from splatpainter.operations.file_options import FileOptions, Worder, check_to_file
from splatpainter.operations.operation import Operation, Report, ReportedView, Tools, Wording
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.operations.to_file import ProvedFile
    from splatpainter.receipts import Receipt

_Operation = TypeVar("_Operation", bound=Operation)


@dataclass(frozen=True)
class AssetArguments:
    """From which file to which."""

    asset: AssetFile
    """The splat file, or a folder of INRIA's trainer (its last iteration); it is not changed."""
    out: OutFile
    """The file to write; its name says the format."""


@dataclass(frozen=True, kw_only=True)
class FileArguments:
    """How the files are read and written."""

    in_axes: InAxesOption = "auto"
    """Axes of ASSET's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    axes: AxesOption = "auto"
    """Axes of OUT's numbers; auto: those of ASSET if both are of one format, else what OUT's format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    receipt: Annotated[Path | None, Argument(metavar="R.json", help_behavior_hint="")] = None
    """Where the receipt goes; default: OUT.receipt.json."""
    overwrite: bool = False
    """Replace OUT and the receipt if they exist."""
    json: bool = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True, kw_only=True)
class EditArguments(FileArguments):
    """How the files of an edit are read and written."""

    dry_run: bool = False
    """Print which views would be sent and how many paid calls that makes (with mode spread: how far it reaches); send
    and write nothing."""


def operation_from(config: Any, kind: type[_Operation]) -> _Operation:
    """The operation among the options of a command."""
    return kind(**{field.name: getattr(config, field.name) for field in fields(kind)})


def run_operation(config: Any, kind: type[Operation], command: str) -> Outcome:
    """A command of one operation. command: its name."""
    act = plan_operations if getattr(config, "dry_run", False) else run_operations
    return act(config, [operation_from(config, kind)], lambda _: spoken(kind, f"splatpainter {command}: "))


def run_operations(config: Any, operations: Sequence[Operation], wording: Worder) -> Outcome:
    """Check, read, apply, write, verify. config: has AssetArguments and FileArguments."""
    options = FileOptions(config.in_axes, config.axes, config.lenient, config.receipt, config.overwrite)
    check_to_file(config.asset, operations, config.out, options, wording)
    from splatpainter.operations.to_file import apply_to_file  # after the checks: a refusal need not wait for it

    # Reading, writing and verifying, and one stage for each operation.
    with stages(3 + len(operations)) as bar:
        done = apply_to_file(
            config.asset,
            operations,
            config.out,
            options,
            tools=Tools(progress=SourceBar, cancel=threading.Event(), aside=True),
            report=Report(warn),
            stage=bar.enter,
            wording=wording,
            complain=complain,
        )
    return Outcome(_record(config, done), _lines(config, done))


def plan_operations(config: Any, operations: Sequence[Operation], wording: Worder) -> Outcome:
    """What --dry-run prints: which views a source would be sent, or how far an edit of mode spread reaches."""
    # Checked as for the real run, so that a plan is not of something that will be refused.
    options = FileOptions(config.in_axes, config.axes, config.lenient, config.receipt, config.overwrite)
    check_to_file(config.asset, operations, config.out, options, wording)
    from splatpainter.io import read
    from splatpainter.operations.generate import Generate
    from splatpainter.operations.paint import Paint
    from splatpainter.operations.to_file import apply_to_asset

    asking = [operation for operation in operations if isinstance(operation, Generate)]
    if asking:
        tasks = [operation.task(Tools(asset=config.asset)) for operation in asking]
        splats = read(config.asset, axes=config.in_axes, lenient=config.lenient).numpy()
        records, lines = zip(*(task.planned(splats) for task in tasks), strict=True)
        record = records[0] if len(records) == 1 else {"sources": list(records)}
        return Outcome(record, [line for part in lines for line in part])
    spreading = [operation for operation in operations if isinstance(operation, Paint) and operation.mode == "spread"]
    if len(spreading) != len(operations):
        (first, *_) = (operation for operation in operations if operation not in spreading)
        raise wording(first).error(first.kind, "--dry-run is for pictures that a source makes; give --source NAME too")
    with stages(1 + len(operations)) as bar:
        tools = Tools(aside=True, asset=config.asset)
        applied = apply_to_asset(config.asset, operations, options, tools, Report(warn), bar.enter, wording)
    receipt = applied.edited.receipt
    assert receipt is not None
    lines = [f"{config.asset}: nothing is written", *(f"note: {note}" for note in _parts(receipt.note))]
    lines.append(f"{len(receipt.touched):,} of {count(receipt.asset_rows, 'Gaussian')} would change")
    record = {"touched_rows": len(receipt.touched), "rows": receipt.asset_rows, "note": receipt.note}
    return Outcome(record | {"confidence": spreading[0].spread_confidence}, lines)


def spoken(kind: type[Operation], where: str, names: Mapping[str, str] | None = None) -> Wording:
    """How a command line names the options of a kind. names: those that are called otherwise there."""
    options = {}
    for field in fields(kind):
        if field.metadata.get("positional"):
            options[field.name] = field.metadata["metavar"]
        elif field.metadata.get("option"):
            options[field.name] = f"--{option_name(field)}"
    return Wording(where, "--", {**options, **(names or {})})


def _record(config: Any, done: ProvedFile) -> dict[str, Any]:
    from splatpainter.operations.to_file import proved_record
    from splatpainter.output_paths import receipt_of

    record = proved_record(config.out, config.receipt or receipt_of(config.out), done.receipt, done.verification)
    notes = [f"{view.name}: {note}" for step in done.steps for view in step.views for note in view.notes]
    return record | {"notes": notes, "doubts": list(done.doubts)}


def _lines(config: Any, done: ProvedFile) -> list[str]:
    """What people read."""
    verification, receipt = done.verification, done.receipt
    views = [view for step in done.steps for view in step.views]
    rounded = len(receipt.touched) - len(done.applied.touched)
    lines = [f"{config.asset} -> {config.out}"]
    lines += [f"{view.name}: {note}" for view in views for note in view.notes]
    lines += [f"axes: {verification.axes}"] if verification.axes_are_news else []
    if len(done.steps) == 1:
        lines += receipt_lines(receipt, views, rounded)
    else:
        for step in done.steps:
            lines += [f"{step.operation.kind}: {line}" for line in receipt_lines(step.receipt, step.views)]
        lines += [f"note: {note}" for note in _parts(receipt.note.removeprefix(done.applied.note))]
        lines.append(f"together: {_changed(receipt, rounded)}")
    same = f"{verification.same:,} of {count(verification.rows, 'Gaussian')} {verification.how_same}, verified"
    return [*lines, same, seconds(receipt.seconds)]


def receipt_lines(receipt: Receipt, views: Sequence[ReportedView], rounded: int = 0) -> list[str]:
    """What an operation did. views: of its receipt; rounded: how many rows the format changed besides."""
    notes = _parts(receipt.note)
    if not views:
        removed = [f"{count(len(receipt.removed), 'Gaussian')} removed (opacity 0)"] if len(receipt.removed) else []
        changed = [] if receipt.mode == "fill" else [f"{count(len(receipt.touched), 'Gaussian')} changed"]
        return [*removed, *notes, *changed]
    notes = [f"note: {note}" for note in notes]
    if any(view.against for view in views):
        lines = notes
        for view, score in zip(views, receipt.views, strict=True):
            before, after = decibels(score.psnr_before), decibels(score.psnr_after)
            lines.append(f"{view.name}: {before} -> {after} against {view.against}")
        changed = f"{count(len(receipt.touched), 'Gaussian')} changed, {receipt.appended_rows:,} appended"
        return [*lines, changed]
    weights = f" with preset {receipt.preset}" if receipt.preset != "lift" else ""
    rounding = f", in {receipt.precision}" if receipt.precision else ""
    lines = [f"method {receipt.method}{weights}, mode {receipt.mode}{rounding}", *notes]
    for view, score in zip(views, receipt.views, strict=True):
        inside = decibels(score.psnr_before), decibels(score.psnr_after)
        where = f"{inside[0]} -> {inside[1]} against the picture, where it was edited"
        lines.append(f"{view.name}: {where}; elsewhere {decibels(score.psnr_outside)} against before")
    for view, (psnr, share) in zip(views, receipt.aside, strict=False):
        if psnr is not None:
            lines.append(f"{view.name}: {decibels(psnr)} seen from the side, {100 * share:.0f} % of the paint")
    return [*lines, _changed(receipt, rounded)]


def _changed(receipt: Receipt, rounded: int) -> str:
    again = f", {rounded:,} more rounded anew by the format" if rounded else ""
    sheet = (
        f" (of them {len(receipt.replaced):,} replaced and {len(receipt.removed):,} removed under a sheet)"
        if len(receipt.replaced) + len(receipt.removed)
        else ""
    )
    changed = count(len(receipt.touched) - rounded, "Gaussian")
    return f"{changed} changed{sheet}{again}, {receipt.appended_rows:,} appended"


def _parts(note: str) -> list[str]:
    return [part for part in note.split("; ") if part]
