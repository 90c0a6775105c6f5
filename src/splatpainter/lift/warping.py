"""What one view shows, moved into another over the surface: where both see the same point, and its values there."""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.cameras import Camera
from splatpainter.system.quick_dataclass import dataclass

MAX_DEPTH_DIFFERENCE = 0.02
"""Largest difference between a point's depth and that of the surface which a view shows there, of that depth: else
something hides it."""


@dataclass(frozen=True)
class ViewedChange:
    """What an edit changes in one view, and on what surface."""

    camera: Camera
    change: np.ndarray = field(repr=False)
    """[h, w, 3] edited - before, 0 outside the mask."""
    mask: Floats = field(repr=False)
    """[h, w] float32 share of the pixel that was edited and has a surface."""
    depth: np.ndarray = field(repr=False)
    """[h, w] z-depth of the surface, 0 for none."""

    def moved(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """[H, W, 4] change and mask where the surface of `camera` (depth [H, W], 0 for none) is the one that was
        edited; zeros elsewhere."""
        pixels, z = self.camera.project(camera.unproject(np.where(depth > 0, depth, 1)))
        visible = _is_seen(self.depth, pixels, z, depth)
        values = np.concatenate([self.change, self.mask[..., None]], -1)
        out = np.zeros((*depth.shape, values.shape[2]))
        out[visible] = bilinear(values, pixels[visible])  # of the few that are, not of all
        return out


def seen_in_both(
    first: Camera, first_depth: np.ndarray, other: Camera, other_depth: np.ndarray, min_tolerance: float = 0.0
) -> np.ndarray:
    """[H, W] of `other`: the surface that it shows (z-depths, 0 for none) is the one that `first` shows there.
    min_tolerance: difference in depth, world units, up to which it is, however near the first camera stands."""
    pixels, z = first.project(other.unproject(np.where(other_depth > 0, other_depth, 1)))
    return _is_seen(first_depth, pixels, z, other_depth, min_tolerance)


def _is_seen(
    first_depth: np.ndarray, pixels: np.ndarray, z: np.ndarray, other_depth: np.ndarray, min_tolerance: float = 0.0
) -> np.ndarray:
    """`seen_in_both`; pixels, z: where the surface of the other view lies in the first, and its depth there."""
    height, width = first_depth.shape
    x, y = (np.floor(np.nan_to_num(pixels[..., k], nan=-1, posinf=-1, neginf=-1)).astype(int) for k in (0, 1))
    # NaN and infinite projections were set to -1 above and so count as outside.
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (z > 0) & (other_depth > 0)
    first_depth_seen = first_depth[y.clip(0, height - 1), x.clip(0, width - 1)]
    tolerance = np.maximum(MAX_DEPTH_DIFFERENCE * z, min_tolerance)
    return inside & (first_depth_seen > 0) & (np.abs(first_depth_seen - z) < tolerance)


def bilinear(values: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """[..., C] of pictures [h, w, C] at pixel positions [..., 2] (centres at +0.5), 0 outside."""
    height, width = values.shape[:2]
    # A border of zeros: positions outside fade out instead of being asked for.
    padded = np.pad(values, ((1, 1), (1, 1), (0, 0)))
    x = np.clip(np.nan_to_num(pixels[..., 0]) + 0.5, 0, width + 0.999)
    y = np.clip(np.nan_to_num(pixels[..., 1]) + 0.5, 0, height + 0.999)
    left, top = x.astype(int), y.astype(int)
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    upper = padded[top, left] * (1 - fx) + padded[top, left + 1] * fx
    lower = padded[top + 1, left] * (1 - fx) + padded[top + 1, left + 1] * fx
    return upper * (1 - fy) + lower * fy


def shrunk(values: np.ndarray, factor: int) -> np.ndarray:
    """[h, w, ...] means of factor x factor blocks of [H, W, ...]; beyond the edges there are zeros."""
    if factor == 1:
        return values
    rest = [(0, -n % factor) for n in values.shape[:2]]
    values = np.pad(values, [*rest, *[(0, 0)] * (values.ndim - 2)])
    height, width = (n // factor for n in values.shape[:2])
    return values.reshape(height, factor, width, factor, *values.shape[2:]).mean((1, 3))
