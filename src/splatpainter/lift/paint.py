"""One edited view, written onto an asset: a sheet where the surface is trusted, split Gaussians where it is not.

painted = paint_view(splats, surface, camera, edited, mask, options, allowed)
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.limits import paintable
from splatpainter.lift.local_edit import WIDE_EDIT_FRACTION, lift_local
from splatpainter.lift.masks import dilated
from splatpainter.lift.options import LOCAL_DEFAULTS, LocalOptions
from splatpainter.lift.resurface import MIN_COVER, RING_PX, resurface
from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import visible_surface

MIN_PAINT = 1 / 64
"""Share of a pixel's paint below which the limits leave it out."""


@dataclass(frozen=True)
class PaintedView:
    """Result of `paint_view`."""

    splats: Splats
    """N Gaussians at their old indices, then the appended ones."""
    touched: np.ndarray = field(repr=False)
    """[T] int64 ascending: old Gaussians of which any attribute changed."""
    parents: np.ndarray = field(repr=False)
    """[A] int64: the old Gaussian that each appended one was split from, or lies on or in place of."""
    replaced: np.ndarray = field(repr=False)
    """[R] int64 ascending, part of `touched`: indices that a sheet Gaussian took."""
    removed: np.ndarray = field(repr=False)
    """[E] int64 ascending, part of `touched`: indices that are empty now (opacity 0)."""
    limited: float
    """Edited pixels' worth of paint that the limits left out."""


def paint_view(
    splats: Splats,
    surface: Surface | None,
    camera: Camera,
    edited: np.ndarray,
    mask: np.ndarray,
    options: LocalOptions = LOCAL_DEFAULTS,
    allowed: np.ndarray | None = None,
    first_appended: int | None = None,
) -> PaintedView:
    """Write the masked pixels of `edited` onto the splats.

    surface: of the original; None, and edits of most of a picture: Gaussians are split, nothing is resurfaced. edited:
    [H, W, 3] float32 0..1; mask: [H, W] bool; allowed: [N] bool Gaussians that may be split and recoloured where there
    is no sheet (default: all); first_appended: number of Gaussians of the original (default: N).
    Raises ValueError when no Gaussian contributes to the masked pixels."""
    none = np.zeros(0, np.int64)
    if surface is None or mask.mean() > WIDE_EDIT_FRACTION:
        lifted = lift_local(splats, camera, edited, mask, options, allowed)
        return PaintedView(lifted.splats, lifted.touched, lifted.parents, none, none, 0.0)
    reach = dilated(mask, RING_PX)
    view = project(splats, camera, tiles=tiles_of_mask(reach))
    before, alpha, _ = view.rasterize()
    solid = alpha > MIN_COVER
    visible = visible_surface(surface, splats, view, reach & solid)
    share = paintable(visible, mask & solid, options.angle_limit, options.depth_edge_limit)
    limited = float((mask & solid).sum() - share.sum())
    share[mask & ~solid] = 1
    target = (before + share[..., None] * (edited - before)).astype(np.float32)
    painted = share > MIN_PAINT
    if not painted.any():
        raise ValueError(
            "edit: every edited pixel lies beyond the limits of this view; paint it from the front, or pass "
            "angle_limit 0 and depth_edge_limit 0"
        )
    first = len(splats) if first_appended is None else first_appended
    pixels = dilated(painted, RING_PX) & solid
    target = np.where(painted[..., None], target, before)
    sheet = resurface(splats, view, visible, before, target, pixels, options, first)
    if sheet is None:
        lifted = lift_local(splats, camera, target, painted, options, allowed)
        return PaintedView(lifted.splats, lifted.touched, lifted.parents, none, none, limited)
    result = PaintedView(sheet.splats, sheet.touched, sheet.parents, sheet.replaced, sheet.removed, limited)
    left = painted & ~sheet.covered
    if left.sum() <= options.max_left_px:
        return result
    return _then_split(result, camera, target, left, options, allowed, len(splats))


def _then_split(
    first: PaintedView,
    camera: Camera,
    target: np.ndarray,
    mask: np.ndarray,
    options: LocalOptions,
    allowed: np.ndarray | None,
    count: int,
) -> PaintedView:
    """The pixels that have no sheet, by splitting; those that no Gaussian makes stay as they are."""
    splats = first.splats
    may = np.ones(len(splats), bool)
    if allowed is not None:
        may[:count] = allowed
    try:
        lifted = lift_local(splats, camera, target, mask, options, may)
    except ValueError:
        return first
    touched = lifted.touched[lifted.touched < count]
    # A Gaussian that the sheet appended has its own parent among the asset's.
    ancestry = np.append(np.arange(count), first.parents)
    parents = np.concatenate([first.parents, ancestry[lifted.parents]])
    removed = first.removed[lifted.splats.opacities[first.removed] == 0]
    return replace(
        first, splats=lifted.splats, touched=np.union1d(first.touched, touched), parents=parents, removed=removed
    )
