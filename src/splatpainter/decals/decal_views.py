"""Where to stand around a patch of surface: cameras that face it, what they see of it, and which sees what best.

Used by decals, which are laid over more of a surface than one camera sees.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.decals.decal_fusion import fused_surface
from splatpainter.decals.decal_surface import (
    MAX_FIT_PX,
    MIN_ALPHA,
    SIZES_AWAY,
    SurfacePixels,
    depth_pixels,
    facing_camera,
    surface_pixels,
)
from splatpainter.lift.masks import dilated
from splatpainter.lift.sheets.near_surface import NearSurface
from splatpainter.lift.sheets.resurface import clear_pixels
from splatpainter.painter import Asset
from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask
from splatpainter.surface.estimate import Surface
from splatpainter.surface.unwrap import Unwrapped, smoothed, thinned, unwrap
from splatpainter.voxels.raycast import inside

MAX_ROUGH = 0.1
"""Share of the samples that are rough, from which all are smoothed: smoothed ones beside others would lie on two
layers."""
SMOOTHED_VOXELS = 4.0
"""Radius within which what views see of rough surface is moved onto the fused one, voxels, ..."""
RAY_ROUNDS = 2
"""... as often, each time back onto its line of sight: all views find the same letters at the same place."""
MIN_SLOPE = 0.2
"""Cosine of the angle at which a line of sight must meet the surface for that."""
SAME_SIDE = 0.3
"""Cosine between the normals of the first point and of the fused surface there, at least."""
SMOOTHED_SPACINGS = 5.0
"""Radius of this smoothing, in spacings of samples, ..."""
SMOOTHED_SIZE = 0.06
"""... and in diagonals of the decal, at least."""
SMOOTHING_ROUNDS = 2
"""Rounds of smoothing of the samples."""
MIN_OUTLINE_SHARE, MAX_OUTLINE_SHARE = 0.05, 0.85
"""Share of the pixels around one that show the same surface: up to the first it is a speck, up to the second it lies
at an outline, ..."""
INWARD_SINE = 0.5
"""... and of the sine of the angle by which these lie above its tangent plane, from which its normal is wrong."""
FUSED_RADIUS_DIAGONALS = 0.54
"""Radius of the ball in which views of rough surface are fused, in diagonals of the decal."""
MAX_SAMPLES = 60_000
"""Most samples of one decal; from which on no further view is surveyed."""
STRIP_MARGIN = 0.35
"""How far beyond its rectangle's side a turned decal may wind around something, in lengths of the other side."""
MIN_RIM_ALPHA = 0.15
"""Alpha of a pixel from which a decal is continued over an outline, so that the Gaussians there are painted."""
FILL_PX = 3
"""How far, ..."""
RIM_SLOPE = 4.0
"""... and how steeply the surface may fall away there: depth over width."""
MAX_SURVEYS = 10
"""Cameras that look for the surface under a decal."""
PIXELS_PER_SPACING = 1.4
"""Resolution of these cameras, where they face the surface."""
MIN_FACING_COSINE = np.cos(np.radians(58.0))
"""Cosine between the normal and the line of sight below which a sample should be seen from elsewhere."""
LEAN_RADIANS = np.radians(50.0)
"""Angle by which a camera leans outwards over a rim, to see how the surface goes on behind it."""
MIN_RIM_LENGTH = 0.22
"""Length of `Unwrapped.rims` from which a sample is at a rim."""
MIN_CAMERA_COSINE = np.cos(np.radians(40.0))
"""Cosine between the direction in which a sample asks for a camera and that of one, from which it has got it."""
MIN_OPEN = 0.25
"""Samples of a decal that must ask for a camera, over those along its shorter side: a word that goes on around an edge
asks along a line."""
FRONTAL_COSINE = np.cos(np.radians(42.0))
"""Cosine between normal and line of sight from which a view counts as frontal."""
SIDE_TURN = np.radians(38.0)
"""Angle to both sides of a view that paints fog: more cameras that paint the same part."""
MIN_CLEAR = 0.25
"""Share of the pixels of a view that show Gaussians on the surface, below which it paints fog, as on rough surface."""
CREASE_PX = 10
"""Width to both sides of an edge between faces, pixels of the decal that a view from between them paints: for those
that face them the edge is an outline, and what they see there of the other face they would spoil."""
MAX_CREASE_COSINE = 0.64
"""Cosine between the directions of two views for an edge between what they face; less its negative: a rim."""
MIN_FACE_COSINE = 0.85
"""Mean, over what lies beside the edge, of the cosine between normals and the direction of the view that faces it:
round surfaces have no edge."""
OVERLAP_PX = 3
"""Pixels by which the parts of neighbouring views overlap."""
MARGIN_PX = 24
"""Pixels around the part that a view paints."""
MAX_PART_SHARE = 0.35
"""Largest share of its picture that a view paints: an edit of 0.4 of a picture is taken for a zoom-in (lift/edits.py),
which has no sheets."""
MIN_SHARE = 0.01
"""Least share of a patch: what a view must show best, to be one of those that paint it."""


@dataclass(frozen=True)
class UnwrappedPatch:
    """The surface under a decal, unwrapped."""

    samples: Unwrapped
    within: np.ndarray = field(repr=False)
    """[S] bool samples within the wrap limit, reached."""
    under: np.ndarray = field(repr=False)
    """[S] bool ... and under the decal's rectangle."""
    smoothing: float
    """Radius within which the samples were smoothed, world units; 0: not."""


def survey(
    asset: Asset,
    surface: Surface,
    start: tuple[np.ndarray, np.ndarray],
    up: np.ndarray,
    size: tuple[float, float],
    spacing: float,
    max_turn: float,
) -> UnwrappedPatch:
    """The surface under a decal: seen by a camera that faces its start (point, normal), then by others that face what
    those before saw at a grazing angle, or that look over a rim; rough surface is fused out of views from all around.
    up: [3] of the decal; size: (width, height), world
    units; max_turn: wrap limit, radians."""
    radius = 0.5 * float(np.hypot(*size))
    smoothing = max(SMOOTHED_SPACINGS * spacing, SMOOTHED_SIZE * 2 * radius)
    points, normals, rough = start[0][None], start[1][None], np.zeros(1, bool)
    half = (size[0] / 2, size[1] / 2)
    directions: list[np.ndarray] = []
    best = np.zeros(1)
    target, direction = start
    while True:
        # From behind the start one looks past it: nearer to it is within what it is the surface of.
        nearer = bool(direction @ start[1] > 0)
        camera = facing_camera(asset, target, direction, up, radius * 1.08, spacing / PIXELS_PER_SPACING, nearer=nearer)
        view = project(asset.splats, camera)
        _, alpha, depth = view.rasterize()
        frontal = best > MIN_FACING_COSINE
        requested = (alpha > MIN_ALPHA) & ~_surveyed(camera, depth, points[frontal], normals[frontal], spacing)
        ys, xs = np.nonzero(requested)
        requested[ys, xs] = _near_strip(camera.unproject(depth[ys, xs], np.stack([xs, ys], 1) + 0.5), start, up, size)
        seen = surface_pixels(asset, surface, view, requested, depth)
        if not directions and len(seen.ys) and seen.rough.mean() > MAX_ROUGH:
            patch = _fused_patch(asset, surface, start, up, size, max_turn)
            if patch is not None:
                return patch
        near = ((seen.points - start[0]) ** 2).sum(1) < (1.06 * radius) ** 2
        near &= ~_facing_inwards(seen, alpha.shape, 4 * spacing)
        points, normals, best, rough = _joined((points, normals, best, rough), seen, near, camera, spacing)
        even, turned = points, normals
        scatters = rough.mean() > MAX_ROUGH
        for _ in range(SMOOTHING_ROUNDS if scatters else 0):
            even, turned = smoothed((even, turned), (even, turned), smoothing)
        samples = unwrap(even, turned, up, spacing, half, max_turn)
        within = samples.reached & (samples.normals @ turned[0] >= np.cos(min(max_turn, np.pi)) - 1e-9)
        under = within & (np.abs(samples.uv) < half).all(1)
        directions.append(direction)
        rim = np.linalg.norm(samples.rims, axis=1)
        at_rim = under & (rim > MIN_RIM_LENGTH)
        leaning = np.where(
            at_rim[:, None],
            np.cos(LEAN_RADIANS) * turned - np.sin(LEAN_RADIANS) * samples.rims / np.maximum(rim, 1e-9)[:, None],
            turned,
        )
        asking = under & (at_rim | (best < MIN_FACING_COSINE))
        asking &= (leaning @ np.stack(directions, 1)).max(1) < MIN_CAMERA_COSINE
        asking[0] = False
        if asking.sum() <= max(MIN_OPEN * min(size) / spacing, 3):
            break
        if len(directions) == MAX_SURVEYS or len(points) > MAX_SAMPLES:
            break
        view_requests = leaning[asking]
        candidates = view_requests[:: max(len(view_requests) // 200, 1)]
        votes = view_requests @ candidates.T > np.cos(np.radians(35.0))
        winner = votes[:, votes.sum(0).argmax()]
        direction = view_requests[winner].mean(0)
        direction /= np.linalg.norm(direction)
        target = start[0]
    return UnwrappedPatch(samples, within, under, smoothing if scatters else 0.0)


def _fused_patch(
    asset: Asset,
    surface: Surface,
    start: tuple[np.ndarray, np.ndarray],
    up: np.ndarray,
    size: tuple[float, float],
    max_turn: float,
) -> UnwrappedPatch | None:
    """`survey` on rough surface: one made of all views (`fused_surface`); None where there is none at the start."""
    radius = FUSED_RADIUS_DIAGONALS * float(np.hypot(*size))

    def facing(direction: np.ndarray, pixel: float) -> Camera:
        return facing_camera(asset, start[0], direction, up, radius * 1.08, pixel)

    points, normals, voxel = fused_surface(asset.splats, surface, start, up, radius, facing)
    away = np.where(normals @ start[1] > SAME_SIDE, np.linalg.norm(points - start[0], axis=1), np.inf)
    if not len(away) or away.min() > SMOOTHED_VOXELS * voxel:
        return None
    order = np.concatenate([[away.argmin()], np.delete(np.arange(len(points)), away.argmin())])
    order = order[thinned(points[order], normals[order], voxel)]
    half = (size[0] / 2, size[1] / 2)
    samples = unwrap(points[order], normals[order], up, voxel, half, max_turn)
    within = samples.reached & (samples.normals @ samples.normals[0] >= np.cos(min(max_turn, np.pi)) - 1e-9)
    under = within & (np.abs(samples.uv) < half).all(1)
    return UnwrappedPatch(samples, within, under, SMOOTHED_VOXELS * voxel)


def _facing_inwards(seen: SurfacePixels, shape: tuple[int, int], reach: float) -> np.ndarray:
    """[Q] bool specks, and pixels at an outline of a picture [H, W] whose normal leads into it: that of a face behind
    the outline, turned to the camera. reach: world units up to which neighbours belong together."""
    rows, columns = seen.ys + MAX_FIT_PX, seen.xs + MAX_FIT_PX
    share = _share_near(seen.points, rows, columns, (shape[0] + 2 * MAX_FIT_PX, shape[1] + 2 * MAX_FIT_PX), reach)
    outline = np.flatnonzero((share >= MIN_OUTLINE_SHARE) & (share < MAX_OUTLINE_SHARE))
    index = np.full((shape[0] + 2 * MAX_FIT_PX, shape[1] + 2 * MAX_FIT_PX), -1)
    index[rows, columns] = np.arange(len(rows))
    total = np.zeros((len(outline), 3))
    for dy, dx in np.ndindex(2 * MAX_FIT_PX + 1, 2 * MAX_FIT_PX + 1):
        other = index[seen.ys[outline] + dy, seen.xs[outline] + dx]
        way = seen.points[other] - seen.points[outline]
        near = (other >= 0) & ((way**2).sum(1) < reach**2)
        total += np.where(near[:, None], way, 0)
    inwards = share < MIN_OUTLINE_SHARE  # specks
    inwards[outline] = (total * seen.normals[outline]).sum(1) > INWARD_SINE * np.linalg.norm(total, axis=1)
    return inwards


def _share_near(
    points: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], reach: float
) -> np.ndarray:
    """[Q] share of the pixels up to MAX_FIT_PX away, itself too, with points nearer than `reach`. points: [Q, 3] at
    rows and columns ([Q], so far from the edges) of a picture [H, W]."""
    planes = np.full((3, *shape), np.nan)
    planes[:, rows, columns] = points.T
    count = np.ones(shape, np.uint8)
    for dy in range(MAX_FIT_PX + 1):
        for dx in range(-MAX_FIT_PX if dy else 1, MAX_FIT_PX + 1):  # each pair once
            first = slice(0, shape[0] - dy), slice(max(-dx, 0), shape[1] - max(dx, 0))
            second = slice(dy, None), slice(max(dx, 0), shape[1] - max(-dx, 0))
            x, y, z = (plane[first] - plane[second] for plane in planes)
            near = x * x + y * y + z * z < reach**2
            count[first] += near
            count[second] += near
    return count[rows, columns] / (2 * MAX_FIT_PX + 1) ** 2


def _joined(
    samples: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    seen: SurfacePixels,
    near: np.ndarray,
    camera: Camera,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Samples (points [S, 3], normals [S, 3], [S] cosines towards the cameras that saw them, [S] bool rough) and those
    that another camera sees near the decal (near: [Q] bool of `seen`), no nearer to each other than the spacing. The
    first one stays the first."""
    points, normals, best, rough = samples
    new, facing, new_rough = seen.points[near], seen.normals[near], seen.rough[near]
    line = camera.position - new
    cosine = (line * facing).sum(1) / np.linalg.norm(line, axis=1)
    # Grazing points are rough: leave them to another camera.
    good = cosine > 0.17
    points, normals = np.concatenate([points, new[good]]), np.concatenate([normals, facing[good]])
    best, rough = np.concatenate([best, cosine[good]]), np.concatenate([rough, new_rough[good]])
    order = np.concatenate([[0], 1 + np.argsort(-(best[1:] > MIN_FACING_COSINE).astype(int), kind="stable")])
    order = order[thinned(points[order], normals[order], spacing)]
    return points[order], normals[order], best[order], rough[order]


def _surveyed(camera: Camera, depth: np.ndarray, points: np.ndarray, normals: np.ndarray, spacing: float) -> np.ndarray:
    """[H, W] bool pixels of a view that show samples ([K, 3] points and normals), by its rendered depth [H, W]."""
    out = np.zeros(depth.shape, bool)
    uv, z = camera.project(points)
    line = camera.position - points
    faces = (line * normals).sum(1) > 0.35 * np.linalg.norm(line, axis=1)
    faces &= (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    x, y = uv[faces].astype(int).T
    same = np.abs(depth[y, x] - z[faces]) < 4 * spacing
    out[y[same], x[same]] = True
    return dilated(out, 1)


def _near_strip(
    points: np.ndarray, start: tuple[np.ndarray, np.ndarray], up: np.ndarray, size: tuple[float, float]
) -> np.ndarray:
    """[K] bool whether points ([K, 3]) may lie under a decal of a size (width, height) around a start (point, normal):
    no point is farther along a direction than the way along the surface is, and no way is longer than its sides."""
    right = np.cross(up, start[1])
    right /= np.linalg.norm(right)
    way = points - start[0]
    u, v = np.abs(way @ right), np.abs(way @ np.cross(start[1], right))
    width, height = size
    along, across = 0.5 * width + STRIP_MARGIN * height, 0.5 * height + STRIP_MARGIN * width
    return (u < along) & (v < across) & ((way**2).sum(1) < 0.4 * (width**2 + height**2))


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
    groups = _directions(samples.points[painted], samples.normals[painted], limit)
    creases = [] if patch.smoothing else _creases(samples, painted, groups, max(CREASE_PX * pixel, samples.spacing))
    faces = len(groups)
    groups += [(direction, samples.points[beside]) for direction, beside in creases[: limit - faces]]
    for direction, members in groups:
        views.append(_view(asset, surface, patch, painted, direction, members, up, pixel))
    for view, (_, beside) in zip(views[faces:], creases, strict=False):
        view.cosines[:] = np.where(beside & (view.cosines > 0), 2, 0)  # there before all others, and nowhere else
    free = [not inside(asset.grid, asset.grid.occupancy, view.camera.position) for view in views]
    if not any(free):
        raise ValueError("decal: no camera that faces it stands free of the asset; choose another pixel")
    views = [view for view, f in zip(views, free, strict=True) if f]
    groups = [group for group, f in zip(groups, free, strict=True) if f]
    cosines = np.stack([view.cosines for view in views])
    keep = np.ones(len(views), bool)
    while True:  # the smallest goes while it is hardly needed
        owners = np.where(keep[:, None], cosines, -1).argmax(0)
        seen = cosines[keep].max(0) > 0
        shares = np.bincount(owners[seen & painted], minlength=len(views)) / max((seen & painted).sum(), 1)
        small = np.flatnonzero(keep & (shares < MIN_SHARE))
        if not len(small) or keep.sum() == 1:
            break
        keep[small[shares[small].argmin()]] = False
    parts = [view.part(owners == k, patch) for k, view in enumerate(views) if keep[k]]
    # What shows at an angle in fog are often other Gaussians: paint those, too, and before, as the latest view wins.
    sides: list[FacedPart] = []
    for k in np.flatnonzero(keep)[np.argsort(-shares[keep], kind="stable")]:
        if not patch.smoothing and not views[k].foggy(painted & (owners == k)):
            continue
        direction, members = groups[k]
        for turn in (-SIDE_TURN, SIDE_TURN):
            if len(parts) + len(sides) >= limit:
                break
            side = np.cross(up, direction)
            turned = np.cos(turn) * direction + np.sin(turn) * side / np.linalg.norm(side)
            view = _view(asset, surface, patch, painted, turned, members, up, pixel)
            if not inside(asset.grid, asset.grid.occupancy, view.camera.position):
                sides.append(view.part(owners == k, patch))
    return sides + parts


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

    def foggy(self, chosen: np.ndarray) -> bool:
        """Whether most of the pixels of some samples ([S] bool) are not clear."""
        at = chosen[self.nearest]
        return bool(at.any()) and self.clear[self.ys[at], self.xs[at]].mean() < MIN_CLEAR

    def part(self, owned: np.ndarray, patch: UnwrappedPatch) -> FacedPart:
        """owned: [S] bool samples that this view paints."""
        picture = np.zeros(self.before.shape[:2], bool)
        at = owned[self.nearest]
        picture[self.ys[at], self.xs[at]] = True
        picture = dilated(picture, OVERLAP_PX)
        chosen = picture[self.ys, self.xs] & patch.within[self.nearest]
        ys, xs = self.ys[chosen], self.xs[chosen]
        height, width = picture.shape
        if not len(ys):
            return FacedPart(self.camera, self.before, self.alpha, ys, xs, self.uv[chosen])
        margin = MARGIN_PX
        extent = np.array([np.ptp(ys) + 1, np.ptp(xs) + 1])
        while len(ys) > MAX_PART_SHARE * np.prod(extent + 2 * margin):
            margin += MARGIN_PX // 2
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
    """The patch from a direction, in a picture with room for some of its points ([M, 3])."""
    middle = (np.quantile(members, 0.02, 0) + np.quantile(members, 0.98, 0)) / 2
    target = members[np.linalg.norm(members - middle, axis=1).argmin()]
    radius = float(np.quantile(np.linalg.norm(members - target, axis=1), 0.995)) + MARGIN_PX * pixel
    camera = facing_camera(asset, target, direction, up, radius, pixel)
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
    region = np.zeros((camera.height, camera.width), bool)
    inside_picture = (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    x, y = uv[inside_picture].astype(int).T
    region[y, x] = True
    if pixel is None:
        pixel = float(np.median(z[z > 0])) / camera.fx if (z > 0).any() else 1.0
    reach = int(np.ceil(2.5 * samples.spacing / pixel * SIZES_AWAY / (SIZES_AWAY - 0.5)))
    tiles = tiles_of_mask(dilated(region, reach + MARGIN_PX))
    region = dilated(region, reach)
    view = project(asset.splats, camera, tiles=tiles)
    before, alpha, depth = view.rasterize()
    drawn = region & (alpha > MIN_ALPHA)
    seen = depth_pixels(camera, drawn, depth) if patch.smoothing else surface_pixels(asset, surface, view, drawn, depth)
    points, normals = seen.points, seen.normals
    if patch.smoothing:
        reached = samples.reached
        even = (samples.points[reached], samples.normals[reached])
        for _ in range(RAY_ROUNDS):
            points, normals = smoothed(even, (points, normals), patch.smoothing)
            points = _on_rays(camera.position, seen.points, points, normals, 2 * patch.smoothing)
        points, normals = smoothed(even, (points, normals), patch.smoothing)
    clear = np.zeros(region.shape, bool)
    if seen.visible is not None and len(seen.ys):
        drawn[:] = False
        drawn[seen.ys, seen.xs] = True
        clear, _ = clear_pixels(asset.splats, view, NearSurface.of(seen.visible, drawn), drawn)
    coordinates, nearest = samples.at(points, normals)
    uv = np.full((*region.shape, 2), np.nan)
    index = np.full(region.shape, -1, np.int64)
    uv[seen.ys, seen.xs], index[seen.ys, seen.xs] = coordinates, nearest
    visible = np.zeros(len(samples.points), bool)
    visible[nearest[nearest >= 0]] = True
    mapped = uv[..., 0].copy()
    uv, index = _filled(uv, index, region & (alpha > MIN_RIM_ALPHA), 4 * pixel)
    # Over an outline it goes on only where nothing else stands behind: there the paint would land.
    ys, xs = np.nonzero(index >= 0)
    behind = np.abs(camera.project(samples.points[index[ys, xs]])[1] - depth[ys, xs])
    beyond = np.isnan(mapped[ys, xs]) & (behind > 3 * samples.spacing + RIM_SLOPE * FILL_PX * pixel)
    ys, xs = ys[~beyond], xs[~beyond]
    line = camera.position - samples.points
    cosine = (line * samples.normals).sum(1) / np.linalg.norm(line, axis=1)
    cosine = np.where(visible, np.maximum(cosine, 1e-3), 0)
    return PatchView(camera, before, alpha, ys, xs, uv[ys, xs], index[ys, xs], cosine, clear)


def _on_rays(
    position: np.ndarray, seen: np.ndarray, points: np.ndarray, normals: np.ndarray, limit: float
) -> np.ndarray:
    """[Q, 3] where lines of sight from a position [3] through points `seen` [Q, 3] meet the planes through `points`
    with `normals`; these points where that is far away (limit: world units) or the plane is seen from its edge."""
    ray = seen - position
    slope = (ray * normals).sum(1)
    frontal = slope < -MIN_SLOPE * np.linalg.norm(ray, axis=1)
    length = ((points - position) * normals).sum(1) / np.where(frontal, slope, -1.0)
    moved = position + length[:, None] * ray
    near = np.linalg.norm(moved - seen, axis=1) < limit
    return np.where((frontal & near)[:, None], moved, points)


def _filled(uv: np.ndarray, index: np.ndarray, region: np.ndarray, limit: float) -> tuple[np.ndarray, np.ndarray]:
    """uv [H, W, 2] and sample [H, W], continued linearly up to FILL_PX into pixels of `region` without them: creases,
    outlines and specks of surface that is not trusted. limit: largest step per pixel, world units."""
    uv, index = uv.copy(), index.copy()
    for _ in range(FILL_PX):
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
    face = np.where(painted, (samples.normals @ directions.T).argmax(1), -1)
    out = []
    for first in range(len(groups)):
        for second in range(first):
            if abs(directions[first] @ directions[second]) > MAX_CREASE_COSINE:
                continue
            a, b = (np.flatnonzero(face == k) for k in (first, second))
            a, b = (
                a[_beside(samples.points[a], samples.points[b], reach)],
                b[_beside(samples.points[b], samples.points[a], reach)],
            )
            if not len(a) or not len(b):
                continue
            flat = [(samples.normals[ids] @ directions[k]).mean() for ids, k in ((a, first), (b, second))]
            if min(flat) < MIN_FACE_COSINE:
                continue
            way = samples.points[b].mean(0) - samples.points[a].mean(0)
            if way @ directions[first] > 0:  # an inward edge: both views see it well
                continue
            beside = np.zeros(len(face), bool)
            beside[a], beside[b] = True, True
            direction = directions[first] + directions[second]
            out.append((direction / np.linalg.norm(direction), beside))
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
    steps = np.array([(x << 42) + (y << 21) + z for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
    return np.isin(keys[0], np.unique(keys[1][:, None] + steps))


def _directions(points: np.ndarray, normals: np.ndarray, limit: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """(direction [3], points [M, 3] that face it) of at most `limit` cameras: each faces most of what those before do
    not. points, normals: [S, 3]."""
    out = []
    left = np.ones(len(points), bool)
    for _ in range(limit):
        if left.sum() <= max(MIN_SHARE * len(points), 0) and out:
            break
        candidates = normals[left][:: max(int(left.sum()) // 256, 1)]
        direction = candidates[(normals[left] @ candidates.T > FRONTAL_COSINE).sum(0).argmax()]
        for _ in range(3):
            near = left & (normals @ direction > FRONTAL_COSINE)
            direction = normals[near].mean(0)
            direction /= np.linalg.norm(direction)
        near = left & (normals @ direction > FRONTAL_COSINE)
        if not near.any():
            break
        out.append((direction, points[near]))
        left &= ~near
    return out
