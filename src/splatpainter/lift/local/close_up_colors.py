"""Base colours of close-ups after the rounds of all pictures: as much more of the close-ups as other views bear out.

Rounds that views around hold leave a close-up's own view soft. Rounds towards the close-up alone make it sharp, and for
what they write into Gaussians that it hardly shows other views pay. How much of these each Gaussian takes, and how far
it goes back to its colour before the edit, is learnt from novel views of the truth (`LEARNT`). J Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.lift.colors import MIN_CHANGE, lift_colors
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.local.evidence import footprints
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass

CLOSE_UP_ROUNDS = 12
"""Rounds of base colours, of which a part is taken."""
HOLD_HIDDEN = 0.05
"""Pixels' worth of weight, per pixel of a Gaussian that a close-up hides, that its colour has in these (measured for
`models.local_edit_colors.HELD_COLORS.hold_hidden`)."""
HALF_SEEN_PX, HALF_WIDE_PX = 1.0, 16.0
"""Pixels' worth of a Gaussian, shown and in all, that count as half of many. Taste."""
LEARNT = (
    (0.149, 0.178, 0.178, 0.222, 0.201, 0.176, 0.209),
    (0.008, 0.007, 0.006, 0.009, 0.015, 0.004, 0.004),
)
"""What each of `gaussian_features` adds to the share of the rounds, and of the way back to the colour before. Ridge
regression (as much as the diagonal) on 126 close-ups: of 60 training meshes, sampled or fitted by 3DGS, and of three
captures made coarser. Eight novel views near each, four of the object, and 0.2 times itself count, by what they gain in
dB. Novel close-ups / whole object / edited view of held-out objects, dB, before and after: clean (29) 29.70 / 27.53 /
35.9, 29.78 / 27.53 / 36.8; fitted (29) 26.34 / 27.63 / 34.4, 26.42 / 27.63 / 35.6; three other captures (12 views)
31.08 / 24.01 / 40.5, 31.11 / 24.01 / 41.3.

`python scripts/calibrate/close_up_colors.py DATA CACHE` fits such numbers. Other close-ups of such assets give others,
at most 0.07 away, which gain as much (docs/ADAPTATION.md)."""


@dataclass(frozen=True)
class CloseUps:
    """What the close-ups of a lifted asset show. N Gaussians, V views."""

    views: Sequence[EditView]
    """V."""
    solid: Sequence[Floats] = field(repr=False)
    """[H, W] for each view: what its pixels count."""
    before: Floats = field(repr=False)
    """[N, 3] band 0 of what each Gaussian was, or was split from."""
    movable: Bools = field(repr=False)
    """[N] bool: Gaussians whose colours may change."""


def sharpened(splats: Splats, close_ups: CloseUps, learnt: Sequence[Sequence[float]] = LEARNT) -> Floats:
    """[N, K, 3] SH of a lifted asset, with more of the close-ups' detail."""
    ids = np.flatnonzero(close_ups.movable)
    facts, ways = gaussian_features(splats, close_ups.views, ids), ways_of_change(splats, close_ups, ids)
    rounds, back = ((facts * weights).sum(1, dtype=np.float64)[:, None] for weights in np.array(learnt))
    change = rounds * ways[0] + back * ways[1]
    moved = np.abs(change).max(1) * SH_C0 > MIN_CHANGE
    sh = splats.sh.copy()
    sh[ids[moved], 0] += change[moved].astype(sh.dtype)
    return sh


def ways_of_change(splats: Splats, close_ups: CloseUps, ids: Ids) -> tuple[Floats, Floats]:
    """([J, 3], [J, 3]) float64 of band 0: all of CLOSE_UP_ROUNDS, and all the way back to before."""
    result = splats
    for view, use in zip(close_ups.views, close_ups.solid, strict=True):
        result = replace(result, sh=_after_rounds(result, view, use, close_ups.movable))
    band = splats.sh[ids, 0].astype(np.float64)
    return result.sh[ids, 0] - band, close_ups.before[ids] - band


def _after_rounds(splats: Splats, view: EditView, use: Floats, movable: Bools) -> Floats:
    """[N, K, 3] SH after CLOSE_UP_ROUNDS of band 0 towards a picture."""
    projected = project(splats, view.camera)
    ids = projected.gaussian_ids
    weight = projected.backproject(view.target, np.ones_like(use)).weight
    hold = HOLD_HIDDEN * np.maximum(footprints(projected) - weight, 0)
    colors = lift_colors(projected, view.target, use, movable[ids], CLOSE_UP_ROUNDS, hold)
    sh = splats.sh.copy()
    sh[ids, 0] += (colors - np.maximum(projected.unclamped_colors, 0)) * movable[ids, None] / np.float32(SH_C0)
    return sh


def gaussian_features(splats: Splats, views: Sequence[EditView], ids: Ids) -> Floats:
    """[J, 7] float64: 1, opacity, and of the view that shows most of each Gaussian the most that it makes of a pixel,
    the share of its footprint that is shown, of what nothing covers, and how many pixels it is and would be."""
    best = np.zeros((len(splats), 5))
    for view in views:
        projected: ProjectedView = project(splats, view.camera)
        sums = projected.backproject(view.target, view.mask.astype(np.float32))
        wide = footprints(projected)
        weight, peak, alpha = (values.astype(np.float64) for values in (sums.weight, sums.peak, sums.alpha))
        shares = np.minimum(weight / np.maximum(wide, 1e-6), 1), weight / np.maximum(alpha, 1e-6)
        sizes = weight / (weight + HALF_SEEN_PX), wide / (wide + HALF_WIDE_PX)
        here = np.stack([peak, *shares, *sizes], 1)
        more = here[:, 3] > best[projected.gaussian_ids, 3]
        best[projected.gaussian_ids[more]] = here[more]
    return np.concatenate([np.ones((len(ids), 1)), splats.opacities[ids, None], best[ids]], 1)
