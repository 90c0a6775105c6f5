"""Settings of local and global lifts."""

from __future__ import annotations

from typing import Literal

from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import out_of_range, ranged

ResidualBase = Literal["own", "lift"]
"""What a network's residual is added to: the asset as it is, or the lift's answer."""


MAX_DEPTH_EDGE_LIMIT_PX = 16.0
"""Largest strip beside an edge in depth that can be left out, pixels."""


@dataclass(frozen=True)
class LocalOptions:
    """How a local lift trades detail for Gaussians."""

    rounds: int = 8
    """Colour rounds after splitting; 0: split only, no colours and no detail layer."""
    goal_px: float = 2.0
    """Gaussians are halved until they are about this wide (standard deviation, pixels of the edited view)."""
    tolerance: float = 0.1
    """A Gaussian is halved if the wanted change varies over its footprint by more than this standard deviation
    (0..1)."""
    min_share: float = 0.05
    """Only Gaussians that give some masked pixel at least this share of its colour are halved."""
    max_halvings: int = 7
    """Most halvings of one Gaussian."""
    max_appended: int = 40_000
    """About how many Gaussians splitting may append, before those that want one colour are joined again."""
    max_error: float = 0.03
    """Pixels that are further than this from the picture afterwards are covered by further Gaussians; 1: none are."""
    rim_px: int = 24
    """Pixels around the mask that the detail layer may mend."""
    resurface: bool = True
    """Lay sheets where the surface is trusted; False: split Gaussians everywhere."""
    fine_px: float = 12.0
    """Painted pixels per Gaussian that makes them up to which most of a side is split, not covered by sheets (0: never;
    `paint.is_fine`)."""
    sheet_rounds: int = 2
    """Colour rounds of sheets."""
    max_pieces: int = 12_000
    """Pieces of Gaussians across the edge of a sheet from which on none is halved any more."""
    angle_limit: float = ranged(85.0, ge=0, le=90)
    """Degrees between the line of sight and the surface's normal from which one view's paint fades; 0: no limit."""
    depth_edge_limit: float = ranged(0.0, ge=0, le=MAX_DEPTH_EDGE_LIMIT_PX)
    """Pixels beside an edge in depth that one view does not paint; 0: none."""
    max_left_px: int = 12
    """Edited pixels without a sheet up to which they are left as they are, not split."""
    damping: float = 0.3
    """What is left of SH bands >= 1 in a fully repainted Gaussian, 0..1."""
    correct: bool = False
    """One view's paint on a part takes colours that suit views from beside, too (correction.py)."""
    spares_long: bool = False
    """Long Gaussians of which little lies under the paint keep their colour (`evidence.reaches_out`). For edits of
    several views: other ones see what a view hides of them. With one view novel ones of captures gain 0.2 to 1.4 dB
    outside of the paint by it, and lose 0 to 1.0 inside."""

    def __post_init__(self) -> None:
        if (line := out_of_range(self)) is not None:
            raise ValueError(line)


@dataclass(frozen=True)
class GlobalOptions:
    """How a global lift trusts what the views show."""

    rounds: int = 5
    """Colour rounds over all views at once."""
    last_rounds: int = 3
    """Further ones, which start from what the regression predicts for every Gaussian."""
    hold: float = 0.25
    """Pixels of weight with which these hold on to the regression: what views see little of is predicted. Novel views
    from 1, 2 and 4 relit ones, against 0.1: held-out assets fitted by 3DGS to path traced pictures +0.08, +0.14 and
    +0.04 dB, 20 clean ones +0.01, 0.00 and -0.02; 1 costs those 0.1, 0.4 and 0.5."""
    ridge: float = 1e-3
    """Ridge weight of the affine part, relative to the total weight of the Gaussians that are seen."""
    ridge_normals: float = 1e-2
    """Ridge for the part that depends on the normal (light directions that no view shows stay unchanged)."""
    far_side: float = 0.4
    """Share of the mean change that goes the other way on what no view shows, where all views come from one side: what
    a light takes from the front it tends to give to the back, as exposure is set for the whole. From one view, assets
    fitted by 3DGS to path traced pictures: relit +0.27 dB, graded -0.02 (28 training objects), relit +0.15 (10 held-out
    ones); clean ones: relit -0.01 (20), graded +0.03 (8)."""
    unexplained: tuple[float, float] = (0.15, 0.35)
    """What colour leaves unexplained of the change (`unexplained_by_color`): up to the first, it is a look that goes
    all around, and nothing goes the other way; from the second on, all of `far_side`. From 0 to 0.2, graded clean
    assets lose 0.5 dB."""
    half_hidden_px: float = 0.5
    """A Gaussian seen with this many pixels of weight counts as half hidden."""
    half_seen: float = 2.0
    """A Gaussian seen with this many pixels of weight counts as half seen, half predicted."""


LOCAL_DEFAULTS, GLOBAL_DEFAULTS = LocalOptions(), GlobalOptions()
