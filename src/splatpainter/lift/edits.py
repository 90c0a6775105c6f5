"""Edits of one or several views, lifted: what an asset becomes, or what a network is to change of it.

    views = edit_views(splats, cameras, pictures, masks)
    lifted = lift_local_views(splats, grid, views)         or lift_global_views(splats, views)

A network's residual is added to the lift's answer ("lift"), or to the asset itself ("own"), of which the lift then
only says what is to change. So an untrained network returns the lift, or the asset, bit for bit. N Gaussians of the
asset, A appended by the lift, J that may change.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.lift.colors import refine_colors_local
from splatpainter.lift.contradictions import runs_that_agree
from splatpainter.lift.edit_views import EditView, edit_views, errors_name, gaussians_in_views
from splatpainter.lift.features import global_features, local_features, no_features
from splatpainter.lift.global_edit import Predict, lift_global
from splatpainter.lift.local.evidence import Evidence
from splatpainter.lift.local.local_edit import NothingPaintableError, fills_view, gaussians_in_mask, is_wide
from splatpainter.lift.local.wide_edit import lift_wide
from splatpainter.lift.masks import median_change
from splatpainter.lift.options import GLOBAL_DEFAULTS, LOCAL_DEFAULTS, GlobalOptions, LocalOptions, ResidualBase
from splatpainter.lift.sheets.paint import PaintedView, is_fine, paint_view
from splatpainter.lift.sheets.resurface import RESURFACING
from splatpainter.lift.sheets.rounding import rounded
from splatpainter.lift.view_selection import ViewShare, view_shares, with_joint_colors
from splatpainter.rendering.cpu.projected_view import ProjectedView, project, tiles_of_mask
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import SightEstimates
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.grid import VoxelGrid, voxelize


@dataclass(frozen=True)
class EditThresholds:
    """Which way an edit takes. Measured where an entry says on what, else taste."""

    hint_rounds: int = 4
    """Colour rounds behind the features of base "own": a hint, and half of what a lift would cost."""
    min_repainted: float = 0.08
    """Median change of a view's colours, 0..1, from which it was repainted or regraded; less is detail. Beside a view
    of a whole asset (vase, chair) splitting gains 3 to 6 dB over `lift_wide` where it was repainted or strongly
    regraded, and loses 2 where it was warmed a little."""
    min_repainted_followed: float = 0.7
    """Share of the change that the Gaussians can follow as they are (`Evidence.followed`) from which a view was
    repainted; less is detail, however strong. Eight training meshes fitted by 3DGS: graded, recoloured and inverted
    close-ups 0.75 to 1.00 (splitting gains up to 4 dB in novel ones, less where the change is small), close-ups of the
    truth 0.09 to 0.63 (it loses 0.2 to 2.8), posterised ones 0.08 to 0.59 (+0.4 to -0.4)."""
    same_part: float = 0.3
    """Share of a view's Gaussians from which a later one counts as showing the same part. On 20 painted training meshes
    with 2 to 4 edited views, near them: 26.4 dB with a detail layer per view, 27.3 with one for the last; in the edited
    views 29.0 and 29.5."""


EDITS = EditThresholds()


@dataclass(frozen=True)
class LiftedEdit:
    """What the edited pictures make of an asset."""

    splats: Splats
    """Numpy, N + A Gaussians: the lift's answer, or the asset (base "own"; A = 0, as of all global edits)."""
    ids: Ids = field(repr=False)
    """[J] int64 Gaussians of `splats` that the edit may change."""
    parents: Ids = field(repr=False)
    """[J] int64 the asset's Gaussian that each is, or was split from."""
    features: Floats = field(repr=False)
    """[J, 13] float32 of lift/features.py, or zeros."""
    confidence: Floats | None = field(default=None, repr=False)
    """[N] float32 0..1, of a global lift: seen (1) or predicted (towards 0); of a spread one: of the painted material
    (1) or not."""
    detail: bool = False
    """Whether a network may append children (local, base "own": with "lift" the children are the lift's)."""
    replaced: Ids = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    """[R] int64 ascending, part of `ids`: Gaussians of the asset whose indices sheet Gaussians took."""
    removed: Ids = field(default_factory=lambda: np.zeros(0, np.int64), repr=False)
    """[E] int64 ascending, part of `ids`: those whose indices are empty now (opacity 0)."""
    limited: tuple[float, ...] = ()
    """Per view, edited pixels' worth of paint that its limits left out."""
    corrected: bool = False
    """Whether its colours were corrected (`LocalOptions.correct`)."""
    note: str = ""
    """A line for receipts."""

    def followed_by(self, last: LiftedEdit, count: int) -> LiftedEdit:
        """This edit of N Gaussians and another one of its result, as one of the N; without features. count: N."""
        parents = self.parent_ids(count)[last.parent_ids(len(self.splats))]
        changed, replaced = np.zeros(len(last.splats), bool), np.zeros(count, bool)
        changed[self.ids] = changed[last.ids] = True
        replaced[self.replaced] = replaced[last.replaced[last.replaced < count]] = True
        empty = last.splats.opacities[:count] == 0
        ids = np.flatnonzero(changed)
        return LiftedEdit(
            last.splats,
            ids,
            parents[ids],
            no_features(ids),
            replaced=np.flatnonzero(replaced & ~empty),
            removed=np.flatnonzero(changed[:count] & empty),
            limited=(*self.limited, *last.limited),
        )

    def parent_ids(self, count: int) -> Ids:
        """[N + A] int64 the asset's Gaussian that each Gaussian of `splats` is or was split from. count: N."""
        return np.append(np.arange(count), self.parents[self.ids >= count])


def lift_local_views(
    splats: Splats,
    grid: VoxelGrid | None,
    views: Sequence[EditView],
    base: ResidualBase,
    options: LocalOptions = LOCAL_DEFAULTS,
    *,
    features: bool = True,
    surface: Surface | None = None,
    originals: int | None = None,
) -> LiftedEdit:
    """A local edit: Gaussians that visibly make the edited pixels; later views win. splats: numpy, N Gaussians; grid:
    its voxels (None will do for one view with sheets); features: whether a network reads them; surface: of the
    original, on which sheets are laid (None: Gaussians are split, as networks know it); originals: how many of the N
    are the original's (default: all). Raises ValueError, naming the view, where an edit reaches no Gaussian."""
    if base == "lift":
        # Whether the edit fills its pictures decides the way: a zoom-in or restyled view is detail, paint on a part is
        # paint.
        close = surface is not None and options.resurface
        close = close and all(fills_view(splats, view.camera, view.mask, originals) for view in views)
        # Lifted together, pictures that contradict each other would come out as their mean.
        if close and len(views) > 1 and len(runs := runs_that_agree(splats, views)) > 1:
            lifted = _in_turn(splats, surface, runs, options, originals)
        elif close and not _all_repainted(splats, views, options, originals):
            lifted = _together(splats, views, options)
        elif surface is None or not options.resurface:
            lifted = _one_after_the_other(splats, grid, views, options)
        else:
            lifted = _on_surface(splats, grid, surface, views, options, originals)
        if not features:
            return lifted
        return replace(lifted, features=local_features(splats, lifted.splats, lifted.ids, lifted.parents, views))
    assert grid is not None
    # Base "own": the network makes the edit; the lift only says which Gaussians may change, and hints at colours.
    reached = gaussians_in_views(splats, grid, views)
    ids = np.flatnonzero(reached)
    values = no_features(ids)
    if features:
        pictures = [(view.camera, view.target) for view in views]
        painted = refine_colors_local(splats, pictures, reached, min(options.rounds, EDITS.hint_rounds))
        values = local_features(splats, painted, ids, ids, views)
    return LiftedEdit(splats, ids, ids, values, detail=True)


def lift_global_views(
    splats: Splats,
    views: Sequence[EditView],
    base: ResidualBase,
    options: GlobalOptions = GLOBAL_DEFAULTS,
    *,
    features: bool = True,
    normals: np.ndarray | None = None,
    predict: Predict | None = None,
) -> LiftedEdit:
    """A global edit: all Gaussians that can be drawn. splats: numpy, N; features: as in `lift_local_views`; normals and
    predict: as in `lift_global`. Raises ValueError, naming the views, where they show no solid part of it."""
    ids = np.flatnonzero(splats.drawable)
    # Nothing would read the lift then, and it is most of the time.
    if base == "own" and not features:
        return LiftedEdit(splats, ids, ids, no_features(ids))
    with errors_name(", ".join(dict.fromkeys(view.name for view in views))):
        pictures = [(v.camera, v.edited, v.mask) for v in views]
        lift = lift_global(splats, pictures, options, normals, predict)
    values = global_features(splats, lift, ids) if features else no_features(ids)
    return LiftedEdit(lift.splats if base == "lift" else splats, ids, ids, values, lift.confidence)


def _all_repainted(splats: Splats, views: Sequence[EditView], options: LocalOptions, originals: int | None) -> bool:
    """Whether every view was repainted; and where most of its picture was, shows much of the asset, and by Gaussians
    nearly as fine as its pixels (`paint.is_fine`): it is no zoom-in."""
    count = len(splats) if originals is None else originals
    for view in views:
        with errors_name(view.name):
            # Pixels that the asset hardly covers belong to the background, whatever was painted there.
            painted = (
                view.mask & (np.asarray(view.alpha) > RESURFACING.min_cover) if view.alpha is not None else view.mask
            )
            alpha = np.ones(painted.shape, np.float32) if view.alpha is None else np.asarray(view.alpha)
            # The cheapest test first; the dearer ones only where it passes.
            if not painted.any() or median_change(view.edited, view.before, alpha) < EDITS.min_repainted:
                return False
            projected = project(splats, view.camera, tiles=tiles_of_mask(painted))
            if is_wide(view.mask) and not is_fine(
                painted, gaussians_in_mask(splats, view.camera, painted, None, projected), count, count, options
            ):
                return False
            # Repainted means that Gaussians as they are can follow the change; detail finer than they are cannot be
            # followed.
            change = np.where(painted[..., None], view.edited - view.before, 0)
            if Evidence.of(projected, change, painted).followed < EDITS.min_repainted_followed:
                return False
    return True


def _together(splats: Splats, views: Sequence[EditView], options: LocalOptions) -> LiftedEdit:
    """Views that are edited nearly everywhere, without features."""
    lifted, count = lift_wide(splats, views, options), len(splats)
    ids = np.append(lifted.touched, np.arange(count, len(lifted.splats)))
    parents = np.append(lifted.touched, lifted.parents)
    return LiftedEdit(lifted.splats, ids, parents, no_features(ids), limited=(0.0,) * len(views))


def _in_turn(
    splats: Splats,
    surface: Surface | None,
    runs: Sequence[list[EditView]],
    options: LocalOptions,
    originals: int | None,
) -> LiftedEdit:
    """Views that are edited nearly everywhere and contradict each other: run after run, each on the result of those
    before, as edits in turn are, so that the later ones win; without features."""
    nobody = np.zeros(0, np.int64)
    result = LiftedEdit(splats, nobody, nobody, no_features(nobody))
    for run in runs:
        before = result.splats
        cameras, pictures, masks = zip(*((view.camera, view.edited, view.mask) for view in run), strict=True)
        drawn = edit_views(before, cameras, pictures, masks)
        again = [replace(now, name=view.name) for now, view in zip(drawn, run, strict=True)]
        grid = None if len(run) == 1 else voxelize(before)
        count = len(splats) if originals is None else originals
        last = lift_local_views(before, grid, again, "lift", options, features=False, surface=surface, originals=count)
        result = result.followed_by(last, len(splats))
    return result


def _one_after_the_other(
    splats: Splats, grid: VoxelGrid | None, views: Sequence[EditView], options: LocalOptions
) -> LiftedEdit:
    """Split Gaussians, each view on the result of those before, without features. A view gets no detail layer where a
    later one shows the same part: from another side its Gaussians stand in the way (EDITS.same_part)."""
    from splatpainter.voxels.raycast import editable_gaussians

    result = _PaintedSoFar.of(splats)
    again = _shown_again(splats, grid, views)
    for k, view in enumerate(views):
        with errors_name(view.name):
            assert grid is not None
            # Splitting moved and added Gaussians: who is visible from here is asked of what there is now.
            grid = grid if k == 0 else voxelize(result.splats, grid.resolution)
            allowed = editable_gaussians(grid, result.splats, view.camera, view.mask)
            # max_error 1 switches the detail layer off.
            settings = replace(options, max_error=1.0) if again[k] else options
            at_hand = view.projected if k == 0 else None
            painted = paint_view(
                result.splats, None, view.camera, view.edited, view.mask, settings, allowed, view=at_hand
            )
        result = result.after(painted)
    return result.lifted(len(splats))


def _on_surface(
    splats: Splats,
    grid: VoxelGrid | None,
    surface: Surface,
    views: Sequence[EditView],
    options: LocalOptions,
    originals: int | None,
) -> LiftedEdit:
    """Sheets on the surface, each from the view that sees it best, and split Gaussians where there is none, each view
    on the result of those before; without features."""
    result, first = _PaintedSoFar.of(splats), len(splats) if originals is None else originals

    def painted_by(
        view: EditView,
        pixels: np.ndarray,
        settings: LocalOptions,
        *,
        at_hand: ProjectedView | None = None,
        sight: SightEstimates | None = None,
    ) -> PaintedView:
        camera, edited = view.camera, view.edited
        with errors_name(view.name):
            return paint_view(
                result.splats, surface, camera, edited, pixels, settings, None, first, view=at_hand, sight=sight
            )

    if len(views) == 1:
        view = views[0]
        lifted = result.after(painted_by(view, view.mask, options, at_hand=view.projected)).lifted(len(splats))
        return replace(lifted, corrected=options.correct and not is_wide(view.mask))
    # Which view paints which point of the surface is decided before anything is painted, on the asset as it is.
    shares = view_shares(splats, surface, views)
    # What is seen from beside other views say, no guess.
    options = replace(options, spares_long=True, correct=False)
    settings = [replace(options, max_error=1.0) if again else options for again in _shown_again(splats, grid, views)]
    on_surface, limited = [np.zeros_like(view.mask) for view in views], [0.0] * len(views)
    for k, (view, share) in enumerate(zip(views, shares, strict=True)):
        if share.is_empty:
            continue
        try:
            painted = painted_by(view, share.painted, settings[k], sight=share.sight)
        except NothingPaintableError:
            # A view that was left all its pixels and can paint none is the user's error; one that lost pixels to others
            # is not.
            if np.array_equal(share.painted, view.mask):
                raise
            limited[k] = float(share.painted.sum())  # what others left to it lies beyond its limits
            continue
        result, on_surface[k], limited[k] = result.after(painted), painted.on_surface, painted.limited
    # A second pass for pixels that were given to a view which found no trusted surface there.
    for k, (view, share) in enumerate(zip(views, shares, strict=True)):
        bare = share.off_surface(on_surface)
        if not bare.any():
            continue
        with contextlib.suppress(NothingPaintableError):  # it has painted already what it could
            result = result.after(painted_by(view, bare, settings[k], sight=share.sight))
    return replace(result.with_joint_colors(len(splats), views, shares), limited=tuple(limited)).lifted(len(splats))


@dataclass(frozen=True)
class _PaintedSoFar:
    """The Gaussians after the views so far: of N originals, S now."""

    splats: Splats
    changed: Bools
    """[S] bool."""
    replaced: Bools
    """[S] bool: indices that a sheet Gaussian took."""
    parents: Ids
    """[S] int64 among the N."""
    limited: tuple[float, ...] = ()

    @staticmethod
    def of(splats: Splats) -> _PaintedSoFar:
        nothing = np.zeros(len(splats), bool)
        return _PaintedSoFar(splats, nothing, nothing, np.arange(len(splats)))

    def after(self, painted: PaintedView) -> _PaintedSoFar:
        """painted: made of these `splats`."""
        changed, replaced = self.changed.copy(), self.replaced.copy()
        changed[painted.touched], replaced[painted.replaced] = True, True
        # Appended Gaussians are changed by definition, and took no old index.
        new = np.ones(len(painted.parents), bool)
        return _PaintedSoFar(
            painted.splats,
            np.append(changed, new),
            np.append(replaced, ~new),
            np.append(self.parents, self.parents[painted.parents]),
            (*self.limited, painted.limited),
        )

    def with_joint_colors(self, count: int, views: Sequence[EditView], shares: Sequence[ViewShare]) -> _PaintedSoFar:
        """count: N."""
        splats = with_joint_colors(self.splats, self.changed, views, shares)
        # The joint colours are no longer rounded as new Gaussians are; project files count on it.
        new = np.flatnonzero(self.replaced | (np.arange(len(splats)) >= count))
        splats.sh[new] = rounded(splats.take(new)).sh
        return replace(self, splats=splats)

    def lifted(self, count: int) -> LiftedEdit:
        """count: N."""
        ids = np.flatnonzero(self.changed)
        # Opacity 0 is how an index stays when its Gaussian goes: rows never move.
        empty = self.splats.opacities[:count] == 0
        removed = np.flatnonzero(self.changed[:count] & empty)
        taken = np.flatnonzero(self.replaced[:count] & ~empty)
        return LiftedEdit(
            self.splats, ids, self.parents[ids], no_features(ids), replaced=taken, removed=removed, limited=self.limited
        )


def _shown_again(splats: Splats, grid: VoxelGrid | None, views: Sequence[EditView]) -> list[bool]:
    """For each view, whether a later one edits EDITS.same_part of the Gaussians that it edits."""
    if len(views) == 1:
        return [False]
    assert grid is not None
    parts = [gaussians_in_views(splats, grid, [view]) for view in views]
    return [
        any((part & later).sum() > EDITS.same_part * part.sum() for later in parts[k + 1 :])
        for k, part in enumerate(parts)
    ]
