"""`splatpainter generate`: views of an asset edited by a picture source, verified like an edit."""

from __future__ import annotations

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import AssetArguments, EditArguments, run_operation
from splatpainter.operations.generate import Generate
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config(EditArguments, Generate, AssetArguments):
    """Have a picture source edit a view of an asset, or one view after another until the surface is covered. What comes
    back is registered, corrected and cut to what changed; Gaussians that it does not reach keep every bit, and the
    receipt proves it and names the source.

    example:
      splatpainter generate vase.ply --source gemini --prompt "mossy stone" --views auto --out mossy.ply
      splatpainter generate vase.ply --source gemini --prompt "mossy stone" --views auto --dry-run --out mossy.ply
    """


def run(config: Config) -> Outcome:
    """Check, read, apply, write, verify."""
    return run_operation(config, Generate, "generate")
