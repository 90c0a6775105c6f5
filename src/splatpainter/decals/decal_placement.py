"""Where a decal lies: its middle on the surface under a pixel, the picture's up, the surface around it unwrapped. The
same for what is laid and for what is shown of it before, on any view. Pure.
"""

from __future__ import annotations

import math
from dataclasses import field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.decals.decal_surface import mean_normal, surface_under
from splatpainter.decals.decal_survey import UnwrappedPatch, survey
from splatpainter.decals.decal_views import mapped_view
from splatpainter.painter import Asset
from splatpainter.surface.estimate import Surface
from splatpainter.system.quick_dataclass import dataclass

MAX_DECAL_PX = 384
"""Pixels of a decal's longer side in the views that paint it; larger pictures are averaged down to it."""


@dataclass(frozen=True)
class DecalPlacementThresholds:
    """Where a decal lies and how finely. Source: taste."""

    min_decal_px: int = 96
    """Pixels of that side, at least."""
    samples: int = 12_000
    """Samples of the surface, under a decal, at most."""
    ball_samples: int = 20_000
    """Samples of a disk around it, at most."""
    spacing_widths: float = 0.6
    """Least distance between samples, in widths of the Gaussians."""
    min_level_sine: float = 0.26
    """Sine of the angle between the surface's normal and the object's up, from which a picture stands upright on it; on
    what lies flatter (15 degrees: a table, a lid) its up is the view's."""
    evened_share: float = 0.35
    """Radius around the middle within which the surface's mean direction says what is upright, in the shorter sides
    (the page's handles have the same)."""
    max_preview_px: int = 320
    """Longer side of a view on which a decal is shown before it is laid."""


PLACEMENT = DecalPlacementThresholds()


@dataclass(frozen=True)
class DecalPlacement:
    """A rectangle of the size of a picture, on the surface."""

    point: np.ndarray
    """[3] of the surface under its middle."""
    normal: np.ndarray
    """[3] there, unit, outwards."""
    up: np.ndarray
    """[3] unit tangent: the picture's up."""
    size: tuple[float, float]
    """(width, height), world units along the surface."""
    spacing: float
    """World units between samples."""
    patch: UnwrappedPatch = field(repr=False)

    def map_on(self, asset: Asset, surface: Surface, camera: Camera) -> np.ndarray:
        """[H, W, 2] float32: which place of the picture each pixel of a view of the asset shows, world units right and
        up of its middle; NaN where it shows none."""
        out = np.full((camera.height, camera.width, 2), np.nan, np.float32)
        # The same code that lays the decal draws its preview: what is shown is what will be painted.
        view = mapped_view(asset, surface, self.patch, self.patch.under, camera)
        chosen = self.patch.within[view.nearest]
        chosen &= (np.abs(view.uv) <= np.array(self.size) / 2 + self.spacing).all(1)
        out[view.ys[chosen], view.xs[chosen]] = view.uv[chosen]
        return out


def decal_placement(
    asset: Asset,
    surface: Surface,
    camera: Camera,
    at: tuple[float, float],
    size: tuple[float, float],
    longer_px: int,
    *,
    angle: float = 0.0,
    wrap: float = 180.0,
    level: np.ndarray | None = None,
) -> DecalPlacement:
    """at: pixel (x, y) of the camera (of the asset's own space); size: (width, height), world units; longer_px: pixels
    of the picture's longer side; angle: degrees, counter-clockwise from outside; wrap: degrees; level: [3] world
    direction that is up, None: the view's. Raises ValueError where there is no surface under the pixel."""
    width, height = size
    pixel = max(size) / int(np.clip(longer_px, PLACEMENT.min_decal_px, MAX_DECAL_PX))
    # Samples as fine as the picture needs, as the Gaussians can tell, and as time allows.
    spacing = max(
        math.sqrt(width * height / PLACEMENT.samples), 1.5 * pixel, PLACEMENT.spacing_widths * surface.typical_width
    )
    spacing = max(spacing, math.sqrt(math.pi * (width**2 + height**2) / 4 / PLACEMENT.ball_samples))
    # Upright by what the surface does over the picture's size, not by the fold under one pixel.
    point, normal = surface_under(asset, surface, camera, at)
    around = mean_normal(asset, surface, camera, (point, normal), PLACEMENT.evened_share * min(size))
    up = picture_up(camera, around, angle, level)
    up -= (up @ normal) * normal
    up /= np.linalg.norm(up)
    seen_from = (camera.position - point) / np.linalg.norm(camera.position - point)
    patch = survey(asset, surface, (point, normal), up, size, spacing, math.radians(wrap), seen_from)
    return DecalPlacement(point, normal, up, size, spacing, patch)


def picture_up(camera: Camera, normal: np.ndarray, angle: float, level: np.ndarray | None = None) -> np.ndarray:
    """[3] unit tangent: the picture's up, with the arguments of `decal_placement`. normal: [3] unit, outwards."""
    rotation = camera.world_to_camera[:3, :3]
    # Up of the object if it is told, else up of the view, else forwards for a surface seen edge-on.
    ways = [(-rotation[1], 0.05), (rotation[2], 0.0)]  # the surface is seen from its edge: forwards is up
    if level is not None:
        ways.insert(0, (np.asarray(level, np.float64) / np.linalg.norm(level), PLACEMENT.min_level_sine))
    up = np.zeros(3)
    for way, least in ways:
        up = way - (way @ normal) * normal
        if np.linalg.norm(up) >= least:
            break
    up /= np.linalg.norm(up)
    right = np.cross(up, normal)
    turn = math.radians(angle)
    return math.cos(turn) * up - math.sin(turn) * right


def blocks_of(camera: Camera) -> tuple[Camera, int]:
    """(the same view in blocks, at most PLACEMENT.max_preview_px along its longer side; pixels of one). The last blocks
    of a row and a column may reach beyond the view."""
    block = -(-max(camera.width, camera.height) // PLACEMENT.max_preview_px)
    focal = {name: getattr(camera, name) / block for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, width=-(-camera.width // block), height=-(-camera.height // block), **focal), block
