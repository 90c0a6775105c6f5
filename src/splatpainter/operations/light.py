"""New light on an asset, or the light that is baked in taken out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from splatpainter.cameras import UpAxis
from splatpainter.lights.lamps import SUN_DEGREES
from splatpainter.lights.light_words import FORMS, parse_lamp, parse_sky, parse_sun, white_of
from splatpainter.lights.relight import Lights, delight, relight
from splatpainter.lights.sky_maps import SkyMap, read_sky
from splatpainter.operations.operation import AS_PYTHON, Operation, ReadyOperation, Report, Tools, Wording, parameter
from splatpainter.operations.region import Region, check_terms
from splatpainter.painter import Asset

ANY_SKY = SkyMap(np.ones((2, 4, 3), np.float32), "environment")
"""Stands for an environment whose file is not read yet."""


@dataclass(frozen=True, kw_only=True)
class LightBefore(Operation):
    """What relighting and delighting share: the light that an asset was captured in, and what of it changes."""

    mix: float = 1.0
    """How much of the new look, 0 .. 1; the rest is the captured one."""
    shadows: bool = True
    """Shadows and occlusion by the asset itself, in the light before and now."""
    source_light: Path | None = parameter(None, metavar="SKY", file=True)
    """The environment that the asset was captured in (lat-long .hdr, .exr); default: estimated from its colours."""
    full_range: bool = False
    """Environments with suns and lamps as bright as they are stored; default: limited to what 99.9 % of their values
    stay below. A sun comes back by `splatpainter light --sun`."""
    where: tuple[str, ...] = parameter((), metavar="WHERE ...")
    """Region that changes; default: everything. What is outside casts shadows all the same."""
    up: UpAxis = "auto"
    """Which way is up for environments and suns; auto: -y, as captures have it."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        if not 0 < self.mix <= 1:
            raise wording.error(self.kind, f"expected {wording.option('mix')} above 0, up to 1, got {self.mix:g}")
        if self.where:
            check_terms(self.where)

    def lights(self) -> Lights | None:
        """The new lights, their files read; None: white light from all around."""
        return None

    def ready(self, tools: Tools) -> ReadyOperation:
        lights = self.lights()
        source: SkyMap | None = read_sky(self.source_light, self.full_range) if self.source_light else None
        region = Region.parse(self.where) if self.where else None

        def lit(asset: Asset, report: Report) -> Asset:
            how = {"mix": self.mix, "shadows": self.shadows, "source": source}
            if lights is None:
                edited = delight(asset.splats, region, up=self.up, **how)
            else:
                edited = relight(asset.splats, lights, region, **how)
            return replace(edited, original=asset.original or asset.splats)

        return lit


@dataclass(frozen=True)
class Relight(LightBefore):
    """Light an asset, or a region of it: an environment, suns, lamps, with the asset's own shadows, baked into its
    colours."""

    kind: ClassVar[str] = "light"

    hdri: str = parameter("", metavar="SKY")
    """Environment: studio, noon, overcast, sunset, or a lat-long picture (.hdr, .exr; .png ends at white). Its mean
    counts as that of the light before: brighter or darker by --exposure."""
    rotate: float = 0.0
    """Degrees by which the environment turns, counter-clockwise seen from above."""
    exposure: float = 0.0
    """Stops, of all lights."""
    sun: tuple[str, ...] = parameter((), metavar="LIGHT ...")
    """Suns: AZIMUTH,ELEVATION in degrees, azimuths as of cameras."""
    sun_size: float = SUN_DEGREES
    """Angular diameter of the suns, degrees: softness of their shadows."""
    point: tuple[str, ...] = parameter((), metavar="LIGHT ...")
    """Points: X,Y,Z in world units, as `splatpainter info` prints bounds."""
    spot: tuple[str, ...] = parameter((), metavar="LIGHT ...")
    """Spots: X,Y,Z, where they look to, and the full angle in degrees."""
    rect: tuple[str, ...] = parameter((), metavar="LIGHT ...")
    """Rectangles: X,Y,Z, where they look to, width, height."""
    disk: tuple[str, ...] = parameter((), metavar="LIGHT ...")
    """Disks: X,Y,Z, where they look to, radius."""
    sphere: tuple[str, ...] = parameter((), metavar="LIGHT ...")
    """Spheres: X,Y,Z, radius."""
    kelvin: float | None = parameter(None, metavar="K")
    """Colour of suns and lamps that say none, as a temperature: 1667 to 25000; 2700 a bulb, 6500 about white."""
    fill: float | None = parameter(None, metavar="LEVEL")
    """White light from all around besides; default: 0.15 where suns and lamps come without --hdri, else 0."""
    add: bool = False
    """Add the lights to the one that is baked in; default: they replace it."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        replace(self._lamps(), sky=ANY_SKY if self.hdri else None).check()
        super().check(wording)

    def files(self) -> tuple[Path, ...]:
        return (*super().files(), *([Path(self.hdri)] if Path(self.hdri).suffix else []))

    def lights(self) -> Lights:
        sky = parse_sky(self.hdri, self.full_range) if self.hdri else None
        lights = replace(self._lamps(), sky=sky)
        lights.check()
        return lights

    def _lamps(self) -> Lights:
        """All but the environment. Raises ValueError: words that are no light."""
        white = white_of(self.kelvin)
        return Lights(
            suns=tuple(parse_sun(text, self.sun_size, white) for text in self.sun),
            lamps=tuple(parse_lamp(kind, text, white) for kind in FORMS for text in getattr(self, kind)),
            rotate=self.rotate,
            exposure=self.exposure,
            fill=self.fill,
            add=self.add,
            up=self.up,
        )


@dataclass(frozen=True)
class Delight(LightBefore):
    """Take the light and the shadows out of an asset's colours, as far as they can be estimated: what is left is its
    look in white light from all around."""

    kind: ClassVar[str] = "delight"

    shadows: bool = parameter(True, shared=True)
    """Shadows and occlusion by the asset itself, in the light before."""
