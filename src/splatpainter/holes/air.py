"""Where there was air: what fills a hole never stands in it. Pure.

A place is in the air where views from all around see past it to what lies behind (space carving: Kutulakos and Seitz,
"A Theory of Shape by Space Carving", IJCV 2000). What was within a removed thing, or below it, no view saw.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.cameras import Camera, look_at
from splatpainter.holes.border import Border
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere


@dataclass(frozen=True)
class AirThresholds:
    """What counts as air. Tried on a sign, an ear and tails that were removed, and on bodies that stood on a ground."""

    directions: int = 24
    """Directions from which a place is looked at."""
    side_px: int = 160
    """Side of these views."""
    distance_radii: float = 4.0
    """Distance of the cameras, in radii of the border."""
    margin_cells: float = 2.0
    """Depth by which a place lies before what a view shows, in cells, from which that view sees past it."""
    min_alpha: float = 0.5
    """Alpha of a pixel that shows something."""
    min_share: float = 0.25
    """Share of the views that see past a place, from which it is in the air. Half of all see past what stands free over
    a plane; at a grazing angle some see past any bump of it."""


AIR = AirThresholds()


def in_the_air(splats: Splats, points: np.ndarray, border: Border) -> Bools:
    """[P] bool: points ([P, 3], world) near a border where splats (numpy; with what is to be removed) have nothing, as
    views from most sides see."""
    # A little more than the border: a fill may bulge over it.
    radius = 1.2 * max(float(np.linalg.norm(points - border.center, axis=1).max()), border.radius)
    distance, side = AIR.distance_radii * radius, AIR.side_px
    pixel = 2 * radius / side
    margin = AIR.margin_cells * border.cell + pixel
    # Only what is near: a wall elsewhere in the room would stand before the cameras.
    near = np.linalg.norm(splats.means - border.center, axis=1) < 2 * radius
    part = replace(splats.take(np.flatnonzero(near)), source=None, origin=None)
    past = np.zeros(len(points))
    for direction in fibonacci_sphere(AIR.directions):
        up = np.eye(3)[np.abs(direction).argmin()]
        pose = look_at(border.center + distance * direction, border.center, up, width=side, height=side)
        camera = Camera(
            side, side, distance / pixel, distance / pixel, side / 2, side / 2, pose.world_to_camera, offset=None
        )
        _, alpha, depth = project(part, camera).rasterize()
        pixels, z = camera.project(points)
        x, y = np.clip(np.floor(pixels).astype(int), 0, side - 1).T
        past += (alpha[y, x] < AIR.min_alpha) | (z < depth[y, x] - margin)
    return past >= AIR.min_share * AIR.directions
