"""`splatpainter delight`: the light that is baked into an asset taken out, verified like an edit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from splatpainter.cameras import UpAxis
from splatpainter.commands import Outcome
from splatpainter.commands.light import write_lit
from splatpainter.commands.option_parsing import AssetFile, AxesOption, FrameOption, OutFile


@dataclass(frozen=True)
class Config:
    """Take the light and the shadows out of an asset's colours, as far as they can be estimated: what is left is its
    look in white light from all around.

    example:
      splatpainter delight vase.ply --out flat.ply
      splatpainter delight vase.ply --source-light studio.hdr --mix 0.7 --out flat.ply
    """

    asset: AssetFile
    """The splat file; it is not changed."""
    out: OutFile
    """The file to write; its name says the format."""
    mix: float = 1.0
    """How much of the new look, 0 .. 1; the rest is the captured one."""
    shadows: bool = True
    """Shadows and occlusion by the asset itself, in the light before."""
    source_light: Annotated[Path | None, arg(metavar="SKY", help_behavior_hint="")] = None
    """The environment that the asset was captured in (lat-long .hdr, .exr); default: estimated from its colours."""
    full_range: bool = False
    """Environments with suns and lamps as bright as they are stored; default: limited to what 99.9 % of their values
    stay below. A sun comes back by `splatpainter light --sun`."""
    where: Annotated[tuple[str, ...], arg(metavar="WHERE ...", help_behavior_hint="")] = ()
    """Region that changes; default: everything. What is outside casts shadows all the same."""
    up: UpAxis = "auto"
    """Which way is up for environments and suns; auto: -y, as captures have it."""
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
    """Check, read, take the light out, write, verify."""
    return write_lit(config, None, [])
