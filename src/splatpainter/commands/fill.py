"""`splatpainter fill`: remove a part of an asset and fill what it leaves, or fill a hole, verified like an edit."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from splatpainter.commands import Outcome
from splatpainter.commands.asset_doubts import warn_of_doubts
from splatpainter.commands.option_parsing import AssetFile, AxesOption, FrameOption, OutFile
from splatpainter.commands.sourced_edit import InterruptibleSource, SourceBar, keeping_answers
from splatpainter.commands.terminal import count, seconds, stages
from splatpainter.commands.verified_write import check_outputs, proved_record, write_proved
from splatpainter.commands.verify import same_words
from splatpainter.commands.view_options import given_camera
from splatpainter.gatekeeper.gatekeeper import Strictness
from splatpainter.io import read
from splatpainter.operations.region import Region
from splatpainter.receipts import receipt_of

COMMAND = "splatpainter fill"


@dataclass(frozen=True)
class Config:
    """Remove the part that WHERE selects and fill the gap, or fill a hole, with new Gaussians that continue the
    surface, the tone and the texture around it (or show what a picture source paints there). What is removed stays in
    the file with opacity 0; the new Gaussians are appended, nothing else changes, and the receipt proves it.

    WHERE is as in `splatpainter grade`: sphere=X,Y,Z,R, box=X,Y,Z,X,Y,Z, mask=M.png@CAM.json and others, which all have
    to hold, with `or` between groups.

    example:
      splatpainter fill vase.ply --where sphere=0,0.2,1,0.15 --out mended.ply
      splatpainter fill vase.ply --around mask=circle.png@views/view_000.json --out closed.ply
      splatpainter fill vase.ply --where box=0,0,0,1,1,1 --source gemini --prompt "old wall" --out wall.ply
    """

    asset: AssetFile
    """The splat file; it is not changed."""
    out: OutFile
    """The file to write; its name says the format."""
    where: Annotated[tuple[str, ...], arg(metavar="WHERE ...", help_behavior_hint="")] = ()
    """Part to remove; what it leaves is filled."""
    remove: Literal["body", "selection"] = "body"
    """What goes of WHERE: body: the whole thing that it is of, its back too, without the ground it stands on; where it
    is a spot on something larger, as selection: it alone."""
    around: Annotated[tuple[str, ...], arg(metavar="WHERE ...", help_behavior_hint="")] = ()
    """Instead: what surrounds an existing hole, such as a mask drawn around it."""
    source: Annotated[str, arg(metavar="NAME", help_behavior_hint="")] = ""
    """A picture source (`splatpainter source list`) that is sent a view of the filled hole, which is its mask; default:
    the texture of what surrounds it."""
    prompt: Annotated[str, arg(metavar="TEXT", help_behavior_hint="")] = ""
    """What the source should paint there."""
    view: Annotated[Path | None, arg(metavar="CAM.json", help_behavior_hint="")] = None
    """Camera of the view that is sent; default: one that faces the hole."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Pixels of its longer side; default: what --view says."""
    source_option: Annotated[tuple[str, ...], arg(metavar="KEY=VALUE ...", help_behavior_hint="")] = ()
    """Options of the source."""
    source_strictness: Strictness = "normal"
    """Which pictures are refused, as in `splatpainter edit`."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Random seed, for sources that take one."""
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
    """Check, read, fill, write, verify."""
    from splatpainter.source_edits.fill import fill
    from splatpainter.sources.registry import open_source
    from splatpainter.sources.source_options import option_words

    receipt_path = config.receipt or receipt_of(config.out)
    if bool(config.where) == bool(config.around):
        given = "both" if config.where else "none"
        raise ValueError(
            f"{COMMAND}: expected --where (what to remove) or --around (what surrounds a hole), got {given}"
        )
    region = Region.parse(config.where or config.around)
    check_outputs(
        config.out, receipt_path, config.overwrite, config.asset, [config.view] if config.view is not None else []
    )
    source = _source(config, open_source, option_words)
    cameras = [given_camera(config.view, config.size, config.asset)] if config.view is not None else []
    with keeping_answers(source, config.out), stages(4) as bar:
        bar.enter("reading")
        clock = time.perf_counter()
        splats = read(config.asset, frame=config.frame, lenient=config.lenient)
        warn_of_doubts(splats, config.asset, editing=True)
        read_seconds = time.perf_counter() - clock
        bar.enter("filling")
        weights = region.weights(splats)
        with SourceBar() as progress:
            edited = fill(
                splats,
                weights if config.where else None,
                around=weights if config.around else None,
                body=config.remove == "body",
                source=source,
                prompt=config.prompt,
                camera=cameras[0].relative_to(splats.offset) if cameras else None,
                seed=config.seed,
                strictness=config.source_strictness,
                progress=progress,
                cancel=threading.Event(),
            )
        receipt, verification = write_proved(splats, edited, config.out, receipt_path, config.axes, bar, read_seconds)
    same = f"{verification.same:,} of {count(verification.rows, 'Gaussian')} {same_words(verification)}, verified"
    removed = [f"{count(len(receipt.removed), 'Gaussian')} removed (opacity 0)"] if config.where else []
    lines = [
        f"{config.asset} -> {config.out}",
        *([f"frame: {verification.frame}"] if verification.frame_is_news else []),
        *removed,
        *(part for part in receipt.note.split("; ") if part),
        same,
        seconds(receipt.seconds),
    ]
    return Outcome(proved_record(config.out, receipt_path, receipt, verification), lines)


def _source(config: Config, open_source, option_words) -> InterruptibleSource | None:
    """Raises ValueError: options without a source."""
    options = {
        "--prompt": config.prompt,
        "--view": config.view,
        "--size": config.size,
        "--seed": config.seed,
        "--source-option": config.source_option,
    }
    if config.source:
        return InterruptibleSource(open_source(config.source, option_words(config.source_option)))
    for option, value in options.items():
        if value:
            raise ValueError(f"{COMMAND}: {option} is for pictures that a source makes; give --source NAME too")
    return None
