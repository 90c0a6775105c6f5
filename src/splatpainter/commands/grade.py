"""`splatpainter grade`: new colours for an asset or a region of it, verified like an edit."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from splatpainter.commands import Outcome
from splatpainter.commands.asset_doubts import warn_of_doubts
from splatpainter.commands.option_parsing import AssetFile, AxesOption, FrameOption, OutFile
from splatpainter.commands.terminal import count, seconds, stages
from splatpainter.commands.verified_write import check_outputs, proved_record, write_proved
from splatpainter.commands.verify import same_words
from splatpainter.io import read
from splatpainter.operations.grade import LOOKS, SLIDERS, Grade, Look, grade
from splatpainter.operations.operation import Wording
from splatpainter.operations.region import Region
from splatpainter.receipts import receipt_of

COMMAND = "splatpainter grade"


@dataclass(frozen=True)
class Config:
    """Grade the colours of an asset, or of a region of it: by sliders, a look of the studio, a LUT, the colours of a
    picture, or one new colour. Nothing but colours changes, and the receipt proves which.

    WHERE is made of terms that all have to hold, with `or` between groups and `not:` before a term: hue=A..B (degrees,
    340..20 goes through red), saturation=A..B, lightness=A..B, color=#RRGGBB~DISTANCE, x=A..B, y=A..B, z=A..B,
    box=X,Y,Z,X,Y,Z, sphere=X,Y,Z,R, opacity=A..B, size=A..B, mask=M.png@CAM.json, selection=NAME@P.splatproj and
    layer=NAME@P.splatproj (of a project of the same asset). Ranges may lack an end (y=..0.5).

    example:
      splatpainter grade vase.ply --exposure 0.5 --temperature 0.3 --out warm.ply
      splatpainter grade shoe.ply --recolor "#2040a0" --where hue=340..20 saturation=0.4.. --out blue.ply
      splatpainter grade vase.ply --match sunset.jpg --strength 0.8 --out evening.ply
    """

    asset: AssetFile
    """The splat file; it is not changed."""
    out: OutFile
    """The file to write; its name says the format."""
    exposure: float = 0.0
    """Exposure in stops, of linear light."""
    temperature: float = 0.0
    """-1 cold .. 1 warm."""
    tint: float = 0.0
    """-1 green .. 1 magenta."""
    contrast: float = 0.0
    """-1 .. 1: slope 2^c in the mid-tones."""
    saturation: float = 0.0
    """-1 grey .. 1 twice as colourful."""
    hue: float = 0.0
    """Degrees by which all hues turn, about the grey axis; 120: red to green."""
    look: Annotated[Path | None, arg(metavar="LOOK.json", help_behavior_hint="")] = None
    """Instead of sliders: an adjustment layer, as the studio exports it (.splatlayer), or its settings as JSON: the
    sliders, curve, hues, strength."""
    lut: Annotated[Path | None, arg(metavar="FILE.cube", help_behavior_hint="")] = None
    """... or a table of display colours, 1D or 3D, as grading programs write it."""
    match: Annotated[Path | None, arg(metavar="PICTURE", help_behavior_hint="")] = None
    """... or the mean and spread of the colours of this picture (linear Monge-Kantorovitch map)."""
    recolor: Annotated[str, arg(metavar="#RRGGBB", help_behavior_hint="")] = ""
    """... or one new colour; light and shade stay as they are."""
    strength: float = 1.0
    """Strength of the change, 0 .. 1."""
    where: Annotated[tuple[str, ...], arg(metavar="WHERE ...", help_behavior_hint="")] = ()
    """Region that changes; default: everything."""
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
    """Check, read, grade, write, verify."""
    receipt_path = config.receipt or receipt_of(config.out)
    inputs = [path for path in (config.look, config.lut, config.match) if path is not None]
    check_outputs(config.out, receipt_path, config.overwrite, config.asset, inputs)
    look = look_of(config)
    region = Region.parse(config.where) if config.where else None
    with stages(4) as bar:
        bar.enter("reading")
        clock = time.perf_counter()
        splats = read(config.asset, frame=config.frame, lenient=config.lenient)
        read_seconds = time.perf_counter() - clock
        warn_of_doubts(splats, config.asset)
        bar.enter("grading")
        edited = grade(splats, look, region, strength=config.strength)
        receipt, verification = write_proved(splats, edited, config.out, receipt_path, config.axes, bar, read_seconds)
    changed = f"{count(len(receipt.touched), 'Gaussian')} changed"
    same = f"{verification.same:,} of {count(verification.rows, 'Gaussian')} {same_words(verification)}, verified"
    lines = [
        f"{config.asset} -> {config.out}",
        *([f"frame: {verification.frame}"] if verification.frame_is_news else []),
        *(part for part in receipt.note.split("; ") if part),
        changed,
        same,
        seconds(receipt.seconds),
    ]
    return Outcome(proved_record(config.out, receipt_path, receipt, verification), lines)


def look_of(config: Config) -> Look:
    """The one look that is asked for. Raises ValueError: none, several, or one that cannot be read."""
    names = (*SLIDERS, *LOOKS)
    options = Grade(**{name: getattr(config, name) for name in names})
    options.check(Wording(f"{COMMAND}: ", "--"))
    return options.colors()
