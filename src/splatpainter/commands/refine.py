"""`splatpainter refine`: views of an asset enlarged by a model or another source, and their detail lifted onto it."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from splatpainter.commands import Outcome
from splatpainter.commands.asset_doubts import warn_of_doubts
from splatpainter.commands.option_parsing import AssetFile, AxesOption, FrameOption, OutFile
from splatpainter.commands.sourced_edit import InterruptibleSource, SourceBar, keeping_answers
from splatpainter.commands.terminal import count, decibels, seconds, stages
from splatpainter.commands.verified_write import check_outputs, proved_record, write_proved
from splatpainter.commands.verify import same_words
from splatpainter.commands.view_options import given_camera
from splatpainter.io import read
from splatpainter.painter import MAX_VIEWS, Painter
from splatpainter.receipts import receipt_of

COMMAND = "splatpainter refine"


@dataclass(frozen=True)
class Config:
    """Make an asset sharper in close-up views. Each view is rendered, enlarged by a
    super-resolution model (or another picture source), and all of them are lifted together at the enlarged size:
    Gaussians that are too coarse are split, the others only take new colours.

    Without a model the enlargement is Lanczos and gentle sharpening, which invents no detail. Models are files that
    spandrel opens (pip install 'splatpainter[upscale]').

    example:
      splatpainter refine vase.ply --view views/view_000.json views/view_001.json --out fine.ply
      splatpainter refine vase.ply --view near.json --upscale realesrgan.safetensors --scale 4 --out fine.ply
    """

    asset: AssetFile
    """The splat file to refine; it is not changed."""
    out: OutFile
    """The file to write; its name says the format."""
    view: Annotated[tuple[Path, ...], arg(metavar="CAM.json ...", help_behavior_hint="")] = ()
    """1 to 16 cameras of the views (CAM.json, or pictures that `render` made)."""
    upscale: Annotated[Path | None, arg(metavar="MODEL.safetensors", help_behavior_hint="")] = None
    """Super-resolution model that enlarges the views."""
    scale: Annotated[Literal[1, 2, 4] | None, arg(metavar="1|2|4", help_behavior_hint="")] = None
    """Factor by which each view is enlarged; default: 2, or 1 for sources that do not enlarge."""
    source: Annotated[str, arg(metavar="NAME")] = "upscale"
    """Picture source that enlarges the views (`splatpainter source list`)."""
    source_option: Annotated[tuple[str, ...], arg(metavar="KEY=VALUE ...", help_behavior_hint="")] = ()
    """Options of the source."""
    prompt: Annotated[str, arg(metavar="TEXT", help_behavior_hint="")] = ""
    """Prompt, for sources that take one."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Pixels of the longer side at which views are rendered and sent; default: the cameras'."""
    method: Literal["lift", "fit"] = "lift"
    """lift: analytic, seconds; fit: some seconds of optimisation after it, nearer to the pictures."""
    frame: FrameOption = "auto"
    """Axes of ASSET's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    axes: AxesOption = "auto"
    """Axes of OUT's numbers; auto: those of ASSET if both are of one format, else what OUT's format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    receipt: Annotated[Path | None, arg(metavar="R.json", help_behavior_hint="")] = None
    """Where the receipt goes; default: OUT.receipt.json."""
    overwrite: bool = False
    """Replace OUT and the receipt if they exist."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Check, read, ask, lift, write, verify."""
    from splatpainter.source_edits.edit import refine_views, usual_scale
    from splatpainter.source_edits.view_edit import SourceBrief
    from splatpainter.sources.registry import open_source
    from splatpainter.sources.source_options import option_words

    receipt_path = config.receipt or receipt_of(config.out)
    if not 1 <= len(config.view) <= MAX_VIEWS:
        given = len(config.view) or "none"
        raise ValueError(f"{COMMAND}: expected 1 to {MAX_VIEWS} cameras (--view CAM.json ...), got {given}")
    if config.upscale is not None and config.source != "upscale":
        raise ValueError(f"{COMMAND}: --upscale is the model of source upscale, not of {config.source}")
    inputs = [*config.view, *filter(None, [config.upscale])]
    check_outputs(config.out, receipt_path, config.overwrite, config.asset, inputs)
    options = option_words(config.source_option)
    if config.upscale is not None:
        options = {**options, "model": str(config.upscale)}
    source = InterruptibleSource(open_source(config.source, options))
    cameras = [given_camera(path, config.size, config.asset) for path in config.view]
    painter = replace(Painter.load("lift"), aside=True)
    with keeping_answers(source, config.out), stages(4) as bar:
        bar.enter("reading")
        clock = time.perf_counter()
        splats = read(config.asset, frame=config.frame, lenient=config.lenient)
        warn_of_doubts(splats, config.asset, editing=True)
        read_seconds = time.perf_counter() - clock
        bar.enter("refining")
        with SourceBar() as progress:
            brief = SourceBrief(config.prompt, scale=config.scale or usual_scale(source))
            asset = painter.encode(splats, config.method, ["local"])
            refined = refine_views(
                painter,
                asset,
                source,
                brief,
                [camera.relative_to(splats.offset) for camera in cameras],
                method=config.method,
                progress=progress,
                cancel=threading.Event(),
            )
        receipt, verification = write_proved(
            splats, refined.asset, config.out, receipt_path, config.axes, bar, read_seconds
        )
    notes = [f"{path}: {note}" for path, edit in zip(config.view, refined.edits, strict=True) for note in edit.notes]
    lines = [f"{config.asset} -> {config.out}", *notes]
    lines += [f"frame: {verification.frame}"] if verification.frame_is_news else []
    lines += [f"note: {note}" for note in receipt.note.split("; ") if note]
    for path, edit, view in zip(config.view, refined.edits, receipt.views, strict=True):
        size = f"{edit.edit.camera.width} x {edit.edit.camera.height}"
        before, after = decibels(view.psnr_before), decibels(view.psnr_after)
        lines.append(f"{path}: {before} -> {after} against the picture of {edit.answer.model or source.name}, {size}")
    lines.append(f"{count(len(receipt.touched), 'Gaussian')} changed, {receipt.appended_rows:,} appended")
    lines.append(
        f"{verification.same:,} of {count(verification.rows, 'Gaussian')} {same_words(verification)}, verified"
    )
    lines.append(seconds(receipt.seconds))
    return Outcome({**proved_record(config.out, receipt_path, receipt, verification), "notes": notes}, lines)
