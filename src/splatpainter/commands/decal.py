"""`splatpainter decal`: a picture or a text laid on an asset's surface, verified like an edit."""

from __future__ import annotations

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import AssetArguments, FileArguments, run_operation
from splatpainter.operations.decal import LayDecal
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config(FileArguments, LayDecal, AssetArguments):
    """Lay a picture, or a text, on an asset's surface under a pixel of a camera's picture, unwrapped over it; what is
    transparent stays as it is. Other Gaussians keep every bit, and the receipt proves it.

    example:
      splatpainter decal vase.ply label.png --at 400,300 --camera views/view_000.json --width 20% --out new.ply
      splatpainter decal vase.ply --text "No. 7" --at 400,300 --camera cam.json --width 0.4 --angle 15 --out new.ply
    """


def run(config: Config) -> Outcome:
    """Check, read, apply, write, verify."""
    return run_operation(config, LayDecal, "decal")
