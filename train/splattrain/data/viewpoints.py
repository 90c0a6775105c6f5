"""Where samples are seen from: rings around an object, close-ups of a point on it, and neighbours of a close-up.

Objects are about the origin, y up, within -1..1. Random choices come from the generator given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from splatpainter.cameras import FRAME_MARGIN, Camera, look_at

MIN_ELEVATION, MAX_ELEVATION = -25.0, 65.0
"""Elevations of cameras, degrees."""
UP_AXIS_ROTATIONS = (
    ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
)
"""Turns of the world, one per asset: y up, y down (3DGS captures), z up; files do not say which they have."""


@dataclass(frozen=True)
class Optics:
    """What the views of one sample share."""

    size: int
    """Pixels of each edge."""
    fov: float = 40.0
    """Vertical field of view of a view of the whole object, degrees."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


def object_camera(radius: float, optics: Optics, azimuth: float, elevation: float) -> Camera:
    """A view of a whole object that fits in a sphere of `radius` about the origin; degrees."""
    distance = FRAME_MARGIN * radius / math.sin(math.radians(optics.fov / 2))
    return _aimed(distance * _direction(azimuth, elevation), np.zeros(3), optics)


def ring(radius: float, optics: Optics, count: int, rng: np.random.Generator) -> list[Camera]:
    """`count` views of the whole object, evenly around it with jitter, at varied heights."""
    start = rng.uniform(0, 360)
    turns = start + (np.arange(count) + rng.uniform(-0.2, 0.2, count)) * 360 / max(count, 1)
    heights = rng.uniform(-15, 50, count)
    return [object_camera(radius, optics, float(a), float(e)) for a, e in zip(turns, heights, strict=True)]


def facing(
    target: np.ndarray, normal: np.ndarray, window: float, optics: Optics, rng: np.random.Generator, tilt: float = 25.0
) -> Camera:
    """A close-up of a surface point: `window` world units fill the picture's height at the target's depth. The line of
    sight is the normal, turned as `view_angles` does."""
    line = _direction(*view_angles(normal, rng, tilt))
    return _aimed(target + line * window / (2 * math.tan(math.radians(optics.fov / 2))), target, optics)


def view_angles(normal: np.ndarray, rng: np.random.Generator, tilt: float = 25.0) -> tuple[float, float]:
    """(azimuth, elevation), degrees, of a line of sight: the normal, turned by up to about `tilt` degrees and brought
    between MIN_ELEVATION and MAX_ELEVATION."""
    axis = normal + math.tan(math.radians(tilt)) * rng.uniform(0, 1) * _unit(rng.standard_normal(3))
    azimuth, elevation = angles(axis)
    return azimuth, float(np.clip(elevation, MIN_ELEVATION, MAX_ELEVATION))


def neighbour(
    camera: Camera, target: np.ndarray, rng: np.random.Generator, apart: tuple[float, float] = (15.0, 40.0)
) -> Camera:
    """The target from another side, `apart` (from, to) degrees away, a little nearer or farther."""
    degrees, way = rng.uniform(*apart), rng.uniform(0, 2 * math.pi)
    for turn in (way, way + math.pi, way + math.pi / 2):  # not from below the floor nor through the zenith
        if MIN_ELEVATION - 10 <= angles(_line_beside(camera, target, degrees, turn))[1] <= MAX_ELEVATION + 15:
            break
    return turned(camera, target, degrees, turn, rng.uniform(0.9, 1.3))


def turned(camera: Camera, target: np.ndarray, degrees: float, way: float, distance: float = 1.0) -> Camera:
    """The target from `degrees` away in the direction `way`, radians around the line of sight; distance: over that of
    the camera."""
    line = _line_beside(camera, target, degrees, way)
    away = float(np.linalg.norm(camera.position - target)) * distance
    fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
    return _aimed(target + away * line, target, Optics(camera.height, fov, camera.background))


def _line_beside(camera: Camera, target: np.ndarray, degrees: float, way: float) -> np.ndarray:
    """[3] unit vector from the target to a camera that is turned so."""
    offset = camera.position - target
    forward, angle = _unit(offset), math.radians(degrees)
    side = _unit(np.cross(_direction(angles(offset)[0] + 90, 0.0), forward))
    across = math.cos(way) * side + math.sin(way) * np.cross(forward, side)
    return math.cos(angle) * forward + math.sin(angle) * across


def crop(camera: Camera, target: np.ndarray, zoom: float) -> Camera:
    """The window of a `zoom` times larger picture of this view, of the view's own size, around the target and
    within the picture: a tile that an artist sends to an upscaler."""
    large = camera.resized(round(camera.width * zoom), round(camera.height * zoom))
    pixel, _ = large.project(target)
    corner = np.round(pixel - [camera.width / 2, camera.height / 2])
    left, top = np.clip(corner, 0, [large.width - camera.width, large.height - camera.height]).astype(int).tolist()
    return large.cropped(left, top, camera.width, camera.height)


def _aimed(eye: np.ndarray, target: np.ndarray, optics: Optics) -> Camera:
    kind = {"width": optics.size, "height": optics.size, "fov": optics.fov, "background": optics.background}
    return look_at(eye, target, **kind)


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    turn, tilt = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(tilt) * math.sin(turn), math.sin(tilt), math.cos(tilt) * math.cos(turn)])


def angles(line: np.ndarray) -> tuple[float, float]:
    """(azimuth, elevation), degrees, of a direction of any length."""
    x, y, z = _unit(np.asarray(line, np.float64))
    return math.degrees(math.atan2(x, z)), math.degrees(math.asin(max(min(y, 1.0), -1.0)))


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
