"""Points on an object's surface where an edit may go, found in pictures of it with depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatpainter.cameras import Camera

MIN_VIEW_COSINE = 0.45
"""Cosine between the normal of a surface point and the line of sight that finds it."""
MIN_SOLID_ALPHA = 0.99


@dataclass(frozen=True)
class SurfacePoint:
    """A point on the surface that some view sees."""

    position: np.ndarray
    """[3] world."""
    normal: np.ndarray
    """[3] unit, towards that view."""


def random_surface_point(
    cameras: Sequence[Camera], depths: np.ndarray, alphas: np.ndarray, rng: np.random.Generator
) -> SurfacePoint:
    """What lies under a pixel of the views where the surface faces them. depths, alphas: [V, H, W]. Raises ValueError
    where there is none."""
    for k in rng.permutation(len(cameras)):
        points = cameras[k].unproject(depths[k].astype(np.float64))
        normals, cosines = facing_normals(points, cameras[k].position)
        pixels = np.argwhere(interior(alphas[k] > MIN_SOLID_ALPHA) & (cosines >= MIN_VIEW_COSINE))
        if len(pixels):
            y, x = pixels[rng.integers(len(pixels))]
            return SurfacePoint(points[y, x], normals[y, x])
    raise ValueError("no part of its surface faces a view")


def facing_normals(points: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([H, W, 3] unit normals towards `eye` [3] of the surface through the points [H, W, 3] of neighbouring pixels,
    [H, W] their cosines with the lines of sight); nonsense at silhouettes, see `interior`."""
    down, right = np.gradient(points, axis=(0, 1))
    normals, lines = np.cross(down, right), eye - points
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    normals *= np.where((normals * lines).sum(-1, keepdims=True) < 0, -1, 1)
    return normals, (normals * lines).sum(-1) / np.maximum(np.linalg.norm(lines, axis=-1), 1e-30)


def interior(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels of the mask whose eight neighbours are in it too."""
    for axis in (0, 1):
        mask = mask & np.roll(mask, 1, axis) & np.roll(mask, -1, axis)
    return mask
