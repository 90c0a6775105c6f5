"""Resurfacing: where the surface under an edit is trusted, a sheet of thin Gaussians takes the place of the old ones.

The sheet lies on the surface of the original, as finely as the picture needs, under the edited pixels and a narrow ring
of unedited ones, so that the paint's edge lies within it. Old Gaussians that lie on the surface under the sheet go;
those that only reach under it are halved until each half is clearly under it or beside it. What lies in front of the
surface at a distance, behind it, or beside it stays.
"""

from __future__ import annotations

import math
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels import portable
from splatpainter.kernels.arrays import readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.kernels.rows import take
from splatpainter.lift.colors import MIN_CHANGE, colors_towards, lift_editable, recolor
from splatpainter.lift.local import correction
from splatpainter.lift.local.correction import LiftedGaussians, PaintedPictures
from splatpainter.lift.local.split import Lattice, projected_sizes
from splatpainter.lift.masks import box_mean, dilated, paste, window_around
from splatpainter.lift.nearest import nearest_pixels
from splatpainter.lift.options import LocalOptions
from splatpainter.lift.sheets.fringe import FringedSurface, fringe_of, fringe_paint
from splatpainter.lift.sheets.near_surface import FAR_BEHIND, TOUCHES, NearSurface
from splatpainter.lift.sheets.pieces import Pieces, joined_view
from splatpainter.lift.sheets.sheet import SHEET, Cells, SheetGeometry, flat_cells, sheet_geometry
from splatpainter.lift.sheets.sparse_edit import SparseEdit
from splatpainter.rendering.cpu.projected_view import (
    MaskSums,
    ProjectedView,
    copy_tiles,
    pixels_of_tiles,
    project,
    tiles_of_mask,
)
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.splats import ATTRIBUTES, Splats, float_bits
from splatpainter.surface.visible import VisibleSurface, depths_along
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max


@dataclass(frozen=True)
class ResurfacingThresholds:
    """Where a sheet takes the place of old Gaussians. Source: taste, tried on painted training meshes and captures,
    where an entry names no measurement."""

    min_cover: float = 0.6
    """Alpha of a pixel below which no sheet lies there."""
    min_replaced_share: float = 0.85
    """Share of a Gaussian's footprint under the sheet from which all of it goes."""
    max_untouched_share: float = 0.08
    """Share of its footprint under the sheet up to which all of it stays."""
    rim_goal_px: float = 2.2
    """Gaussians across the sheet's edge are halved until they are no wider than this (standard deviation)."""
    max_rim_halvings: int = 8
    """Halvings of one Gaussian across the edge, at most: a bound on what one long Gaussian may cost."""
    max_cut_px: float = 8.0
    """Gaussians longer than this (standard deviation) are not cut at the sheet's edge."""
    min_handled: float = 0.85
    """Where less than this share of a pixel's light comes from Gaussians that a sheet replaces, there is none."""
    min_touching: float = 0.5
    """What lies far behind the surface, seen through cracks, does not count against a sheet as long as this share of
    the light comes from the surface."""
    clear_radius_px: int = 2
    """Whether a pixel gets a sheet is decided by the majority of the pixels in this radius."""
    min_clear: float = 0.5
    """If that leaves less than this share of the pixels, the edit gets no sheet at all."""
    unedited_weight: float = 0.35
    """Weight of an unedited pixel in colour rounds, beside an edited one."""
    color_step_fraction: float = 0.75
    """Share of a colour round's step that sheets take."""
    min_peak: float = 0.02
    """Old Gaussians that remain before the sheet take part in the colour rounds if they give some pixel of it more than
    this share of its light."""
    min_sheet_share: float = 0.6
    """They must have this share of their weight before the sheet."""
    min_visible: float = 0.5
    """They must have this share of their alpha visible; behind the sheet they have not."""
    max_host_sigmas: float = 2.5
    """A sheet Gaussian farther than this from the Gaussian whose pixel it takes, in standard deviations of that, lies
    past the horizon of a round surface, on a plane that touches it before: it would hang beside the object from other
    sides."""
    min_host_flatness: float = 0.3
    """Thickness of a Gaussian over its length, at least, in that distance."""
    host_reach_px: int = 2
    """Pixels around whose Gaussians count as well."""
    horizon_degrees: float = 65.0
    """Degrees between line of sight and normal, from which a surface is near its horizon."""


RESURFACING = ResurfacingThresholds()


RING_PX = 2
"""Unedited pixels around the edited ones that the sheet covers too."""


@dataclass(frozen=True)
class Resurfaced:
    """Result of `resurface`: the edit's trusted part, done."""

    edit: SparseEdit
    replaced: Ids = field(repr=False)
    """[R] int64 ascending: indices that a sheet Gaussian took."""
    covered: Bools = field(repr=False)
    """[H, W] bool pixels that the sheet covers, ring included."""


@dataclass(frozen=True)
class LaidSheet:
    """A sheet of C Gaussians, and P pieces of those across its edge, before their colour rounds."""

    pieces: Pieces
    fresh: Splats
    """P + C Gaussians: the pieces, then the sheet; their SH are written to."""
    parent_ids: Ids = field(repr=False)
    """[C] int64: the Gaussian in place of which each one lies."""
    emptied_ids: Ids = field(repr=False)
    """[E] int64 indices whose Gaussian went: the sheet may take them, else they are empty."""
    tiles: Bools = field(repr=False)
    """[TH, TW] bool: all that Gaussians under the sheet touch."""
    painted: Bools = field(repr=False)
    """[H, W] bool pixels that are to change."""
    covered: Bools = field(repr=False)
    """[H, W] bool, as of Resurfaced."""


def lay_sheet(
    splats: Splats,
    view: ProjectedView,
    around: ProjectedView,
    visible: VisibleSurface,
    alpha: np.ndarray,
    target: Floats,
    painted: Bools,
    pixels: Bools,
    options: LocalOptions,
) -> LaidSheet | None:
    """Lay a sheet under some pixels as far as the surface is trusted; None where it is nowhere.

    view: of `splats`, at least the tiles of `pixels`; around: those of all Gaussians that make these pixels;
    visible: the surface at these; alpha: [H, W] of the view; target: [H, W, 3] float32 the picture to reach in its
    tiles; painted: [H, W] bool where that is another than the view's; pixels: [H, W] bool, these and their ring."""
    # Which pixels get a sheet: those with a trusted surface ...
    camera = view.camera
    at, depth = np.flatnonzero(pixels), np.zeros(pixels.shape)
    depth.ravel()[at] = visible.at_centers(at).depth
    covered = without_islands(depth > 0)
    if not covered.any():
        return None
    # ... whose light comes from Gaussians that the sheet can replace.
    near = NearSurface.of(visible, covered)
    window = window_around(covered, RESURFACING.clear_radius_px)  # of the whole picture: most sheets are small
    here = pixels_of_tiles(view.tiles, covered.shape)
    sums, summed = around.pair_mask_sums(covered, here), covered
    clear = clear_pixels(splats, around, here, around.reduced_masks(sums), near, covered, window)
    clear &= covered
    if clear.sum() < RESURFACING.min_clear * covered.sum():
        return None
    remaining = without_islands(clear)
    if not remaining.any():
        return None
    covered, near = remaining, near if np.array_equal(remaining, covered) else None
    # The fringe: painted pixels beside the sheet that show too little of a surface go on with that of their neighbours.
    fringe, surface = fringe_of(painted, covered, depth > 0, alpha), visible
    colors, cover = target, np.broadcast_to(np.float32(1), alpha.shape)
    if fringe.any():
        surface = FringedSurface.of(visible, covered, fringe, None if near is None else near.nearest)
        colors, cover = fringe_paint(target, surface, np.asarray(camera.background, np.float32))
        covered, near = covered | fringe, None
        at = np.flatnonzero(fringe)
        depth.ravel()[at] = surface.at_centers(at).depth
    near = NearSurface.of(surface, covered) if near is None else near
    # Which Gaussians lie under it, and by which share of their footprint, which may reach out of the view's tiles. What
    # was summed for clear pixels is so still but in these, and where the sheet is another by now.
    fresh = tiles_of_mask(covered != summed) | (around.tiles & ~view.tiles)
    around.sum_again(sums, covered, np.ones(covered.shape, bool), fresh)
    under, everywhere = around.reduced_masks(sums)
    del sums
    tiles = around.touched_tiles(under.alpha > 0) | tiles_of_mask(pixels)
    share, seen = np.zeros(len(splats), under.alpha.dtype), np.zeros(len(splats), bool)
    share[around.gaussian_ids] = under.alpha / np.maximum(everywhere.alpha, 1e-9)
    seen[around.gaussian_ids[under.peak > options.min_share]] = True
    # Those across the edge are halved; each piece is then clearly under the sheet or beside it.
    lattice, gone = _cut(splats, share, camera, tiles, seen, near, covered, options)
    pieces = Pieces.of(lattice, gone)
    del near, under, everywhere, share, seen
    # The sheet's own Gaussians, as large as flat paint allows.
    cells = flat_cells(target, covered, depth, camera.fx)
    del depth
    geometry, index = sheet_geometry(surface, cells, target)
    cells = Cells(cells.centers[index], cells.sizes[index])
    # What the sheet hides lends it SH bands, origin and index; where nothing goes, what is nearest.
    replaced = np.flatnonzero(gone)
    if len(replaced):
        hidden, parent_ids = lattice.take(replaced).splats(), lattice.parent[replaced]
    else:
        hidden, parent_ids = pieces.remaining_gaussians(splats)
    sheet, hidden_ids = _sheet(hidden, geometry, cells, colors, cover, tiles, camera)
    emptied_ids, parent_ids = lattice.parent[gone & lattice.slot], parent_ids[hidden_ids]
    return LaidSheet(pieces, pieces.splats.append(sheet), parent_ids, emptied_ids, tiles, painted, covered)


def resurface(
    splats: Splats,
    laid: LaidSheet,
    around: ProjectedView,
    before: tuple[np.ndarray, ...],
    drawn: Bools,
    target: Floats,
    options: LocalOptions,
    first_appended: int,
) -> Resurfaced:
    """Colour rounds of a sheet, and everything at its index. Apart from laying it, as here an edit needs the most
    memory, and nothing is read any more of what says where the surface is.

    around, target: as of `lay_sheet`; the target is written to; before: image, alpha and depth that the view shows, in
    the tiles `drawn` ([TH, TW] bool); first_appended: Gaussians from this index on are no part of the original, and
    their indices may take any sheet Gaussian."""
    # The pixels beside the sheet ask for what they showed before.
    image, alpha, depth = before
    paste(target, image, laid.painted & ~laid.covered)
    copy_tiles(target, image, laid.tiles & drawn & ~tiles_of_mask(laid.painted))
    missing = laid.tiles & ~drawn
    if missing.any():
        alpha, depth = alpha.copy(), depth.copy()
        around.redraw(missing, target, alpha, depth)
    pictures = PaintedPictures(target, laid.painted & laid.covered, alpha, depth)
    return _assemble(splats, laid, _recolored(splats, laid, around, pictures, options), first_appended)


def without_islands(mask: np.ndarray) -> Bools:
    """[H, W] bool without parts that nowhere hold a 3 x 3 block (those parts' surroundings within 3 pixels stay)."""
    core, window = np.zeros(mask.shape, bool), window_around(mask, 1)
    # Only around the set pixels; most masks are small.
    core[window] = ~dilated(~mask[window], 1)
    return mask & dilated(core, 3)


def clear_pixels(
    splats: Splats,
    view: ProjectedView,
    within: Bools,
    mask_sums: tuple[MaskSums, MaskSums],
    near: NearSurface,
    covered: np.ndarray,
    window: tuple[slice, slice],
) -> np.ndarray:
    """[H, W] bool pixels most of whose light comes from Gaussians that a sheet can take the place of: they lie on the
    surface, and under the sheet, or are small enough to be cut at its edge; elsewhere, in the fog of captures, a veil
    would stay before the sheet. within: [H, W] bool, of the view's pixels only these are looked at; mask_sums: of
    `covered`, and of these; window: rows and columns of the pixels that may be clear, and of those within
    RESURFACING.clear_radius_px around them."""
    ids, (sums, everywhere) = view.gaussian_ids, mask_sums
    handled = sums.weight > 0
    reached = np.flatnonzero(handled)
    share = sums.alpha.take(reached) / np.maximum(everywhere.alpha.take(reached), 1e-9)
    # Long Gaussians that are only partly under the sheet cannot be cut, and would stay as a veil.
    unsure = reached[share <= RESURFACING.min_replaced_share]
    handled[unsure] = row_max(projected_sizes(splats.geometry(ids[unsure]), view.camera)) < RESURFACING.max_cut_px
    sides = near.sides(splats, ids[reached])
    # One channel for their light, one for that of what the sheet will hide, one for what nothing stops.
    red = view.camera.background[0]
    view = replace(view, camera=replace(view.camera, background=(red, red, red)))
    colors = np.zeros((len(ids), 3), np.float32)
    colors[reached, 0], colors[reached, 1] = handled[reached] & (sides == TOUCHES), sides == FAR_BEHIND
    image, alpha, _ = view.rasterize(colors)
    clear = np.zeros(covered.shape, bool)
    image, alpha = image[window], alpha[window]
    weight, hidden = image[..., 0] - image[..., 2], image[..., 1] - image[..., 2]  # over black
    light = (weight > RESURFACING.min_handled * (alpha - hidden)) & (weight > RESURFACING.min_touching * alpha)
    light &= within[window]
    clear[window] = box_mean(light.astype(np.float32), RESURFACING.clear_radius_px) > 0.5
    return clear


def _cut(
    splats: Splats,
    share: np.ndarray,
    camera: Camera,
    tiles: Bools,
    seen: Bools,
    near: NearSurface,
    covered: np.ndarray,
    options: LocalOptions,
) -> tuple[Lattice, np.ndarray]:
    """Halve Gaussians that lie across the sheet's edge: (the lattice of those that touch the surface under the sheet,
    [S] bool those that go). share: [N] of each one's footprint under the sheet; tiles: [TH, TW] bool all that those
    under it touch; seen: [N] bool, those that make the picture: what is hidden behind them goes or stays as one."""
    # Touching the surface is asked only of those that reach far enough under the sheet; all others stay as they are.
    ids = np.flatnonzero(share > RESURFACING.max_untouched_share)
    ids = ids[near.touches(splats, ids)]
    share, touching = share[ids].astype(np.float64), np.ones(len(ids), bool)
    across = share < RESURFACING.min_replaced_share
    # Hidden ones behind the surface are not cut: nobody sees where they end.
    wide = across & seen[ids]
    lattice = Lattice.of(splats, camera, ids, ids[wide])
    for turn in range(RESURFACING.max_rim_halvings + 1):
        wide[wide] = row_max(lattice.take(np.flatnonzero(wide)).widths) > RESURFACING.rim_goal_px
        if turn == RESURFACING.max_rim_halvings or not wide.any() or (~lattice.slot).sum() > options.max_pieces:
            break
        lattice, source = lattice.halved(wide, RESURFACING.rim_goal_px)
        ids = np.flatnonzero(touching[source])
        pieces = lattice.take(ids).splats()
        # Pieces are judged by their own footprints, again and again, until they are narrow enough.
        view = project(pieces, camera, tiles=tiles)
        under, everywhere = view.mask_sums(covered, np.ones(covered.shape, bool))
        share, touching = np.zeros(len(lattice)), np.zeros(len(lattice), bool)
        share[ids[view.gaussian_ids]] = under.alpha / np.maximum(everywhere.alpha, 1e-9)
        chosen = np.flatnonzero(share[ids] > RESURFACING.max_untouched_share)
        touching[ids[chosen]] = near.touches(pieces, chosen)
        across = touching & (share < RESURFACING.min_replaced_share)
        wide = across & seen[lattice.parent]
    # A piece that still lies across goes with the side that holds more of it.
    return lattice, touching & (share > np.where(across, 0.5, RESURFACING.min_replaced_share))


def _sheet(
    hidden: Splats,
    geometry: SheetGeometry,
    cells: Cells,
    colors: np.ndarray,
    cover: np.ndarray,
    tiles: np.ndarray,
    camera: Camera,
) -> tuple[Splats, np.ndarray]:
    """(C Gaussians in the picture's colours, [C] their hosts: those of the `hidden` ones, in place of which the sheet
    lies, that weigh most in their pixels)."""
    xs, ys = cells.centers.astype(np.int64).T
    view = project(hidden, camera, tiles=tiles)
    heaviest = view.heaviest_gaussians()
    hidden_ids = heaviest[ys, xs]
    if (hidden_ids < 0).any():
        # A cell over a crack takes the nearest host.
        nearest = nearest_pixels(heaviest >= 0)
        hidden_ids = heaviest.ravel()[nearest[ys, xs]]
    toward = np.zeros((len(hidden), 3), np.float32)
    toward[view.gaussian_ids] = view.unclamped_colors
    parents, dtype = take(hidden, hidden_ids), hidden.means.dtype
    sheet = Splats(
        _within_horizon(hidden, hidden_ids, heaviest, geometry, cells.centers, camera).astype(dtype),
        geometry.quats.astype(dtype),
        geometry.scales.astype(dtype),
        (SHEET.opacity * cover[ys, xs]).astype(dtype),
        recolor(parents.sh, toward[hidden_ids], colors[ys, xs]),
        hidden.antialiased,
        hidden.color_space,
        parents.source,
        parents.origin,
        parents.offset,
    )
    return sheet, hidden_ids


def _within_horizon(
    hidden: Splats,
    hidden_ids: np.ndarray,
    heaviest: np.ndarray,
    geometry: SheetGeometry,
    pixels: np.ndarray,
    camera: Camera,
) -> Floats:
    """[C, 3] float64 the means of sheet Gaussians. Those near the horizon and beyond RESURFACING.max_host_sigmas of all
    Gaussians that make the pixels around are moved along the lines of sight of their pixels ([C, 2]) to where their
    host ([C], ids of `hidden`) is densest: the edited view stays as it is. heaviest: [H, W] ids of `hidden`, -1:
    none."""
    means, past = geometry.means, np.empty(len(hidden_ids), bool)
    arrays = (readonly(getattr(hidden, name), np.float64) for name in ("means", "quats", "scales"))
    sheet = (readonly(values, np.float64) for values in (means, geometry.quats))
    pictured = (readonly(hidden_ids, np.int64), readonly(pixels, np.float64), readonly(heaviest, np.int64))
    horizon = portable.cos(math.radians(RESURFACING.horizon_degrees))
    limits = (horizon, RESURFACING.max_host_sigmas, RESURFACING.min_host_flatness, RESURFACING.host_reach_px)
    run(kernels.mark_past_horizon, *arrays, *sheet, *pictured, readonly(camera.position, np.float64), *limits, past)
    far = np.flatnonzero(past)
    depth, _ = depths_along(hidden, hidden_ids[far], camera, camera.sight_lines(pixels[far]))
    # Moved along the line of sight: the edited view stays as it is, side views no longer see it hang in the air.
    ahead = depth > 0
    out = means.copy()
    out[far[ahead]] = camera.unproject(depth[ahead], pixels[far[ahead]])
    return out


@dataclass(frozen=True)
class _Recolored:
    """Of Gaussians around a sheet after colour rounds."""

    ids: Ids = field(repr=False)
    """[Q] int64: those that are as they were but for their colour."""
    sh: np.ndarray = field(repr=False)
    """[Q, K, 3] SH of those."""


def _recolored(
    splats: Splats, laid: LaidSheet, around: ProjectedView, pictures: PaintedPictures, options: LocalOptions
) -> _Recolored:
    """Colour rounds of the sheet, of the pieces around it and of what hangs before it. around: of the N `splats`, with
    the sheet's tiles."""
    pieces, fresh, tiles, covered = laid.pieces, laid.fresh, laid.tiles, laid.covered
    view, count, first = joined_view(pieces, fresh, around, tiles), len(splats), len(splats) + len(pieces.parent_ids)
    ids = view.gaussian_ids
    added, piece = ids >= first, (ids >= count) & (ids < first)
    inside, everywhere = view.mask_sums(covered, np.ones(covered.shape, bool))
    # What hangs before the sheet and gives its pixels light has to take part, or the sheet would compensate for it.
    hanging = (inside.peak > RESURFACING.min_peak) & (inside.weight > RESURFACING.min_sheet_share * everywhere.weight)
    hanging &= inside.weight > RESURFACING.min_visible * inside.alpha
    movable = added | piece | hanging
    editable = np.flatnonzero(movable)
    visible_sums = everywhere.take(editable)
    del inside, everywhere, added, piece, hanging  # now comes what an edit needs the most memory for
    goal, rounds = pictures.target, options.sheet_rounds
    weights = np.where(laid.painted, covered, RESURFACING.unedited_weight).astype(np.float32)
    steps = sirt_steps(view, goal, weights, movable) if options.correct else None
    relaxation = RESURFACING.color_step_fraction
    lifted = lift_editable(view, goal, weights, movable, rounds, relaxation=relaxation, steps=steps)
    del weights
    if steps is not None:
        # What the picture leaves open, views from beside decide.
        numbers = ids[editable]
        parents = np.concatenate([np.arange(count), pieces.parent_ids, laid.parent_ids])[numbers]
        old = np.concatenate([np.ones(count, bool), pieces.slot, np.zeros(len(laid.parent_ids), bool)])
        facing, there = np.empty(len(numbers), np.float32), numbers < count
        for splats_there, at, begin in ((splats, there, 0), (fresh, ~there, count)):
            facing[at] = correction.facing(splats_there, numbers[at] - begin, view.camera)
        gaussians = LiftedGaussians(
            view,
            editable,
            facing,
            visible_sums,
            lifted,
            colors_towards(around, splats, parents),
            ~old[numbers],
            pictures,
        )
        lifted = gaussians.corrected(correction.weights(), steps)
        del gaussians
    del visible_sums, steps  # what is read no more goes
    before, ids = view.unclamped_of(editable), ids[editable]
    moved = row_max(np.abs(lifted - np.maximum(before, 0))) > MIN_CHANGE
    sh = fresh.sh
    # The sheet keeps its parents' bands whole: `_sheet` has damped them already; pieces are damped as old Gaussians
    # are.
    for chosen, damping in ((ids >= first, 1.0), ((ids >= count) & (ids < first), options.damping)):
        chosen &= moved
        fresh_ids = ids[chosen] - count
        sh[fresh_ids] = recolor(sh.take(fresh_ids, 0), before[chosen], lifted[chosen], damping)
    hanging = moved & (ids < count)
    recolored = recolor(splats.sh.take(ids[hanging], 0), before[hanging], lifted[hanging], options.damping)
    return _Recolored(ids[hanging], recolored)


def _assemble(splats: Splats, laid: LaidSheet, painted: _Recolored, first_appended: int) -> Resurfaced:
    """Everything at its index: pieces of a Gaussian at that of their parent, one sheet Gaussian at that of its host,
    further ones at emptied indices that are no part of the original; the rest is appended."""
    pieces, fresh, parent_ids, first = laid.pieces, laid.fresh, laid.parent_ids, len(laid.pieces.parent_ids)
    emptied = np.zeros(len(splats), bool)
    emptied[laid.emptied_ids] = True
    index = np.full(len(parent_ids), -1, np.int64)
    # One sheet Gaussian takes the index of each host that went, so that files grow as little as possible.
    fitting = np.flatnonzero(emptied[parent_ids])
    _, chosen = np.unique(parent_ids[fitting], return_index=True)
    index[fitting[chosen]] = parent_ids[fitting[chosen]]
    emptied[parent_ids[fitting[chosen]]] = False
    # Indices of earlier edits may take any of the rest; those of the original only their own.
    free = np.flatnonzero(emptied[first_appended:]) + first_appended
    unplaced = np.flatnonzero(index < 0)[: len(free)]
    index[unplaced] = free[: len(unplaced)]
    emptied[index[unplaced]] = False
    placed = np.flatnonzero(index >= 0)
    removed = np.flatnonzero(emptied)

    slots = np.flatnonzero(pieces.slot)
    written_gaussians = take(fresh, np.concatenate([slots, first + placed]))
    recolored = replace(splats.take(painted.ids), sh=painted.sh)
    written = np.concatenate([painted.ids, pieces.parent_ids[slots], index[placed]])
    order = np.argsort(written, kind="stable")
    written, values = written[order], take(recolored.append(written_gaussians), order)
    # Bits, not values: -0.0 and NaN count as what they are in the file.
    differs = np.zeros(len(written), bool)
    for name in ATTRIBUTES:
        bits, old = float_bits(getattr(values, name)), float_bits(getattr(splats, name)[written])
        differs |= (bits != old).reshape(len(written), -1).any(1)
    tail = np.concatenate([np.flatnonzero(~pieces.slot), first + np.flatnonzero(index < 0)])
    parents = np.concatenate([pieces.parent_ids[~pieces.slot], parent_ids[index < 0]])
    edit = SparseEdit(written[differs], take(values, np.flatnonzero(differs)), removed, take(fresh, tail), parents)
    return Resurfaced(edit, np.sort(index[placed]), laid.covered)
