"""Where to stand around a patch of surface to paint it: cameras that face it, and which of them shows what best.

Used by decals, which are laid over more of a surface than one camera sees.
"""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.decals.decal_surface import (
    DECAL_SURFACE,
    SurfacePixels,
    facing_camera,
    rough_pixels,
    stands_free,
    surface_pixels,
)
from splatpainter.decals.decal_survey import SURVEY, UnwrappedPatch, share_near
from splatpainter.kernels.portable import cos, dot, hypot, length, matmul, mean, sin
from splatpainter.lift.masks import dilated
from splatpainter.lift.nearest import nearest_pixels
from splatpainter.lift.sheets.near_surface import NearSurface
from splatpainter.lift.sheets.resurface import clear_pixels
from splatpainter.order_statistics import distinct
from splatpainter.painter import Asset
from splatpainter.rendering.cpu.projected_view import ProjectedView, project, tiles_of_mask
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.unwrap import Unwrapped, smoothed
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class DecalViewThresholds:
    """Which cameras paint which part of a decal. Source: taste, tried on boxes, cylinders, rims and captures."""

    ray_rounds: int = 2
    """How often it is moved, each time back onto its line of sight: all views find the same letters at the same
    place."""
    max_pull: float = 1.0
    """How far a pixel of trusted surface is moved onto the fused one, in radii of the smoothing. Two decals on
    st-peter, outside of the preview, without a limit and with this: 11.1 -> 9.9 and 4.1 -> 3.4 %; massa's pedestal with
    0.5: 9.1 -> 16.9."""
    min_slope: float = 0.2
    """Cosine of the angle at which a line of sight must meet the surface for that."""
    min_rim_alpha: float = 0.15
    """Alpha of a pixel from which a decal is continued over an outline, so that the Gaussians there are painted."""
    fill_px: int = 3
    """Pixels by which a decal is continued over an outline."""
    max_front: float = 0.05
    """Share of a pixel's light from what stands before the surface, up to which a view paints it."""
    min_speck_share: float = 0.2
    """Share of the pixels around one that show a near place of the decal, below which a view does not paint it."""
    speck_reach_px: float = 12.0
    """How near, pixels that face the decal."""
    min_distance: float = 0.5
    """Depth of a pixel, in distances of the camera from what it faces, from which it is painted."""
    max_stray: float = 0.15
    """How far from its place on the surface the paint of a pixel may land, in lengths of the decal's longer side. Less
    leaves fog unpainted that veils the decal (0.1: massa, a pedestal), more is seen as crumbs beside it."""
    front_px: int = 2
    """Pixels around one of more than that which it does not paint either: paint spreads by as much."""
    rim_slope: float = 4.0
    """Slope, depth over width, by which the surface may fall away there."""
    frontal_cosine: float = 0.7431448254773942
    """Of 42 degrees: the cosine between normal and line of sight from which a view counts as frontal."""
    max_hidden: float = 0.02
    """Share of the painted samples that no view that faces some shows, from which they are painted from where they were
    found."""
    side_turn: float = np.radians(38.0)
    """Angle to both sides of a view that paints fog: more cameras that paint the same part."""
    min_clear: float = 0.25
    """Share of the pixels of a view that show Gaussians on the surface, below which it paints fog, as on rough
    surface."""
    crease_px: int = 10
    """Width to both sides of an edge between faces, pixels of the decal that a view from between them paints: for those
    that face them the edge is an outline, and what they see there of the other face they would spoil."""
    max_crease_cosine: float = 0.64
    """Cosine between the directions of two views for an edge between what they face; less its negative: a rim."""
    min_face_cosine: float = 0.85
    """Mean, over what lies beside the edge, of the cosine between normals and the direction of the view that faces it:
    round surfaces have no edge."""
    overlap_px: int = 3
    """Pixels by which the parts of neighbouring views overlap."""
    margin_px: int = 24
    """Pixels around the part that a view paints."""
    max_part_share: float = 0.35
    """Largest share of its picture that a view paints: an edit of 0.4 of a picture is taken for a zoom-in
    (lift/edits.py), which has no sheets."""
    min_share: float = 0.01
    """Least share of a patch: what a view must show best, to be one of those that paint it."""

    def stray_limit(self, samples: Unwrapped, painted: np.ndarray) -> float:
        """max_stray in world units. painted: [S] bool samples of the decal."""
        return self.max_stray * 2 * float(np.nanmax(np.abs(samples.uv[painted])))


DECAL_VIEWS = DecalViewThresholds()


@dataclass(frozen=True)
class FacedPart:
    """What one view shows of a patch and is to paint, P pixels."""

    camera: Camera
    before: np.ndarray = field(repr=False)
    """[H, W, 3] float32 render of the asset, over black."""
    alpha: np.ndarray = field(repr=False)
    """[H, W] float32 its alpha."""
    ys: np.ndarray = field(repr=False)
    """[P] int64."""
    xs: np.ndarray = field(repr=False)
    """[P] int64."""
    uv: np.ndarray = field(repr=False)
    """[P, 2] float64 of the patch."""


def faced_parts(
    asset: Asset, surface: Surface, patch: UnwrappedPatch, painted: np.ndarray, up: np.ndarray, pixel: float, limit: int
) -> list[FacedPart]:
    """Parts of a patch, each in the view that sees it most frontally, of at most `limit` views. painted: [S] bool
    samples that something is painted on; up: [3] of the pictures; pixel: world units."""
    samples = patch.samples
    views: list[PatchView] = []
    # One camera for each face, one between two faces that meet at an outward edge.
    groups = _directions(np.flatnonzero(painted), samples.normals, limit)
    creases = (
        []
        if patch.smoothing
        else _creases(samples, painted, groups, max(DECAL_VIEWS.crease_px * pixel, samples.spacing))
    )
    faces = len(groups)
    groups += [(direction, np.flatnonzero(beside)) for direction, beside in creases[: limit - faces]]
    for direction, members in groups:
        views.append(_view(asset, surface, patch, painted, direction, members, up, pixel))
    for view, (_, beside) in zip(views[faces:], creases, strict=False):
        view.cosines[:] = np.where(beside & (view.cosines > 0), 2, 0)  # there before all others, and nowhere else
    # A camera inside something solid or hollow sees its inner side, one beyond another body little of what it is for.
    free = [stands_free(asset, view.camera.position, patch.outdoors) for view in views]
    sees = [(v.cosines[members] > 0).mean() > SURVEY.min_resumed for v, (_, members) in zip(views, groups, strict=True)]
    if any(f and s for f, s in zip(free, sees, strict=True)):
        free = [f and s for f, s in zip(free, sees, strict=True)]
    if not any(free):
        raise ValueError("decal: no camera that faces it stands free of the asset; choose another pixel")
    views = [view for view, f in zip(views, free, strict=True) if f]
    groups = [group for group, f in zip(groups, free, strict=True) if f]
    # In a crease another body may hide what faces it from all that face it: those that found it see it.
    hidden = painted & ~np.any([view.cosines > 0 for view in views], axis=0)
    if hidden.sum() > DECAL_VIEWS.max_hidden * painted.sum():
        useful = sum((view.cosines[painted] > 0).mean() >= DECAL_VIEWS.min_share for view in views)
        for direction, members in _directions(np.flatnonzero(hidden), patch.lines, limit - useful):
            groups.append((direction, members))
            views.append(_view(asset, surface, patch, painted, direction, members, up, pixel))
    # Every sample belongs to the view that sees it most frontally.
    cosines = np.stack([view.cosines for view in views])
    keep = np.ones(len(views), bool)
    while True:  # the smallest goes while it is hardly needed
        owners = np.where(keep[:, None], cosines, -1).argmax(0)
        seen = cosines[keep].max(0) > 0
        shares = np.bincount(owners[seen & painted], minlength=len(views)) / max((seen & painted).sum(), 1)
        small = np.flatnonzero(keep & (shares < DECAL_VIEWS.min_share))
        if not len(small) or keep.sum() == 1:
            break
        keep[small[shares[small].argmin()]] = False
    stray_limit = DECAL_VIEWS.stray_limit(samples, painted)
    views = _less_astray(views, keep, stray_limit)
    owners = np.where(keep[:, None], np.stack([view.cosines for view in views]), -1).argmax(0)
    parts = [view.part(owners == k, patch) for k, view in enumerate(views) if keep[k]]
    # What shows at an angle in fog are often other Gaussians: paint those, too, and before, as the latest view wins.
    sides: list[FacedPart] = []
    for k in np.flatnonzero(keep)[np.argsort(-shares[keep], kind="stable")]:
        if not patch.smoothing and not views[k].foggy(painted & (owners == k)):
            continue
        direction, members = groups[k]
        for turn in (-DECAL_VIEWS.side_turn, DECAL_VIEWS.side_turn):
            if len(parts) + len(sides) >= limit:
                break
            side = np.cross(up, direction)
            turned = cos(turn) * direction + sin(turn) * side / length(side)
            view = _view(asset, surface, patch, painted, turned, members, up, pixel)
            view = view.without_strays(np.full(len(owners), stray_limit))
            if stands_free(asset, view.camera.position, patch.outdoors):
                sides.append(view.part(owners == k, patch))
    return sides + parts


def _less_astray(views: list[PatchView], keep: np.ndarray, limit: float) -> list[PatchView]:
    """Views without what another of those that paint (keep: [V] bool) lays nearer to its place: paint that lands
    elsewhere, farther than `limit` (world units), shows there from all other sides."""
    if keep.sum() < 2:
        return views
    strays = np.stack([view.least_stray() for view in views])
    strays[~keep] = np.inf
    least, good = np.maximum(strays.min(0), limit), strays <= limit
    return [
        view.without_strays(np.where(good[k] & (good.sum(0) == 1), np.inf, least)) if keep[k] else view
        for k, view in enumerate(views)
    ]


@dataclass(frozen=True)
class PatchView:
    """A patch as a view shows it, Q pixels."""

    camera: Camera
    before: np.ndarray
    alpha: np.ndarray
    ys: np.ndarray
    xs: np.ndarray
    uv: np.ndarray
    """[Q, 2] float64."""
    nearest: np.ndarray
    """[Q] int64 sample of each."""
    cosines: np.ndarray
    """[S] float64 between normal and line of sight, 0 where a sample is not seen."""
    clear: np.ndarray
    """[H, W] bool pixels whose light comes from Gaussians on the surface, not from fog before and behind it."""
    stray: np.ndarray
    """[Q] float64 how far from its place paint on a pixel lands, world units; 0 where nothing is painted."""

    def least_stray(self) -> np.ndarray:
        """[S] float64 of the pixels that show each sample, infinite where none does or the view is not to paint it."""
        least = np.full(len(self.cosines), np.inf)
        np.minimum.at(least, self.nearest, self.stray)
        return np.where(self.cosines > 0, least, np.inf)

    def without_strays(self, limits: np.ndarray) -> PatchView:
        """The view without pixels whose paint lands farther from its place than their samples allow (limits: [S])."""
        near = self.stray <= limits[self.nearest]
        if near.all():
            return self
        cosines = np.where(np.bincount(self.nearest[near], minlength=len(limits)) > 0, self.cosines, 0)
        parts = {name: getattr(self, name)[near] for name in ("ys", "xs", "uv", "nearest", "stray")}
        return replace(self, cosines=cosines, **parts)

    def foggy(self, chosen: np.ndarray) -> bool:
        """Whether most of the pixels of some samples ([S] bool) are not clear."""
        at = chosen[self.nearest]
        return bool(at.any()) and self.clear[self.ys[at], self.xs[at]].mean() < DECAL_VIEWS.min_clear

    def part(self, owned: np.ndarray, patch: UnwrappedPatch) -> FacedPart:
        """owned: [S] bool samples that this view paints."""
        picture = np.zeros(self.before.shape[:2], bool)
        at = owned[self.nearest]
        picture[self.ys[at], self.xs[at]] = True
        picture = dilated(picture, DECAL_VIEWS.overlap_px)
        chosen = picture[self.ys, self.xs] & patch.within[self.nearest]
        ys, xs = self.ys[chosen], self.xs[chosen]
        height, width = picture.shape
        if not len(ys):
            return FacedPart(self.camera, self.before, self.alpha, ys, xs, self.uv[chosen])
        # Enough unpainted picture around the part that it is not taken for a zoom-in.
        margin = DECAL_VIEWS.margin_px
        extent = np.array([np.ptp(ys) + 1, np.ptp(xs) + 1])
        while len(ys) > DECAL_VIEWS.max_part_share * np.prod(extent + 2 * margin):
            margin += DECAL_VIEWS.margin_px // 2
        top, left = int(ys.min()) - margin, int(xs.min()) - margin
        bottom, right = top + int(extent[0]) + 2 * margin, left + int(extent[1]) + 2 * margin
        camera = self.camera.cropped(left, top, right - left, bottom - top)
        room = [(max(-top, 0), max(bottom - height, 0)), (max(-left, 0), max(right - width, 0))]
        # Nothing is painted beyond the picture, so that it may show nothing there.
        top_edge, left_edge = top + room[0][0], left + room[1][0]
        window = slice(top_edge, top_edge + bottom - top), slice(left_edge, left_edge + right - left)
        before, alpha = np.pad(self.before, [*room, (0, 0)])[window], np.pad(self.alpha, room)[window]
        return FacedPart(camera, before, alpha, ys - top, xs - left, self.uv[chosen])


def _view(
    asset: Asset,
    surface: Surface,
    patch: UnwrappedPatch,
    painted: np.ndarray,
    direction: np.ndarray,
    members: np.ndarray,
    up: np.ndarray,
    pixel: float,
) -> PatchView:
    """The patch from a direction, in a picture with room for some of its samples (members: [M] int64)."""
    points = patch.samples.points[members]
    # Quantiles: a few far samples must not move the camera.
    middle = (np.quantile(points, 0.02, 0) + np.quantile(points, 0.98, 0)) / 2
    target = points[np.linalg.norm(points - middle, axis=1).argmin()]
    radius = float(np.quantile(np.linalg.norm(points - target, axis=1), 0.995)) + DECAL_VIEWS.margin_px * pixel
    camera = facing_camera(asset, target, direction, up, radius, pixel, outdoors=patch.outdoors)
    return mapped_view(asset, surface, patch, painted, camera, pixel)


def mapped_view(
    asset: Asset,
    surface: Surface,
    patch: UnwrappedPatch,
    painted: np.ndarray,
    camera: Camera,
    pixel: float | None = None,
) -> PatchView:
    """The patch as a camera shows it, around some samples (painted: [S] bool). pixel: world units of one, there; None:
    as the camera shows the samples, which need not face it."""
    samples = patch.samples
    uv, z = camera.project(samples.points[painted])
    painting = pixel is not None
    # Only the surroundings of projected samples are rendered.
    region = np.zeros((camera.height, camera.width), bool)
    inside_picture = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    x, y = uv[inside_picture].astype(int).T
    region[y, x] = True
    if pixel is None:
        pixel = float(np.median(z[z > 0])) / camera.fx if (z > 0).any() else 1.0
    reach = int(np.ceil(2.5 * samples.spacing / pixel * DECAL_SURFACE.sizes_away / (DECAL_SURFACE.sizes_away - 0.5)))
    tiles = tiles_of_mask(dilated(region, reach + DECAL_VIEWS.margin_px))
    region = dilated(region, reach)
    view = project(asset.splats, camera, tiles=tiles)
    before, alpha, depth = view.rasterize()
    drawn = region & (alpha > DECAL_SURFACE.min_alpha)
    pixels_of = rough_pixels if patch.smoothing else surface_pixels
    seen = pixels_of(asset, surface, view, drawn, depth)
    points, normals = seen.points, seen.normals
    if patch.smoothing:
        reached = samples.reached
        # On rough surface pixels are pulled onto the fused one, along their own lines of sight.
        even = (samples.points[reached], samples.normals[reached])
        for _ in range(DECAL_VIEWS.ray_rounds):
            points, normals = smoothed(even, (points, normals), patch.smoothing)
            points = _on_rays(camera.position, seen.points, points, normals, 2 * patch.smoothing)
        points, normals = smoothed(even, (points, normals), patch.smoothing)
    clear = np.zeros(region.shape, bool)
    if seen.visible is not None and len(seen.ys):
        drawn[:] = False
        drawn[seen.ys, seen.xs] = True
        everywhere = (slice(None), slice(None))  # samples are filled in beyond what is drawn
        near, ones = NearSurface.of(seen.visible, drawn), np.ones(drawn.shape, bool)
        clear = clear_pixels(asset.splats, view, ones, view.mask_sums(drawn, ones), near, drawn, everywhere)
    # The place of every pixel on the decal.
    coordinates, nearest = samples.at(points, normals)
    if patch.smoothing:
        # What is trusted to lie elsewhere is another body, before the decal or behind it, and not fog.
        pull = np.linalg.norm(points - seen.points, axis=1)
        elsewhere = ~seen.rough & (pull > DECAL_VIEWS.max_pull * patch.smoothing)
        coordinates[elsewhere], nearest[elsewhere] = np.nan, -1
    if painting and (nearest >= 0).any():
        # A speck is where another body, and what is behind it, have the depth of the surface in their mean.
        speck = _specks(seen, coordinates, region.shape, DECAL_VIEWS.speck_reach_px * pixel)
        # What is much nearer than what the camera faces is a blur of a few Gaussians.
        speck |= depth[seen.ys, seen.xs] < DECAL_VIEWS.min_distance * camera.fx * pixel
        coordinates[speck], nearest[speck] = np.nan, -1
        # What stands before the surface shows in the same pixels at its rim: their paint would land on it.
        front = _front_share(asset.splats, view, seen, nearest >= 0, depth, pixel, samples.spacing)
        beside = dilated(front > DECAL_VIEWS.max_front, DECAL_VIEWS.front_px)[seen.ys, seen.xs]
        coordinates[beside], nearest[beside] = np.nan, -1
        region[seen.ys[beside | speck], seen.xs[beside | speck]] = False
    uv = np.full((*region.shape, 2), np.nan)
    index = np.full(region.shape, -1, np.int64)
    uv[seen.ys, seen.xs], index[seen.ys, seen.xs] = coordinates, nearest
    visible = np.zeros(len(samples.points), bool)
    visible[nearest[nearest >= 0]] = True
    mapped = uv[..., 0].copy()
    uv, index = _filled(uv, index, region & (alpha > DECAL_VIEWS.min_rim_alpha), 4 * pixel)
    # Over an outline it goes on only where nothing else stands behind: there the paint would land.
    ys, xs = np.nonzero(index >= 0)
    behind = np.abs(camera.project(samples.points[index[ys, xs]])[1] - depth[ys, xs])
    beyond = np.isnan(mapped[ys, xs]) & (
        behind > 3 * samples.spacing + DECAL_VIEWS.rim_slope * DECAL_VIEWS.fill_px * pixel
    )
    ys, xs = ys[~beyond], xs[~beyond]
    line = camera.position - samples.points
    cosine = (line * samples.normals).sum(1) / np.linalg.norm(line, axis=1)
    # A sample that is seen at all belongs to someone, however grazing.
    cosine = np.where(visible, np.maximum(cosine, 1e-3), 0)
    uv, nearest = uv[ys, xs], index[ys, xs]
    stray = np.zeros(len(ys))
    if painting:
        limit = DECAL_VIEWS.stray_limit(samples, painted)
        stray = _strays(samples, camera, np.stack([xs, ys], 1), uv, nearest, depth, limit)
    return PatchView(camera, before, alpha, ys, xs, uv, nearest, cosine, clear, stray)


def _strays(
    samples: Unwrapped,
    camera: Camera,
    pixels: np.ndarray,
    uv: np.ndarray,
    nearest: np.ndarray,
    depth: np.ndarray,
    limit: float,
) -> np.ndarray:
    """[Q] how far from its place along the surface the paint of each pixel lands, world units, in a view that mostly
    shows what stands far before it at a slant: most of its pixels beyond `limit`; else 0. pixels: [Q, 2] int64 (x, y);
    uv, nearest: of each, as of `PatchView`; depth: [H, W] z."""
    right, normals = samples.right[nearest], samples.normals[nearest]
    axes = np.stack([right, np.cross(normals, right)], 1)
    position = samples.points[nearest] + ((uv - samples.uv[nearest])[:, :, None] * axes).sum(1)
    way = camera.unproject(depth[pixels[:, 1], pixels[:, 0]], pixels + 0.5) - position
    # Fog straight before the surface shows at its place from there.
    before = (way * normals).sum(1) > 0
    along = np.where(before, np.linalg.norm((way[:, None] * axes).sum(2), axis=1), 0)
    return along if len(along) and np.median(along) > limit else np.zeros(len(along))


def _specks(seen: SurfacePixels, uv: np.ndarray, shape: tuple[int, int], reach: float) -> np.ndarray:
    """[Q] bool mapped pixels of a picture [H, W] with few others around them whose (u, v) is near. uv: [Q, 2], NaN
    where a pixel is not mapped; reach: world units."""
    speck = np.isfinite(uv[:, 0])
    on_decal = np.concatenate([uv[speck], np.zeros((int(speck.sum()), 1))], 1)
    margin = DECAL_SURFACE.max_fit_px
    share = share_near(
        on_decal,
        seen.ys[speck] + margin,
        seen.xs[speck] + margin,
        (shape[0] + 2 * margin, shape[1] + 2 * margin),
        reach,
    )
    speck[speck] = share < DECAL_VIEWS.min_speck_share
    return speck


def _front_share(
    splats: Splats,
    view: ProjectedView,
    seen: SurfacePixels,
    mapped: np.ndarray,
    depth: np.ndarray,
    pixel: float,
    spacing: float,
) -> np.ndarray:
    """[H, W] share of each pixel's light that comes from Gaussians that stand before the surface at the nearest mapped
    pixel (mapped: [Q] bool of `seen`). depth: [H, W] z; pixel, spacing: world units of one."""
    on = np.zeros(depth.shape, bool)
    on[seen.ys[mapped], seen.xs[mapped]] = True
    nearest = nearest_pixels(on)
    ids = view.gaussian_ids
    uv, z = view.camera.project(splats.numpy().means[ids].astype(np.float64))
    x = np.clip(uv[:, 0], 0, depth.shape[1] - 1).astype(int)
    y = np.clip(uv[:, 1], 0, depth.shape[0] - 1).astype(int)
    at = nearest[y, x]
    # Farther from it along the picture the surface may rise, and more so the larger a Gaussian is.
    away = hypot(uv[:, 0] - at % depth.shape[1], uv[:, 1] - at // depth.shape[1])
    size = splats.numpy().scales[ids].max(1)
    front = depth.ravel()[at] - z > 3 * spacing + DECAL_VIEWS.rim_slope * away * pixel + 2 * size
    colors = np.zeros((len(ids), 3), np.float32)
    colors[front, 0] = 1
    return view.rasterize(colors)[0][..., 0]  # over the black of cameras that face a decal


def _on_rays(
    position: np.ndarray, seen: np.ndarray, points: np.ndarray, normals: np.ndarray, limit: float
) -> np.ndarray:
    """[Q, 3] where lines of sight from a position [3] through points `seen` [Q, 3] meet the planes through `points`
    with `normals`; these points where that is far away (limit: world units) or the plane is seen from its edge."""
    ray = seen - position
    slope = (ray * normals).sum(1)
    # Edge-on a line of sight meets the plane anywhere; such points stay where they are.
    frontal = slope < -DECAL_VIEWS.min_slope * np.linalg.norm(ray, axis=1)
    length = ((points - position) * normals).sum(1) / np.where(frontal, slope, -1.0)
    moved = position + length[:, None] * ray
    near = np.linalg.norm(moved - seen, axis=1) < limit
    return np.where((frontal & near)[:, None], moved, points)


def _filled(uv: np.ndarray, index: np.ndarray, region: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """uv [H, W, 2] and sample [H, W], continued linearly up to DECAL_VIEWS.fill_px into pixels of `region` without
    them: creases, outlines and specks of surface that is not trusted. limit: largest step per pixel, world units."""
    uv, index = uv.copy(), index.copy()
    for _ in range(DECAL_VIEWS.fill_px):
        ys, xs = np.nonzero(region & (index < 0))
        padded = np.pad(uv, [(2, 2), (2, 2), (0, 0)], constant_values=np.nan)
        total, count, source = np.zeros((len(ys), 2)), np.zeros(len(ys)), np.full(len(ys), -1, np.int64)
        for dy, dx in ((dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx):
            first, second = padded[ys + 2 + dy, xs + 2 + dx], padded[ys + 2 + 2 * dy, xs + 2 + 2 * dx]
            near = (np.abs(first - second) < limit).all(1)  # NaN is not near
            total[near] += 2 * first[near] - second[near]
            count += near
            neighbour = near & (source < 0)
            source[neighbour] = index[ys[neighbour] + dy, xs[neighbour] + dx]
        some = count >= 2
        uv[ys[some], xs[some]] = total[some] / count[some, None]
        index[ys[some], xs[some]] = source[some]
    return uv, index


def _creases(
    samples: Unwrapped, painted: np.ndarray, groups: list[tuple[np.ndarray, np.ndarray]], reach: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """(direction [3] between both faces, [S] bool samples up to `reach` from it) of outward edges between what views
    face, the longest first. painted: [S] bool; groups: of `_directions`."""
    directions = np.stack([direction for direction, _ in groups])
    face = np.where(painted, matmul(samples.normals, directions.T).argmax(1), -1)
    out = []
    for first in range(len(groups)):
        for second in range(first):
            # Faces that look nearly the same way, or opposite ways, share no edge that a view between them would see.
            if abs(dot(directions[first], directions[second])) > DECAL_VIEWS.max_crease_cosine:
                continue
            a, b = (np.flatnonzero(face == k) for k in (first, second))
            a, b = (
                a[_beside(samples.points[a], samples.points[b], reach)],
                b[_beside(samples.points[b], samples.points[a], reach)],
            )
            if not len(a) or not len(b):
                continue
            flat = [mean(matmul(samples.normals[ids], directions[k])) for ids, k in ((a, first), (b, second))]
            if min(flat) < DECAL_VIEWS.min_face_cosine:
                continue
            way = samples.points[b].mean(0) - samples.points[a].mean(0)
            if dot(way, directions[first]) > 0:  # an inward edge: both views see it well
                continue
            beside = np.zeros(len(face), bool)
            beside[a], beside[b] = True, True
            direction = directions[first] + directions[second]
            out.append((direction / length(direction), beside))
    return sorted(out, key=lambda crease: -int(crease[1].sum()))


def _beside(points: np.ndarray, neighbours: np.ndarray, reach: float) -> np.ndarray:
    """[P] bool: points [P, 3] in a cube with an edge of `reach` that holds one of `neighbours` [Q, 3], or in one beside
    it."""
    if not len(neighbours):
        return np.zeros(len(points), bool)
    corner = np.minimum(points.min(0), neighbours.min(0)) - 2 * reach if len(points) else neighbours.min(0)
    keys = []
    for values in (points, neighbours):
        x, y, z = ((values - corner) / reach).astype(np.int64).T
        keys.append((x << 42) | (y << 21) | z)
    # Keys of all 27 cubes around: an exact distance is not needed to find an edge's neighbours.
    steps = np.array([(x << 42) + (y << 21) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
    return np.isin(keys[0], distinct((keys[1][:, None] + steps).ravel()))


def _directions(ids: np.ndarray, normals: np.ndarray, limit: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """(direction [3], [M] int64 samples that face it) of at most `limit` cameras: each faces most of what those before
    do not. ids: [P] int64 samples; normals: [S, 3] of all."""
    out = []
    normals = normals[ids]
    left = np.ones(len(ids), bool)
    for _ in range(limit):
        if left.sum() <= max(DECAL_VIEWS.min_share * len(ids), 0) and out:
            break
        # The normal with most others around it, then their mean, a few times (mean shift).
        candidates = normals[left][:: max(int(left.sum()) // 256, 1)]
        direction = candidates[(matmul(normals[left], candidates.T) > DECAL_VIEWS.frontal_cosine).sum(0).argmax()]
        for _ in range(3):
            near = left & (matmul(normals, direction) > DECAL_VIEWS.frontal_cosine)
            direction = normals[near].mean(0)
            direction /= length(direction)
        near = left & (matmul(normals, direction) > DECAL_VIEWS.frontal_cosine)
        if not near.any():
            break
        out.append((direction, ids[near]))
        left &= ~near
    return out
