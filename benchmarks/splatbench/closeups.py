"""A close-up of an asset, chosen by rule: where a person would paint. Knows no paint and no lift.

The asset is drawn small from twelve sides at two heights. Its *front* is the side on which its upper part (things stand
on pedestals, tables and lawns) shows most contrast and is brightest: what matters is what people carve, print and
light. In the pictures of that side and its two neighbours, square windows of a few sizes are rated by contrast, number
of Gaussians, height, and how squarely the surface faces the camera; the camera moves up to the best ones along the same
line of sight, and the view with the best rating times the fourth power of its filled part is taken. Nothing is random:
the same asset gives the same view.

A grazing close-up, where edits are hardest, is one of these windows with the camera walked around it until most of the
surface in the picture's middle is seen at 60 to 75 degrees from its normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from splatpainter.cameras import Camera, look_at, orbit
from splatpainter.splats import Splats

OVERVIEW_PX = 160
"""Pixels of the small pictures."""
FOV = 40.0
"""Vertical field of view, degrees, of the small pictures and of the close-up."""
AZIMUTHS = 12
ELEVATIONS = (5.0, 25.0)
WINDOW_SIDES = (0.16, 0.2, 0.25, 0.3)
"""Sides of the windows, in edges of the asset's bounding cube."""
UPPER_PART_HEIGHT = 0.12
"""What counts as the upper part: above the bounding cube's middle by this share of its edge."""
WINDOWS_PER_SIDE = 8
"""Windows of each size that are tried as close-ups."""
GRAZING_DEGREES = (60.0, 75.0)
"""Degrees between line of sight and normal of what a grazing close-up shows: from, to."""
GRAZING_TURNS = (15.0, 30.0, 45.0, 60.0, 75.0)
"""Degrees by which the camera walks around a window, to either side, in looking for a grazing one."""
GRAZING_WINDOWS = 3
"""Windows of each size that are tried so."""
MIN_GRAZING_FILLED = 0.5
"""Part of a grazing close-up's middle that is surface."""
MIN_GRAZING_CORE = 0.25
"""Part of the middle of that which is seen at GRAZING_DEGREES."""
MAX_TARGET_OFFSET = 0.1
"""Largest difference between the depth of a window's middle and that of the surface that is seen there, of that
depth."""
DEPTH_MEDIAN_PX = 5
"""Takes single Gaussians out of the depth from which normals are read."""
ANGLE_MARGIN_PX = 4
"""Margin around pixels whose angles are asked for: their own do not depend on what is beyond."""


@dataclass(frozen=True)
class Closeup:
    """A view, and what is needed to walk around its target."""

    camera: Camera
    target: np.ndarray
    """[3] the surface point in the middle of the picture, world units."""
    up: np.ndarray
    """[3] unit vector that points up in the picture."""
    filled: float
    """Part of the picture that the surface covers, 0..1."""
    front_turn: float = -1.0
    """Sign of the azimuth in which the surface turns to the camera; -1, left, where it faces it already."""

    def turned(self, azimuth: float, elevation: float = 0.0) -> Camera:
        """The target seen from another side at the same distance; degrees about and above it."""
        eye = self.camera.position - self.target
        side = np.cross(self.up, eye)
        side /= np.linalg.norm(side)
        rise = Rotation.from_rotvec(-math.radians(elevation) * side)
        eye = (Rotation.from_rotvec(math.radians(azimuth) * self.up) * rise).apply(eye)
        return _aimed(self.target + eye, self.target, self.up, self.camera.width, self.camera.background)


def closeup(splats: Splats, size: int = 512, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Closeup:
    """The best-rated close-up, size x size pixels. Raises ValueError when no part of the asset is opaque enough to
    paint on."""
    axis = default_up(splats)
    best, best_rating = None, 0.0
    for window in _best_windows(splats, axis, WINDOWS_PER_SIDE):
        camera = _aimed(window.target + window.eye, window.target, axis, OVERVIEW_PX, background)
        filled = _filled(splats, camera)
        rating = window.score * filled**4
        if rating > best_rating:
            best, best_rating = Closeup(camera.resized(size, size), window.target, axis, filled), rating
    if best is not None:
        return best
    raise ValueError("closeup: found no part of the asset that fills a view; it is too small or too transparent")


def grazing_closeup(
    splats: Splats, size: int = 512, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Closeup:
    """The close-up whose middle shows most surface at GRAZING_DEGREES, by the same windows as `closeup`; arguments as
    there. Raises ValueError when no view shows enough of it so."""
    axis = default_up(splats)
    best, best_rating = None, 0.0
    for window in _best_windows(splats, axis, GRAZING_WINDOWS):
        start = Closeup(
            _aimed(window.target + window.eye, window.target, axis, OVERVIEW_PX, background), window.target, axis, 1.0
        )
        for turn in (sign * degrees for degrees in GRAZING_TURNS for sign in (-1, 1)):
            camera = start.turned(turn)
            filled, grazing, core = _grazing_shares(splats, camera, window.target)
            rating = window.score * (grazing * core) ** 2 if core >= MIN_GRAZING_CORE else 0.0
            if filled >= MIN_GRAZING_FILLED and rating > best_rating:
                best_rating = rating
                best = Closeup(camera.resized(size, size), window.target, axis, filled, -float(np.sign(turn)))
    if best is not None:
        return best
    raise ValueError("closeup: no view shows enough of the asset at a grazing angle")


@dataclass(frozen=True)
class ViewAngles:
    """How a view sees the surface, H x W pixels: all of a picture, or its middle."""

    degrees: np.ndarray
    """[H, W] between the line of sight and the normal, from smoothed depth."""
    valid: np.ndarray
    """[H, W] bool: opaque, with opaque neighbours."""
    depth: np.ndarray
    """[H, W] smoothed z-depth, world units."""

    @staticmethod
    def of(splats: Splats, camera: Camera, rim: int = 0) -> ViewAngles:
        """rim: pixels at every side of the picture that are left out, and not drawn; of the rest, the outermost
        ANGLE_MARGIN_PX know one side only."""
        from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask

        inner = camera.cropped(rim, rim, camera.width - 2 * rim, camera.height - 2 * rim)
        rows, columns = slice(rim, rim + inner.height), slice(rim, rim + inner.width)
        drawn = np.zeros((camera.height, camera.width), bool)
        drawn[rows, columns] = True
        _, alpha, expected = project(splats, camera, tiles=tiles_of_mask(drawn)).rasterize()
        alpha, expected = alpha[rows, columns], expected[rows, columns]
        depth = ndimage.median_filter(expected, DEPTH_MEDIAN_PX, mode="nearest")
        points = inner.unproject(depth)
        normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        sight = points - camera.position
        sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-12)
        degrees = np.degrees(np.arccos(np.clip(np.abs((normals * sight).sum(-1)), 0, 1)))
        return ViewAngles(degrees, ndimage.minimum_filter(alpha > 0.9, 3), depth)


def _grazing_shares(splats: Splats, camera: Camera, target: np.ndarray) -> tuple[float, float, float]:
    """(part of the picture's middle half, each way, that is surface; part of it, and of its own middle half, seen at
    GRAZING_DEGREES); zeros where something hides the target [3], the middle of the picture."""
    half, quarter = camera.height // 2, camera.height // 4
    rim = max(quarter - ANGLE_MARGIN_PX, 0)
    angles = ViewAngles.of(splats, camera, rim)
    if abs(angles.depth[half - rim, half - rim] / camera.to_camera(target)[2] - 1) > MAX_TARGET_OFFSET:
        return 0.0, 0.0, 0.0
    middle = (slice(quarter - rim, camera.height - quarter - rim),) * 2
    core = (slice(half - quarter // 2 - rim, half + quarter // 2 - rim),) * 2
    low, high = GRAZING_DEGREES
    grazing = angles.valid & (angles.degrees >= low) & (angles.degrees <= high)
    return float(angles.valid[middle].mean()), float(grazing[middle].mean()), float(grazing[core].mean())


def _best_windows(splats: Splats, axis: np.ndarray, count: int) -> list[_Window]:
    """`count` of each size, best first, of the asset's front and the two sides beside it."""
    ring = [_Overview(splats, camera, axis) for camera in _ring(splats, axis, ELEVATIONS[0])]
    front = int(np.argmax([overview.richness for overview in ring]))
    near = [(front + step) % AZIMUTHS for step in (0, 1, -1)]
    high = _ring(splats, axis, ELEVATIONS[1])
    chosen = [ring[k] for k in near] + [_Overview(splats, high[k], axis) for k in near]
    best = []
    for part in WINDOW_SIDES:  # some of each size: the largest would crowd out what fits a narrow asset
        windows = [window for overview in chosen for window in overview.windows(part)]
        best += sorted(windows, key=lambda window: -window.score)[:count]
    return best


def default_up(splats: Splats) -> np.ndarray:
    """[3] what is up where nobody says: -y for assets from files (every reader turns them into the axes of PLY
    captures), +y for those that come from no file."""
    return np.array([0.0, 1.0 if splats.source is None else -1.0, 0.0])


@dataclass(frozen=True)
class _Window:
    """A square of an overview. Most are only rated: where it is in the world costs more than all of its rating."""

    score: float
    overview: _Overview
    row: int
    column: int
    side: int
    """Pixels."""
    reach: float
    """Distance from the target to the camera, world units."""

    @cached_property
    def target(self) -> np.ndarray:
        """[3] the middle of what it shows, world units."""
        rows, columns = (slice(start, start + self.side) for start in (self.row, self.column))
        return np.median(self.overview.points[rows, columns].reshape(-1, 3), 0)

    @cached_property
    def eye(self) -> np.ndarray:
        """[3] from the target to the camera, world units."""
        away = self.overview.camera.position - self.target
        return away / np.linalg.norm(away) * self.reach


class _Overview:
    """One small picture of the whole asset."""

    def __init__(self, splats: Splats, camera: Camera, up: np.ndarray) -> None:
        from splatpainter.rendering.cpu.projected_view import project
        from splatpainter.voxels.grid import bounding_cube

        self.camera = camera
        low, self.edge = bounding_cube(splats)
        self.projected = project(splats, camera)
        self.image, self.alpha, self.depth = self.projected.rasterize()
        self.points = camera.unproject(self.depth)  # [H, W, 3] world
        self.height = (self.points - low - self.edge / 2) @ up / self.edge  # [H, W], 0 in the cube's middle
        solid = self.alpha > 0.95
        inner = solid & np.roll(solid, 1, 0) & np.roll(solid, -1, 0) & np.roll(solid, 1, 1) & np.roll(solid, -1, 1)
        down, across = np.gradient(self.image.mean(-1))
        self.contrast = np.where(inner, np.hypot(down, across), 0)  # silhouettes do not count
        self.inner = inner

    @property
    def richness(self) -> float:
        """How much like a front this side is."""
        upper = self.inner & (self.height > UPPER_PART_HEIGHT)
        return float(self.contrast[upper].sum() * self.image[upper].mean()) if upper.any() else 0.0

    @cached_property
    def centers(self) -> np.ndarray:
        """[H, W] centres of Gaussians that are not hidden, per pixel."""
        sums = self.projected.backproject(self.image, np.ones_like(self.alpha))
        visible = sums.weight > 0.25 * sums.alpha
        x, y = np.clip(self.projected.means2d[visible].astype(int), 0, OVERVIEW_PX - 1).T
        counts = np.zeros((OVERVIEW_PX, OVERVIEW_PX))
        np.add.at(counts, (y, x), 1)
        return counts

    def windows(self, part: float) -> list[_Window]:
        """Windows that the surface fills. part: their side, in edges of the cube."""
        if not self.inner.any():
            return []
        scale = self.camera.fy / float(np.median(self.depth[self.inner]))  # pixels per world unit
        side = max(round(part * self.edge * scale), 4)
        if side > OVERVIEW_PX:
            return []
        covered, centers, contrast, height, depth = (
            _means(values, side) for values in (self.alpha > 0.9, self.centers, self.contrast, self.height, self.depth)
        )
        relief = np.sqrt(np.maximum(_means(self.depth**2, side) - depth**2, 0)) * scale / side  # of the side
        level = np.clip(4 * height, 0.01, 1)
        score = part * np.sqrt(centers * contrast) * level * np.exp(-((relief / 0.5) ** 2))
        reach = part * self.edge / (2 * math.tan(math.radians(FOV / 2)))
        step, out = max(side // 6, 1), []
        for y, x in np.argwhere(covered[::step, ::step] > 0.9) * step:
            out.append(_Window(float(score[y, x]), self, y, x, side, reach))
        return out


def _ring(splats: Splats, up: np.ndarray, elevation: float) -> list[Camera]:
    from splatpainter.voxels.grid import bounding_cube

    low, edge = bounding_cube(splats)
    radius = 0.75 * edge / math.tan(math.radians(FOV / 2))
    settings = {"elevation": elevation, "up": up, "width": OVERVIEW_PX, "height": OVERVIEW_PX, "fov": FOV}
    return orbit(low + edge / 2, radius, AZIMUTHS, **settings)


def _means(values: np.ndarray, side: int) -> np.ndarray:
    """[H - side + 1, W - side + 1] mean of every side x side window."""
    sums = np.pad(values.astype(np.float64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    return (sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]) / side**2


def _filled(splats: Splats, camera: Camera) -> float:
    from splatpainter.rendering.cpu.projected_view import project

    return float((project(splats, camera).rasterize()[1] > 0.9).mean())


def _aimed(eye: np.ndarray, target: np.ndarray, up: np.ndarray, size: int, background: tuple) -> Camera:
    return look_at(eye, target, up, width=size, height=size, fov=FOV, background=background)
