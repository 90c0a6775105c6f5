"""`splatpainter refine`: views of an asset enlarged by a model or another source, and their detail lifted onto it."""

from __future__ import annotations

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import AssetArguments, FileArguments, run_operation
from splatpainter.operations.refine import Refine
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config(FileArguments, Refine, AssetArguments):
    """Make an asset sharper in close-up views. Each view is rendered, enlarged by a
    super-resolution model (or another picture source), and all of them are lifted together at the enlarged size:
    Gaussians that are too coarse are split, the others only take new colours.

    Without a model the enlargement is Lanczos and gentle sharpening, which invents no detail. Models are files that
    spandrel opens (pip install 'splatpainter[upscale]').

    example:
      splatpainter refine vase.ply --view views/view_000.json views/view_001.json --out fine.ply
      splatpainter refine vase.ply --view near.json --upscale realesrgan.safetensors --scale 4 --out fine.ply
    """


def run(config: Config) -> Outcome:
    """Check, read, ask, lift, write, verify."""
    return run_operation(config, Refine, "refine")
