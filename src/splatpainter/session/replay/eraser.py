"""The eraser: what masks reach of an edited asset looks as the original did, and is it again where nothing is in the
way. None is removed. Pure.

A Gaussian of the original and those that were split from it, or lie in place of it (a sheet's, of which it is the
host), are one family. *Reached* are those of which a masked view shows most inside its mask, those of their families
that lie hidden there (lift/masked_gaussians.py), and what lies hidden right behind them.

1. An original that only changed its colour and is reached has the original's colours again.
2. One that lost its place (split, replaced by a sheet's, emptied) *returns*, byte for byte, where some of its family is
   reached, or what stands nearest to it where it was emptied, and where it does not stick out over paint that stays:
   at most `max_overlap` of its footprint lies on pixels beside the mask on which the asset and the original differ by
   more than `paint_contrast`, and no painted one of its family lies where the eraser's views do not see it.
3. Reached Gaussians that are none of the original get opacity 0 where the original is complete again (at most
   `max_overlap` of what the original shows under their footprint is still missing), and with them what is left of the
   families that returned and is no paint. The Gaussian at the index of one that returns is appended where it has to
   stay.
4. All others that are reached stay where they are and take the *old look* at their place: colours of their family in
   the original, then colour rounds towards the picture of the original inside the mask.

So all of it erased is the original bit for bit with everything else hidden; a part erased has neither holes (what is
hidden is covered) nor specks (what returns lies beside the paint). At an opacity below 1 an eraser moves nothing:
everything that is reached takes the old look by that share (`fade_delta`), so the picture is the mean of both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.color import base_color
from splatpainter.rendering.pixel_shares import footprint_mean, share_of
from splatpainter.session.replay.appearance import fitted_sh, moved_gaussians, picture_of
from splatpainter.session.replay.delta import Delta, without_source
from splatpainter.splats import ATTRIBUTES, Splats, changed_rows
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class EraserThresholds:
    """Which Gaussians an erasing stroke reaches."""

    paint_contrast: float = 0.04
    """Change of a colour channel, 0..1, from which a pixel beside the mask shows paint."""
    max_overlap: float = 0.05
    """Share of a footprint."""
    min_in_mask: float = 0.02
    """Share of a footprint that the mask must hold of an original that returns."""
    unseen_paint_contrast: float = 0.1
    """Change of base colours, from which a Gaussian that no view of the eraser shows counts as painted."""
    min_seen_px: float = 0.05
    """Pixels of weight from which a view shows a Gaussian."""
    hidden_in_mask: float = 0.5
    """Share of a footprint that the mask must hold of what is hidden right behind a reached Gaussian, to count
    as reached with it."""
    near_sizes: float = 3.0
    """Distance of such a Gaussian from the reached one, in largest scales of both, at most."""
    nearest_block: int = 1 << 22
    """Distances in memory at a time."""


ERASER = EraserThresholds()

Views = Sequence[tuple[Camera, np.ndarray]]
"""(camera, [H, W] bool mask)."""


def erase_delta(below: Splats, original: Splats, views: Views, reached: np.ndarray) -> Delta:
    """The delta that takes Gaussians (reached: [N] bool) of an edited asset back. `below.origin` [N]: the original's
    Gaussian that each comes from (-1: none)."""
    n, first = len(below), len(original)
    family = _families(below)
    has_family, source = family >= 0, np.maximum(family, 0)
    moved = np.ones(n, bool)
    moved[:first] = moved_gaussians(original, below.take(np.arange(first)))
    moved[:first] |= (below.opacities[:first] == 0) & (original.opacities > 0)
    visible = below.opacities > 0
    seen = _Seen.of(below, original, views)
    # Colours count as changed too, where nothing moved: a recoloured original is paint.
    changed = moved.copy()
    changed[:first] |= (below.sh[:first] != original.sh).any((1, 2))
    masks = [mask for _, mask in views]
    reached, front = _with_hidden(below, views, reached, changed)

    # What returns.
    contrast = np.abs(base_color(below.sh) - base_color(original.sh[source])).max(1)
    unseen_paint = visible & ~reached & (seen.weight < ERASER.min_seen_px) & (contrast > ERASER.unseen_paint_contrast)
    over_paint = _largest_share(below, views, seen.paint)
    paint = visible & ~reached & (over_paint > ERASER.max_overlap) & (contrast > ERASER.paint_contrast) | unseen_paint
    lost = np.flatnonzero(moved[:first])
    missing_ones = original.take(lost)
    in_mask = _largest_share(missing_ones, views, masks)
    sticks_out = _largest_share(missing_ones, views, seen.paint) > ERASER.max_overlap
    # Unseen paint of a family keeps its original away: no view could show that the two are in each other's way.
    blocked = np.zeros(first, bool)
    blocked[source[has_family & unseen_paint]] = True
    erased = np.zeros(first, bool)
    erased[source[has_family & reached]] = True
    orphans = lost[~erased[lost] & ~visible[lost] & (in_mask > ERASER.min_in_mask)]
    # An emptied original has no family in sight: what stands nearest to its place speaks for it.
    stand_ins = np.flatnonzero(visible & moved)
    if len(stand_ins):
        erased[orphans] = reached[stand_ins[_nearest(original.means[orphans], below.means[stand_ins])]]
    # Hidden ones behind what is reached go with it: they would else be holes under what returns.
    orphans = lost[~erased[lost] & ~visible[lost] & (in_mask > ERASER.hidden_in_mask)]
    erased[orphans] = _is_near(original.take(orphans), front)
    orphans = orphans[~erased[orphans]]
    erased[orphans] = ~_is_near(original.take(orphans), below.take(visible & moved & ~reached))  # nobody else's
    returns = np.zeros(first, bool)
    returns[lost] = erased[lost] & ~blocked[lost] & (in_mask > ERASER.min_in_mask) & ~sticks_out

    # What it replaces.
    missing = [share_of(original, camera, moved[:first] & ~returns) for camera, _ in views]
    complete = _largest_share(below, views, missing) <= ERASER.max_overlap
    hidden = visible & moved & complete & (reached | (has_family & returns[source] & ~paint))
    # A sheet's Gaussian may sit at the index of one that returns, and has to stay elsewhere.
    occupants = np.flatnonzero(returns & visible[:first] & moved[:first] & ~hidden[:first])

    back = np.flatnonzero(returns)
    arrays = {name: getattr(below, name).copy() for name in ATTRIBUTES}
    # Starts the colour rounds near: the family's colours in the original.
    old_look = reached & ~hidden & has_family
    arrays["sh"][old_look] = original.sh[source[old_look]]
    tail = without_source(replace(below, sh=arrays["sh"]).take(occupants))
    for name in ATTRIBUTES:
        arrays[name][back] = getattr(original, name)[back]
    returning = np.zeros(n, bool)
    returning[back] = True
    arrays["opacities"][hidden & ~returning] = 0
    joined = without_source(replace(below, **arrays)).append(tail)
    # Only what was reached, moved and stays is fitted: other colours are the original's, or not to change.
    look = np.append(reached & moved & ~hidden & ~returning, reached[occupants])
    joined = replace(joined, sh=fitted_sh(joined, look, seen.targets))
    return _difference(below, joined, occupants)


def fade_delta(below: Splats, original: Splats, views: Views, reached: np.ndarray) -> Delta:
    """The delta that gives Gaussians (reached: [N] bool) of an edited asset the colours with which they look as the
    original did; geometry and opacities stay."""
    n, first, family = len(below), len(original), _families(below)
    moved = np.ones(n, bool)
    moved[:first] = moved_gaussians(original, below.take(np.arange(first)))
    changed = moved.copy()
    changed[:first] |= (below.sh[:first] != original.sh).any((1, 2))
    reached, _ = _with_hidden(below, views, reached, changed)
    # Below full opacity nothing returns or goes: the picture is then the mean of both.
    recolored = reached & (family >= 0)
    sh = below.sh.copy()
    sh[recolored] = original.sh[family[recolored]]
    start = without_source(replace(below, sh=sh))
    after = replace(start, sh=fitted_sh(start, reached & moved, _Seen.of(below, original, views).targets))
    return _difference(below, after, np.zeros(0, np.int64))


@dataclass(frozen=True)
class _Seen:
    """What the eraser's views show; lists are by view."""

    targets: list[tuple[Camera, np.ndarray]]
    """The picture to reach: the original's inside the mask, the asset's beside it."""
    paint: list[np.ndarray]
    """[H, W] bool pixels beside the mask that show paint."""
    weight: np.ndarray
    """[N] float32 pixels that show each Gaussian of the asset, in all views."""

    @staticmethod
    def of(below: Splats, original: Splats, views: Views) -> _Seen:
        from splatpainter.rendering.cpu.projected_view import project

        targets, paint, weight = [], [], np.zeros(len(below), np.float32)
        for camera, mask in views:
            view = project(below, camera)
            now, before = view.rasterize()[0], picture_of(original, camera)
            targets.append((camera, np.where(mask[..., None], before, now)))
            paint.append(~mask & (np.abs(now - before).max(-1) > ERASER.paint_contrast))
            weight[view.gaussian_ids] += view.backproject(now, np.ones(mask.shape, np.float32)).weight
        return _Seen(targets, paint, weight)


def _with_hidden(below: Splats, views: Views, reached: np.ndarray, changed: np.ndarray) -> tuple[np.ndarray, Splats]:
    """([N] bool reached, with what lies hidden, or nearly so, right behind: of a sheet and its rim there is some; those
    in front). changed: [N] bool, Gaussians that are not as in the original."""
    visible = below.opacities > 0
    front = below.take(reached & visible & changed)
    # Only what an edit changed can lie hidden behind paint; the original's inside stays.
    behind = visible & changed & ~reached
    behind[behind] = _largest_share(below.take(behind), views, [mask for _, mask in views]) > ERASER.hidden_in_mask
    reached = reached.copy()
    reached[behind] = _is_near(below.take(behind), front)
    return reached, front


def _families(below: Splats) -> np.ndarray:
    return np.arange(len(below)) if below.origin is None else below.origin


def _largest_share(splats: Splats, views: Views, pictures: Sequence[np.ndarray]) -> np.ndarray:
    """[N] float32 the largest mean of a picture ([H, W] 0..1, one per view) over each footprint; 0 where no view has
    it."""
    out = np.zeros(len(splats), np.float32)
    for (camera, _), picture in zip(views, pictures, strict=True):
        out = np.maximum(out, footprint_mean(splats, camera, picture))
    return out


def _nearest(points: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """[P] int64 index of the candidate nearest to each point. points: [P, 3]; candidates: [C, 3], C > 0."""
    out = np.zeros(len(points), np.int64)
    size = max(ERASER.nearest_block // len(candidates), 1)
    for start in range(0, len(points), size):
        block, squared = points[start : start + size], 0.0
        for axis in range(3):
            squared = squared + (block[:, axis, None] - candidates[None, :, axis]) ** 2
        out[start : start + size] = np.argmin(squared, 1)
    return out


def _is_near(splats: Splats, visible: Splats) -> np.ndarray:
    """[len(splats)] bool: those within `near_sizes` of their own and the nearest other one's largest scales."""
    if not len(splats) or not len(visible):
        return np.zeros(len(splats), bool)
    nearest = _nearest(splats.means, visible.means)
    distance = np.sqrt(((splats.means - visible.means[nearest]) ** 2).sum(1))
    return distance < ERASER.near_sizes * (splats.scales.max(1) + visible.scales.max(1)[nearest])


def _difference(below: Splats, after: Splats, parent_ids: np.ndarray) -> Delta:
    """parent_ids: [A] of what was appended."""
    n, changed = len(below), changed_rows(below, after)
    return Delta(
        n,
        changed,
        without_source(after.take(changed)),
        without_source(after.take(np.arange(n, len(after)))),
        parent_ids,
    )
