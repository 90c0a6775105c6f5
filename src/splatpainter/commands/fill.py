"""`splatpainter fill`: remove a part of an asset and fill what it leaves, or fill a hole, verified like an edit."""

from __future__ import annotations

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import AssetArguments, FileArguments, run_operation
from splatpainter.operations.fill import Fill
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config(FileArguments, Fill, AssetArguments):
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


def run(config: Config) -> Outcome:
    """Check, read, fill, write, verify."""
    return run_operation(config, Fill, "fill")
