"""Suns and lamps: what they are, the points that stand for their area, and how bright each is from where.

Irradiance is over pi, so that white light of radiance 1 from all around is 1: a sun of intensity 1 gives a white
surface that faces it 1, a lamp of intensity 1 does so from a distance of one world unit.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from splatpainter.kernels import portable
from splatpainter.lights.skies import direction
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import GOLDEN_ANGLE, fibonacci_sphere

LampKind = Literal["point", "spot", "rect", "disk", "sphere"]
AREA_SAMPLES = 16
"""Points that stand for the area of a lamp, or for the disc of a sun: each has its own shadow."""
PENUMBRA = 0.2
"""Share of a spot's half angle over which it fades out."""
SUN_DEGREES = 0.53
"""Angular diameter of the sun."""
SHARP_SUN = 1.0
"""Degrees up to which a sun is one direction: a shadow map sees no finer."""
KELVIN_RANGE = (1667.0, 25000.0)
"""Of the approximation in `kelvin_color`."""
XYZ_TO_RGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Sun:
    """A distant light. azimuth: degrees counter-clockwise seen from above, 0 at the front of the asset (where a camera
    of azimuth 0 stands); elevation: degrees above the horizon, below it too."""

    azimuth: float
    elevation: float
    size: float = SUN_DEGREES
    """Angular diameter, degrees: softness of its shadows."""
    color: Rgb = (1.0, 1.0, 1.0)
    """Linear."""
    intensity: float = 1.0

    def directions(self) -> np.ndarray:
        """[K, 3] float64 unit, towards the sun, y up."""
        middle = direction(self.azimuth, self.elevation)
        if self.size <= SHARP_SUN:
            return middle[None]
        # A wide sun is some directions all over its disc: together they make the edge of a shadow soft.
        side, other = across(middle)
        x, y = _disk(AREA_SAMPLES) * math.radians(self.size / 2)
        towards = middle + x[:, None] * side + y[:, None] * other
        return towards / np.linalg.norm(towards, axis=1, keepdims=True)


@dataclass(frozen=True)
class Lamp:
    """A light at a place, in world coordinates."""

    kind: LampKind
    position: tuple[float, float, float]
    color: Rgb = (1.0, 1.0, 1.0)
    """Linear."""
    intensity: float = 1.0
    target: tuple[float, float, float] | None = None
    """Where spot, rect and disk look to."""
    sizes: tuple[float, ...] = ()
    """spot: full angle, degrees; rect: width and height; disk and sphere: radius; world units."""

    def points(self) -> np.ndarray:
        """[K, 3] float64 that stand for it."""
        middle = np.array(self.position, np.float64)
        if self.kind in ("point", "spot"):
            return middle[None]
        if self.kind == "sphere":
            return middle + self.sizes[0] * fibonacci_sphere(AREA_SAMPLES)
        side, other = across(self.axis)
        if self.kind == "rect":
            # Middles of equal parts, so that the points have the lamp's own mean and none lies on its edge.
            grid = (np.arange(4) + 0.5) / 4 - 0.5
            x, y = np.repeat(grid, 4) * self.sizes[0], np.tile(grid, 4) * self.sizes[1]
        else:
            x, y = _disk(AREA_SAMPLES) * self.sizes[0]
        return middle + x[:, None] * side + y[:, None] * other

    @property
    def axis(self) -> np.ndarray:
        """[3] float64 unit, from the lamp to its target."""
        assert self.target is not None
        line = np.array(self.target, np.float64) - np.array(self.position, np.float64)
        return line / max(portable.length(line), 1e-300)

    @property
    def radius(self) -> float:
        """Half its extent, world units; 0 of points."""
        return 0.0 if self.kind in ("point", "spot") else max(self.sizes) / (2 if self.kind == "rect" else 1)

    def emission(self, away: np.ndarray) -> np.ndarray:
        """[N] 0..1 of unit directions [N, 3] that leave the lamp."""
        if self.kind in ("point", "sphere"):
            return np.ones(len(away))
        cosines = (away * self.axis).sum(1)
        if self.kind in ("rect", "disk"):
            return np.maximum(cosines, 0)
        half = math.radians(self.sizes[0] / 2)
        angle = portable.arccos(np.clip(cosines, -1, 1))
        rim = np.clip((half - angle) / (PENUMBRA * half), 0, 1)
        return rim * rim * (3 - 2 * rim)


def kelvin_color(kelvin: float) -> Rgb:
    """Linear sRGB of luminance 1 of a black body at this temperature: Kim et al. 2002 (US patent 7024034), cubic
    splines of the Planckian locus. Negative channels are 0. Raises ValueError outside KELVIN_RANGE."""
    low, high = KELVIN_RANGE
    if not low <= kelvin <= high:
        raise ValueError(f"expected a colour temperature from {low:g} to {high:g} K, got {kelvin:g}")
    t = 1000.0 / kelvin
    if kelvin <= 4000:
        x = -0.2661239 * t * t * t - 0.2343589 * t * t + 0.8776956 * t + 0.179910
    else:
        x = -3.0258469 * t * t * t + 2.1070379 * t * t + 0.2226347 * t + 0.240390
    if kelvin <= 2222:
        y = -1.1063814 * x * x * x - 1.34811020 * x * x + 2.18555832 * x - 0.20219683
    elif kelvin <= 4000:
        y = -0.9549476 * x * x * x - 1.37418593 * x * x + 2.09137015 * x - 0.16748867
    else:
        y = 3.0817580 * x * x * x - 5.87338670 * x * x + 3.75112997 * x - 0.37001483
    xyz = (x / y, 1.0, (1 - x - y) / y)
    red, green, blue = (max(sum(a * b for a, b in zip(row, xyz, strict=True)), 0.0) for row in XYZ_TO_RGB)
    return red, green, blue


def azimuth_elevation(towards: np.ndarray) -> tuple[float, float]:
    """(azimuth, elevation) in degrees of a unit direction [3] to a light, y up: what `direction` makes of them."""
    x, y, z = (float(value) for value in towards)
    return math.degrees(portable.arctan2(x, z)), math.degrees(portable.arctan2(y, portable.hypot(x, z)))


def across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across a unit axis [3], and each other."""
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side = side / portable.length(side)
    return side, np.cross(axis, side)


def _disk(count: int) -> np.ndarray:
    """[2, count] points spread evenly over the unit disc, on Vogel's spiral."""
    radius = np.sqrt((np.arange(count) + 0.5) / count)
    angle = np.arange(count) * GOLDEN_ANGLE
    return np.stack([radius * portable.cos(angle), radius * portable.sin(angle)])
