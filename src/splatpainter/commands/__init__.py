"""The commands: one small module each, with a frozen dataclass `Config` and `run(config) -> Outcome`.

The dataclass is the command line, its help and its JSON: one docstring line under each field, an example in the class's
own. Commands print nothing themselves; what they found goes back in the Outcome, warnings and progress go to stderr
through `terminal`. Wrong input is a ValueError of one line.
"""

from __future__ import annotations

from dataclasses import field
from typing import Any

from splatpainter.system.quick_dataclass import dataclass

SUMMARIES = {
    "demo": "paint on the bundled asset: before, edited picture, after, turntable, receipt",
    "info": "what a splat file holds, and what is odd about it",
    "convert": "convert from one splat format to another",
    "mesh": "a closed triangle mesh of an asset, for shadows and collisions",
    "merge": "merge several assets into one file, each in its own range of rows",
    "render": "pictures of an asset that carry their camera",
    "turntable": "a video of a turn around an asset: MP4 or animated WebP",
    "compare": "pictures of two assets side by side, their difference, dB per view",
    "edit": "edited pictures, decals, colours and light onto an asset: any list of operations",
    "decal": "lay a picture or a text on an asset's surface",
    "generate": "views edited by a picture source: a program, an image service, a local model",
    "refine": "make an asset sharper in close-ups: views enlarged by a model, lifted together",
    "fill": "remove a part and fill the gap, or fill a hole: surface, tone and texture continue",
    "grade": "new colours for an asset or a region of it: sliders, LUTs, a picture's colours",
    "light": "new light on an asset: environments, suns, lamps, baked into its colours",
    "delight": "the light that is baked into an asset taken out, nearly",
    "pixelate": "make a region unreadable from all sides: faces, plates, words",
    "batch": "the edits of a JOBS.yaml on many assets, in variants: resumable, with a page of all results",
    "watch": "lift every edited picture that is saved into a folder onto an asset",
    "source": "where edited pictures come from: programs, image services, local models",
    "verify": "prove that an edit changed only the rows in its receipt; exit 1 if another differs",
    "fit": "optimise an asset from a mesh, from pictures with cameras, or from another asset",
    "data": "training and evaluation data: render, check, list",
    "train": "train the networks: stages lrm, compress, predict, rows, refine",
    "studio": "paint on an asset in the browser",
    "bench": "measure speed, or quality on given assets",
}
"""Command -> one line for `splatpainter --help`, in the order shown."""
ENTRY_POINTS = "splatpainter.commands"
"""Group of entry points by which other distributions add commands."""
DISTRIBUTIONS = {
    "data": "the distribution splatpainter-train: pip install ./train, in the repository",
    "train": "the distribution splatpainter-train: pip install ./train ./networks, in the repository",
    "bench": "the distribution splatpainter-bench: pip install ./benchmarks ./train ./networks, in the repository",
}
"""Commands that are not in this package -> what brings them."""


@dataclass(frozen=True)
class Outcome:
    """What a command did."""

    record: dict[str, Any]
    """What --json prints; may hold paths, numpy numbers and infinities (`terminal.to_json`)."""
    lines: list[str] = field(default_factory=list)
    """What people read, without --json."""
    code: int = 0
    """Exit code."""

    def as_json(self) -> Outcome:
        """The outcome, its lines replaced by the record as JSON."""
        # Imported here: only --json needs it, and --help must stay quick.
        from splatpainter.commands.parts.terminal import to_json

        return Outcome(self.record, [to_json(self.record)], self.code)
