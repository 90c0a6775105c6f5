"""Lights that turn about an asset, for films: as the camera of a turntable does, counter-clockwise seen from above."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from splatpainter.kernels import portable
from splatpainter.lights.lamps import Lamp
from splatpainter.lights.light_set import Lights, axes_of


def turned_lights(lights: Lights, degrees: float, center: np.ndarray) -> Lights:
    """Sky, suns and lamps after a turn about the vertical through a centre ([3], world coordinates)."""
    axes = axes_of(lights.up)
    c, s = portable.cos(math.radians(degrees)), portable.sin(math.radians(degrees))
    # About y of the axes of lights, in which azimuths grow from +z to +x.
    turn = portable.matmul(axes.T, portable.matmul(np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]), axes))

    def moved(point: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if point is None:
            return None
        x, y, z = portable.matmul(turn, (np.array(point) - center)[:, None])[:, 0] + center
        return float(x), float(y), float(z)

    def lamp(one: Lamp) -> Lamp:
        position = moved(one.position)
        assert position is not None
        return replace(one, position=position, target=moved(one.target))

    return replace(
        lights,
        rotate=lights.rotate + degrees,
        suns=tuple(replace(sun, azimuth=sun.azimuth + degrees) for sun in lights.suns),
        lamps=tuple(map(lamp, lights.lamps)),
    )
