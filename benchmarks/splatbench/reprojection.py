"""Paint that was put on one view, as other views should show it: moved through the depth of the surface. Knows no lift.

No other picture of the edited asset exists, so this is the nearest to a truth: good where the surface is opaque and
smooth, and undecided (left out of both scores) near silhouettes and near the paint's own edge. On thick,
half-transparent rows there is no one depth: there the score under the paint compares methods and is no quality of its
own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.splats import Splats

AGREE = 0.02
"""Largest difference between the depth of a point and the depth that the painted view shows there, of that depth."""
DOUBT = 0.06
"""The surface may be this part of its depth nearer or farther than its rows say: no pixel that paint reaches then is
called clean. Paint that smears farther than that is found."""
SLICES = 16
"""Slices of rows by depth in which the surface is looked for."""
SMOOTHING = 5
"""Edge of the median window that takes single rows out of the depth, pixels."""
RIM = 6
"""Pixels around the paint that belong to neither score."""


@dataclass(frozen=True)
class Expected:
    """What a view should show of the paint."""

    layer: np.ndarray
    """[H, W, 4] the paint, as in paint.py."""
    painted: np.ndarray
    """[H, W] bool: pixels that the paint surely covers (coverage above a half all around, surface in plain view)."""
    clean: np.ndarray
    """[H, W] bool: pixels that no paint can reach."""


def surface_depth(splats: Splats, camera: Camera) -> np.ndarray:
    """[H, W] z-depth at which half of a pixel's colour is reached, 0 where the asset covers less than half of it.

    Not the expected depth: some per cent of the wall behind shine through and pull the mean (on the demo asset the
    score under the paint was 17 dB with it and 27 dB with this, of one and the same edit). Per pixel the rows are
    summed in SLICES of equal total weight; the depth is the mean of the rows in the slice with the median."""
    from splatpainter.rendering.cpu.projected_view import project

    frame = project(splats, replace(camera, background=(0.0, 0.0, 0.0)))
    shape = (camera.height, camera.width)
    weight = frame.backproject(np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32)).weight
    share = np.cumsum(weight) / max(float(weight.sum()), 1e-9)  # the frame's rows come front to back
    slices = np.minimum((share * SLICES).astype(int), SLICES - 1)
    alpha = frame.rasterize()[1]
    depth, reached = np.zeros(shape), np.zeros(shape)
    for k in range(SLICES):
        here = (slices == k).astype(np.float32)
        sums = frame.rasterize(np.stack([here, here * frame.depths, here], 1))[0]
        crossed = (reached <= alpha / 2) & (reached + sums[..., 0] > alpha / 2)
        depth = np.where(crossed, sums[..., 1] / np.maximum(sums[..., 0], 1e-9), depth)
        reached += sums[..., 0]
    padded = np.pad(depth, SMOOTHING // 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (SMOOTHING, SMOOTHING))
    return np.where(alpha > 0.5, np.median(windows, axis=(2, 3)), 0)


def reproject(layer: np.ndarray, camera: Camera, depth: np.ndarray, view: Camera, seen: np.ndarray) -> Expected:
    """layer: [H, W, 4] over the picture of `camera`, whose `surface_depth` is `depth` [H, W]; seen: that of `view`."""
    spots = _Spots(camera, view)
    u, v, z = spots.at(seen)
    inside = (seen > 0) & (z > 0)
    sampled = _bilinear(np.concatenate([layer, depth[..., None]], -1), u, v)
    near = inside & (np.abs(sampled[..., 4] - z) < AGREE * z)
    paint = sampled[..., :4] * np.where(near, 1.0, 0.0)[..., None]
    maybe = np.zeros(seen.shape, bool)
    for factor in 1 + DOUBT * np.linspace(-1, 1, 9):
        u, v, z = spots.at(factor * seen)
        maybe |= inside & (_bilinear(layer[..., 3:], u, v)[..., 0] > 0)
    return Expected(paint.astype(np.float32), _shrunk(paint[..., 3] > 0.5, 1), ~_grown(maybe, RIM))


class _Spots:
    """Where the pixels of one view lie in the picture of another camera."""

    def __init__(self, camera: Camera, view: Camera) -> None:
        x, y = np.meshgrid(np.arange(view.width) + 0.5 - view.cx, np.arange(view.height) + 0.5 - view.cy)
        self.rays = np.stack([x / view.fx, y / view.fy, np.ones_like(x)], -1)  # [H, W, 3], z = 1
        self.matrix = camera.world_to_camera @ np.linalg.inv(view.world_to_camera)
        self.camera = camera

    def at(self, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(u, v, z-depth) [H, W] of the view's pixels if the surface is at `depth` [H, W]; far outside if behind."""
        there = (self.rays * depth[..., None]) @ self.matrix[:3, :3].T + self.matrix[:3, 3]
        z = np.maximum(there[..., 2], 1e-9)
        camera = self.camera
        return camera.fx * there[..., 0] / z + camera.cx, camera.fy * there[..., 1] / z + camera.cy, there[..., 2]


def _bilinear(values: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[H, W, C] values at pixel positions (centres at +0.5); 0 outside the picture."""
    height, width = values.shape[:2]
    x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    upper = values[top, left] * (1 - fx) + values[top, left + 1] * fx
    lower = values[top + 1, left] * (1 - fx) + values[top + 1, left + 1] * fx
    inside = (u > 0) & (u < width) & (v > 0) & (v < height)
    return (upper * (1 - fy) + lower * fy) * inside[..., None]


def _grown(mask: np.ndarray, steps: int) -> np.ndarray:
    """Within `steps` pixels of a set one along both axes."""
    out = mask
    for axis in (0, 1):
        padded = np.pad(out, [(steps, steps) if k == axis else (0, 0) for k in (0, 1)])
        out = np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * steps + 1, axis).any(-1))
    return out


def _shrunk(mask: np.ndarray, steps: int) -> np.ndarray:
    return ~_grown(~mask, steps)
