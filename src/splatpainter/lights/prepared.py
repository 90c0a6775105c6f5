"""What light needs to know of an asset, once per asset: its surface with what each Gaussian sees, and the light that is
baked into its colours. Kept by content, so that a layer below that changes colours finds the surface again, and a panel
that moves a sun finds both."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from threading import RLock
from typing import Any

import numpy as np

from splatpainter.cameras import UpAxis
from splatpainter.lighting import unoccluded_transfer
from splatpainter.lights.highlight_color import highlight_color, sampled_bands
from splatpainter.lights.irradiance import BLOCKER_RADIANCE, LitSurface, sun_light
from splatpainter.lights.lamps import Lamp, Sun
from splatpainter.lights.source_light import SourceLight, estimate_source, uniform_source
from splatpainter.splats import SH_C0, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.recent import Recent

SURFACES = 3
"""Of the assets used last; one of a million Gaussians takes 200 MB."""
SOURCES = 16
"""Estimated lights; small."""
MAX_CLOSED = 0.35
"""Share of a Gaussian's sky that may be hidden, for it to be a witness of the light: what comes back from what hides it
is not known well."""
_SURFACES = Recent[LitSurface](SURFACES)
_SOURCES = Recent[SourceLight](SOURCES)
_RECEIVED = Recent[tuple[LitSurface, np.ndarray]](128 << 20, lambda item: item[1].nbytes)
"""What single suns and lamps give to each Gaussian: 128 MiB, 16 of them on a million."""
_LOCK = RLock()


def lit_surface(splats: Splats, shadows: bool = True) -> LitSurface:
    """`LitSurface.of`, computed once for equal shapes. Raises ValueError."""
    with _LOCK:
        return _SURFACES.get((_shape_hash(splats), shadows), lambda: LitSurface.of(splats, shadows))


def captured_light(splats: Splats, shadows: bool = True, up: UpAxis = "auto") -> SourceLight:
    """`estimate_source` of the asset's colours as views show them, computed once for equal assets. up: where light
    usually comes from. Raises ValueError."""
    with _LOCK:
        surface = lit_surface(splats, shadows)
        colors = _hash(splats.sh[:, 0], sampled_bands(splats))
        key = (_shape_hash(splats), shadows, up, splats.color_space, colors)
        return _SOURCES.get(key, lambda: _estimate(splats, surface, up))


def from_sun(surface: LitSurface, sun: Sun, axes: np.ndarray) -> np.ndarray:
    """[N] float64 irradiance of a sun of intensity 1, whatever its colour, computed once while it stands where it is.
    axes: [3, 3] from the asset's axes to the lights' (y up)."""
    return _received(surface, _sun_key(sun, axes), lambda: sun_light(surface, sun, axes))


def from_lamp(surface: LitSurface, lamp: Lamp, offset: tuple[float, float, float]) -> np.ndarray:
    """[N] float64 irradiance of a lamp of intensity 1, as `from_sun`. offset: of the asset."""
    return _received(surface, _lamp_key(lamp, offset), lambda: surface.from_lamp(lamp, offset))


@dataclass(frozen=True)
class _Middle(Lamp):
    """An area lamp while it is dragged: as bright, its shadow that of its middle alone."""

    def points(self) -> np.ndarray:
        return np.array(self.position, np.float64)[None]


def quick_sun(surface: LitSurface, sun: Sun, axes: np.ndarray) -> Sun:
    """A sun as it can be shown at once: with a sharp shadow, unless its soft one is at hand."""
    return sun if _is_at_hand(surface, _sun_key(sun, axes)) else replace(sun, size=0.0)


def quick_lamp(surface: LitSurface, lamp: Lamp, offset: tuple[float, float, float]) -> Lamp:
    """A lamp as it can be shown at once: with a sharp shadow, unless its soft one is at hand."""
    if lamp.radius == 0 or _is_at_hand(surface, _lamp_key(lamp, offset)):
        return lamp
    return _Middle(lamp.kind, lamp.position, lamp.color, lamp.intensity, lamp.target, lamp.sizes)


def _sun_key(sun: Sun, axes: np.ndarray) -> tuple[Any, ...]:
    return (sun.azimuth, sun.elevation, sun.size, axes.tobytes())


def _lamp_key(lamp: Lamp, offset: tuple[float, float, float]) -> tuple[Any, ...]:
    return (type(lamp), lamp.kind, lamp.position, lamp.target, lamp.sizes, offset)


def _is_at_hand(surface: LitSurface, key: tuple[Any, ...]) -> bool:
    item = _RECEIVED.find((id(surface), key))
    return item is not None and item[0] is surface


def _received(surface: LitSurface, key: tuple[Any, ...], make: Callable[[], np.ndarray]) -> np.ndarray:
    # Light is linear, so colours and levels need nothing anew. The surface is held with it: another one could get its
    # id.
    with _LOCK:
        if _is_at_hand(surface, key):
            return _RECEIVED.find((id(surface), key))[1]
        received = make()
        received.flags.writeable = False
        return _RECEIVED.put((id(surface), key), (surface, received))[1]


def _estimate(splats: Splats, surface: LitSurface, up: UpAxis) -> SourceLight:
    if surface.facing.surface_pixels is None:
        return uniform_source("source light: uniform grey, for want of a surface that was looked at")
    # Where patches know their normals the first reading is the better one: of five clean tuning assets the second takes
    # 0.26 dB, and what it is made of was learnt on fitted ones.
    return estimate_source(
        *source_witnesses(splats, surface),
        up,
        both=not surface.facing.oriented,
        highlights=lambda light: highlight_color(splats, surface, light),
    )


def source_witnesses(splats: Splats, surface: LitSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Arguments of `estimate_source` of an asset of this surface, which was looked at (`Facing.surface_pixels`)."""
    pixels = surface.facing.surface_pixels
    assert pixels is not None
    # Of pixels, not of Gaussians: several make the colour of each, and their own are what a fit left them.
    sides = surface.facing
    # Oriented patches know their normals better than a view does: 18 clean tuning assets, two lights each, are 2.79 dB
    # below the true source with them, 3.41 with the surface's. Of others 23 tuning assets gain 0.1 dB by a blend, and 6
    # held-out ones lose 0.2.
    seen, facing = splats, sides.normals
    if sides.few is not None:
        seen, facing = sides.few.colored(splats), sides.few.normals(sides.normals)
    light, filled, normals = pixels.witnesses(seen, facing if sides.oriented else None)
    usable = filled & (surface.pixel_closed < MAX_CLOSED)
    # What is in the way of a pixel hardly depends on a few degrees, and stays.
    turned = unoccluded_transfer(normals) - unoccluded_transfer(pixels.normals.astype(np.float64))
    transfer = surface.pixel_transfer + turned / np.pi
    transfer[:, 0] += SH_C0 * BLOCKER_RADIANCE * surface.pixel_closed  # as `LitSurface.from_sky` lights them
    return light, transfer, pixels.points, usable


def _shape_hash(splats: Splats) -> bytes:
    return _hash(splats.means, splats.quats, splats.scales, splats.opacities, splats.drawable)


def _hash(*arrays: np.ndarray) -> bytes:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).view(np.uint8).reshape(-1).data)
    return digest.digest()
