"""`splatpainter delight`: the light that is baked into an asset taken out, verified like an edit."""

from __future__ import annotations

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import AssetArguments, FileArguments, run_operation
from splatpainter.operations.light import Delight
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config(FileArguments, Delight, AssetArguments):
    """Take the light and the shadows out of an asset's colours, as far as they can be estimated: what is left is its
    look in white light from all around.

    example:
      splatpainter delight vase.ply --out flat.ply
      splatpainter delight vase.ply --source-light studio.hdr --mix 0.7 --out flat.ply
    """


def run(config: Config) -> Outcome:
    """Check, read, take the light out, write, verify."""
    return run_operation(config, Delight, "delight")
