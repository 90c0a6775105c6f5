"""Sizes and switches of the local network (models/local_network.py); the dataclass is the command line and the JSON in
the checkpoint. No torch here."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import field
from typing import ClassVar

from splatpainter.models.config import RefineConfig, read_json
from splatpainter.models.picture_patches import SLOTS
from splatpainter.system.quick_dataclass import dataclass

PLACE_WIDTH = SLOTS + 1
"""Width of the code of a place."""


@dataclass(frozen=True)
class LocalConfig:
    """The local network."""

    format: ClassVar[str] = "splatpainter local network"
    """Format name in its checkpoints."""
    preset: str = "local"
    """Name under which its checkpoint is found."""
    content_width: int = 95
    """Width of what a patch or a Gaussian is, beside its place."""
    refine: RefineConfig = field(
        default_factory=lambda: RefineConfig(
            blocks=2,
            fast_hidden=128,
            hidden=128,
            heads=4,
            patch=4,
            inner_loss="dot",
            detail=True,
        )
    )
    """Blocks, fast weights and the extra layer; of the other fields none is read."""

    def __post_init__(self) -> None:
        if self.content_width < 2:
            raise ValueError(f"config: expected content_width of at least 2, got {self.content_width}")
        if self.refine.fast_hidden <= SLOTS:
            raise ValueError(
                f"config: expected fast_hidden above the {SLOTS} cells of a tile, got {self.refine.fast_hidden}"
            )
        if self.dim % self.refine.heads:
            raise ValueError(
                f"config: expected a width that is a multiple of {self.refine.heads} heads, got {self.dim}"
            )

    @property
    def dim(self) -> int:
        """D."""
        return PLACE_WIDTH + self.content_width

    def to_json(self) -> str:
        """Every field."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    @staticmethod
    def from_json(text: str, where: str = "config") -> LocalConfig:
        """Parse what `to_json` wrote. Raises ValueError naming `where` and the key that is wrong."""
        return read_json(LocalConfig, text, where)
