"""`splatpainter light`: an asset, or a region of it, under other lights, verified like an edit."""

from __future__ import annotations

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import AssetArguments, FileArguments, run_operation
from splatpainter.operations.light import Relight
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config(FileArguments, Relight, AssetArguments):
    """Light an asset, or a region of it: an environment, suns, lamps, with the asset's own shadows, baked into its
    colours. The light that is in them already is estimated, or given; colours change by the ratio of both.

    A light is numbers with commas between, then perhaps a colour and an intensity: 120,35,#ffe0b0,2. An intensity of 1
    is as bright as white light from all around, on a surface that faces the sun, or stands one world unit from a lamp.
    Lights that begin with a minus need an equals sign: --point=-1,0,2. WHERE is as `splatpainter grade` has it.

    example:
      splatpainter light vase.ply --hdri sunset --rotate 40 --out evening.ply
      splatpainter light vase.ply --hdri sky.hdr --source-light studio.hdr --out outside.ply
      splatpainter light room.ply --point 0,-1.2,0.5,#ffe0b0,2 --add --out lamp_on.ply
      splatpainter light vase.ply --rig three-point --save-rig lights.usda --out lit.ply
    """


def run(config: Config) -> Outcome:
    """Check, read, light, write, verify."""
    return run_operation(config, Relight, "light")
