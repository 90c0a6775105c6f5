"""The surface under a decal: cameras look for what was not seen well yet, and what they see is unwrapped."""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.decals.decal_fusion import fused_surface
from splatpainter.decals.decal_surface import (
    DECAL_SURFACE,
    SurfacePixels,
    facing_camera,
    lies_outdoors,
    surface_pixels,
)
from splatpainter.kernels.portable import cos, dot, hypot, length, matmul, sin
from splatpainter.lift.masks import dilated
from splatpainter.painter import Asset
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.surface.estimate import Surface
from splatpainter.surface.unwrap import NEIGHBOUR_SPACINGS, Unwrapped, smoothed, thinned, unwrap
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.neighbours import joined_labels, near_pairs


@dataclass(frozen=True)
class SurveyThresholds:
    """Where surface is looked for, what of it counts. Source: taste, tried on boxes, cylinders, rims and captures."""

    max_rough: float = 0.1
    """Share of the samples that are rough, from which all are smoothed: smoothed ones beside others would lie on two
    layers."""
    smoothed_voxels: float = 4.0
    """Radius within which what views see of rough surface is moved onto the fused one, voxels."""
    same_side: float = 0.3
    """Cosine between the normals of the first point and of the fused surface there, at least."""
    smoothed_spacings: float = 5.0
    """Radius of the smoothing of samples, in spacings of samples."""
    smoothed_size: float = 0.06
    """The least of that radius, in diagonals of the decal."""
    smoothing_rounds: int = 2
    """Rounds of smoothing of the samples."""
    min_outline_share: float = 0.05
    """Share of the pixels around one that show the same surface, up to which it is a speck."""
    max_outline_share: float = 0.85
    """The same, up to which it lies at an outline."""
    inward_sine: float = 0.5
    """Sine of the angle by which these pixels lie above its tangent plane, times their share, from which its normal is
    wrong."""
    fused_radius_diagonals: float = 0.54
    """Radius of the ball in which views of rough surface are fused, in diagonals of the decal."""
    sheet_spacings: float = 8.0
    """Distance from which samples that face opposite ways lie on two sheets of surface, in spacings: backs of walls are
    12 to 17 away; at 3, bars of a grate lost places to each other."""
    max_crumb: float = 0.05
    """Largest share of a decal of a piece of it that is left out, where nothing joins it to the middle. On captures
    such pieces held 0.035 (a helmet beside a hip) and 0.03 (the underside of ground); a finger beside a gap holds
    more."""
    joined_stretch: float = 1.5
    """Way along the picture over the straight line from which two samples side by side are not joined; a crease of 90
    degrees has 1.41."""
    joined_spacings: float = 0.3
    """The same, besides, in spacings: places of samples are means of several ways."""
    joined_cosine: float = -0.5
    """Least cosine between their normals: that of neighbours on whose way the picture goes on (surface/unwrap.py)."""
    max_samples: int = 60_000
    """Most samples of one decal; from which on no further view is surveyed."""
    strip_margin: float = 0.35
    """How far beyond its rectangle's side a turned decal may wind around something, in lengths of the other side."""
    max_surveys: int = 10
    """Cameras that look for the surface under a decal."""
    pixels_per_spacing: float = 1.4
    """Resolution of these cameras, where they face the surface."""
    min_facing_cosine: float = 0.5299192642332049
    """Of 58 degrees: the cosine between the normal and the line of sight below which a sample should be seen from
    elsewhere."""
    lean_radians: float = np.radians(50.0)
    """Angle by which a camera leans outwards over a rim, to see how the surface goes on behind it."""
    min_rim_length: float = 0.22
    """Length of `Unwrapped.rims` from which a sample is at a rim."""
    min_camera_cosine: float = 0.766044443118978
    """Of 40 degrees: the cosine between the direction in which a sample asks for a camera and that of one, from which
    it has got it."""
    min_served_cosine: float = 0.8191520442889918
    """Of 35 degrees: the cosine between that direction and a camera's from which it serves the sample."""
    min_open: float = 0.25
    """Samples of a decal that must ask for a camera, over those along its shorter side: a word that goes on around an
    edge asks along a line."""
    min_resumed: float = 0.25
    """Share of the samples for which a camera was placed that it must see, or it stands on the other side of a wall."""
    resumed_spacings: float = 3.0
    """Difference in depth, in spacings, up to which it sees one."""


SURVEY = SurveyThresholds()


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
    lines: np.ndarray = field(repr=False)
    """[S, 3] unit directions from which they were seen."""
    outdoors: bool
    """Whether it is seen from a place that is open: from no hollow of the asset, and in no room."""


def survey(
    asset: Asset,
    surface: Surface,
    start: tuple[np.ndarray, np.ndarray],
    up: np.ndarray,
    size: tuple[float, float],
    spacing: float,
    max_turn: float,
    seen_from: np.ndarray,
) -> UnwrappedPatch:
    """The surface under a decal: seen by a camera that faces its start (point, normal), then by others that face what
    those before saw at a grazing angle, or that look over a rim; rough surface is fused out of views from all around.
    up: [3] of the decal; size: (width, height), world units; max_turn: wrap limit, radians; seen_from: [3] unit, a
    direction from which the start is seen."""
    # Start with the point that was clicked; every round adds what one more camera sees.
    radius, half = 0.5 * float(hypot(*size)), (size[0] / 2, size[1] / 2)
    smoothing = max(SURVEY.smoothed_spacings * spacing, SURVEY.smoothed_size * 2 * radius)
    pixel, outdoors = spacing / SURVEY.pixels_per_spacing, lies_outdoors(asset, start[0], seen_from)
    samples_so_far = (start[0][None], start[1][None], np.zeros((1, 3)), np.zeros(1, bool))
    directions: list[np.ndarray] = []
    direction, requesting = start[1], np.zeros(0, np.int64)
    while True:
        # From behind the start one looks past it: nearer to it is within what it is the surface of.
        camera = facing_camera(
            asset,
            start[0],
            direction,
            up,
            radius * 1.08,
            pixel,
            outdoors=outdoors,
            nearer=dot(direction, start[1]) > 0,
            seen_from=None if directions else seen_from,
        )
        sight = _Sight.of(asset, surface, camera, samples_so_far, start, up, size, spacing)
        # A view that shows nothing of what asked for it shows another side of a wall, or another body.
        points, normals, _, _ = samples_so_far
        resumed = not directions or (
            _share_seen(camera, sight.depth, points[requesting], normals[requesting], spacing) > SURVEY.min_resumed
        )
        # The first look decides: on fog one fused surface serves all views.
        if not directions and len(sight.seen.ys) and sight.seen.rough.mean() > SURVEY.max_rough:
            patch = _fused_patch(asset, surface, start, up, size, max_turn, seen_from)
            if patch is not None:
                return patch
        # No point farther than the decal's half diagonal can be under it.
        near = ((sight.seen.points - start[0]) ** 2).sum(1) < (1.06 * radius) ** 2
        near &= resumed & ~_facing_inwards(sight.seen, sight.depth.shape, 4 * spacing)
        samples_so_far = _joined(samples_so_far, sight.seen, near, camera, spacing)
        # Unwrapped on smoothed samples where they scatter, as they are elsewhere.
        points, normals, lines, rough = samples_so_far
        scatters = rough.mean() > SURVEY.max_rough
        for _ in range(SURVEY.smoothing_rounds if scatters else 0):
            points, normals = smoothed((points, normals), (points, normals), smoothing)
        samples = unwrap(points, normals, up, spacing, half, max_turn)
        within = samples.reached & (matmul(samples.normals, normals[0]) >= cos(min(max_turn, np.pi)) - 1e-9)
        under = within & (np.abs(samples.uv) < half).all(1)
        directions.append(direction)
        # Where to look next.
        leaning, asking = _requests(samples, under, (lines * samples_so_far[1]).sum(1), directions)
        if asking.sum() <= max(SURVEY.min_open * min(size) / spacing, 3):
            break
        if len(directions) == SURVEY.max_surveys or len(samples_so_far[0]) > SURVEY.max_samples:
            break
        direction, requesting = _next_direction(leaning, np.flatnonzero(asking))
    lines[0] = seen_from
    left_out = crumbs(samples, within, under)
    samples, within, under = samples.without(left_out), within & ~left_out, under & ~left_out
    return UnwrappedPatch(samples, within, under, smoothing if scatters else 0.0, lines, outdoors)


@dataclass(frozen=True)
class _Sight:
    """What one camera sees that no earlier one saw frontally."""

    seen: SurfacePixels
    depth: np.ndarray
    """[H, W] z."""

    @staticmethod
    def of(
        asset: Asset,
        surface: Surface,
        camera: Camera,
        samples_so_far: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        start: tuple[np.ndarray, np.ndarray],
        up: np.ndarray,
        size: tuple[float, float],
        spacing: float,
    ) -> _Sight:
        """samples_so_far: samples so far, as of `_joined`; start, up, size: of the decal."""
        points, normals, lines, _ = samples_so_far
        view = project(asset.splats, camera)
        _, alpha, depth = view.rasterize()
        # Most pixels are known after two views.
        frontal = (lines * normals).sum(1) > SURVEY.min_facing_cosine
        frontal_pixels = _surveyed(camera, depth, points[frontal], normals[frontal], spacing)
        requested = (alpha > DECAL_SURFACE.min_alpha) & ~frontal_pixels
        ys, xs = np.nonzero(requested)
        requested[ys, xs] = _near_strip(camera.unproject(depth[ys, xs], np.stack([xs, ys], 1) + 0.5), start, up, size)
        return _Sight(surface_pixels(asset, surface, view, requested, depth), depth)


def _requests(
    samples: Unwrapped, under: np.ndarray, facing: np.ndarray, directions: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """([S, 3] unit directions from which samples want to be seen: frontally, at a rim leaning over it to see what goes
    on behind it; [S] bool those that ask for a camera). under: [S] bool; facing: [S] cosine at which each was seen;
    directions: of the cameras so far."""
    rim = np.linalg.norm(samples.rims, axis=1)
    at_rim = under & (rim > SURVEY.min_rim_length)
    outwards = samples.rims / np.maximum(rim, 1e-9)[:, None]
    over_rim = cos(SURVEY.lean_radians) * samples.normals - sin(SURVEY.lean_radians) * outwards
    leaning = np.where(at_rim[:, None], over_rim, samples.normals)
    asking = under & (at_rim | (facing < SURVEY.min_facing_cosine))
    asking &= matmul(leaning, np.stack(directions, 1)).max(1) < SURVEY.min_camera_cosine
    asking[0] = False
    return leaning, asking


def _next_direction(leaning: np.ndarray, asking: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(the direction [3] unit that serves most of the samples `asking` ([A] indices of `leaning`, [S, 3] unit), in the
    mean of what these want; [W] their indices)."""
    requests = leaning[asking]
    candidates = requests[:: max(len(requests) // 200, 1)]
    votes = matmul(requests, candidates.T) > SURVEY.min_served_cosine
    winner = votes[:, votes.sum(0).argmax()]
    direction = requests[winner].mean(0)
    return direction / length(direction), asking[winner]


def _fused_patch(
    asset: Asset,
    surface: Surface,
    start: tuple[np.ndarray, np.ndarray],
    up: np.ndarray,
    size: tuple[float, float],
    max_turn: float,
    seen_from: np.ndarray,
) -> UnwrappedPatch | None:
    """`survey` on rough surface: one made of all views (`fused_surface`); None where there is none at the start."""
    radius = SURVEY.fused_radius_diagonals * float(hypot(*size))
    outdoors = lies_outdoors(asset, start[0], seen_from)

    def facing(direction: np.ndarray, pixel: float) -> Camera:
        return facing_camera(asset, start[0], direction, up, radius * 1.08, pixel, outdoors=outdoors)

    points, normals, voxel = fused_surface(asset.splats, surface, start, up, radius, facing)
    # The fused surface has to pass by the start, facing the same way.
    away = np.where(matmul(normals, start[1]) > SURVEY.same_side, np.linalg.norm(points - start[0], axis=1), np.inf)
    if not len(away) or away.min() > SURVEY.smoothed_voxels * voxel:
        return None
    order = np.concatenate([[away.argmin()], np.delete(np.arange(len(points)), away.argmin())])
    order = order[thinned(points[order], normals[order], voxel)]
    half = (size[0] / 2, size[1] / 2)
    samples = unwrap(points[order], normals[order], up, voxel, half, max_turn)
    within = samples.reached & (matmul(samples.normals, samples.normals[0]) >= cos(min(max_turn, np.pi)) - 1e-9)
    within &= ~laid_twice(samples)
    under = within & (np.abs(samples.uv) < half).all(1)
    left_out = crumbs(samples, within, under)
    samples, within, under = samples.without(left_out), within & ~left_out, under & ~left_out
    lines = np.broadcast_to(seen_from, samples.points.shape)
    return UnwrappedPatch(samples, within, under, SURVEY.smoothed_voxels * voxel, lines, outdoors)


def crumbs(samples: Unwrapped, within: np.ndarray, under: np.ndarray) -> np.ndarray:
    """[S] bool samples of small pieces of the decal that do not hang together with its middle: on another body that
    comes near, or on fog, which the way around led to along a strand of samples. Large pieces stay: the other side of a
    gap. within, under: [S] bool as of UnwrappedPatch."""
    ids = np.flatnonzero(within)
    one, two = near_pairs(samples.points[ids], NEIGHBOUR_SPACINGS * samples.spacing)
    # Side by side in space and in the picture: else a fold of it comes by.
    straight = np.linalg.norm(samples.points[ids[one]] - samples.points[ids[two]], axis=1)
    way = np.linalg.norm(samples.uv[ids[one]] - samples.uv[ids[two]], axis=1)
    joined = way < SURVEY.joined_stretch * straight + SURVEY.joined_spacings * samples.spacing
    joined &= (samples.normals[ids[one]] * samples.normals[ids[two]]).sum(1) > SURVEY.joined_cosine
    labels = joined_labels(len(ids), one[joined], two[joined])
    small = np.bincount(labels, under[ids], len(ids))[labels] < SURVEY.max_crumb * under.sum()
    middle = np.flatnonzero(ids == 0)
    if len(middle):
        small &= labels != labels[middle[0]]
    out = np.zeros(len(within), bool)
    out[ids] = small
    return out


def laid_twice(samples: Unwrapped) -> np.ndarray:
    """[S] bool samples that hold a place of the picture which one of another sheet of surface, that faces the other
    way, holds by a shorter way: around a burr of fog ways lead to the back of a wall, which shows the picture again."""
    twice = np.zeros(len(samples.points), bool)
    reached = np.flatnonzero(samples.reached)
    # The nearest sample of every cell of the picture holds it.
    cell = np.floor(samples.uv[reached] / samples.spacing).astype(np.int64)
    cell -= cell.min(0) - 1
    columns, rows = cell.max(0) + 2
    holder = np.full((columns, rows), -1)
    farthest_first = np.argsort(-samples.distances[reached], kind="stable")
    holder[tuple(cell[farthest_first].T)] = reached[farthest_first]
    for step in np.ndindex(3, 3):
        other = holder[tuple((cell + step - 1).T)]
        away = np.linalg.norm(samples.points[reached] - samples.points[other], axis=1)
        opposite = (samples.normals[reached] * samples.normals[other]).sum(1) < 0
        second = samples.distances[other] < samples.distances[reached]
        twice[reached] |= (other >= 0) & second & opposite & (away > SURVEY.sheet_spacings * samples.spacing)
    return twice


def _facing_inwards(seen: SurfacePixels, shape: tuple[int, int], reach: float) -> np.ndarray:
    """[Q] bool specks, and pixels at an outline of a picture [H, W] whose normal leads into it: that of a face behind
    the outline, turned to the camera. reach: world units up to which neighbours belong together."""
    rows, columns = seen.ys + DECAL_SURFACE.max_fit_px, seen.xs + DECAL_SURFACE.max_fit_px
    # Cheap first: only pixels near an outline are looked at closely.
    share = share_near(
        seen.points,
        rows,
        columns,
        (shape[0] + 2 * DECAL_SURFACE.max_fit_px, shape[1] + 2 * DECAL_SURFACE.max_fit_px),
        reach,
    )
    outline = np.flatnonzero((share >= SURVEY.min_outline_share) & (share < SURVEY.max_outline_share))
    index = np.full((shape[0] + 2 * DECAL_SURFACE.max_fit_px, shape[1] + 2 * DECAL_SURFACE.max_fit_px), -1)
    index[rows, columns] = np.arange(len(rows))
    total = np.zeros((len(outline), 3))
    for dy, dx in np.ndindex(2 * DECAL_SURFACE.max_fit_px + 1, 2 * DECAL_SURFACE.max_fit_px + 1):
        other = index[seen.ys[outline] + dy, seen.xs[outline] + dx]
        way = seen.points[other] - seen.points[outline]
        near = (other >= 0) & ((way**2).sum(1) < reach**2)
        total += np.where(near[:, None], way, 0)
    inwards = share < SURVEY.min_outline_share  # specks
    inwards[outline] = (total * seen.normals[outline]).sum(1) > SURVEY.inward_sine * np.linalg.norm(total, axis=1)
    return inwards


def share_near(
    points: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], reach: float
) -> np.ndarray:
    """[Q] share of the pixels up to DECAL_SURFACE.max_fit_px away, itself too, with points nearer than `reach`. points:
    [Q, 3] at rows and columns ([Q], so far from the edges) of a picture [H, W]."""
    planes = np.full((3, *shape), np.nan)
    planes[:, rows, columns] = points.T
    count = np.ones(shape, np.uint8)
    for dy in range(DECAL_SURFACE.max_fit_px + 1):
        for dx in range(-DECAL_SURFACE.max_fit_px if dy else 1, DECAL_SURFACE.max_fit_px + 1):  # each pair once
            first = slice(0, shape[0] - dy), slice(max(-dx, 0), shape[1] - max(dx, 0))
            second = slice(dy, None), slice(max(dx, 0), shape[1] - max(-dx, 0))
            x, y, z = (plane[first] - plane[second] for plane in planes)
            near = x * x + y * y + z * z < reach**2
            count[first] += near
            count[second] += near
    return count[rows, columns] / (2 * DECAL_SURFACE.max_fit_px + 1) ** 2


def _joined(
    samples: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    seen: SurfacePixels,
    near: np.ndarray,
    camera: Camera,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Samples (points [S, 3], normals [S, 3], [S, 3] unit lines to the cameras that saw them, [S] bool rough) and those
    that another camera sees near the decal (near: [Q] bool of `seen`), no nearer to each other than the spacing. The
    first one stays the first."""
    points, normals, lines, rough = samples
    new, facing, new_rough = seen.points[near], seen.normals[near], seen.rough[near]
    line = camera.position - new
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    # Grazing points are rough: leave them to another camera.
    good = (line * facing).sum(1) > 0.17
    points, normals = np.concatenate([points, new[good]]), np.concatenate([normals, facing[good]])
    lines, rough = np.concatenate([lines, line[good]]), np.concatenate([rough, new_rough[good]])
    frontal = (lines[1:] * normals[1:]).sum(1) > SURVEY.min_facing_cosine
    order = np.concatenate([[0], 1 + np.argsort(-frontal.astype(int), kind="stable")])
    order = order[thinned(points[order], normals[order], spacing)]
    return points[order], normals[order], lines[order], rough[order]


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


def _share_seen(camera: Camera, depth: np.ndarray, points: np.ndarray, normals: np.ndarray, spacing: float) -> float:
    """Share of some samples ([K, 3] points and normals) that a camera sees, by its rendered depth [H, W]."""
    uv, z = camera.project(points)
    seen = ((camera.position - points) * normals).sum(1) > 0
    seen &= (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    x, y = uv[seen].astype(int).T
    seen[seen] = np.abs(depth[y, x] - z[seen]) < SURVEY.resumed_spacings * spacing
    return float(seen.mean()) if len(seen) else 0.0


def _near_strip(
    points: np.ndarray, start: tuple[np.ndarray, np.ndarray], up: np.ndarray, size: tuple[float, float]
) -> np.ndarray:
    """[K] bool whether points ([K, 3]) may lie under a decal of a size (width, height) around a start (point, normal):
    no point is farther along a direction than the way along the surface is, and no way is longer than its sides."""
    right = np.cross(up, start[1])
    right /= length(right)
    way = points - start[0]
    u, v = np.abs(matmul(way, right)), np.abs(matmul(way, np.cross(start[1], right)))
    width, height = size
    along, across = 0.5 * width + SURVEY.strip_margin * height, 0.5 * height + SURVEY.strip_margin * width
    return (u < along) & (v < across) & ((way**2).sum(1) < 0.4 * (width**2 + height**2))
