"""Lights as scenes of other programs hold them: at a place, looking along a line. What `usd_lights` and `gltf_lights`
read and write, and the way from there to an asset's lights and back.

Their scenes are those in which the asset stands as this package writes it into GLB: y up and z back where the asset's y
points down (as of captures), the asset's axes where its y points up.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from splatpainter.cameras import AUTO_UP, UpAxis
from splatpainter.kernels import portable
from splatpainter.lights.lamps import Lamp, Rgb, Sun, across, azimuth_elevation
from splatpainter.lights.light_set import Lights, axes_of
from splatpainter.system.quick_dataclass import dataclass

SceneKind = Literal["distant", "point", "spot", "rect", "disk", "sphere"]


@dataclass(frozen=True)
class SceneLight:
    """One light in a scene's axes (y up)."""

    kind: SceneKind
    position: np.ndarray
    """[3] float64; of no meaning where distant."""
    direction: np.ndarray
    """[3] float64 unit: where it looks; of no meaning of points and spheres."""
    color: Rgb
    """Linear."""
    intensity: float
    """As of `Sun` and `Lamp`."""
    sizes: tuple[float, ...] = ()
    """As of `Lamp`; distant: its angular diameter, degrees."""
    name: str = ""

    @property
    def matrix(self) -> np.ndarray:
        """[4, 4] float64 of an object that looks along its own -z."""
        out = np.eye(4)
        side, other = across(self.direction)
        out[:3, :3] = np.stack([side, -other, -self.direction], 1)
        out[:3, 3] = 0 if self.kind == "distant" else self.position
        return out


@dataclass(frozen=True)
class SceneSky:
    """An environment in a scene."""

    file: str
    """Its picture; empty: uniform."""
    intensity: float
    rotate: float
    """Degrees, counter-clockwise seen from above."""


def scene_axes(up: UpAxis) -> np.ndarray:
    """[3, 3] float64 rotation from an asset's axes to those of a scene of it, y up."""
    axis = AUTO_UP if up == "auto" else up
    if axis == "-y":
        return np.diag([1.0, -1.0, -1.0])
    return np.eye(3) if axis == "+y" else axes_of(up)


def sky_turn(up: UpAxis) -> float:
    """Degrees, counter-clockwise seen from above, from the axes of suns and skies to those of a scene. Of the picture
    itself both have the middle at +z and the left half at +x, as OpenEXR says and USD after it."""
    return 180.0 if (AUTO_UP if up == "auto" else up) == "-y" else 0.0


def to_scene(lights: Lights, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[SceneLight]:
    """The suns and lamps. offset: taken from their places."""
    axes = scene_axes(lights.up)
    # Suns are told from the front of the asset, lamps in the world: two ways into the same scene.
    back = portable.matmul(axes, axes_of(lights.up).T)  # from the axes of suns
    gain = float(portable.exp(lights.exposure * portable.log(2.0)))
    out = []
    for number, sun in enumerate(lights.suns, 1):
        towards = portable.matmul(Sun(sun.azimuth, sun.elevation).directions(), back.T)[0]
        strength = gain * sun.intensity
        out.append(SceneLight("distant", np.zeros(3), -towards, sun.color, strength, (sun.size,), f"Sun{number}"))
    for number, lamp in enumerate(lights.lamps, 1):
        where = portable.matmul(axes, (np.array(lamp.position) - np.array(offset))[:, None])[:, 0]
        along = np.array([0.0, 0.0, -1.0]) if lamp.target is None else portable.matmul(axes, lamp.axis[:, None])[:, 0]
        name = f"{lamp.kind.capitalize()}{number}"
        out.append(SceneLight(lamp.kind, where, along, lamp.color, gain * lamp.intensity, lamp.sizes, name))
    return out


def from_scene(scene: list[SceneLight], up: UpAxis = "auto") -> tuple[tuple[Sun, ...], tuple[Lamp, ...]]:
    """Suns and lamps of an asset that is up that way."""
    back = scene_axes(up).T
    suns, lamps = [], []
    for light in scene:
        along = portable.matmul(back, light.direction[:, None])[:, 0]
        if light.kind == "distant":
            x, y, z = portable.matmul(axes_of(up), -along[:, None])[:, 0]
            azimuth, elevation = azimuth_elevation(np.array([x, y, z]))
            suns.append(Sun(azimuth, elevation, light.sizes[0], light.color, light.intensity))
            continue
        where = portable.matmul(back, light.position[:, None])[:, 0]
        # Any point along the line does: only the direction counts.
        target = None if light.kind in ("point", "sphere") else _numbers(where + along)
        lamps.append(Lamp(light.kind, _numbers(where), light.color, light.intensity, target, light.sizes))
    return tuple(suns), tuple(lamps)


def _numbers(vector: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z
