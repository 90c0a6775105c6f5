"""The lights that an asset shall stand in, as a value: what they are, their ranges, and which way is up for them."""

from __future__ import annotations

import math

import numpy as np

from splatpainter.cameras import AUTO_UP, UPS, UpAxis
from splatpainter.kernels import portable
from splatpainter.lights.lamps import Lamp, Sun
from splatpainter.lights.sky_maps import SkyMap
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import out_of_range, ranged
from splatpainter.transforms import sh_rotations

LAMP_FILL = 0.15
"""White light from all around where lamps come without an environment: shadows are not black."""
MAX_LAMPS = 64


@dataclass(frozen=True)
class Lights:
    """What an asset shall stand in."""

    sky: SkyMap | None = None
    """Light from all around; its mean counts as that of the light before."""
    sky_intensity: float = ranged(1.0, gt=0, le=1e6)
    """Of the sky's mean, over that of the light before."""
    suns: tuple[Sun, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    rotate: float = 0.0
    """Degrees by which the sky turns, counter-clockwise seen from above."""
    exposure: float = ranged(0.0, ge=-10, le=10)
    """Stops, of all of them."""
    fill: float | None = ranged(None, ge=0, le=10)
    """White light from all around, added; None: LAMP_FILL where there is no sky."""
    add: bool = False
    """Whether they are added to the light before, which stays."""
    up: UpAxis = "auto"
    """Which way of the asset is up for sky and suns."""

    def check(self) -> None:
        """Raises ValueError: no light, a number out of its range, too many."""
        # Judged before anything is computed: shadow maps take long, and a wrong number would only be black.
        if self.sky is None and not self.suns and not self.lamps and not self.fill:
            raise ValueError("light: expected a light (an environment, a sun or a lamp), got none")
        if len(self.suns) + len(self.lamps) > MAX_LAMPS:
            raise ValueError(f"light: expected at most {MAX_LAMPS} suns and lamps, got {len(self.suns + self.lamps)}")
        if (line := out_of_range(self)) is not None:
            raise ValueError(f"light: {line}")
        if not math.isfinite(self.rotate):
            raise ValueError(f"light: expected a rotation in degrees, got {self.rotate}")
        for sun in self.suns:
            if not (abs(sun.azimuth) <= 36000 and -90 <= sun.elevation <= 90):
                raise ValueError(
                    f"light: expected a sun at AZIMUTH,ELEVATION (-90 to 90), got {sun.azimuth:g},{sun.elevation:g}"
                )
            if not 0 <= sun.size <= 90:
                raise ValueError(f"light: expected a sun of 0 to 90 degrees, got {sun.size:g}")
        for light in (*self.suns, *self.lamps):
            if not 0 < light.intensity <= 1e6:
                raise ValueError(f"light: expected an intensity above 0, up to 1e6, got {light.intensity:g}")
            if not any(light.color):
                raise ValueError("light: expected a colour of a light that is not black")
        for lamp in self.lamps:
            numbers = (*lamp.position, *(lamp.target or ()), *lamp.sizes)
            if not all(math.isfinite(value) and abs(value) < 1e12 for value in numbers):
                raise ValueError(f"light: expected finite places and sizes of a {lamp.kind} light")
            if lamp.target is not None and lamp.target == lamp.position:
                raise ValueError(f"light: expected a {lamp.kind} light to look to another place than its own")
            if any(size <= 0 for size in lamp.sizes) or lamp.kind == "spot" and lamp.sizes[0] > 170:
                raise ValueError(f"light: expected sizes of a {lamp.kind} light above 0 (a spot's angle up to 170)")

    def describe(self) -> str:
        """One line for receipts."""
        parts = []
        if self.sky is not None:
            parts.append(
                f"environment {ascii(self.sky.name)[1:-1]}"
                + (f" turned {self.rotate:g}" if self.rotate else "")
                + (f" of {self.sky_intensity:g}" if self.sky_intensity != 1 else "")
            )
        parts += [f"sun {sun.azimuth:g},{sun.elevation:g} of {sun.intensity:g}" for sun in self.suns]
        parts += [f"{lamp.kind} of {lamp.intensity:g}" for lamp in self.lamps]
        parts += [f"exposure {self.exposure:g}"] if self.exposure else []
        parts += [f"fill {self.fill_level:g}"] if self.fill_level else []
        return ", ".join(parts) + (", added to the light before" if self.add else "")

    @property
    def fill_level(self) -> float:
        if self.fill is not None:
            return self.fill
        # Lamps alone would leave the rest black; an environment, or the light before, fills it already.
        return 0.0 if self.sky is not None or self.add else LAMP_FILL


def axes_of(up: UpAxis) -> np.ndarray:
    """[3, 3] float64 rotation from an asset's axes to those of lights: y up, azimuth 0 (as of cameras) at +z."""
    axis = np.array(UPS[AUTO_UP if up == "auto" else up], np.float64)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    return np.stack([side, axis, np.cross(side, axis)])


def turned_sky(sky: SkyMap, axes: np.ndarray, rotate: float = 0.0) -> np.ndarray:
    """[9, 3] SH of a sky in an asset's axes, turned by degrees counter-clockwise seen from above."""
    return _turned(sky.coefficients(), portable.matmul(_about_y(rotate), axes).T)


def about_up(coefficients: np.ndarray, up: UpAxis, degrees: float) -> np.ndarray:
    """SH [9, 3] in an asset's axes, turned about its way up, as `turned_sky` turns."""
    axes = axes_of(up)
    return _turned(coefficients, portable.matmul(portable.matmul(axes.T, _about_y(degrees).T), axes))


def _about_y(degrees: float) -> np.ndarray:
    """[3, 3] that turns back by degrees counter-clockwise seen from above."""
    c, s = portable.cos(math.radians(degrees)), portable.sin(math.radians(degrees))
    return np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])


def _turned(coefficients: np.ndarray, turn: np.ndarray) -> np.ndarray:
    bands = (slice(0, 1), slice(1, 4), slice(4, 9))
    # The coefficients are turned, not the picture: exact for SH, and at no cost.
    turns = sh_rotations(turn, 2)
    return np.concatenate([portable.matmul(m, coefficients[band]) for m, band in zip(turns, bands, strict=True)])
