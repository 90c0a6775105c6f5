"""Which of several edited views paints what, and their colours together.

    shares = view_shares(splats, surface, views)      one per view: the pixels that it paints
    share.off_surface(on_surface)                     and those that all views paint, for want of a surface
    splats = with_joint_colors(splats, changed, views, shares)

Laid one after the other, the sheet of each view would cover those of the views before, also where it sees the paint at
a grazing angle and knows least of it. So each point of the surface is painted from the view that shows it in the most
pixels per area, as in the texturing of meshes (Lempitsky & Ivanov 2007: a view for each face), among the views that
paint it alike; where they do not, the latest view wins. H x W pixels of each view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Floats, Ids
from splatpainter.cameras import Camera
from splatpainter.kernels import portable
from splatpainter.lift.colors import MIN_SOLID_ALPHA, SolidView, joint_change
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.local.evidence import reaches_out
from splatpainter.lift.masks import box_mean, dilated, largest_channel
from splatpainter.lift.nearest import nearest_pixels
from splatpainter.lift.warping import bilinear
from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask
from splatpainter.splats import SH_C0, Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import SightEstimates, visible_surface
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class ViewSelectionThresholds:
    """Which of several edited views paints which pixel. Measured where an entry says on what, else taste."""

    min_alpha: float = 0.5
    """Least alpha of a pixel that shows a surface."""
    max_height: float = 0.02
    """Distance of a point from the plane that a view shows in its pixel, as a share of its depth, up to which the view
    sees it."""
    max_sight_distance: float = 0.1
    """The same along the line of sight, at most: grazing planes are long."""
    min_resolution_ratio: float = 1.3
    """Pixels per area over another view's, from which a view is preferred to a later one."""
    min_difference: float = 0.08
    """Colours, 0..1, that differ by less are alike."""
    relative_difference: float = 0.25
    """Colours are also alike if they differ by less than this share of the edit's change, times the ratio of the views'
    pixels per area: what a grazing view shows of an edge lies where its few pixels put it."""
    compared_px: int = 4
    """Reach of the means in which changes are compared."""
    margin_ratio: float = 1.5
    """Ratio of the pixels per area from which the better view also decides on what it leaves unedited."""
    margin_px: float = 3.0
    """It does so around its mask, for so many pixels of the other view."""
    max_margin_px: int = 8
    """It does so for so many of its own pixels, at most."""
    majority_px: tuple[int, ...] = (3, 6, 12)
    """Reaches of the means by which pixels join the view that paints most around them; the further ones are for pixels
    whose own surface is not known."""
    overlap_px: int = 2
    """Pixels by which the pixels of a view reach into those of others."""
    max_joint_difference: float = 0.1
    """A view's pixels that another one paints take part in the joint colours up to this difference, 0..1."""
    alike_px: int = 2
    """Reach of the means in which that difference is taken, pixels."""
    joint_rounds: int = 4
    """Colour rounds over all views. On 24 local edits of 2 or 3 views and 6 painted clean meshes with 2 or 3 (none held
    out), novel / edited views: 30.0 / 33.1 dB without, 30.7 / 34.7 with two, 30.8 / 34.9 with four; split in place of
    sheets 27.3 / 31.0."""
    unedited_weight: float = 0.35
    """Weight of a pixel that a view does not edit, beside an edited one: it is to stay as it is."""
    joint_hold_px: float = 0.15
    """Weight of a Gaussian's colour in these rounds, pixels. Two views of one paint, novel / edited views over 0.5:
    training meshes, clean (24) +0.12 / +0.04 dB, fitted by 3DGS (24) +0.09 / +0.07, the latter at worst -0.14; with
    0.05 +0.15 / +0.04, +0.11 / +0.08 and -0.19. Held-out ones (eleven were seen with 0.05 before): clean (23) +0.16
    (0.10 to 0.23) / +0.24, fitted (22) +0.01 (-0.03 to 0.05) / +0.09; four captures +0.30 to +0.44 / +0.4."""


VIEW_SELECTION = ViewSelectionThresholds()


@dataclass(frozen=True)
class ViewShare:
    """What one of several views paints."""

    painted: Bools = field(repr=False)
    """[H, W] bool, part of its mask."""
    consistent: Bools = field(repr=False)
    """[H, W] bool, part of its mask: there it shows what is painted, by itself or by another view."""
    winner: np.ndarray = field(repr=False)
    """[H, W] int: the view that paints a pixel of the mask in its stead, -1: none."""
    pixels: Ids = field(repr=False)
    """[H, W] int64 flat index of the winner's pixel."""
    sight: SightEstimates = field(repr=False)
    """What its view sees of the surface."""

    @staticmethod
    def of(index: int, mask: np.ndarray, views: Sequence[_ViewOnSurface]) -> ViewShare:
        """Shares of view `index`, whose mask it is. From the latest view to the first, each takes what it shows
        better."""
        window = _window(mask)
        here, mask_here = views[index].cropped(window), mask[window]
        winner, pixels = np.full(mask_here.shape, -1), np.zeros(mask_here.shape, np.int64)
        best, silent = np.zeros(mask_here.shape), np.zeros(mask_here.shape, bool)
        change = np.zeros((*mask_here.shape, 3))
        # Latest first: an earlier view takes a pixel only where it paints alike and sees it better.
        for k in range(len(views) - 1, -1, -1):
            moved = here.at_its_pixels() if k == index else views[k].moved_to(here)
            ratio = moved.density / np.maximum(best, 1e-9)
            beside = (
                (winner >= 0)
                & (ratio > VIEW_SELECTION.margin_ratio)
                & (moved.margin_px <= VIEW_SELECTION.margin_px * np.sqrt(ratio))
            )
            says = moved.painted | beside
            better = _alike(moved.change, change, says & (winner >= 0), ratio) & (
                ratio > VIEW_SELECTION.min_resolution_ratio
            )
            taken = says & ((winner < 0) | better)
            winner[taken], pixels[taken], best[taken] = k, moved.pixels[taken], moved.density[taken]
            change[taken], silent[taken] = moved.change[taken], ~moved.painted[taken]
        # Pixels without a surface follow the majority around them.
        judged = winner >= 0
        lost = _majority(judged, judged & (winner != index), mask_here)
        # Where this view shows what the winner paints, both may help the joint colours.
        difference = largest_channel(
            np.abs(box_mean(_float32((here.change - change) * judged[..., None]), VIEW_SELECTION.alike_px))
        )
        nothing = np.zeros_like(mask)
        out = ViewShare(nothing, nothing.copy(), np.full(mask.shape, -1), np.zeros(mask.shape, int), here.sight)
        # Parts overlap by a few pixels, so that no seam is left between two views' sheets.
        out.painted[window] = mask_here & dilated(mask_here & ~lost, VIEW_SELECTION.overlap_px)
        out.consistent[window] = mask_here & judged & (difference < VIEW_SELECTION.max_joint_difference)
        out.winner[window] = np.where(lost & ~silent & (winner != index), winner, -1)
        out.pixels[window] = pixels
        return out

    @property
    def is_empty(self) -> bool:
        """Whether other views paint all of it."""
        return not self.painted.any()

    def off_surface(self, on_surface: Sequence[np.ndarray]) -> Bools:
        """[H, W] bool: pixels that others paint in its stead, but on no surface that they trust. There, in the fog of
        captures, paint is right only from where it is seen, and all views paint it. on_surface: [H, W] bool of every
        view, as of PaintedView."""
        given = self.consistent & (self.winner >= 0)
        off = np.zeros_like(given)
        for k, trusted in enumerate(on_surface):
            at = given & (self.winner == k)
            off[at] = ~trusted.ravel()[self.pixels[at]]
        return _majority(given, off, given)


def view_shares(splats: Splats, surface: Surface, views: Sequence[EditView]) -> list[ViewShare]:
    """One per view. splats: numpy, N Gaussians; surface: of the original; views: earliest first."""
    on_surface = [_ViewOnSurface.of(splats, surface, view) for view in views]
    return [ViewShare.of(k, view.mask, on_surface) for k, view in enumerate(views)]


def with_joint_colors(
    splats: Splats, changed: np.ndarray, views: Sequence[EditView], shares: Sequence[ViewShare]
) -> Splats:
    """Colours of the Gaussians that an edit changed ([N] bool) towards all its views at once; of those that only one
    view shows they are what they are."""
    solid, seen_by, spills = [], np.zeros(len(splats), np.int64), np.zeros(len(splats), bool)
    for view, share in zip(views, shares, strict=True):
        # Each view counts where it shows what is painted, and a little where it must not change.
        projected = project(splats, view.camera, tiles=tiles_of_mask(share.consistent))
        image, alpha, _ = projected.rasterize()
        opaque = alpha > MIN_SOLID_ALPHA
        edited, unedited = (_float32(opaque & part) for part in (share.consistent, ~share.consistent))
        target = np.where(share.consistent[..., None], view.edited, image)
        sums = projected.backproject(target, edited)
        seen_by[projected.gaussian_ids] += sums.weight > 0
        spills[projected.gaussian_ids] |= (sums.weight > 0) & reaches_out(projected, sums.alpha)
        use, weight = edited + VIEW_SELECTION.unedited_weight * unedited, np.zeros(len(splats), np.float32)
        weight[projected.gaussian_ids] = projected.backproject(target, use).weight
        solid.append(SolidView(view.camera, target, use, weight, projected))
    # A Gaussian that one view shows has its colour from that view already.
    # Long fog would carry the paint beyond the tiles that are looked at.
    common = changed & (seen_by > 1) & ~spills
    if not common.any():
        return splats
    solid = [replace(view, weight=np.where(common, view.weight, 0)) for view in solid]
    sh = splats.sh.copy()
    sh[:, 0] += joint_change(solid, VIEW_SELECTION.joint_rounds, hold=VIEW_SELECTION.joint_hold_px) / SH_C0
    return replace(splats, sh=sh)


@dataclass(frozen=True)
class _Moved:
    """What one view shows, at the pixels of another."""

    change: np.ndarray
    """[H, W, 3]"""
    painted: Bools
    """[H, W] bool: in the mask."""
    density: np.ndarray
    """[H, W] pixels per area; 0 where it is not seen."""
    margin_px: np.ndarray
    """[H, W] pixels from the mask, inf beyond VIEW_SELECTION.max_margin_px."""
    pixels: Ids
    """[H, W] int64 flat indices of its pixels; any where it is not seen."""


@dataclass(frozen=True)
class _ViewOnSurface:
    """An edited view with the surface that it shows."""

    camera: Camera
    change: np.ndarray
    """[H, W, 3] edited - before, 0 outside the mask."""
    mask: Floats
    """[H, W] float64: 1 where it was edited and has a surface."""
    margin_px: np.ndarray
    depth: np.ndarray
    """[H, W] z, 0 for none."""
    normals: np.ndarray
    """[H, W, 3] camera space."""
    density: np.ndarray
    """[H, W] pixels per area, fx fy cos / z^2."""
    sight: SightEstimates

    @staticmethod
    def of(splats: Splats, surface: Surface, view: EditView) -> _ViewOnSurface:
        camera, near = view.camera, dilated(view.mask, VIEW_SELECTION.max_margin_px)
        projected = view.projected
        if projected is None or (tiles_of_mask(near) & ~projected.tiles).any():
            projected = project(splats, camera, tiles=tiles_of_mask(near))
        # Surface, normals and resolution at every pixel of the mask and its margin.
        solid = near & (projected.rasterize()[1] > VIEW_SELECTION.min_alpha)
        ys, xs = np.nonzero(solid)
        visible = visible_surface(surface, splats, projected, solid)
        at = visible.at(np.stack([xs, ys], 1) + 0.5)
        depth, density, normals = np.zeros(solid.shape), np.zeros(solid.shape), np.zeros((*solid.shape, 3))
        seen = at.depth > 0
        ys, xs = ys[seen], xs[seen]
        depth[ys, xs], normals[ys, xs] = at.depth[seen], at.normals[seen]
        rays = camera.sight_lines(np.stack([xs, ys], 1) + 0.5)
        facing = np.abs((at.normals[seen] * rays).sum(1)) / np.linalg.norm(rays, axis=1)
        # Pixels per area: grazing and far views have few.
        density[ys, xs] = facing * camera.fx * camera.fy / at.depth[seen] ** 2
        mask = (view.mask & (depth > 0)).astype(np.float64)
        change = (view.edited - view.before) * mask[..., None]
        return _ViewOnSurface(camera, change, mask, _distance_px(view.mask), depth, normals, density, visible.estimates)

    def cropped(self, window: tuple[slice, slice]) -> _ViewOnSurface:
        """window: rows, columns."""
        rows, columns = window
        camera = self.camera.cropped(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
        names = ("change", "mask", "margin_px", "depth", "normals", "density")
        return replace(self, camera=camera, **{name: getattr(self, name)[window] for name in names})

    def at_its_pixels(self) -> _Moved:
        pixels = np.arange(self.mask.size).reshape(self.mask.shape)
        return _Moved(self.change, self.mask > 0, self.density, self.margin_px, pixels)

    def moved_to(self, other: _ViewOnSurface) -> _Moved:
        """What this view shows of the points that `other` shows."""
        pixels, z = self.camera.project(other.camera.unproject(np.where(other.depth > 0, other.depth, 1)))
        height, width = self.depth.shape
        x, y = (np.floor(np.nan_to_num(pixels[..., k], nan=-1, posinf=-1, neginf=-1)).astype(int) for k in (0, 1))
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (z > 0) & (other.depth > 0)
        x, y = x.clip(0, width - 1), y.clip(0, height - 1)
        depth = self.depth[y, x]
        rays = self.camera.sight_lines(np.stack([x, y], -1) + 0.5)
        # Seen if the point lies on the plane shown there; along the line of sight alone grazing planes would fail.
        height_over = np.abs((z - depth) * (rays * self.normals[y, x]).sum(-1))
        seen = (
            inside
            & (depth > 0)
            & (height_over < VIEW_SELECTION.max_height * z)
            & (np.abs(z - depth) < VIEW_SELECTION.max_sight_distance * z)
        )
        values = np.concatenate([self.change, self.mask[..., None], self.density[..., None]], -1)
        values = bilinear(values, pixels) * seen[..., None]
        margin = np.where(seen, self.margin_px[y, x], np.inf)
        return _Moved(values[..., :3], values[..., 3] > 0.5, values[..., 4], margin, y * width + x)


def _window(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the mask and of all around it that its pixels' shares depend on."""
    reach = VIEW_SELECTION.majority_px[-1] + VIEW_SELECTION.compared_px
    spans = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    rows, columns = (
        slice(max(int(span[0]) - reach, 0), min(int(span[-1]) + 1 + reach, size))
        for span, size in zip(spans, mask.shape, strict=True)
    )
    return rows, columns


def _alike(first: np.ndarray, second: np.ndarray, both: np.ndarray, ratio: np.ndarray) -> Bools:
    """[H, W] bool: two changes [H, W, 3] are the same edit, by their means over pixels that have both ([H, W] bool).
    ratio: [H, W] of the pixels per area."""
    total = np.maximum(box_mean(_float32(both), VIEW_SELECTION.compared_px), 1e-6)[..., None]
    difference = box_mean(_float32((first - second) * both[..., None]), VIEW_SELECTION.compared_px) / total
    # The difference is judged against how large the edit is there.
    size = (
        box_mean(_float32(np.maximum(np.abs(first), np.abs(second)) * both[..., None]), VIEW_SELECTION.compared_px)
        / total
    )
    limit = np.maximum(
        VIEW_SELECTION.min_difference, VIEW_SELECTION.relative_difference * ratio * largest_channel(size)
    )
    return largest_channel(np.abs(difference)) < limit


def _majority(judged: np.ndarray, lost: np.ndarray, mask: np.ndarray) -> Bools:
    """[H, W] bool: pixels of the mask that other views paint. judged: those whose surface is known; lost: part of these
    that others paint."""
    out, left = np.zeros_like(mask), mask
    for k, reach in enumerate(VIEW_SELECTION.majority_px):
        total = box_mean(_float32(judged), reach)
        decided = left & (judged if k == 0 else total > 1e-6)
        out |= decided & (box_mean(_float32(lost), reach) > 0.5 * total)
        left = left & ~decided
    return out


def _distance_px(mask: np.ndarray) -> np.ndarray:
    """[H, W] pixels to the nearest one of the mask, inf beyond VIEW_SELECTION.max_margin_px."""
    nearest = nearest_pixels(mask)
    ys, xs = np.indices(mask.shape)
    distance = portable.hypot(ys - nearest // mask.shape[1], xs - nearest % mask.shape[1])
    return np.where((nearest >= 0) & (distance <= VIEW_SELECTION.max_margin_px), distance, np.inf)


def _float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32)
