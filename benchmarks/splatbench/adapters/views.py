"""The asset from all around, as pictures that other systems read. Knows no file formats."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from splatpainter.cameras import Camera, look_at, orbit
from splatpainter.splats import Splats

UP = (0.0, 1.0, 0.0)
RINGS = ((-15.0, 0.25), (15.0, 0.375), (45.0, 0.375))
"""(elevation in degrees, share of the views)."""
AT_ONCE = 8
"""Pictures in memory."""
GL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenCV camera axes <-> OpenGL's (y up, z backwards), which Blender and nerfstudio use."""


@dataclass(frozen=True)
class View:
    """One picture of the asset."""

    camera: Camera
    colors: np.ndarray = field(repr=False)
    """[H, W, 3] float32 display sRGB 0..1, straight (not multiplied by alpha), 0 where alpha is 0."""
    alpha: np.ndarray = field(repr=False)
    """[H, W] float32 0..1."""

    def rgba(self) -> np.ndarray:
        """[H, W, 4] uint8."""
        return _bytes(np.concatenate([self.colors, self.alpha[..., None]], -1))

    def on_black(self) -> np.ndarray:
        """[H, W, 3] uint8."""
        return _bytes(self.colors * self.alpha[..., None])


def sphere(lo: np.ndarray, size: float, count: int, *, pixels: int, fov: float, radius: float) -> list[Camera]:
    """`count` cameras evenly on a sphere (golden spiral) around a cube (corner [3], edge), looking at its middle.
    radius: in edges; fov in degrees."""
    middle = np.asarray(lo, np.float64) + size / 2
    height = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    flat = np.sqrt(1 - height**2)
    eyes = middle + radius * size * np.stack([flat * np.cos(turn), height, flat * np.sin(turn)], 1)
    return [look_at(eye, middle, UP, width=pixels, height=pixels, fov=fov) for eye in eyes]


def rings(lo: np.ndarray, size: float, count: int, *, pixels: int, fov: float = 50.0) -> list[Camera]:
    """`count` cameras on three rings around a cube, as a person walks around an object, so far that all of it shows."""
    middle = np.asarray(lo, np.float64) + size / 2
    away = size * math.sqrt(3) / 2 / math.sin(math.radians(fov / 2))
    counts = [int(count * share) for _, share in RINGS]
    counts[1] += count - sum(counts)
    cameras: list[Camera] = []
    for k, ((elevation, _), number) in enumerate(zip(RINGS, counts, strict=True)):
        cameras += orbit(
            middle, away, number, elevation=elevation, start=17.0 * k, up=UP, width=pixels, height=pixels, fov=fov
        )
    return cameras


def drawn(splats: Splats, cameras: Sequence[Camera]) -> Iterator[View]:
    """The asset from each camera (all of one size), a few at a time."""
    from splatpainter.rendering import render
    from splatpainter.sources.color import to_display

    for start in range(0, len(cameras), AT_ONCE):
        some = [replace(camera, background=(0.0, 0.0, 0.0)) for camera in cameras[start : start + AT_ONCE]]
        shown = render(splats, some)
        for camera, colors, alphas in zip(some, shown.colors, shown.alphas, strict=True):
            straight = np.where(alphas > 0, colors / np.maximum(alphas, 1e-6), 0).astype(np.float32)
            straight = np.clip(to_display(straight, splats.color_space), 0, 1)
            yield View(camera, straight, np.clip(alphas[..., 0], 0, 1))


def camera_to_world(camera: Camera) -> np.ndarray:
    """[4, 4] OpenGL camera axes -> world: nerfstudio's and Blender's transform_matrix."""
    return np.linalg.inv(camera.world_to_camera) @ GL


def _bytes(values: np.ndarray) -> np.ndarray:
    return (np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)
