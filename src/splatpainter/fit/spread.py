"""Cameras evenly on a sphere around an object. Knows no splats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.cameras import Camera, look_at

GOLDEN = np.pi * (3 - np.sqrt(5))
"""Angle between neighbours of Fibonacci's lattice, radians."""


def spread(
    center: Sequence[float] | np.ndarray,
    distance: float,
    count: int,
    *,
    size: int = 256,
    fov: float = 40.0,
    up: Sequence[float] | np.ndarray = (0.0, 1.0, 0.0),
    backgrounds: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 0.0),),
    between: bool = False,
) -> list[Camera]:
    """`count` square views from `distance` (world units) by Fibonacci's lattice, which gives each the same solid angle.

    fov: degrees. backgrounds: taken in turn. between: another lattice, turned by half a step: views that are not those
    of the first."""
    axis = np.asarray(up, np.float64) / np.linalg.norm(up)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    front = np.cross(axis, side)
    cameras = []
    for k in range(count):
        height = 1 - (2 * k + 1) / count
        angle = GOLDEN * (k + 0.5 * between)
        flat = np.cos(angle) * side + np.sin(angle) * front
        eye = np.asarray(center) + distance * (height * axis + np.sqrt(1 - height**2) * flat)
        background = backgrounds[k % len(backgrounds)]
        cameras.append(look_at(eye, center, axis, width=size, height=size, fov=fov, background=background))
    return cameras
