"""`splatpainter pixelate`: a region of an asset made unreadable from all sides."""

from __future__ import annotations

from splatpainter.commands import Outcome
from splatpainter.commands.parts.edited_file import AssetArguments, FileArguments, run_operation
from splatpainter.operations.pixelate import Pixelate
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Config(FileArguments, Pixelate, AssetArguments):
    """Make a region of an asset unreadable from all sides, for good: faces, plates, words. Each cell of a grid takes
    one colour, or the region is blurred; view-dependent colour is cleared, hidden Gaussians behind the region change
    with it. Everything else keeps every bit; the receipt says what was done, and `verify` checks it in the file.

    Places and sizes of Gaussians stay unless --merge: letters that are cut into the surface stay readable without it.
    Words can be guessed from the means of small cells: take cells larger than the letters, or --color.

    example:
      splatpainter pixelate street.ply --where mask=plate.png@views/view_000.json --size 0.1 --merge --out public.ply
      splatpainter pixelate room.ply --where box=-0.2,0.1,0.8,0.2,0.3,1 --color "#808080" --merge --out public.ply
    """


def run(config: Config) -> Outcome:
    """Check, read, apply, write, verify."""
    return run_operation(config, Pixelate, "pixelate")
