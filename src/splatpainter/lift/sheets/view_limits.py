"""What one view may paint: surfaces that it sees too much from the side, or across an edge in depth, it cannot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.cameras import Camera
from splatpainter.kernels import portable
from splatpainter.lift.masks import dilated
from splatpainter.lift.options import MAX_DEPTH_EDGE_LIMIT_PX
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import VisibleSurface, visible_surface
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import row_norm


@dataclass(frozen=True)
class ViewLimitThresholds:
    """What fades at a view's limits. Source: taste."""

    soft_degrees: float = 10.0
    """Degrees from the angle limit on, over which paint fades."""
    edge_windows: float = 1.5
    """A step in depth between neighbouring pixels by more than this, in windows of the surface, is an edge."""
    coarse_blocks: int = 128
    """Blocks along the longer side of a view for which `left_out` says whether they are painted."""
    min_share: float = 0.5
    """Share of its paint below which a block counts as left out."""


VIEW_LIMITS = ViewLimitThresholds()


def coarse_surface(surface: Surface, splats: Splats, camera: Camera) -> VisibleSurface:
    """All that a view sees, on a lattice of at most VIEW_LIMITS.coarse_blocks blocks a side: quick, and enough to show
    limits by. Its camera has one pixel per block, and the full camera's pixels are `blocks_px` times smaller."""
    view = project(splats, camera)
    size = blocks_px(camera)
    centers = np.zeros((camera.height, camera.width), bool)
    centers[size // 2 :: size, size // 2 :: size] = True
    visible = visible_surface(surface, splats, view, centers, size)
    height, width = visible.index.shape
    lens = {name: getattr(camera, name) / size for name in ("fx", "fy", "cx", "cy")}
    return replace(visible, camera=replace(camera, width=width, height=height, **lens), step=1)


def blocks_px(camera: Camera) -> int:
    """Pixels along a side of the blocks of `coarse_surface`."""
    return -(-max(camera.width, camera.height) // VIEW_LIMITS.coarse_blocks)


def left_out(coarse: VisibleSurface, camera: Camera, angle_limit: float, depth_edge_limit: float) -> Bools:
    """[H, W] bool: pixels of a view whose paint the limits leave out (by more than half), to about a block. coarse: of
    `coarse_surface`, for this camera; limits: as `paintable`'s."""
    size = blocks_px(camera)
    seen = coarse.index >= 0
    out = seen & (paintable(coarse, seen, angle_limit, depth_edge_limit / size) < VIEW_LIMITS.min_share)
    return out.repeat(size, 0).repeat(size, 1)[: camera.height, : camera.width]


def paintable(visible: VisibleSurface, pixels: Bools, angle_limit: float, depth_edge_limit: float) -> Floats:
    """[H, W] float32 0..1: how much of a pixel's paint this view lays down.

    pixels: [H, W] bool, those that are asked for (others are 0). angle_limit: degrees between line of sight and normal
    from which paint fades, over VIEW_LIMITS.soft_degrees; 0: no limit. depth_edge_limit: pixels beside an edge in depth
    that are left out, fading over as many again; 0: none. Where the surface is not trusted there is nothing to limit
    by: 1."""
    out = pixels.astype(np.float32)
    ids = np.flatnonzero(pixels)
    centers, at = np.stack(np.divmod(ids, pixels.shape[1])[::-1], 1) + 0.5, visible.at_centers(ids)
    seen = at.depth > 0
    if angle_limit > 0:
        rays = visible.camera.sight_lines(centers)
        facing = -(rays * at.normals).sum(1) / row_norm(rays)
        angle = np.degrees(portable.arccos(np.clip(facing, 0, 1)))
        # The fade has to end at 90 degrees, also for a limit close to it.
        soft = min(VIEW_LIMITS.soft_degrees, max(90.0 - angle_limit, 1e-3))
        share = np.clip(1 - (angle - angle_limit) / soft, 0, 1)
        out.ravel()[ids] *= np.where(seen, share, 1).astype(np.float32)
    if depth_edge_limit > 0:
        distance = _distance_to_edges(pixels, at.depth, at.windows)
        share = np.clip(distance / depth_edge_limit - 1, 0, 1)
        out *= np.where(np.isfinite(distance), share, 1).astype(np.float32)
    return out


def _distance_to_edges(pixels: np.ndarray, depth: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """[H, W] pixels (chessboard distance, up to a bound; inf beyond) to the nearest pixel pair whose depths break."""
    full = np.zeros(pixels.shape)
    window = np.zeros(pixels.shape)
    full[pixels], window[pixels] = depth, windows
    edge = np.zeros(pixels.shape, bool)
    for axis in (0, 1):
        low = [slice(None), slice(None)]
        high = [slice(None), slice(None)]
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        a, b = full[tuple(low)], full[tuple(high)]
        limit = VIEW_LIMITS.edge_windows * np.maximum(window[tuple(low)], window[tuple(high)])
        # A plane that is seen from the side is steep, not broken: what counts is the step against the slope beside it.
        step = np.abs(b - a)
        slope = np.zeros_like(step)
        inner = [slice(None), slice(None)]
        inner[axis] = slice(1, -1)
        before, after = [slice(None), slice(None)], [slice(None), slice(None)]
        before[axis], after[axis] = slice(None, -2), slice(2, None)
        slope[tuple(inner)] = np.minimum(step[tuple(before)], step[tuple(after)])
        broken = (a > 0) & (b > 0) & (step - slope > limit)
        edge[tuple(low)] |= broken
        edge[tuple(high)] |= broken
    out = np.full(pixels.shape, math.inf)
    if not edge.any():
        return out
    # Distances by growing the edge pixel by pixel: the largest limit is 16 px, so few rounds are needed.
    reached = edge
    out[edge] = 0.5
    for distance in range(1, 2 * int(MAX_DEPTH_EDGE_LIMIT_PX) + 1):
        grown = dilated(reached, 1)
        out[grown & ~reached] = distance + 0.5
        reached = grown
    return out
