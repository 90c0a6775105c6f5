"""The Gaussians around a local edit while they are split, coloured and given a detail layer.

A patch is a value: each step returns a new one. Outside the mask the target picture is the render before the edit: a
Gaussian that straddles the mask's edge is held by its full footprint, not painted along its whole length.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.color import base_color
from splatpainter.lift.colors import lift_colors, painted_sh, recolor
from splatpainter.lift.local.detail import DETAIL, detail_layer
from splatpainter.lift.local.evidence import LONG, Evidence, footprints, reaches_out
from splatpainter.lift.local.gaussian_merging import merge
from splatpainter.lift.local.split import Lattice, projected_sizes
from splatpainter.lift.masks import dilated
from splatpainter.lift.options import LocalOptions
from splatpainter.rendering.cpu.projected_view import ProjectedView, pixels_of_tiles, project
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_max

MIN_PIXEL_SHARE = 0.004
"""A Gaussian whose largest share of any masked pixel is below this is not written (1/255)."""


@dataclass(frozen=True)
class PatchThresholds:
    """What of a view's Gaussians is halved, written and given detail. Measured where an entry says on what, else
    taste."""

    max_width_goals: float = 1.4
    """Gaussians up to this many goals wide are not halved any more: they end between 0.7 and 1.4 goals."""
    large_width_goals: float = 3.0
    """Gaussians wider than this many goals drag paint over the mask's edge when they are too faint to be split."""
    min_inside_large: float = 0.6
    """Such large Gaussians are written only if this share of their weight lies inside the mask."""
    added_per_split: int = 6
    """About how many Gaussians a split adds."""
    min_detail_alpha: float = 0.9
    """Detail Gaussians are nearly opaque: less covered pixels, such as a silhouette's, would gain alpha from one."""
    silhouette_margin_px: int = 3
    """Pixels from what lies beside the asset within which there is no detail: what is wrong there is mostly the
    outline, and Gaussians that mend it stand off the surface, in the background's colour, for views from other sides.
    On 29 painted training meshes, near them: 24.3 dB with such Gaussians, 26.2 without; in the edited views 32.4 and
    32.6."""
    first_detail_rounds: int = 4
    """Colour rounds of the detail layer."""
    last_detail_rounds: int = 6
    """Colour rounds of what is added to the detail layer for pixels that are still wrong."""
    max_errors_left: float = 4.0
    """Pixels are still wrong by more than so many times the error from which on the detail layer mends them."""
    unmended_cost: float = 5.0
    """What joining Gaussians costs in pixels that no detail layer may cover, over what it costs in others."""
    min_seen_px: float = 1e-3
    """Pixels of weight from which a Gaussian's part in the wanted change is known."""


PATCHING = PatchThresholds()


MIN_INSIDE_SMALL = 0.05
"""As PATCHING.min_inside_large, for small Gaussians: those at the mask's edge settle between both sides."""


@dataclass(frozen=True)
class Patch:
    """S Gaussians, of which the edited view shows M."""

    lattice: Lattice
    """Lattice of the S Gaussians; of joined ones (`merged`), that of one of them."""
    splats: Splats
    """The S Gaussians of the lattice."""
    widths: np.ndarray = field(repr=False)
    """[S] largest standard deviation of each, pixels."""
    view: ProjectedView = field(repr=False)
    """View of the tiles that editable Gaussians touch; fewer from split to split."""
    target: np.ndarray = field(repr=False)
    """[H, W, 3] the picture to reach: the edit inside the mask, the render before the edit outside."""
    change: np.ndarray = field(repr=False)
    """[H, W, 3] target minus that render; 0 outside the mask."""
    mask: Bools = field(repr=False)
    """[H, W] bool: where the edit counts."""
    editable: Bools = field(repr=False)
    """[S] bool."""
    share: np.ndarray = field(repr=False)
    """[S] largest share of a masked pixel that the parent gave before the edit."""
    evidence: Evidence = field(repr=False)
    """Evidence about the M Gaussians."""

    @staticmethod
    def of(splats: Splats, view: ProjectedView, target: np.ndarray, mask: np.ndarray, editable: Bools) -> Patch:
        """Nothing split yet. view: of the S Gaussians, the tiles to work on; target, mask: the edited picture;
        editable: [S] bool."""
        image, alpha, _ = view.rasterize()
        inside = mask & (alpha > 0.02)  # tiles that are not drawn have none
        # Beyond the mask the target is what is there: Gaussians across its edge are held by those pixels.
        at, change = np.flatnonzero(inside), np.zeros(image.shape, np.float32)
        reached = image.reshape(-1, 3)
        change.reshape(-1, 3)[at] = target.reshape(-1, 3).take(at, 0) - reached.take(at, 0)
        reached[at] += change.reshape(-1, 3).take(at, 0)
        evidence = Evidence.of(view, change, inside)
        share = np.zeros(len(splats), np.float32)
        share[view.gaussian_ids] = evidence.peak
        lattice = Lattice.of(splats, view.camera)
        widths = row_max(lattice.widths)
        return Patch(lattice, splats, widths, view, image, change, inside, editable, share, evidence)

    def too_coarse(self, options: LocalOptions) -> Bools:
        """[S] bool Gaussians over whose footprint the change varies too much, if they are large enough to split."""
        ids, evidence = self.view.gaussian_ids, self.evidence
        coarse = self.editable[ids] & (evidence.peak > MIN_PIXEL_SHARE) & (evidence.spread > options.tolerance**2)
        coarse &= self.share[ids] > options.min_share
        coarse &= self.widths[ids] > PATCHING.max_width_goals * options.goal_px
        if options.spares_long:
            hidden = evidence.visible < LONG.min_visible * footprints(self.view)
            coarse &= ~(hidden & reaches_out(self.view, evidence.covered))
        # A bound on new Gaussians: when it binds, those with most to gain are split.
        left = options.max_appended - int((~self.lattice.slot).sum())
        count = max(left // PATCHING.added_per_split, 0)
        if coarse.sum() > count:  # those with most to gain
            gain = np.where(coarse, evidence.spread * evidence.visible, 0)
            coarse &= gain >= (np.partition(gain, -count)[-count] if count else np.inf)
        out = np.zeros(len(self.splats), bool)
        out[ids[coarse]] = True
        return out

    def split(self, coarse: np.ndarray, options: LocalOptions) -> Patch:
        """The patch with the coarse Gaussians ([S] bool) halved; children without a share of the mask are no longer
        editable."""
        lattice, source = self.lattice.halved(coarse, PATCHING.max_width_goals * options.goal_px)
        splats = lattice.splats()
        view = project(splats, self.view.camera, tiles=self.view.tiles)
        evidence = Evidence.of(view, self.change, self.mask)
        in_mask = np.zeros(len(splats), bool)
        in_mask[view.gaussian_ids] = evidence.peak > MIN_PIXEL_SHARE
        editable = self.editable[source] & in_mask
        tiles = view.tiles_of(editable)
        # Children are small: fewer tiles are in work. Projecting anew pays only if the gain is large.
        if tiles.sum() < 0.8 * view.tiles.sum():
            view = project(splats, self.view.camera, tiles=tiles)
            evidence = Evidence.of(view, self.change, self.mask)
        return replace(
            self,
            lattice=lattice,
            splats=splats,
            widths=row_max(lattice.widths),
            view=view,
            editable=editable,
            share=self.share[source],
            evidence=evidence,
        )

    def merged(self) -> Patch:
        """The patch with split Gaussians joined that want the same colours (merge.py), and without those that are never
        drawn: for patches that are given a detail layer, which mends what joining costs. (Without one, views of several
        captures' edits lose up to 0.9 dB from other sides.)"""
        halved = np.asarray(self.lattice.level.any(1))
        if not halved.any():
            return self
        ids, visible, count = self.view.gaussian_ids, self.evidence.visible, len(self.splats)
        pixels, colors = np.zeros(count), np.clip(base_color(self.splats.sh[:, :1].astype(np.float64)), 0, None)
        # Where no detail layer may mend, joining costs more.
        solid = _is_solid(self.view, self.view.rasterize()[1])
        pixels[ids] = visible + (PATCHING.unmended_cost - 1) * (visible - self.view.mask_sums(solid, solid)[0].weight)
        # The colour that each wants by itself decides who is alike.
        mean_change = self.evidence.change / np.maximum(visible, PATCHING.min_seen_px)[:, None]
        colors[ids] = self.view.colors + np.where(visible[:, None] > PATCHING.min_seen_px, mean_change, 0)
        result = merge(self.splats, self.view.camera, halved, self.lattice.slot, colors, pixels)
        splats, joined = result.splats, np.bincount(result.group[result.group >= 0]) > 1
        widths = self.widths[result.source]
        # Joined ones have new shapes; the others' widths are known.
        widths[joined] = row_max(projected_sizes(splats.geometry(np.flatnonzero(joined)), self.view.camera))
        view = project(splats, self.view.camera, tiles=self.view.tiles)
        evidence = Evidence.of(view, self.change, self.mask)
        may, editable = np.zeros(len(splats), bool), np.zeros(len(splats), bool)
        may[result.group[self.editable & (result.group >= 0)]] = True
        editable[view.gaussian_ids] = evidence.peak > MIN_PIXEL_SHARE
        return replace(
            self,
            lattice=self.lattice.take(result.source),
            splats=splats,
            widths=widths,
            view=view,
            editable=editable & may,
            share=self.share[result.source],
            evidence=evidence,
        )

    def movable(self, options: LocalOptions) -> Bools:
        """[M] bool Gaussians that may take new colours."""
        ids, evidence = self.view.gaussian_ids, self.evidence
        movable = self.editable[ids] & (evidence.peak > MIN_PIXEL_SHARE)
        # What is hidden elsewhere from this view would be seen painted from others.
        if options.spares_long:
            movable &= ~reaches_out(self.view, evidence.covered)
        large = np.zeros(len(ids), bool)
        # Large ones would drag paint over the mask's edge, so more of them has to lie inside.
        large[movable] = self.widths[ids[movable]] > PATCHING.large_width_goals * options.goal_px
        return movable & (
            evidence.inside > np.where(large, PATCHING.min_inside_large, MIN_INSIDE_SMALL) * evidence.visible
        )

    def painted(self, options: LocalOptions) -> Splats:
        """The S Gaussians after the colour rounds; those that did not move keep their bits."""
        hold = self.evidence.hold(self.view)
        movable = self.movable(options)
        sh = painted_sh(self.splats.sh, self.view, self.target, movable, options.rounds, options.damping, hold)
        return replace(self.splats, sh=sh)

    def detail(self, painted: Splats, options: LocalOptions) -> tuple[Splats, np.ndarray] | None:
        """(Gaussians, [A] the patch's Gaussian that each lies on) of the detail layer over the painted patch, if it
        needs one."""
        # Only colours have changed.
        view = self.view.recolored(painted) or project(painted, self.view.camera, tiles=self.view.tiles)
        image, alpha, _ = view.rasterize()
        mendable = dilated(self.mask, options.rim_px) & _is_solid(view, alpha)
        at = np.flatnonzero(mendable)
        goal = self.target.reshape(-1, 3).take(at, 0)
        steps = (
            (DETAIL.reaches_px, 1.0, PATCHING.first_detail_rounds),
            (DETAIL.smallest_px, PATCHING.max_errors_left, PATCHING.last_detail_rounds),
        )
        both, count, parent_ids = painted, len(painted), np.arange(len(painted))
        for reaches, errors, rounds in steps:
            # Only pixels that are wrong after painting get a Gaussian of their own.
            error = row_max(np.abs(goal - np.clip(image.reshape(-1, 3).take(at, 0), 0, 1)))
            wrong = np.zeros_like(mendable)
            wrong.ravel()[at] = error > errors * options.max_error
            layer = detail_layer(both, view, wrong, self.target, reaches)
            if layer is None:
                break
            parent_ids = np.append(parent_ids, parent_ids[view.gaussian_ids[layer.parent_entries]])
            both = both.append(layer.splats)
            view = project(both, self.view.camera, tiles=self.view.tiles)
            # Colours of the layer alone move: what lies under it was painted for all sides.
            added = view.gaussian_ids >= count
            colors = lift_colors(view, self.target, np.ones(self.mask.shape, np.float32), added, rounds)
            both.sh[view.gaussian_ids[added]] = recolor(
                both.sh[view.gaussian_ids[added]], view.unclamped_colors[added], colors[added], 1.0
            )
            # The second, finer step sees what the first one left.
            image = view.rasterize(colors)[0]
        return None if len(both) == count else (both.take(np.arange(count, len(both))), parent_ids[count:])


def _is_solid(view: ProjectedView, alpha: np.ndarray) -> Bools:
    """[H, W] bool: drawn pixels of alpha [H, W] that a detail layer may cover."""
    drawn = pixels_of_tiles(view.tiles, alpha.shape)
    return (alpha > PATCHING.min_detail_alpha) & ~dilated((alpha < 0.5) & drawn, PATCHING.silhouette_margin_px)
