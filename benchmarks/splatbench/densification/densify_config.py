"""Sizes and switches of the densifier; the dataclass is the command line and the JSON in the checkpoint. No torch here.

`paper` has the numbers of the published system as far as they are published (arXiv 2412.06234); of the others
(heads, hidden widths, resolution) the choice is ours.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import ClassVar, Literal

from splatpainter.models.config import read_json

Head = Literal["relative", "absolute"]


@dataclass(frozen=True)
class DensifyConfig:
    """The densifier."""

    format: ClassVar[str] = "splatpainter densifier"
    """Format name in its checkpoints."""
    preset: str = "paper"
    """Name of these settings."""
    most: int = 12_000
    """Gaussians that are replaced, at most: those with the largest absolute screen-space gradients."""
    min_opacity: float = 0.005
    """Gaussians at or below this opacity are never chosen."""
    sh_degree: int = 1
    """Degree of the harmonics that the network sees and changes, 0..4; higher bands of a Gaussian stay."""
    widths: tuple[int, ...] = (160, 256)
    """Widths of a point's features in each level."""
    children: tuple[int, ...] = (2, 4)
    """Points that each surviving point of a level becomes: 2 (along its longest axis) or 4 (along its two longest)."""
    blocks: int = 2
    """Attention blocks per level."""
    window: int = 48
    """Points along a curve that see each other."""
    heads: int = 8
    """Attention heads; every width is a multiple of it."""
    expansion: int = 4
    """Hidden width of the blocks' MLPs, in widths."""
    keep: float = 0.8
    """Share of a level's points that have children; the others are left as they are."""
    frequencies: int = 15
    """Frequencies of the sine and cosine code of a child's offset."""
    resolution: int = 64
    """Cells per edge of the scene box; only head "absolute" needs a cell."""
    head: Head = "absolute"
    """relative: attributes are bounded residuals on those of an even split of the parent, zero at first; absolute: the
    published constants (opacity 0.1, a 48th of a cell)."""

    def __post_init__(self) -> None:
        for name in ("most", "blocks", "window", "heads", "expansion", "frequencies", "resolution"):
            if getattr(self, name) < 1:
                raise ValueError(f"config: expected {name} of at least 1, got {getattr(self, name)}")
        if not self.widths or len(self.widths) != len(self.children):
            raise ValueError(f"config: expected as many widths as children, got {self.widths} and {self.children}")
        if any(width < 1 or width % self.heads for width in self.widths):
            raise ValueError(f"config: expected widths that are multiples of the {self.heads} heads, got {self.widths}")
        if any(count not in (2, 4) for count in self.children):
            raise ValueError(f"config: expected 2 or 4 children per level, got {self.children}")
        if not 0 < self.keep <= 1:
            raise ValueError(f"config: expected keep above 0 and at most 1, got {self.keep}")
        if not 0 <= self.min_opacity < 1:
            raise ValueError(f"config: expected min_opacity 0..1, got {self.min_opacity}")
        if not 0 <= self.sh_degree <= 4:
            raise ValueError(f"config: expected sh_degree 0..4, got {self.sh_degree}")

    def to_json(self) -> str:
        """Every field."""
        return json.dumps(dataclasses.asdict(self), indent=2)

    @staticmethod
    def from_json(text: str, where: str = "config") -> DensifyConfig:
        """Parse what `to_json` wrote. Raises ValueError naming `where` and the key that is wrong."""
        return read_json(DensifyConfig, text, where)


PAPER = DensifyConfig()
COMPACT = DensifyConfig(
    preset="compact",
    most=4096,
    widths=(96, 128),
    heads=4,
    expansion=2,
    frequencies=6,
    head="relative",
)
"""What ships: fits two CPU cores, 1.6 MB of weights in half precision."""
PRESETS = {"paper": PAPER, "compact": COMPACT}
