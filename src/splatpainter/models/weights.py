"""Where weights are: trained ones of the presets, or a folder that the user names. Knows no torch until it loads."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from splatpainter.models.checkpoint import INDEX
from splatpainter.models.config import PRESETS

if TYPE_CHECKING:
    from splatpainter.models.model import SplatPainterModel

VARIABLE = "SPLATPAINTER_WEIGHTS"
"""Environment variable: a folder with one folder of weights per preset, looked into before the package."""
PACKAGED = Path(__file__).parents[1] / "weights"
"""The same for weights that come with the package."""


def places(preset: str) -> list[Path]:
    """Folders that may hold the weights of a preset, in the order in which they are tried."""
    named = os.environ.get(VARIABLE, "")
    return [Path(root) / preset for root in ([named] if named else [])] + [PACKAGED / preset]


def find(preset: str) -> Path | None:
    """The folder with the weights of a preset, or None."""
    return next((folder for folder in places(preset) if (folder / INDEX).is_file()), None)


def load(preset: str) -> SplatPainterModel:
    """The model of a preset with its trained weights, or of the checkpoint in a folder; its own config always wins.

    Raises ValueError: neither a preset nor a folder, no weights there, weights of another preset than the name says,
    and as SplatPainterModel.load."""
    if preset in PRESETS:
        folder = find(preset)
        if folder is None:
            root = os.environ.get(VARIABLE) or f"a folder that {VARIABLE} names"
            what = f"put {INDEX} and its shards into '{preset}' in {root}, or use 'lift'"
            raise ValueError(f"preset '{preset}': no trained weights; {what}")
    else:
        folder = Path(preset)
        if not folder.is_dir():
            known = ", ".join(["auto", "lift", *PRESETS])
            raise ValueError(f"preset: expected one of {known}, or a folder of weights, got {preset!r}")
    from splatpainter.models.model import SplatPainterModel

    return SplatPainterModel.load(folder, preset if preset in PRESETS else None)
