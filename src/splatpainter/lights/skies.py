"""Environments that need no file: skies and studios, as gradients and soft lamps."""

from __future__ import annotations

import numpy as np

from splatpainter.kernels import portable
from splatpainter.lights.sky_maps import SkyMap, lat_long

HEIGHT = 64
"""Rows of their pictures; degree 2 of SH needs less."""
Rgb = tuple[float, float, float]
SKIES: dict[str, tuple[Rgb, Rgb, Rgb, tuple[tuple[float, float, float, Rgb], ...]]] = {
    "studio": (
        (0.10, 0.10, 0.11),
        (0.16, 0.16, 0.16),
        (0.08, 0.08, 0.08),
        ((35, 40, 25, (6.0, 5.7, 5.3)), (-60, 20, 35, (1.1, 1.2, 1.4)), (165, 35, 20, (3.2, 3.3, 3.6))),
    ),
    "noon": (
        (0.20, 0.36, 0.80),
        (0.62, 0.76, 0.98),
        (0.24, 0.21, 0.17),
        ((30, 65, 10, (42.0, 39.0, 34.0)),),
    ),
    "overcast": ((1.00, 1.03, 1.08), (0.50, 0.52, 0.54), (0.16, 0.15, 0.14), ()),
    "sunset": (
        (0.10, 0.15, 0.36),
        (0.72, 0.40, 0.24),
        (0.10, 0.08, 0.07),
        ((60, 7, 11, (30.0, 13.0, 4.2)),),
    ),
    "dawn": (
        (0.16, 0.22, 0.44),
        (0.62, 0.46, 0.42),
        (0.09, 0.08, 0.09),
        ((-75, 3, 14, (9.0, 4.6, 2.6)),),
    ),
    "moonlight": (
        (0.10, 0.14, 0.24),
        (0.13, 0.16, 0.22),
        (0.05, 0.05, 0.06),
        ((-40, 45, 8, (9.0, 9.8, 11.5)),),
    ),
    "forest": (
        (0.54, 0.66, 0.44),
        (0.24, 0.27, 0.19),
        (0.10, 0.08, 0.05),
        ((20, 70, 14, (7.0, 6.6, 5.2)), (-110, 55, 10, (3.4, 3.3, 2.4))),
    ),
    "softbox": (
        (0.22, 0.22, 0.22),
        (0.14, 0.14, 0.14),
        (0.10, 0.10, 0.10),
        ((0, 80, 45, (2.6, 2.6, 2.6)), (75, 15, 30, (1.6, 1.6, 1.6)), (-75, 15, 30, (1.6, 1.6, 1.6))),
    ),
}
"""Name -> radiance at the zenith, at the horizon and of the ground, and soft lamps: azimuth, elevation, radius
(degrees), radiance in the middle."""


def sky(name: str) -> SkyMap:
    """An environment of SKIES. Azimuths are counter-clockwise seen from above, 0 in the middle of the picture (+z)."""
    *levels, lamps = SKIES[name]
    zenith, horizon, ground = np.array(levels)
    towards, _ = lat_long(HEIGHT, 2 * HEIGHT)
    height = towards[..., 1:2]
    above = horizon + (zenith - horizon) * np.sqrt(np.maximum(height, 0))
    picture = np.where(height > 0, above, ground)
    for azimuth, elevation, radius, radiance in lamps:
        axis = direction(azimuth, elevation)
        angle = portable.arccos(np.clip((towards * axis).sum(-1), -1, 1)) * (180 / np.pi)
        soft = np.clip(1.5 - angle / radius, 0, 1)[..., None]  # full up to half its radius, nothing from 1.5 on
        picture = picture + soft * soft * (3 - 2 * soft) * np.array(radiance)
    return SkyMap(picture.astype(np.float32), name)


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """[3] float64 unit direction to a light at this azimuth and elevation (degrees), y up, azimuth 0 at +z, 90 at
    +x."""
    flat, up = portable.cos(np.radians(elevation)), portable.sin(np.radians(elevation))
    turn = np.radians(azimuth)
    return np.array([flat * portable.sin(turn), up, flat * portable.cos(turn)])
