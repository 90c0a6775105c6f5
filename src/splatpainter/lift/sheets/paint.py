"""One edited view, written onto an asset: a sheet where the surface is trusted, split Gaussians where it is not.

painted = paint_view(splats, surface, camera, edited, mask, options, allowed)
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels.arrays import aligned
from splatpainter.kernels.rows import take, taken
from splatpainter.lift.colors import MIN_CHANGE, colors_towards
from splatpainter.lift.local import correction
from splatpainter.lift.local.correction import LiftedGaussians, PaintedPictures
from splatpainter.lift.local.local_edit import (
    NOTHING_THERE,
    NothingPaintableError,
    gaussians_in_mask,
    is_wide,
    lift_local,
    local_edit,
)
from splatpainter.lift.masks import dilated
from splatpainter.lift.options import LOCAL_DEFAULTS, LocalOptions
from splatpainter.lift.sheets.resurface import RESURFACING, RING_PX, lay_sheet, resurface
from splatpainter.lift.sheets.rounding import rounded
from splatpainter.lift.sheets.sparse_edit import EditedGaussians, SparseEdit
from splatpainter.lift.sheets.view_limits import paintable
from splatpainter.rendering.cpu.projected_view import MaskSums, ProjectedView, copy_tiles, project, tiles_of_mask
from splatpainter.rendering.cpu.recent_views import DrawnView, recent_drawing, recent_view
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.splats import ATTRIBUTES, SH_C0, Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.recent_sights import keep_sight, recent_sight
from splatpainter.surface.visible import SightEstimates, visible_surface
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max


@dataclass(frozen=True)
class PaintThresholds:
    """What of a view is painted, and whether by a sheet or by splitting. Source: taste."""

    min_alpha: float = 0.1
    """Least alpha of a pixel that is painted at all: up to this it shows the faint rims of what lies beside it."""
    min_paint: float = 1 / 64
    """Share of a pixel's paint below which the limits leave it out."""
    min_fine_share: float = 0.15
    """Share of the original's Gaussians that make the painted pixels from which these are most of what a view shows:
    about a third of the side that it sees."""
    max_appended_share: float = 0.2
    """Gaussians that earlier edits appended there, over these, up to which they are split: painted again and again,
    pieces of pieces would pile up; a sheet takes their place."""


PAINTING = PaintThresholds()


@dataclass(frozen=True)
class PaintedView:
    """Result of `paint_view`."""

    splats: Splats
    """N Gaussians at their old indices, then the appended ones."""
    touched: Ids = field(repr=False)
    """[T] int64 ascending: old Gaussians of which any attribute changed."""
    parents: Ids = field(repr=False)
    """[A] int64: the old Gaussian that each appended one was split from, or lies on or in place of."""
    replaced: Ids = field(repr=False)
    """[R] int64 ascending, part of `touched`: indices that a sheet Gaussian took."""
    removed: Ids = field(repr=False)
    """[E] int64 ascending, part of `touched`: indices that are empty now (opacity 0)."""
    limited: float
    """Edited pixels' worth of paint that the limits left out."""
    on_surface: Bools = field(repr=False)
    """[H, W] bool: pixels whose paint lies on a trusted surface: on a sheet, or on fine Gaussians (`is_fine`)."""


def paint_view(
    splats: Splats,
    surface: Surface | None,
    camera: Camera,
    edited: Floats,
    mask: Bools,
    options: LocalOptions = LOCAL_DEFAULTS,
    allowed: Bools | None = None,
    first_appended: int | None = None,
    *,
    view: ProjectedView | None = None,
    sight: SightEstimates | None = None,
) -> PaintedView:
    """Write the masked pixels of `edited` onto the splats.

    surface: of the original; None, and edits of most of a picture: Gaussians are split, nothing is resurfaced. edited:
    [H, W, 3] float32 0..1; mask: [H, W] bool; allowed: [N] bool Gaussians that may be split and recoloured where there
    is no surface (default: all; where there is one, those that visibly make the masked pixels may); first_appended:
    number of Gaussians of the original (default: N); view: the splats in any tiles, if at hand; sight: what is known
    already of the surface along lines of sight of this camera.
    Raises NothingPaintableError when no Gaussian contributes to the masked pixels."""
    none = np.zeros(0, np.int64)
    # Edits of most of a picture get no sheet: they are detail on what is there.
    if surface is None or is_wide(mask):
        lifted = lift_local(splats, camera, edited, mask, options, allowed)
        return PaintedView(lifted.splats, lifted.touched, lifted.parents, none, none, 0.0, np.zeros_like(mask))
    # All that the edit reads lies in these tiles; the rest of the asset is not looked at.
    reach = dilated(mask, RING_PX)
    needed = tiles_of_mask(reach)
    if view is None or (needed & ~view.tiles).any():
        view = project(splats, camera, tiles=needed)
    around = local = view.part(tiles=needed)
    drawn = recent_drawing(splats, camera)
    # Both masks in one walk: who makes pixels of the ring, and who makes painted ones.
    around_it, in_mask = local.mask_sums(reach, mask)
    tiles = _tiles_at_work(local, around_it)
    if (tiles & ~view.tiles).any():
        view = recent_view(splats, camera)
    if (tiles & ~needed).any():
        around = project(splats, camera, tiles=tiles) if view is None else view.part(tiles=tiles)
        around = around.part() if around.tiles.all() else around  # without those that only might touch a tile
    # Renumber the Gaussians in work, so that the steps below cost what they touch, not what the asset has.
    present, number = np.zeros(len(splats), bool), aligned((len(splats),), np.dtype(np.int64))
    present[around.gaussian_ids] = True
    ids = np.flatnonzero(present)
    number[ids] = np.arange(len(ids))
    view = replace(local, gaussian_ids=taken(number, local.gaussian_ids), num_gaussians=len(ids))
    around = replace(around, gaussian_ids=taken(number, around.gaussian_ids), num_gaussians=len(ids))
    originals = len(splats) if first_appended is None else first_appended
    # Where the original's Gaussians end among those in work.
    first = int(np.searchsorted(ids, originals))
    chosen, counts = take(splats, ids), (first, originals)
    del number, present, around_it  # what is read no more goes: here an edit needs the most memory
    part = _paint_part(chosen, surface, view, around, drawn, edited, mask, in_mask, options, counts, sight)
    # The largest arrays come now: what is read no more goes.
    del chosen, view, around, local, drawn, in_mask
    return _put_back(splats, ids, part, options.resurface)


def sight_under(
    splats: Splats,
    surface: Surface,
    view: ProjectedView,
    alpha: Floats,
    mask: Bools,
    earlier: SightEstimates | None = None,
) -> SightEstimates | None:
    """What `paint_view` will ask of the surface under a mask ([H, W] bool), ahead of it; None where it asks nothing.
    view: of `splats`, all tiles; alpha: [H, W] its picture's; earlier: what is known already, from this camera."""
    if is_wide(mask) or not mask.any():
        return None
    pixels = dilated(mask, RING_PX) & (alpha > RESURFACING.min_cover)
    return visible_surface(surface, splats, view, pixels, earlier=earlier).estimates


@dataclass(frozen=True)
class _PaintedPart:
    """What `paint_view` makes of the S Gaussians that it depends on."""

    edit: SparseEdit
    replaced: Ids
    """[R] int64 ascending, as of PaintedView."""
    removed: Ids
    """[E] int64 ascending, as of PaintedView."""
    limited: float
    on_surface: Bools
    """[H, W] bool, as of PaintedView."""


def _paint_part(
    splats: Splats,
    surface: Surface,
    view: ProjectedView,
    around: ProjectedView,
    drawn: DrawnView | None,
    edited: np.ndarray,
    mask: np.ndarray,
    in_mask: MaskSums,
    options: LocalOptions,
    counts: tuple[int, int],
    sight: SightEstimates | None,
) -> _PaintedPart:
    """`paint_view` on the Gaussians that it depends on. view: of them, the tiles of the mask and its ring; around: the
    tiles of `read_by_edit`; drawn: the whole view's pictures, if at hand; in_mask: how much of the view's Gaussians the
    mask shows; counts: how many of the Gaussians are the original's, and how many that has in all; sight: as of
    `paint_view`."""
    camera, reach, (first_appended, originals) = view.camera, dilated(mask, RING_PX), counts
    # The surface under the mask and its ring, as far as the asset covers the pixels.
    before, alpha, depth = view.rasterize() if drawn is None else (drawn.colors, drawn.alphas, drawn.depths)
    drawn_tiles = view.tiles if drawn is None else drawn.view.tiles
    solid = alpha > RESURFACING.min_cover
    # Of a stroke in the studio most of it was estimated while it was drawn; of paint over paint, for the edit before.
    earlier = recent_sight(surface, camera) if sight is None else sight
    visible = visible_surface(surface, splats, view, reach & solid, earlier=earlier)
    if sight is None:
        keep_sight(surface, camera, visible.estimates)
    # Limits fade paint by degrees; what they leave out is told to the user.
    share = paintable(visible, mask & solid, options.angle_limit, options.depth_edge_limit)
    limited = float((mask & solid).sum() - share.sum())
    # Outlines have no surface to limit by, but paint reaches them.
    share[mask & ~solid & (alpha > PAINTING.min_alpha)] = 1
    painted = share > PAINTING.min_paint
    if not painted.any():
        if not limited:
            raise NothingPaintableError(NOTHING_THERE)
        raise NothingPaintableError(
            "edit: every edited pixel lies beyond the limits of this view; paint it from the front, or pass "
            "angle_limit 0 and depth_edge_limit 0"
        )
    # The ring is covered too, with what it shows: the paint's edge then lies within the sheet.
    pixels, at = dilated(painted, RING_PX) & solid, np.flatnonzero(painted)
    current, edit = (picture.reshape(-1, 3).take(at, 0) for picture in (before, edited))
    paint = current + share.ravel()[at, None] * (edit - current)
    target, changed = _target(view, before, at, paint), np.zeros_like(mask)
    changed.ravel()[at] = (target.reshape(-1, 3).take(at, 0) != current).any(1)
    del share, current, edit  # what is read no more goes at once: whole pictures
    may, none = gaussians_in_mask(splats, camera, mask, None, view, in_mask), np.zeros(0, np.int64)
    sheet, on_surface = None, np.zeros_like(mask)
    # Gaussians nearly as fine as the pixels are split: a sheet would only bring its own errors.
    if is_fine(painted, may, first_appended, originals, options):
        seen = np.flatnonzero(painted & solid)
        on_surface.ravel()[seen] = visible.at_centers(seen).depth > 0
    else:
        laid = lay_sheet(splats, view, around, visible, alpha, target, changed, pixels, options)
        del visible
        if laid is not None:
            sheet = resurface(
                splats, laid, around, (before, alpha, depth), drawn_tiles, target, options, first_appended
            )
    # No trusted surface anywhere: split, as captures' fog needs.
    if sheet is None:
        edit = local_edit(splats, camera, target, painted, options, may)
        if options.correct:
            edit = _corrected(splats, edit, around, (before, alpha, depth), drawn_tiles, (at, paint))
        return _PaintedPart(edit, none, none, limited, on_surface)
    result = _PaintedPart(sheet.edit, sheet.replaced, sheet.edit.emptied, limited, sheet.covered)
    # The sheet covers what it can; the rest is split after it, on top of the result.
    left = painted & ~sheet.covered
    if left.sum() > options.max_left_px:
        target = _target(view, before, at, paint)
        result = _then_split(splats, result, around, target, left, options, may)
    return result


def _corrected(
    splats: Splats,
    edit: SparseEdit,
    around: ProjectedView,
    before: tuple[np.ndarray, ...],
    drawn: Bools,
    painted: tuple[Ids, np.ndarray],
) -> SparseEdit:
    """An edit of the S `splats` that has no sheet, in colours that suit views from beside, too (correction.py). around:
    of the splats; before: image, alpha and depth that it shows, in the tiles `drawn` ([TH, TW] bool); painted: `at` and
    `paint` of `_target`."""
    count, changed = len(splats), edit.values.append(edit.appended)
    ids = np.concatenate([edit.ids, np.arange(count, count + len(edit.parents))])
    # Only what the edit changed is projected; the rest is cut out of the view at hand.
    fresh = project(changed, around.camera, tiles=around.tiles)
    fresh = replace(fresh, gaussian_ids=ids[fresh.gaussian_ids], num_gaussians=count + len(edit.parents))
    tiles = fresh.tiles_of(np.ones(fresh.num_gaussians, bool))
    view = around.merged(fresh.part(tiles=tiles), tiles=tiles, without=edit.ids)
    number = np.full(view.num_gaussians, -1, np.int64)
    number[ids] = np.arange(len(ids))
    entries = np.flatnonzero(number[view.gaussian_ids] >= 0)
    if not len(entries):
        return edit
    # The picture to reach: the paint, and beside it what was there.
    target, alpha, depth = around.empty_picture(), np.zeros_like(before[1]), np.zeros_like(before[2])
    for picture, source in zip((target, alpha, depth), before, strict=True):
        copy_tiles(picture, source, tiles & drawn)
    around.redraw(tiles & ~drawn, target, alpha, depth)
    at, paint = painted
    target.reshape(-1, 3)[at] = paint
    mask = np.zeros(alpha.shape, bool)
    mask.ravel()[at] = True
    pictures = PaintedPictures(target, mask, alpha, depth)
    movable = np.zeros(len(view), bool)
    movable[entries] = True
    which, parents = number[view.gaussian_ids[entries]], np.concatenate([edit.ids, edit.parents])
    lift = view.colors[entries]
    colors = LiftedGaussians(
        view,
        entries,
        correction.facing(changed, which, view.camera),
        view.mask_sums(mask, np.ones(mask.shape, bool))[1].take(entries),
        lift,
        colors_towards(around, splats, parents[which]),
        ids[which] >= count,
        pictures,
    ).corrected(correction.weights(), sirt_steps(view, target, pictures.weights, movable, lift))
    moved, sh = row_max(np.abs(colors - lift)) > MIN_CHANGE, changed.sh.copy()
    sh[which[moved], 0] += (colors - view.unclamped_of(entries))[moved] / SH_C0
    old = len(edit.ids)
    return replace(edit, values=replace(edit.values, sh=sh[:old]), appended=replace(edit.appended, sh=sh[old:]))


def _target(view: ProjectedView, before: np.ndarray, at: Ids, paint: np.ndarray) -> Floats:
    """[H, W, 3] the picture that a view's tiles are to show, whatever else is drawn of it; beside them its background.
    before: [H, W, 3] what they show; at: [Q] flat indices of the painted pixels; paint: [Q, 3]."""
    target = view.empty_picture()
    copy_tiles(target, before, view.tiles)
    target.reshape(-1, 3)[at] = paint
    return target


def _put_back(splats: Splats, ids: np.ndarray, part: _PaintedPart, rounds: bool) -> PaintedView:
    """What became of the Gaussians `ids` ([S] int64 ascending), at their indices among all. rounds: whether new ones
    (those after the first S and those in the place of others) are rounded (rounding.py)."""
    edit, replaced = part.edit, part.replaced
    if rounds:
        # New Gaussians are rounded so that project files compress; old ones keep every bit.
        at = np.flatnonzero(np.isin(edit.ids, replaced, assume_unique=True))
        values = rounded(edit.values.take(at))
        for name in ATTRIBUTES:
            getattr(edit.values, name)[at] = getattr(values, name)
        edit = replace(edit, appended=rounded(edit.appended))
    edit = edit.within(ids)
    touched = edit.touched(splats)
    removed = ids[part.removed]
    return PaintedView(edit.apply(splats), touched, edit.parents, ids[replaced], removed, part.limited, part.on_surface)


def is_fine(painted: Bools, reached: Bools, first: int, originals: int, options: LocalOptions) -> bool:
    """Whether an edit of much of the asset is better split: its Gaussians are nearly as fine as the pixels already, and
    sheets, which no other view has checked, only bring their own errors. painted: [H, W] bool; reached: [N] bool, the
    Gaussians that make these pixels, of which the first `first` are some of the original's `originals`.

    Paint over a third to all of a side, against the asset whose own colours were changed, 20, 40 and 60 degrees beside
    it, for a fifth of the Gaussians: splitting gains 1 to 5 dB on meshes (2 to 14 pixels per Gaussian) and captures (2
    to 3), -0.8 to 2.2 and nothing in the mean on objects fitted by 3DGS (4 to 12; edited views 1.6, LPIPS -0.003);
    from 14 on strokes may lose up to 3 dB."""
    count, old = int(reached.sum()), int(reached[:first].sum())
    if (
        not options.fine_px
        or old < PAINTING.min_fine_share * originals
        or len(reached) - first > PAINTING.max_appended_share * old
    ):
        return False
    return int(painted.sum()) <= options.fine_px * count


def read_by_edit(splats: Splats, camera: Camera, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([TH, TW] bool the tiles that `paint_view` works on: those of the mask and of RING_PX around it, and of all
    Gaussians that make these pixels; [N] bool those that visibly make masked ones, the only ones that may be split).

    Of the splats a painted view depends on nothing but the Gaussians of these tiles, in their order, and on how many of
    them lie before `first_appended`; without a surface also on which of those that may be split are `allowed`. Raises
    ValueError where no Gaussian contributes to the masked pixels."""
    reach = dilated(mask, RING_PX)
    view = project(splats, camera, tiles=tiles_of_mask(reach))
    around_it, in_mask = view.mask_sums(reach, mask)
    return _tiles_at_work(view, around_it), gaussians_in_mask(splats, camera, mask, None, view, in_mask)


def _tiles_at_work(view: ProjectedView, sums: MaskSums) -> Bools:
    """[TH, TW] bool tiles of `view`, and of all its Gaussians that make pixels of a mask (sums: of it)."""
    return view.tiles | view.touched_tiles(sums.alpha > 0)


def _then_split(
    splats: Splats,
    first: _PaintedPart,
    around: ProjectedView,
    target: np.ndarray,
    mask: np.ndarray,
    options: LocalOptions,
    allowed: Bools,
) -> _PaintedPart:
    """The pixels that have no sheet, by splitting; those that no Gaussian makes stay as they are. allowed: [N] bool
    Gaussians that may be split, beside the new ones; around: of the splats, nothing beyond its tiles is looked at."""
    # A few pixels at the outline as a rule: they cost what lies in their tiles, not what the sheet lies in.
    edited = EditedGaussians(splats, first.edit, around)
    may = np.append(allowed, np.ones(len(first.edit.parents), bool))
    try:
        later = local_edit(edited, around.camera, target, mask, options, may, around.tiles)
    except NothingPaintableError:
        return first
    # Splitting may have written an index that the sheet had emptied, or one of the sheet's own.
    edit = first.edit.then(later, splats)
    refilled_ids = later.ids[later.values.opacities != 0]
    removed = first.removed[~np.isin(first.removed, refilled_ids, assume_unique=True)]
    return replace(first, edit=edit, removed=removed)
