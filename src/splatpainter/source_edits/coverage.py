"""Which views show a surface, and which parts of it earlier views have reached: a plan of views, each of which shows
most of what none before it does, and the mask of what is left in one of them.

Knows the asset's geometry, which edits do not change, and no pictures: so a plan is made before anything is asked of a
source. Cosines of `facing` are between the line of sight and the surface's normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import field
from functools import cached_property

import numpy as np

from splatpainter.cameras import AUTO_UP, FRAME_MARGIN, UPS, Camera, bounding_sphere, spherical_cameras
from splatpainter.kernels.portable import dot, sin
from splatpainter.lift.masks import box_mean, dilated
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

CANDIDATE_VIEWS = 40
"""Views among which a plan chooses, evenly over all directions."""
CANDIDATE_PX = 96
"""Side of their pictures."""
CELLS_PER_RADIUS = 48
"""Cells along the asset's radius; the surface has one sample in each, and for each side."""
FACING_COSINES = (0.25881904510252074, 0.46947156278589086)
"""Cosines (of 75 and 62 degrees) from which a view reaches a surface, and from which fully; the mask is soft between
them."""
MAX_SLOPE = 5.0
"""Change of depth from one pixel to the next, in pixels' widths there, above which it breaks."""
MIN_STEP = 0.008
"""A break also is this part of the depth, at least: folds and the noise of captures are no edges."""
EDGE_PX = 1
"""Reach around such a break that is not painted, pixels."""
SMOOTHING_SHARE = 1 / 130
"""Reach of the mean over which the angle is taken, as a part of the view's longer side: captures' normals are rough."""
FRONTAL_COSINE = 0.7
"""Facing from which a view of a surface counts as good as any."""
USUAL_HEIGHTS, UNUSUAL_WEIGHT = (-0.1, 0.8), 0.7
"""Sines of the elevation between which things are usually looked at, and what views from elsewhere weigh beside them:
generators know less of those."""
MIN_GAIN = 0.005
"""Share of the surface that a further view must reach for the first time."""
MAX_DEPTH_DIFFERENCE = 0.015
"""Largest difference in depth between a point and the surface that a view shows in front of it, as a part of the depth;
more: it is hidden."""
MIN_SURFACE_ALPHA = 0.5
"""Alpha from which a pixel shows the surface."""
MIN_MASK_SHARE = 0.002
"""Share of the asset's pixels below which a mask is not worth a call."""
FOV = 40.0
"""Degrees, vertical, of the views of a plan."""
ViewShare = Callable[[Camera], np.ndarray]
"""Camera -> [H, W] 0..1: how much of each pixel may be painted (a selection)."""


@dataclass(frozen=True)
class SurfaceView:
    """What one camera sees of the surface."""

    camera: Camera
    depth: np.ndarray = field(repr=False)
    """[H, W] float32 z, 0 where nothing solid is."""
    normal: np.ndarray = field(repr=False)
    """[H, W, 3] float32 unit, world axes, towards the camera."""

    @staticmethod
    def of(splats: Splats, camera: Camera, normals: np.ndarray) -> SurfaceView:
        """normals: [N, 3] of `view_files.normals_of`."""
        from splatpainter.view_files import draw_passes

        passes = draw_passes(splats, camera, ("normal",), normals=normals)
        assert passes.normal is not None
        depth = np.where(passes.alpha > MIN_SURFACE_ALPHA, passes.depth, 0).astype(np.float32)
        towards = -(camera.rays()[1] * passes.normal).sum(-1, keepdims=True)
        return SurfaceView(camera, depth, np.where(towards < 0, -passes.normal, passes.normal))

    @property
    def points(self) -> np.ndarray:
        """[H, W, 3] world points; those without depth mean nothing."""
        return self.camera.unproject(np.where(self.depth > 0, self.depth, 1))

    @property
    def reached(self) -> np.ndarray:
        """[H, W] float32 0..1: how far this view may paint each pixel: less where it sees the surface from the side,
        and not beside an edge in depth."""
        farthest = self.depth > 0
        facing = np.where(farthest, -(self.camera.rays()[1] * self.normal).sum(-1), 0)
        reach = max(1, round(SMOOTHING_SHARE * max(self.depth.shape)))
        smooth = box_mean(facing, reach) / np.maximum(box_mean(farthest, reach), 1e-6)
        edge = dilated(self._steps, EDGE_PX)
        return np.where(farthest & ~edge, _ramp(smooth), 0).astype(np.float32)

    @cached_property
    def _farthest(self) -> np.ndarray:
        """[H, W] the largest depth within a pixel's reach: a surface seen from the side does not hide itself."""
        out = self.depth
        for axis in (0, 1):
            padded = np.pad(out, [(1, 1) if k == axis else (0, 0) for k in (0, 1)])
            parts = [np.take(padded, np.arange(k, k + out.shape[axis]), axis) for k in range(3)]
            out = np.maximum(np.maximum(parts[0], parts[1]), parts[2])
        return out

    @property
    def _steps(self) -> np.ndarray:
        """[H, W] bool: pixels beside which the depth breaks: by more than a plane seen at the limiting angle would."""
        limit = np.maximum(self.depth / self.camera.fx * MAX_SLOPE, MIN_STEP * self.depth)
        out = np.zeros(self.depth.shape, bool)
        for axis in (0, 1):
            step = np.abs(np.diff(self.depth, axis=axis))
            low = [slice(None), slice(None)]
            high = [slice(None), slice(None)]
            low[axis], high[axis] = slice(None, -1), slice(1, None)
            broken = step > np.minimum(limit[tuple(low)], limit[tuple(high)])
            out[tuple(low)] |= broken
            out[tuple(high)] |= broken
        return out

    def facing(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """[P] cosine at points [P, 3] of normals [P, 3] that this view sees, 0 for those that it does not."""
        pixels, z = self.camera.project(points)
        x, y = (np.floor(np.nan_to_num(pixels[:, k], nan=-1, posinf=-1, neginf=-1)).astype(int) for k in (0, 1))
        height, width = self.depth.shape
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (z > 0)
        covered = self._farthest[y.clip(0, height - 1), x.clip(0, width - 1)]
        visible = inside & (covered > 0) & (z - covered < MAX_DEPTH_DIFFERENCE * z)
        way = self.camera.position - points
        cosine = (way * normals).sum(1) / np.maximum(np.linalg.norm(way, axis=1), 1e-12)
        return np.where(visible, np.maximum(cosine, 0), 0)


def unreached(view: SurfaceView, earlier: Sequence[tuple[SurfaceView, np.ndarray]]) -> np.ndarray:
    """[H, W] float32 0..1: what of a view its own angle allows and no earlier view has painted, with soft edges.
    earlier: views and their masks [h, w]."""
    mask = view.reached
    covered = view.depth > 0
    points, normals = view.points[covered], view.normal[covered]
    # What an earlier view painted counts only where it looked at the surface frontally enough to be kept.
    painted = np.zeros(view.depth.shape, np.float32)
    for other, share in earlier:
        visible = other.facing(points, normals) > FACING_COSINES[0]
        pixels, _ = other.camera.project(points)
        painted[covered] = np.maximum(painted[covered], np.where(visible, _bilinear(share, pixels), 0))
    # Soft edges, so that two views of one place meet without a seam.
    painted = box_mean(painted, 1) / np.maximum(box_mean(covered, 1), 1e-6)
    return np.minimum(mask, np.clip(2 * (1 - painted), 0, 1)).astype(np.float32)


def worth_asking(mask: np.ndarray, view: SurfaceView) -> bool:
    """Whether enough of a view's pixels are left to paint."""
    return float((mask > 0.5).sum()) > MIN_MASK_SHARE * float((view.depth > 0).sum())


@dataclass(frozen=True)
class ViewPlan:
    """Views one after the other, and how much of the surface they reach."""

    cameras: tuple[Camera, ...]
    gains: tuple[float, ...]
    """Share of the visible surface that each is the first to reach."""

    @property
    def covered(self) -> float:
        """Share of the surface, as far as any direction shows it."""
        return sum(self.gains)


def plan_views(
    splats: Splats,
    *,
    size: int = 800,
    max_views: int = 8,
    first: Camera | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    up: str = "auto",
    allowed: ViewShare | None = None,
) -> ViewPlan:
    """Greedy: each view shows most of what none before it does, counted by how frontally it shows it, until another one
    would add less than MIN_GAIN. splats: numpy; size: pixels of the square views; first: a view to begin with; up: as
    in `orbit_cameras`; allowed: the surface that counts, None: all of it."""
    from splatpainter.view_files import normals_of

    # Candidates all around, small: only what they see of the surface matters, not how it looks.
    center, radius = bounding_sphere(splats)
    distance = FRAME_MARGIN * radius / sin(math.radians(FOV / 2))
    axis = UPS[AUTO_UP if up == "auto" else up]
    cameras = spherical_cameras(
        center, distance, CANDIDATE_VIEWS, size=CANDIDATE_PX, fov=FOV, up=axis, backgrounds=(background,)
    )
    cameras = [camera.local for camera in cameras]
    heights = np.array([dot(camera.position - center, np.asarray(axis, float)) / distance for camera in cameras])
    # Image models know objects as people photograph them: views from far above or below come last.
    preferred = np.where((heights > USUAL_HEIGHTS[0]) & (heights < USUAL_HEIGHTS[1]), 1, UNUSUAL_WEIGHT)
    if first is not None:
        scale = CANDIDATE_PX / max(first.width, first.height)
        small = max(1, round(first.width * scale)), max(1, round(first.height * scale))
        cameras, preferred = [first.resized(*small), *cameras], np.append(1, preferred)
    normals = normals_of(splats)
    views = [SurfaceView.of(splats, camera, normals) for camera in cameras]
    # Points of the surface, evenly: pixels would count what is near and frontal twice.
    points, sides = _samples(views, radius, allowed)
    facing = np.stack([view.facing(points, sides) for view in views])
    reach, value = _ramp(facing), np.minimum(facing / FRONTAL_COSINE, 1)
    visible = (facing > 0.05).any(0)
    total, unseen = max(int(visible.sum()), 1), visible.astype(np.float64)
    chosen: list[int] = []
    gains: list[float] = []
    # Greedy: a best set of views would be dearer to find than one view more is to ask for.
    while len(chosen) < max_views:
        if first is not None and not chosen:
            best = 0
        else:
            best = int((preferred * (value * reach * unseen).sum(1)).argmax())
        left = np.minimum(unseen, 1 - reach[best])
        gain = float((unseen - left).sum() / total)
        if gain < MIN_GAIN and chosen:
            break
        chosen.append(best)
        gains.append(gain)
        unseen = left
    # The user's own view stays as it was given, pixel for pixel.
    full = [first if first is not None and k == 0 else cameras[k].resized(size, size) for k in chosen]
    return ViewPlan(tuple(full), tuple(gains))


def _samples(views: Sequence[SurfaceView], radius: float, allowed: ViewShare | None) -> tuple[np.ndarray, np.ndarray]:
    """([P, 3] points, [P, 3] normals) of the surface: one for each small cell and side that a view sees."""
    usable = [view.depth > 0 if allowed is None else (view.depth > 0) & (allowed(view.camera) > 0.5) for view in views]
    points = np.concatenate([view.points[part] for view, part in zip(views, usable, strict=True)])
    normals = np.concatenate([view.normal[part] for view, part in zip(views, usable, strict=True)])
    if not len(points):
        return np.zeros((0, 3)), np.zeros((0, 3))
    # One sample for each cell and side: a thin wall has two.
    cells = np.floor(points * (CELLS_PER_RADIUS / radius)).astype(np.int64)
    side = 2 * np.abs(normals).argmax(1) + (
        np.take_along_axis(normals, np.abs(normals).argmax(1)[:, None], 1)[:, 0] > 0
    )
    keys = np.vstack([cells.T, side])
    order = np.lexsort(keys[::-1])  # np.unique of rows takes three times as long
    new = np.append(True, (np.diff(keys[:, order]) != 0).any(0))
    first = order[new]
    return points[first], normals[first]


def _ramp(facing: np.ndarray) -> np.ndarray:
    low, high = FACING_COSINES
    return np.clip((facing - low) / (high - low), 0, 1)


def _bilinear(values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """[P] of a map [h, w] at pixel positions [P, 2] (centres at + 0.5); the borders go on."""
    height, width = values.shape
    x = np.clip(np.nan_to_num(pixels[:, 0]) - 0.5, 0, width - 1)
    y = np.clip(np.nan_to_num(pixels[:, 1]) - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), max(width - 2, 0)), np.minimum(y.astype(int), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = x - left, y - top
    upper = values[top, left] * (1 - fx) + values[top, right] * fx
    lower = values[bottom, left] * (1 - fx) + values[bottom, right] * fx
    return upper * (1 - fy) + lower * fy
