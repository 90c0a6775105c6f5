"""Rigs of lamps that need no file: distant soft boxes, so that they fit an asset of any size."""

from __future__ import annotations

from splatpainter.lights.lamps import Sun, kelvin_color
from splatpainter.lights.light_set import Lights

RIGS: dict[str, tuple[float, tuple[tuple[float, float, float, float, float], ...]]] = {
    "three-point": (0.12, ((40, 35, 25, 0.85, 5000), (-50, 15, 45, 0.30, 5600), (165, 40, 15, 0.70, 6500))),
    "rembrandt": (0.06, ((50, 45, 12, 1.0, 4300), (-60, 10, 60, 0.12, 5600))),
    "butterfly": (0.10, ((0, 50, 20, 0.95, 5600), (0, -25, 60, 0.25, 5600))),
    "rim": (0.08, ((140, 25, 15, 1.4, 6500), (-140, 25, 15, 1.4, 6500), (0, 20, 60, 0.25, 5600))),
    "window": (0.14, ((80, 25, 50, 1.0, 6500), (-100, 5, 80, 0.10, 4500))),
    "product": (0.30, ((0, 75, 80, 0.55, 5600), (70, 20, 50, 0.35, 5600), (-70, 20, 50, 0.35, 5600))),
    "neon": (0.06, ((75, 15, 40, 0.8, 1800), (-75, 15, 40, 0.8, 25000))),
}
"""Name -> white light from all around, and soft boxes: azimuth and elevation, angular size (degrees), intensity, K."""


def studio_rig(name: str) -> Lights:
    """One of RIGS."""
    fill, boxes = RIGS[name]
    suns = tuple(Sun(azimuth, elevation, size, kelvin_color(k), level) for azimuth, elevation, size, level, k in boxes)
    return Lights(suns=suns, fill=fill)
