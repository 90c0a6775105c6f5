"""An asset under other lights: colours times the ratio of the light that reaches each Gaussian now and before.

After TranSplat (arXiv 2503.22676), in our words: no albedo is needed, so what de-lighting would get wrong cancels where
the lights are alike. Colours are linear light within. Bands of SH go through the slope of that change, but for what of
them is the mirror image of the old light: that becomes the mirror image of the new one.

    lit = relight(splats, Lights(sky=sky("sunset"), suns=(Sun(60, 10, intensity=2),)))
    plain = delight(splats)
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from splatpainter.cameras import AUTO_UP, UPS, UpAxis
from splatpainter.color import base_color, linear_to_srgb, luminance, sh_from_color, to_light
from splatpainter.kernels import portable
from splatpainter.lights.facing import MIN_FLAT_SHARE
from splatpainter.lights.irradiance import LitSurface, sun_light
from splatpainter.lights.lamps import Lamp, Sun
from splatpainter.lights.sky_maps import SkyMap
from splatpainter.lights.source_light import SourceLight, estimate_source, uniform_coefficients
from splatpainter.painter import Asset
from splatpainter.receipts import Receipt, untouched_hashes
from splatpainter.splats import Splats, changed_rows
from splatpainter.transforms import fibonacci_sphere, sh_basis, sh_rotations

FLOOR = 0.02
"""Irradiance, over that of white light from all around, that counts as there before and after: no ratio is without
bounds, and the way back is exact."""
MAX_RATIO = 100.0
"""Of irradiance now and before, either way."""
MAX_LEVEL = 4.0
"""Linear base colour up to which relit Gaussians go: beyond, whoever blends them makes sparks."""
MAX_SLOPE = 4.0
"""Of a display colour by the one before, for the bands of SH."""
LAMP_FILL = 0.15
"""White light from all around where lamps come without an environment: shadows are not black."""
MAX_EXPOSURE = 10.0
"""Stops, to either side."""
LN_2 = 0.6931471805599453
MAX_LAMPS = 64
MAX_NOTE = 2000
"""Characters of what a receipt says of lights."""
MIRROR_SAMPLES = 24
"""Directions from which mirrored light is projected; degree 2 needs 9."""
PIECE = 8192
"""Gaussians whose mirrored light is computed at a time."""


class Where(Protocol):
    """A region, as `grading.region.Region`."""

    @property
    def text(self) -> str: ...

    def weights(self, splats: Splats) -> np.ndarray: ...


@dataclass(frozen=True)
class Lights:
    """What an asset shall stand in."""

    sky: SkyMap | None = None
    """Light from all around; its mean counts as that of the light before."""
    suns: tuple[Sun, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    rotate: float = 0.0
    """Degrees by which the sky turns, counter-clockwise seen from above."""
    exposure: float = 0.0
    """Stops, of all of them."""
    fill: float | None = None
    """White light from all around, added; None: LAMP_FILL where there is no sky."""
    add: bool = False
    """Whether they are added to the light before, which stays."""
    up: UpAxis = "auto"
    """Which way of the asset is up for sky and suns."""

    def check(self) -> None:
        """Raises ValueError: no light, a number out of its range, too many."""
        if self.sky is None and not self.suns and not self.lamps:
            raise ValueError("light: expected a light (an environment, a sun or a lamp), got none")
        if len(self.suns) + len(self.lamps) > MAX_LAMPS:
            raise ValueError(f"light: expected at most {MAX_LAMPS} suns and lamps, got {len(self.suns + self.lamps)}")
        if not -MAX_EXPOSURE <= self.exposure <= MAX_EXPOSURE:
            raise ValueError(
                f"light: expected an exposure of -{MAX_EXPOSURE:g} to {MAX_EXPOSURE:g} stops, got {self.exposure}"
            )
        if not math.isfinite(self.rotate):
            raise ValueError(f"light: expected a rotation in degrees, got {self.rotate}")
        if self.fill is not None and not 0 <= self.fill <= 10:
            raise ValueError(f"light: expected a fill of 0 to 10, got {self.fill}")
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
                f"environment {ascii(self.sky.name)[1:-1]}" + (f" turned {self.rotate:g}" if self.rotate else "")
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
        return 0.0 if self.sky is not None or self.add else LAMP_FILL


def relight(
    splats: Splats,
    lights: Lights,
    region: Where | None = None,
    *,
    mix: float = 1.0,
    shadows: bool = True,
    source: SkyMap | None = None,
) -> Asset:
    """The asset under lights, with its receipt. mix: 0..1 of the new look; shadows: by what of the asset stands in the
    way, in the light before and now; source: the environment it was captured in (y up, not turned), None: estimated.
    Raises ValueError: no such lights, a lamp that lights nothing, no surface, a region that reaches nothing."""
    lights.check()
    return _edited(splats, lights, region, mix, shadows, source, "light")


light = relight
"""As the command is called."""


def delight(
    splats: Splats,
    region: Where | None = None,
    *,
    mix: float = 1.0,
    shadows: bool = True,
    source: SkyMap | None = None,
    up: UpAxis = "auto",
) -> Asset:
    """As `relight`, under white light from all around that meets no obstacle: the colours of the materials, nearly."""
    return _edited(splats, Lights(up=up), region, mix, shadows, source, "delight")


def axes_of(up: UpAxis) -> np.ndarray:
    """[3, 3] float64 rotation from an asset's axes to those of lights: y up, azimuth 0 (as of cameras) at +z."""
    axis = np.array(UPS[AUTO_UP if up == "auto" else up], np.float64)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    return np.stack([side, axis, np.cross(side, axis)])


def turned_sky(sky: SkyMap, axes: np.ndarray, rotate: float = 0.0) -> np.ndarray:
    """[9, 3] SH of a sky in an asset's axes, turned by degrees counter-clockwise seen from above."""
    c, s = portable.cos(math.radians(rotate)), portable.sin(math.radians(rotate))
    back = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    turn = portable.matmul(back, axes).T
    coefficients = sky.coefficients()
    bands = (slice(0, 1), slice(1, 4), slice(4, 9))
    turns = sh_rotations(turn, 2)
    return np.concatenate([portable.matmul(m, coefficients[band]) for m, band in zip(turns, bands, strict=True)])


def _edited(
    splats: Splats,
    lights: Lights,
    region: Where | None,
    mix: float,
    shadows: bool,
    source: SkyMap | None,
    mode: str,
) -> Asset:
    if not 0 < mix <= 1:
        raise ValueError(f"{mode}: expected a mix above 0, up to 1, got {mix:g}")
    clock = time.perf_counter()
    splats = splats.numpy()
    weights = np.ones(len(splats), np.float32) if region is None else region.weights(splats)
    weights = np.where(splats.drawable, weights, 0) * np.float32(mix)
    chosen = np.flatnonzero(weights)
    surface = LitSurface.of(splats, shadows)
    notes = []
    if surface.facing.flat_share < MIN_FLAT_SHARE:
        notes.append(f"only {surface.facing.flat_share:.0%} of the Gaussians are flat: little surface to light")
    axes = axes_of(lights.up)
    colors = to_light(base_color(np.where(splats.drawable[:, None, None], splats.sh, 0)), splats.color_space)
    if source is None:
        before = estimate_source(colors, surface.transfer, surface.points, surface.facing.trusted)
    else:
        before = SourceLight(turned_sky(source, axes), 0.0, f"source light: {ascii(source.name)[1:-1]}")
    old = surface.from_sky(before.coefficients)
    if mode == "delight":
        now, new = uniform_coefficients(), np.ones((len(splats), 3))
    else:
        now, new = _target(surface, lights, axes, chosen, splats.offset)
        if lights.add:
            now, new = before.coefficients + now, old + new
    new = np.maximum(new, 0)
    ratio = np.clip((new + FLOOR) / (old + FLOOR), 1 / MAX_RATIO, MAX_RATIO)
    sh = splats.sh.copy()
    sh[chosen] = _relit(splats, chosen, ratio[chosen], weights[chosen], surface, before.coefficients, now)
    edited = replace(splats, sh=sh)
    touched = changed_rows(splats, edited)
    if not len(touched):
        raise ValueError(f"{mode}: nothing to do, these lights change no Gaussian")
    before_hash, after_hash = untouched_hashes(splats, edited, touched)
    what = [
        lights.describe() if mode == "light" else "delight",
        before.note,
        lights.sky.note if lights.sky else "",
        source.note if source else "",
        *notes,
        "" if shadows else "no shadows",
        f"mix {mix:g}" if mix != 1 else "",
        f"where {region.text}" if region else "",
        "no tone mapping: what is brighter than white clips where it is drawn",
    ]
    receipt = Receipt(
        asset_sha256=splats.sha256,
        asset_rows=len(splats),
        output_sha256="",
        output_rows=len(edited),
        mode=mode,
        method="ratio",
        preset="",
        touched=touched,
        appended_rows=0,
        untouched_sha256_before=before_hash,
        untouched_sha256_after=after_hash,
        seconds={"light": time.perf_counter() - clock},
        note="".join(c if c.isprintable() else "?" for c in "; ".join(filter(None, what))[:MAX_NOTE]),
    )
    return Asset(edited, receipt, original=splats)


def _target(
    surface: LitSurface, lights: Lights, axes: np.ndarray, chosen: np.ndarray, offset: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """([9, 3] SH of what of the new light comes from all around or afar, for reflections, [N, 3] irradiance)."""
    coefficients = lights.fill_level * uniform_coefficients()
    if lights.sky is not None:
        coefficients = coefficients + turned_sky(lights.sky, axes, lights.rotate)
    total = surface.from_sky(coefficients)
    for sun in lights.suns:
        received = sun_light(surface, sun, axes)
        strength = sun.intensity * np.array(sun.color)
        total = total + received[:, None] * strength
        towards = portable.matmul(sun.directions(), axes)
        coefficients = coefficients + math.pi * sh_basis(towards, 2).mean(0)[:, None] * strength
    for lamp in lights.lamps:
        received = surface.from_lamp(lamp, offset)
        if not received[chosen].any():
            spot = ",".join(f"{value:g}" for value in lamp.position)
            raise ValueError(
                f"light: the {lamp.kind} light at {spot} reaches none of {len(chosen)} Gaussians; "
                "it lies inside the object or looks away: move it"
            )
        total = total + received[:, None] * (lamp.intensity * np.array(lamp.color))
    gain = float(portable.exp(lights.exposure * LN_2))
    return gain * coefficients, gain * total


def _relit(
    splats: Splats,
    chosen: np.ndarray,
    ratio: np.ndarray,
    weights: np.ndarray,
    surface: LitSurface,
    before: np.ndarray,
    now: np.ndarray,
) -> np.ndarray:
    """[M, K, 3] float32 SH of the chosen Gaussians after ratios [M, 3] of irradiance, by weights [M]. before, now:
    [9, 3] light that shines make the mirror images of."""
    sh = splats.sh[chosen].astype(np.float64)
    base = base_color(sh)
    light = to_light(base, splats.color_space)
    share = weights.astype(np.float64)[:, None]
    target = np.minimum(light * ratio, np.maximum(light, MAX_LEVEL))
    # Mixed as light, not as display colours.
    mixed = light + share * (target - light)
    display = mixed if splats.color_space == "linear" else linear_to_srgb(mixed)
    steady = (ratio == 1) | (light <= 0)  # below black there is nothing to light
    out = sh.copy()
    out[:, 0] = np.where(steady, sh[:, 0], sh_from_color(display))
    if sh.shape[1] == 1:
        return out.astype(np.float32)
    gain = 1 + share * (ratio - 1)
    slope = gain if splats.color_space == "linear" else np.minimum(_slope(mixed) * gain / _slope(light), MAX_SLOPE)
    slope = np.where(steady, 1, np.minimum(slope, MAX_SLOPE))[:, None, :]
    mirrored = slice(1, min(sh.shape[1], 9))
    for first in range(0, len(sh), PIECE):
        piece = slice(first, first + PIECE)
        normals = surface.facing.normals[chosen[piece]].astype(np.float64)
        old, new = mirrored_light(before, normals)[:, mirrored], mirrored_light(now, normals)[:, mirrored]
        rest = sh[piece, mirrored]
        gloss = _response(rest, old)
        changed = slope[piece] * rest + share[piece][:, None] * slope[piece] * (
            gloss * (new / _level(now, before) - old)
        )
        out[piece, mirrored] = np.where(steady[piece][:, None], rest, changed)
    out[:, 9:] = sh[:, 9:] * slope
    return out.astype(np.float32)


def _slope(light: np.ndarray) -> np.ndarray:
    """Derivative of the sRGB curve at linear light >= 0."""
    dark = np.maximum(light, 0.0031308)
    return np.where(light <= 0.0031308, 12.92, 1.055 / 2.4 * portable.power(dark, 1 / 2.4) / dark)


def _level(now: np.ndarray, before: np.ndarray) -> float:
    """How much brighter the new light is in the mean: the slope has that already."""
    return max(float(luminance(now[0])) / max(float(luminance(before[0])), 1e-9), 1e-3)


def _response(bands: np.ndarray, mirrored: np.ndarray) -> np.ndarray:
    """[M, B, 3] how much of the mirrored light [M, B, 3] the bands hold: least squares over each band's coefficients
    and the colours, 0..1. What else they hold is no reflection of this light, and stays."""
    out = np.zeros_like(bands)
    for first, last in ((0, 3), (3, 8)):
        if bands.shape[1] >= last:
            ours, theirs = bands[:, first:last], mirrored[:, first:last]
            power = (theirs * theirs).sum((1, 2))
            share = (ours * theirs).sum((1, 2)) / np.maximum(power, 1e-3)
            out[:, first:last] = np.clip(share, 0, 1)[:, None, None]
    return out


def mirrored_light(coefficients: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[M, 9, 3] SH of the light that a mirror with each normal [M, 3] shows along a line of sight d: that of direction
    d - 2 (n . d) n."""
    sights = fibonacci_sphere(MIRROR_SAMPLES)
    basis = sh_basis(sights, 2)
    inverse = portable.solved(portable.gram(basis, np.ones(len(sights))), np.ascontiguousarray(basis.T))
    cosines = portable.matmul(normals, sights.T)
    turned = sights - 2 * cosines[..., None] * normals[:, None]
    seen = portable.matmul(sh_basis(turned, 2).reshape(-1, 9), coefficients).reshape(len(normals), -1, 3)
    out = portable.matmul(seen.transpose(0, 2, 1).reshape(-1, MIRROR_SAMPLES), inverse.T)
    return out.reshape(len(normals), 3, 9).transpose(0, 2, 1)
