"""The figures that the paper prints (arXiv 2512.05354, tables 1 to 4), for tables to show beside measured ones.

They were taken on other data (370 held-out objects of TexVerse; 10 generated assets in table 3) and on another machine
(one A100), with weights that are not public: they say where the paper stands, and compare with no measured row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

MARK = "as published, other data"
"""Text above every column or beside every figure from here."""
EDITED_REGION, OUTSIDE_REGION = "Edited region", "Non-edited region"


@dataclass(frozen=True)
class Published:
    """One row of one of the paper's tables."""

    protocol: str
    label: str
    """Label as the paper prints it."""
    methods: tuple[str, ...]
    """Names of our methods that are this system; the row stands beside the first of them that a block has."""
    figures: dict[tuple[str, str], float]
    """(group, label) of the paper's column -> figure, in its order; group "" where columns have none."""
    setup_seconds: float | None = None
    """The first of two numbers, where the paper prints two."""
    edit_seconds: float | None = None
    views: int | None = None
    """Number of edited views, where the paper prints a row for each; None: it does not say."""

    @property
    def seconds(self) -> str:
        """Seconds as the paper prints them: "1.54 + 0.64", "323", or ""."""
        parts = [f"{value:g}" for value in (self.setup_seconds, self.edit_seconds) if value is not None]
        return " + ".join(parts)


def _three(psnr: float, ssim: float, lpips: float, group: str = "") -> dict[tuple[str, str], float]:
    return {(group, "PSNR"): psnr, (group, "SSIM"): ssim, (group, "LPIPS"): lpips}


ROWS = (
    # Table 1: local refinement
    Published("refine", "GS-LRM", ("lrm",), _three(20.28, 0.5185, 0.3873), None, 0.92),
    Published("refine", "GenDen", ("genden",), _three(17.32, 0.5378, 0.5979), None, 1.68),
    Published("refine", "3DGS", ("3dgs-48", "3dgs"), _three(20.52, 0.6553, 0.3399), None, 323),
    Published("refine", "SRGS", ("srgs-released", "srgs"), _three(21.01, 0.6759, 0.3540), None, 495),
    Published("refine", "Ours (stage I)", ("stage-1",), _three(20.84, 0.5698, 0.3782), None, 1.54),
    Published("refine", "Ours (stage II)", ("network", "ttt"), _three(21.07, 0.5780, 0.3673), 1.54, 0.64),
    # Table 2: global relighting
    Published("relight", "RelitLRM", ("relitlrm",), _three(21.68, 0.8726, 0.0912), None, 22.1),
    Published("relight", "3DGS", ("3dgs-colors", "3dgs"), _three(21.32, 0.8613, 0.1225), None, 320),
    Published("relight", "GS-LRM + CrossAtt", ("cross-attention",), _three(24.05, 0.8970, 0.0802), 1.54, 0.13),
    Published("relight", "Ours (1 view)", ("ttt-global", "ttt"), _three(24.56, 0.8986, 0.0721), 1.54, 0.08, 1),
    Published("relight", "Ours (2 views)", ("ttt-global", "ttt"), _three(24.71, 0.8991, 0.0719), 1.54, 0.11, 2),
    Published("relight", "Ours (4 views)", ("ttt-global", "ttt"), _three(25.03, 0.9011, 0.0712), 1.54, 0.20, 4),
    # Table 3: creative editing
    Published(
        "creative",
        "VoxHammer",
        ("voxhammer",),
        _three(11.25, 0.2165, 0.5036, EDITED_REGION) | _three(13.86, 0.4893, 0.2906, OUTSIDE_REGION),
    ),
    Published(
        "creative",
        "VineDresser3D",
        ("vinedresser3d",),
        _three(11.99, 0.6092, 0.3506, EDITED_REGION) | _three(15.79, 0.7437, 0.2678, OUTSIDE_REGION),
    ),
    Published(
        "creative",
        "Ours",
        ("network", "ttt"),
        _three(25.61, 0.9380, 0.0471, EDITED_REGION) | _three(33.02, 0.9560, 0.0310, OUTSIDE_REGION),
    ),
    # Table 4: voxel compression
    Published("compress", "VoxelAtt", ("stage1-voxel-att",), _three(30.65, 0.9193, 0.0804)),
    Published("compress", "LocalAtt + latent query", ("stage1-latent-query",), _three(33.84, 0.9349, 0.0264)),
    Published("compress", "LocalAtt + feats query", ("stage1-feats-query",), _three(34.02, 0.9387, 0.0262)),
    Published("compress", "Pre-Compression (GS-LRM)", ("stage1-before",), _three(34.19, 0.9283, 0.0249)),
)
"""Published rows in the paper's order."""


def rows(protocol: str) -> tuple[Published, ...]:
    """The paper's rows of a protocol; () where it has no table for it."""
    return tuple(row for row in ROWS if row.protocol == protocol)


def published_rows(protocol: str, methods: Sequence[str], views: int | None = None) -> dict[str, Published]:
    """Method -> the paper's row that stands beside it in a block, each at most once. methods: those of the block.
    views: number of edited views of the block; rows for which the paper states none stand in every block."""
    matches: dict[str, Published] = {}
    for row in rows(protocol):
        if row.views in (None, views):
            method = next((name for name in row.methods if name in methods and name not in matches), None)
            if method is not None:
                matches[method] = row
    return matches


def unmatched(protocol: str, methods: Sequence[str], views: int | None = None) -> tuple[Published, ...]:
    """The paper's rows that stand beside no method of a block."""
    matched = {row.label for row in published_rows(protocol, methods, views).values()}
    return tuple(row for row in rows(protocol) if row.views in (None, views) and row.label not in matched)
