"""`splatpainter grade`: new colours for an asset or a region of it, verified like an edit."""

from __future__ import annotations

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import AssetArguments, FileArguments, run_operation
from splatpainter.operations.grade import Grade
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config(FileArguments, Grade, AssetArguments):
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


def run(config: Config) -> Outcome:
    """Check, read, grade, write, verify."""
    return run_operation(config, Grade, "grade")
