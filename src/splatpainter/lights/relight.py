"""An asset under other lights: colours times the ratio of the light that reaches each Gaussian now and before.

After TranSplat (arXiv 2503.22676), in our words: no albedo is needed, so what de-lighting would get wrong cancels where
the lights are alike. Colours are linear light within. View dependence keeps its contrast; what of it is the mirror
image of the old light becomes that of the new one (`gloss`).

    lit = relight(splats, Lights(sky=sky("sunset"), suns=(Sun(60, 10, intensity=2),)))
    plain = delight(splats)
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Protocol

import numpy as np

from splatpainter.cameras import UpAxis
from splatpainter.color import base_color, display_slope, linear_to_srgb, luminance, sh_from_color, to_light
from splatpainter.kernels import portable
from splatpainter.kernels.parallel import each
from splatpainter.lighting import unoccluded_transfer
from splatpainter.lights.bare_colors import lit_side, white_light
from splatpainter.lights.facing import MIN_FLAT_SHARE, ORIENTATION
from splatpainter.lights.gloss import GLOSS, gloss_of
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.lamps import Lamp
from splatpainter.lights.light_set import Lights, axes_of, turned_sky
from splatpainter.lights.mirror_images import MIRROR, mirrored_light
from splatpainter.lights.prepared import captured_light, from_lamp, from_sun, lit_surface, quick_lamp, quick_sun
from splatpainter.lights.sky_maps import SkyMap
from splatpainter.lights.source_light import LIMITS, SourceLight, uniform_coefficients
from splatpainter.lights.unlit import light_gain
from splatpainter.painter import Asset
from splatpainter.receipts import Receipt, untouched_hashes
from splatpainter.splats import SH_C0, Splats, changed_rows
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import sh_basis

FLOOR = 0.02
"""Irradiance, over that of white light from all around, that counts as there before and after: no ratio is without
bounds, and the way back is exact. With 0.05 those 42 meshes (`irradiance.BLOCKER_RADIANCE`) lose 0.07 +- 0.02 dB fitted
and 0.01 +- 0.04 coarse; with ratio^0.9 0.09 and 0.06, with bands 1 and 2 times 0.9 0.09 and 0.05: no contrast is to be
taken off for normals that are noise."""
MAX_RATIO = 100.0
"""Of irradiance now and before, either way."""
MAX_LEVEL = 4.0
"""Linear base colour up to which relit Gaussians go: beyond, whoever blends them makes sparks."""
MAX_SLOPE = 4.0
"""Of a display colour by the one before, for the bands of SH."""
BURIED, MIN_COSINE = 0.12, 0.05
"""Share of what can be seen that a lamp reaches, below which it lies inside the object; and the cosine, less what is
in the way, from which a Gaussian is reached. In a capture of a statue: 0.05 to 0.1 inside, 0.27 and more beside it."""
MAX_NOTE = 2000
"""Characters of what a receipt says of lights."""


class Where(Protocol):
    """A region, as `grading.region.Region`."""

    @property
    def text(self) -> str: ...

    def weights(self, splats: Splats) -> np.ndarray: ...


def relight(
    splats: Splats,
    lights: Lights,
    region: Where | None = None,
    *,
    mix: float = 1.0,
    shadows: bool = True,
    source: SkyMap | None = None,
    unlit: np.ndarray | None = None,
) -> Asset:
    """The asset under lights, with its receipt. mix: 0..1 of the new look; shadows: by what of the asset stands in the
    way, in the light before and now; source: the environment it was captured in (y up, not turned), None: estimated;
    unlit: [N, 1, 3] SH of its base colours before other lights were put on it, None: as they are. Raises ValueError: no
    such lights, a lamp that lights nothing, no surface, a region that reaches nothing."""
    lights.check()
    return _edited(splats, lights, region, mix, shadows, source, "light", unlit=unlit)


light = relight
"""As the command is called."""


def glance(
    splats: Splats,
    lights: Lights,
    *,
    mix: float = 1.0,
    shadows: bool = True,
    source: SkyMap | None = None,
    unlit: np.ndarray | None = None,
) -> np.ndarray:
    """[N, 1, 3] float32 SH: the base colours of `relight`, while lights are dragged: shadows of wide suns and of area
    lamps are sharp where they have moved, and are soft again with `relight`. Raises ValueError as `relight`."""
    surface = lit_surface(splats, shadows)
    axes = axes_of(lights.up)
    suns = tuple(quick_sun(surface, sun, axes) for sun in lights.suns)
    lamps = tuple(quick_lamp(surface, lamp, splats.offset) for lamp in lights.lamps)
    base = replace(splats, sh=np.ascontiguousarray(splats.sh[:, :1]))
    quick = replace(lights, suns=suns, lamps=lamps)
    return relight(base, quick, mix=mix, shadows=shadows, source=source, unlit=unlit).splats.sh


def delight(
    splats: Splats,
    region: Where | None = None,
    *,
    mix: float = 1.0,
    shadows: bool = True,
    source: SkyMap | SourceLight | None = None,
    up: UpAxis = "auto",
    unlit: np.ndarray | None = None,
    surface: LitSurface | None = None,
) -> Asset:
    """As `relight`, under white light from all around that meets no obstacle, as bright as the lit side was: the
    colours of the materials, nearly (`bare_colors`). source: a sky, or SH in the asset's axes; surface: as of
    `transfer`."""
    return _edited(splats, Lights(up=up), region, mix, shadows, source, "delight", surface=surface, unlit=unlit)


def transfer(
    splats: Splats,
    before: SourceLight,
    after: np.ndarray,
    region: Where | None = None,
    *,
    mix: float = 1.0,
    shadows: bool = True,
    surface: LitSurface | None = None,
) -> Asset:
    """From one environment to another, both as SH [9, 3] in the asset's axes and at one level. surface: the asset's,
    where it is known better than `lit_surface` sees it. Raises ValueError."""
    return _edited(splats, Lights(up="+y"), region, mix, shadows, before, "light", after, surface)


def _edited(
    splats: Splats,
    lights: Lights,
    region: Where | None,
    mix: float,
    shadows: bool,
    source: SkyMap | SourceLight | None,
    mode: str,
    after: np.ndarray | None = None,
    surface: LitSurface | None = None,
    unlit: np.ndarray | None = None,
) -> Asset:
    if not 0 < mix <= 1:
        raise ValueError(f"{mode}: expected a mix above 0, up to 1, got {mix:g}")
    clock = time.perf_counter()
    splats = splats.numpy()
    weights = np.ones(len(splats), np.float32) if region is None else region.weights(splats)
    # The mix is a part of the weights, so that region and strength fade in one place.
    weights = np.where(splats.drawable, weights, 0) * np.float32(mix)
    chosen = np.flatnonzero(weights)
    # Light by the ratio needs normals that mean something; that there are few is said, and nothing is refused.
    surface = lit_surface(splats, shadows) if surface is None else surface
    notes = []
    if surface.facing.flat_share < MIN_FLAT_SHARE:
        notes.append(f"only {surface.facing.flat_share:.0%} of the Gaussians are flat: little surface to light")
    axes = axes_of(lights.up)
    # What the asset was captured in is estimated, where nobody says it.
    if source is None:
        before = captured_light(splats if unlit is None else replace(splats, sh=unlit), shadows, lights.up)
    elif isinstance(source, SourceLight):
        before = source
    else:
        before = SourceLight(turned_sky(source, axes), 0.0, f"source light: {ascii(source.name)[1:-1]}")
    old, visible = surface.from_sky(before.coefficients), before
    if unlit is not None:
        # What other lights have given lies on top of the captured light; gloss shows the sum, as far as colours tell.
        gain = light_gain(splats.sh, unlit, splats.color_space)
        old, visible = np.maximum((old + FLOOR) * gain - FLOOR, 0), captured_light(splats, shadows, lights.up)
    if mode == "delight":
        brightness = lit_side(before.coefficients)
        # Of the captured light alone: what other lights have put on top of it goes as it came.
        captured = to_light(base_color(splats.sh if unlit is None else unlit).astype(np.float64), splats.color_space)
        received = surface.from_sky(before.coefficients)
        now = brightness * uniform_coefficients()
        new = white_light(captured, received, before.uncertainty, brightness, FLOOR)
    elif after is not None:
        now, new = after, surface.from_sky(after)
    else:
        now, new, remarks = _target(surface, lights, axes, chosen, splats.offset)
        notes += remarks
        if lights.add:
            now, new = visible.coefficients + now, old + new
    if mode == "light" and _change(surface, old, new, chosen) < LIMITS.telling * before.uncertainty:
        notes.append(
            "these lights differ from the light before by less than that is doubted: "
            "only with a --source-light that is known the look is sure to be another"
        )
    sh = splats.sh.copy()
    light = Exchange(old, np.maximum(new, 0), visible.coefficients, now)
    shine = gloss_of(splats, surface, visible)

    def lit(first: int) -> None:
        rows = chosen[first : first + GLOSS.piece]
        sh[rows] = _relit(splats, rows, light, weights[rows], shine[rows], surface)

    # In pieces that fit the cache, shared among threads.
    each(lit, range(0, len(chosen), GLOSS.piece))
    # The receipt says what decided the look, so that it can be made again.
    edited = replace(splats, sh=sh)
    what = [
        lights.describe() if mode == "light" else "delight",
        before.note,
        "" if unlit is None else "on top of other lights",
        lights.sky.note if lights.sky else "",
        source.note if isinstance(source, SkyMap) else "",
        *notes,
        "" if shadows else "no shadows",
        f"mix {mix:g}" if mix != 1 else "",
        f"where {region.text}" if region else "",
        "no tone mapping: what is brighter than white clips where it is drawn",
    ]
    receipt = color_receipt(splats, edited, mode, "; ".join(filter(None, what)))
    receipt = replace(receipt, seconds={"light": time.perf_counter() - clock})
    return Asset(edited, receipt, original=splats, unlit=splats.sh[:, :1] if unlit is None else unlit)


def _change(surface: LitSurface, old: np.ndarray, new: np.ndarray, chosen: np.ndarray) -> float:
    """Rms of the natural logarithm of new over old irradiance [N, 3], over what can be seen of some Gaussians."""
    weights = surface.facing.seen[chosen].astype(np.float64)[:, None]
    logs = portable.log((np.maximum(new[chosen], 0) + FLOOR) / (old[chosen] + FLOOR))
    return math.sqrt(float((weights * logs * logs).sum()) / max(3 * float(weights.sum()), 1e-9))


def color_receipt(splats: Splats, edited: Splats, mode: str, note: str) -> Receipt:
    """Of an edit by light that changed colours alone. Raises ValueError: it changed nothing."""
    # Gaussians that light left alone are proved by their hash, as with every edit.
    touched = changed_rows(splats, edited)
    if not len(touched):
        raise ValueError(f"{mode}: nothing to do, these lights change no Gaussian")
    before_hash, after_hash = untouched_hashes(splats, edited, touched)
    return Receipt(
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
        seconds={},
        note="".join(c if c.isprintable() else "?" for c in note[:MAX_NOTE]),
    )


def _target(
    surface: LitSurface, lights: Lights, axes: np.ndarray, chosen: np.ndarray, offset: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """([9, 3] SH of what of the new light comes from all around or afar, for reflections, [N, 3] irradiance, what is
    odd about the lamps)."""
    remarks = []
    coefficients = _from_all_around(lights, axes)
    total = surface.from_sky(coefficients)
    for sun in lights.suns:
        received = from_sun(surface, sun, axes)
        total = total + received[:, None] * (sun.intensity * np.array(sun.color))
    for lamp in lights.lamps:
        received = from_lamp(surface, lamp, offset)
        # A lamp that lights nothing is a mistake of its place, which nobody would find in the picture.
        if not received[chosen].any():
            spot = ",".join(f"{value:g}" for value in lamp.position)
            raise ValueError(
                f"light: the {lamp.kind} light at {spot} reaches none of {len(chosen)} Gaussians; "
                "it lies inside the object or looks away: move it"
            )
        # Through gaps a lamp inside a solid object lights a little of it, which looks like a fault of the light.
        if lamp.kind in ("point", "sphere") and (share := _share_lit(surface, lamp, received, chosen, offset)) < BURIED:
            spot = ",".join(f"{value:g}" for value in lamp.position)
            remarks.append(
                f"the {lamp.kind} light at {spot} reaches {share:.0%} of what can be seen: inside the object"
                f"{', or around it' if lamp.radius else ''}?"
            )
        total = total + received[:, None] * (lamp.intensity * np.array(lamp.color))
    gain = float(portable.exp(lights.exposure * portable.LN_2))
    return distant_light(lights, axes), gain * total, remarks


def _share_lit(
    surface: LitSurface, lamp: Lamp, received: np.ndarray, chosen: np.ndarray, offset: tuple[float, float, float]
) -> float:
    """0..1 of the chosen Gaussians that can be seen from around; 1 where none can. received: [N] of intensity 1."""
    away = surface.points - (np.array(lamp.position) - np.array(offset))
    lit = received * (away * away).sum(1) > MIN_COSINE
    seen = surface.facing.seen[chosen] > ORIENTATION.seen_px
    return float(lit[chosen][seen].mean()) if seen.any() else 1.0


def distant_light(lights: Lights, axes: np.ndarray) -> np.ndarray:
    """[9, 3] SH in an asset's axes of what comes from all around or afar: all but the lamps."""
    coefficients = _from_all_around(lights, axes)
    for sun in lights.suns:
        towards = portable.matmul(sun.directions(), axes)
        # A mirror shows suns as well, as far as SH can: lamps are near, and would show elsewhere from every Gaussian.
        strength = math.pi * sun.intensity * np.array(sun.color)
        coefficients = coefficients + sh_basis(towards, 2).mean(0)[:, None] * strength
    return float(portable.exp(lights.exposure * portable.LN_2)) * coefficients


def _from_all_around(lights: Lights, axes: np.ndarray) -> np.ndarray:
    coefficients = lights.fill_level * uniform_coefficients()
    if lights.sky is not None:
        coefficients = coefficients + lights.sky_intensity * turned_sky(lights.sky, axes, lights.rotate)
    return coefficients


@dataclass(frozen=True)
class Exchange:
    """One light for another."""

    old: np.ndarray
    """[N, 3] float64 irradiance before."""
    new: np.ndarray
    """[N, 3] float64 irradiance now, >= 0."""
    before: np.ndarray
    """[9, 3] SH of the light before."""
    now: np.ndarray
    """[9, 3] SH of the new light that gloss makes the mirror image of."""


def _relit(
    splats: Splats,
    rows: np.ndarray,
    lights: Exchange,
    share: np.ndarray,
    shine: np.ndarray,
    surface: LitSurface,
) -> np.ndarray:
    """[M, K, 3] float32 SH of the Gaussians `rows` [M] under the new light by a share [M] 0..1 and their gloss [M]."""
    sh = splats.sh[rows].astype(np.float64)
    light = to_light(base_color(sh), splats.color_space)
    share = share.astype(np.float64)[:, None]
    old, new = lights.old[rows], lights.new[rows]
    # The floor in both keeps the ratio finite in full shadow, and lets the way back end where it began.
    ratio = np.clip((new + FLOOR) / (old + FLOOR), 1 / MAX_RATIO, MAX_RATIO)
    target, mirrored = light * ratio, np.zeros_like(sh[:, 1:9])
    # What of a Gaussian is a mirror image of the light before becomes one of the new light; the rest follows the ratio,
    # and so keeps its contrast. A mirror shows no more of a light than reaches the surface.
    glossy = np.flatnonzero(shine)
    if len(glossy):
        gone = shine[glossy, None, None] * _reflected(surface, rows[glossy], lights.before, old[glossy])
        come = shine[glossy, None, None] * _reflected(surface, rows[glossy], lights.now, new[glossy])
        # Never more than most of what is there, or a doubtful light would leave less than nothing.
        portion = np.minimum(1, GLOSS.most * light[glossy] / np.maximum(SH_C0 * gone[:, 0], 1e-9))[:, None]
        change = portion * (come - ratio[glossy, None] * gone)
        target[glossy] += SH_C0 * change[:, 0]
        mirrored[glossy] = change[:, 1:]
    # The limit never darkens: a Gaussian that was brighter before may stay as bright.
    target = np.minimum(np.maximum(target, 0), np.maximum(light, MAX_LEVEL))
    # Mixed as light, not as display colours.
    mixed = light + share * (target - light)
    display = mixed if splats.color_space == "linear" else linear_to_srgb(mixed)
    steady = (ratio == 1) | (light <= 0)  # below black there is nothing to light
    out = sh.copy()
    out[:, 0] = np.where(steady, sh[:, 0], sh_from_color(display))
    if sh.shape[1] == 1:
        return out.astype(np.float32)
    # Bands are in display colours: their slope is that of the curve at the new colour over that at the old one.
    before_it, after_it = (display_slope(np.maximum(level, 0), splats.color_space) for level in (light, mixed))
    gain = np.minimum(after_it / before_it * (1 + share * (ratio - 1)), MAX_SLOPE)
    gain = np.where(steady, 1, gain)[:, None]
    # What gloss adds is light and no multiple of what was there.
    steep = np.where(steady, 0, share * np.minimum(after_it, MAX_SLOPE * before_it))[:, None]
    out[:, 1:9] = gain * sh[:, 1:9] + steep * mirrored
    # Bands beyond the second are finer than the light is known.
    out[:, 9:] = sh[:, 9:] * gain
    return out.astype(np.float32)


def _reflected(surface: LitSurface, rows: np.ndarray, light: np.ndarray, received: np.ndarray) -> np.ndarray:
    """[M, 9, 3] SH of what perfect gloss shows of a light [9, 3] that gives the Gaussians `rows` [M] irradiance
    `received` [M, 3], along lines of sight."""
    normals = surface.facing.normals[rows].astype(np.float64)
    share = surface.facing.front[rows].astype(np.float64)[:, None]
    above, below = unoccluded_transfer(normals) / math.pi, unoccluded_transfer(-normals) / math.pi
    free = portable.matmul((share * above + (1 - share) * below).astype(np.float64), luminance(light)[:, None])[:, 0]
    reaches = np.clip(luminance(received) / np.maximum(free, FLOOR), 0, 1)
    bands = np.repeat(np.array(MIRROR.bands), (1, 3, 5))
    return mirrored_light(light, normals) * (reaches[:, None] * bands)[..., None]
