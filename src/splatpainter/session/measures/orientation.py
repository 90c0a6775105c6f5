"""Which way up an asset is and where its front is, measured where nobody said so. Pure.

Captures are photographed from the sides and from above, and from one side more than from the others: what no camera saw
is smooth. *Detail* of a view is the mean absolute Laplacian of its picture where the asset covers it. The axis from
which an asset has by far the least detail is its underside; the side with the most detail in all, and clearly more than
the one that the format's habit shows, is its front. Where neither is clear, the habit stands.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np

from splatpainter.cameras import AUTO_UP, FRAME_MARGIN, UPS, Camera, bounding_sphere, look_at, orbit
from splatpainter.kernels.portable import arctan2, dot, length, sin
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

VIEW_PX = 64
"""Edge, pixels, of the views that are measured."""
FOV_DEGREES, ELEVATION_DEGREES = 40.0, 15.0
VIEWS_AROUND = 8
"""Views around."""
MAX_MEASURED = 60_000
"""Gaussians that are drawn; of more, so many are taken evenly, each as much larger."""
UNDERSIDE_SHARE = 0.6
"""Detail of an underside against the next smooth side, at most."""
FRONT_FACTOR = 1.15
"""Detail of a front against the side that habit shows, at least."""
COVERED_ALPHA = 0.9
"""Alpha from which a pixel counts."""


@dataclass(frozen=True)
class Orientation:
    """How an asset stands."""

    up: str
    """A key of cameras.UPS."""
    front: float
    """Degrees around `up` (cameras.orbit's start) from which its front is seen."""


def habitual_front(up: str) -> float:
    """Degrees at which formats have the front: an asset that is upside down is mostly half a turn about x away."""
    return 180.0 if up == "+y" else 0.0


def measure(splats: Splats, up: str | None = None) -> Orientation:
    """The orientation of an asset, numpy. up: that was said already; None: it is measured too."""
    center, radius = bounding_sphere(splats)
    distance = FRAME_MARGIN * radius / sin(math.radians(FOV_DEGREES / 2))
    # Nothing to look at: the habit of the format stands.
    if not (math.isfinite(distance) and distance > 0):
        return Orientation(up or AUTO_UP, habitual_front(up or AUTO_UP))
    sample = thinned(splats)
    up = up or measured_up(sample, center, distance)
    return Orientation(up, measured_front(sample, center, distance, up))


def thinned(splats: Splats) -> Splats:
    """The asset, or a choice of MAX_MEASURED of its Gaussians that cover as much."""
    share = len(splats) / MAX_MEASURED
    if share <= 1:
        return splats
    # Larger by the share that is missing, so that the picture has no holes, which would count as detail.
    some = splats.take(np.linspace(0, len(splats) - 1, MAX_MEASURED).astype(np.int64))
    return replace(some, scales=some.scales * np.float32(math.sqrt(share)))


def measured_up(splats: Splats, center: np.ndarray, distance: float) -> str:
    """The axis opposite to the one from which the asset is smooth; AUTO_UP where none is clearly smoother."""
    smoothness = []
    for name, axis in UPS.items():
        above = (0, 1, 0) if axis[0] else (1, 0, 0)
        eye = np.asarray(center, float) + distance * np.asarray(axis, float)
        camera = look_at(eye, center, above, width=VIEW_PX, height=VIEW_PX, fov=FOV_DEGREES).local
        total, pixels = view_detail(splats, camera)
        if pixels:
            smoothness.append((total / pixels, name))
    if len(smoothness) < len(UPS):
        return AUTO_UP  # it has sides that cover nothing: flat
    # Against the next smooth side, as some assets are smooth all around.
    (least, under), (second, _) = sorted(smoothness)[:2]
    return under.translate(str.maketrans("+-", "-+")) if least < UNDERSIDE_SHARE * second else AUTO_UP


def measured_front(splats: Splats, center: np.ndarray, distance: float, up: str) -> float:
    """Degrees around `up` of the most detailed side; that of habit where it is not clearly beaten."""
    habit = habitual_front(up)
    ring = orbit(
        center,
        distance,
        VIEWS_AROUND,
        elevation=ELEVATION_DEGREES,
        start=habit,
        up=UPS[up],
        width=VIEW_PX,
        height=VIEW_PX,
        fov=FOV_DEGREES,
    )
    detail = [view_detail(splats, camera.local)[0] for camera in ring]
    # Habit has the first view: a side has to beat it clearly, or the asset would open turned by chance.
    best = int(np.argmax(detail))
    return (habit + 360.0 * best / VIEWS_AROUND) % 360 if detail[best] > FRONT_FACTOR * detail[0] else habit


def view_detail(splats: Splats, camera: Camera) -> tuple[float, int]:
    """(sum of the absolute Laplacian of a view's colours where the asset covers it, pixels that it covers)."""
    from splatpainter.rendering.cpu.projected_view import project

    image, alpha, _ = project(splats, camera).rasterize()
    # Silhouettes are edges of any asset, and say nothing about what a camera saw.
    inner = alpha[1:-1, 1:-1] > COVERED_ALPHA
    around = image[:-2, 1:-1] + image[2:, 1:-1] + image[1:-1, :-2] + image[1:-1, 2:]
    laplacian = np.abs(4 * image[1:-1, 1:-1] - around).sum(-1)
    return float(laplacian[inner].sum(dtype=np.float64)), int(inner.sum())


def azimuth_of(forward: np.ndarray, up: str) -> float:
    """Degrees around `up` (cameras.orbit's start) of a view that looks along `forward`; 0 where it looks along up."""
    axis = np.asarray(UPS[up], float)
    zero = orbit((0, 0, 0), 1.0, 1, elevation=0, up=UPS[up])[0].forward
    quarter = orbit((0, 0, 0), 1.0, 1, elevation=0, start=90, up=UPS[up])[0].forward
    flat = np.asarray(forward, float) - dot(np.asarray(forward, float), axis) * axis
    if length(flat) < 1e-6:
        return 0.0
    return math.degrees(arctan2(dot(flat, quarter), dot(flat, zero))) % 360


def parsed_direction(text: str) -> np.ndarray:
    """[3] a direction as a project holds it, JSON; (0, 0, 0) for anything else."""
    try:
        direction = np.array(json.loads(text), np.float64)
    except (ValueError, TypeError, OverflowError, RecursionError):
        direction = np.zeros(0)
    return direction if direction.shape == (3,) and np.isfinite(direction).all() else np.zeros(3)
