"""Where a decal lies: its middle on the surface under a pixel, the picture's up, the surface around it unwrapped. The
same for what is laid and for what is shown of it before, on any view. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import field, replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.decals.decal_surface import mean_normal, surface_under
from splatpainter.decals.decal_survey import UnwrappedPatch, survey
from splatpainter.decals.decal_views import mapped_view
from splatpainter.kernels.portable import cos, dot, length, sin
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
    beside_shares: tuple[float, ...] = (0.05, 0.08)
    """How far beside a start from which hardly any surface goes on others are tried, in shorter sides: nearer than
    anyone points at a middle, and out of a crack or off a silhouette of captures."""
    cells: int = 12
    """Cells along each side of a rectangle, by which it is told how much of it lies on surface."""
    max_speck: float = 0.1
    """Share of its rectangle that a decal finds from a start, up to which others beside it are tried. Of 46 clicks on
    16 assets those that failed found 0.05 at most, what is thin or small 0.25 and more."""
    min_beside: float = 0.25
    """The same, from which one of these is taken."""
    enough_beside: float = 0.6
    """The same, from which no further one is tried."""
    max_behind: float = 0.25
    """How far behind what was clicked another start may lie, in longer sides: a wire stays clicked, not its wall."""
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

    @property
    def surface_share(self) -> float:
        """Share of its rectangle that lies on surface, 0..1, by cells of PLACEMENT.cells along each side."""
        cells = PLACEMENT.cells
        uv = self.patch.samples.uv[self.patch.under] / self.size + 0.5
        held = np.zeros((cells, cells), bool)
        held[tuple(np.clip(cells * uv, 0, cells - 1).astype(int).T)] = True
        return float(held.mean())

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
    of the picture's longer side, as it will be painted; angle: degrees, counter-clockwise from outside; wrap: degrees;
    level: [3] world direction that is up, None: the view's. Raises ValueError where there is no surface under the
    pixel."""
    width, height = size
    pixel = max(size) / longer_px
    # Samples as fine as the picture needs, as the Gaussians can tell, and as time allows.
    spacing = max(
        math.sqrt(width * height / PLACEMENT.samples), 1.5 * pixel, PLACEMENT.spacing_widths * surface.typical_width
    )
    spacing = max(spacing, math.sqrt(math.pi * (width**2 + height**2) / 4 / PLACEMENT.ball_samples))

    def placed(start: tuple[np.ndarray, np.ndarray]) -> DecalPlacement:
        # Upright by what the surface does over the picture's size, not by the fold under one pixel.
        around = mean_normal(asset, surface, camera, start, PLACEMENT.evened_share * min(size))
        up = picture_up(camera, around, angle, level)
        up -= dot(up, start[1]) * start[1]
        up /= length(up)
        seen_from = (camera.position - start[0]) / length(camera.position - start[0])
        patch = survey(asset, surface, start, up, size, spacing, math.radians(wrap), seen_from)
        return DecalPlacement(*start, up, size, spacing, patch)

    clicked = surface_under(asset, surface, camera, at)
    best = placed(clicked)
    most = best.surface_share
    if most > PLACEMENT.max_speck:
        return best
    # The pixel looks through a crack, or along a silhouette: no surface goes on from what it shows.
    for start in _starts_beside(asset, surface, camera, at, clicked[0], size):
        other = placed(start)
        if other.surface_share > max(most, PLACEMENT.min_beside):
            best, most = other, other.surface_share
        if most > PLACEMENT.enough_beside:
            break
    return best


def _starts_beside(
    asset: Asset,
    surface: Surface,
    camera: Camera,
    at: tuple[float, float],
    point: np.ndarray,
    size: tuple[float, float],
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(point [3], unit normal [3]) of the surface under pixels around one (x, y) that shows `point` ([3]), the nearer
    ones first; not those that lie far behind it."""
    depth = float(camera.project(point[None])[1][0])
    for ring, share in enumerate(PLACEMENT.beside_shares):
        reach = max(share * min(size) * camera.fx / depth, ring + 1.0)
        for quarter in range(4):
            turn = math.pi / 2 * (quarter + 0.5 * ring)
            pixel = (at[0] + reach * cos(turn), at[1] + reach * sin(turn))
            try:
                start = surface_under(asset, surface, camera, pixel)
            except ValueError:  # beside the asset, or the picture
                continue
            if camera.project(start[0][None])[1][0] < depth + PLACEMENT.max_behind * max(size):
                yield start


def picture_up(camera: Camera, normal: np.ndarray, angle: float, level: np.ndarray | None = None) -> np.ndarray:
    """[3] unit tangent: the picture's up, with the arguments of `decal_placement`. normal: [3] unit, outwards."""
    rotation = camera.world_to_camera[:3, :3]
    # Up of the object if it is told, else up of the view, else forwards for a surface seen edge-on.
    ways = [(-rotation[1], 0.05), (rotation[2], 0.0)]  # the surface is seen from its edge: forwards is up
    if level is not None:
        upwards = np.asarray(level, np.float64)
        ways.insert(0, (upwards / length(upwards), PLACEMENT.min_level_sine))
    up = np.zeros(3)
    for way, least in ways:
        up = way - dot(way, normal) * normal
        if length(up) >= least:
            break
    up /= length(up)
    right = np.cross(up, normal)
    turn = math.radians(angle)
    return cos(turn) * up - sin(turn) * right


def blocks_of(camera: Camera) -> tuple[Camera, int]:
    """(the same view in blocks, at most PLACEMENT.max_preview_px along its longer side; pixels of one). The last blocks
    of a row and a column may reach beyond the view."""
    block = -(-max(camera.width, camera.height) // PLACEMENT.max_preview_px)
    focal = {name: getattr(camera, name) / block for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, width=-(-camera.width // block), height=-(-camera.height // block), **focal), block
