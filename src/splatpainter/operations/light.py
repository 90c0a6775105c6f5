"""New light on an asset, or the light that is baked in taken out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from splatpainter.cameras import UpAxis
from splatpainter.io import read
from splatpainter.kernels import portable
from splatpainter.lights.held_skies import sky_of_png, sky_to_png
from splatpainter.lights.lamps import KELVIN_RANGE, SUN_DEGREES
from splatpainter.lights.light_set import Lights, axes_of, turned_sky
from splatpainter.lights.light_words import (
    FORMS,
    lamp_words,
    parse_lamp,
    parse_sky,
    parse_sun,
    parse_sun_at,
    sun_words,
    white_of,
)
from splatpainter.lights.match import ball_sheet, match_light, sky_of
from splatpainter.lights.prepared import captured_light
from splatpainter.lights.relight import delight, distant_light, glance, relight
from splatpainter.lights.rig_files import WRITTEN_RIGS, read_rig, write_rig
from splatpainter.lights.skies import SKIES
from splatpainter.lights.sky_maps import SkyMap, read_sky, write_sky
from splatpainter.lights.studio_rigs import RIGS
from splatpainter.lights.turning import turned_lights
from splatpainter.operations.operation import AS_PYTHON, Operation, ReadyOperation, Report, Tools, Wording, parameter
from splatpainter.operations.region import Region, check_terms
from splatpainter.painter import Asset, Painter
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.system.ranges import same_range

SKY_FILES = (".exr", ".hdr")
"""Endings of environments that are written."""
ANY_SKY = SkyMap(np.ones((2, 4, 3), np.float32), "environment")
"""Stands for an environment whose file is not read yet."""


@dataclass(frozen=True, kw_only=True)
class LightBefore(Operation):
    """What relighting and delighting share: the light that an asset was captured in, and what of it changes."""

    holds: ClassVar[tuple[str, ...]] = ("source_light",)

    mix: float = parameter(1.0, gt=0, le=1)
    """How much of the new look, 0 .. 1; the rest is the captured one."""
    shadows: bool = True
    """Shadows and occlusion by the asset itself, in the light before and now."""
    source_light: Path | None = parameter(None, metavar="SKY", file=True)
    """The environment that the asset was captured in (lat-long .hdr, .exr); default: estimated from its colours."""
    full_range: bool = False
    """Environments with suns and lamps as bright as they are stored; default: limited to what 99.9 % of their values
    stay below. A sun comes back by `splatpainter light --sun`."""
    where: tuple[str, ...] = parameter((), metavar="WHERE ...", holds="region")
    """Region that changes; default: everything. What is outside casts shadows all the same."""
    up: UpAxis = "auto"
    """Which way is up for environments and suns; auto: -y, as captures have it."""

    @property
    def relights(self) -> bool:
        return True

    def check(self, wording: Wording = AS_PYTHON) -> None:
        super().check(wording)
        if self.where:
            check_terms(self.where)

    def lights(self, report: Report, held: Mapping[str, bytes]) -> Lights | None:
        """The new lights, their files read; None: white light from all around. report: takes what of them was passed
        over; held: as of `Tools`."""
        return None

    def source(self, held: Mapping[str, bytes]) -> SkyMap | None:
        """The environment that the asset was captured in; None: it is estimated."""
        if self.source_light is None:
            return None
        if "source_light" in held:
            return sky_of_png(held["source_light"], self.source_light.name)
        return read_sky(self.source_light, self.full_range)

    def packed(self) -> tuple[Operation, dict[str, bytes]]:
        source = self.source({})
        if self.source_light is None or source is None:
            return self, {}
        return replace(self, source_light=Path(self.source_light.name)), {"source_light": sky_to_png(source)}

    def ready(self, tools: Tools) -> ReadyOperation:
        # Read once for all assets, and its remarks kept: each asset's report gets them.
        remarks: list[str] = []
        lights = self.lights(Report(warn=remarks.append), tools.held)
        source = self.source(tools.held)
        region = Region.parse(self.where) if self.where else None

        def lit(asset: Asset, report: Report) -> Asset:
            for line in remarks:
                report.warn(line)
            # Without new lights the old one is only taken out; both ways share what they know of the light before.
            how = {"mix": self.mix, "shadows": self.shadows, "source": source, "unlit": asset.unlit}
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
    holds: ClassVar[tuple[str, ...]] = ("hdri", "source_light")

    hdri: str = parameter("", metavar="SKY")
    """Environment: studio, softbox, noon, overcast, sunset, dawn, moonlight, forest, or a lat-long picture (.hdr, .exr;
    .png ends at white). Its mean counts as that of the light before: brighter or darker by --exposure."""
    rotate: float = 0.0
    """Degrees by which the environment turns, counter-clockwise seen from above."""
    exposure: float = same_range(Lights, "exposure", 0.0)
    """Stops, of all lights."""
    sun: tuple[str, ...] = parameter((), metavar="LIGHT ...")
    """Suns: AZIMUTH,ELEVATION in degrees, azimuths as of cameras."""
    sun_size: float = parameter(SUN_DEGREES, ge=0, le=90)
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
    sun_at: tuple[str, ...] = parameter((), metavar="TIME,LAT,LON ...")
    """The sun at a time (with its zone) and a place, degrees north and east: 2026-06-21T15:00+02:00,48.1,11.6."""
    north: float = 0.0
    """Azimuth at which north lies, for --sun-at; degrees, as of cameras."""
    rig: str = parameter("", metavar="RIG")
    """Lights of a rig: three-point, rembrandt, butterfly, rim, window, product, neon, or a file: .json as --save-rig
    writes it, UsdLux as text (.usda), KHR_lights_punctual (.glb, .gltf). Other options add to it."""
    save_rig: Path | None = parameter(None, metavar="RIG", output=True)
    """Write the lights to a rig: .json, .usda or .glb."""
    match: tuple[Path, ...] = parameter((), metavar="PICTURE ...", file=True)
    """Find the new light in 1 to 4 pictures of ASSET in it: rendered views, relit in 2D. With --hdri it is that one,
    fitted to the pictures."""
    match_cameras: tuple[Path, ...] = parameter((), metavar="CAM.json ...", option="match_camera", file=True)
    """Cameras of --match, where the pictures do not carry them."""
    match_asset: Path | None = parameter(None, metavar="OTHER", file=True)
    """Take the light that is baked into another asset."""
    painter: bool = True
    """Let the painter explain of --match what light does not, where that is better on a part that was held back."""
    balls: Path | None = parameter(None, metavar="FILE.png", output=True)
    """Write a picture of white balls in the light before and in the new one (of environments)."""
    save_light: Path | None = parameter(None, metavar="SKY", output=True)
    """Write the new environment, .exr or .hdr, for --hdri."""
    save_source: Path | None = parameter(None, metavar="SKY", output=True)
    """Write the light before, .exr or .hdr, for --source-light."""
    kelvin: float | None = parameter(None, metavar="K", ge=KELVIN_RANGE[0], le=KELVIN_RANGE[1])
    """Colour of suns and lamps that say none, as a temperature: 1667 to 25000; 2700 a bulb, 6500 about white."""
    fill: float | None = parameter(None, metavar="LEVEL", ge=0, le=10)
    """White light from all around besides; default: 0.15 where suns and lamps come without --hdri, else 0."""
    add: bool = False
    """Add the lights to the one that is baked in; default: they replace it."""

    def check(self, wording: Wording = AS_PYTHON) -> None:
        super().check(wording)
        # A rig may bring everything; whether its lights go together is said once it is read.
        lights = self._added_to(Lights(up=self.up))
        # Without a file that may bring more lights, what is there must be enough; the sky's file is not read for that.
        if not (self.rig or self.match or self.match_asset):
            replace(lights, sky=ANY_SKY if self.hdri else None).check()
        if self.save_rig is not None and self.save_rig.suffix.lower() not in WRITTEN_RIGS:
            raise ValueError(f"{self.save_rig}: expected a rig to write ({', '.join(WRITTEN_RIGS)})")
        # Endings are looked at before the work: a picture at the end of it that cannot be written would waste it.
        for path, suffixes in ((self.balls, (".png",)), (self.save_light, SKY_FILES), (self.save_source, SKY_FILES)):
            if path is not None and path.suffix.lower() not in suffixes:
                raise ValueError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")
        self._check_match(wording)

    def _check_match(self, wording: Wording) -> None:
        name = wording.option
        if self.hdri and self.match_asset is not None:
            raise wording.error(self.kind, f"expected {name('hdri')} or {name('match_asset')}, got both")
        if not self.match:
            return
        # A match finds all of the light from pictures, so each option that sets a part of it contradicts it.
        mixed = {
            name("rig"): self.rig,
            name("match_asset"): self.match_asset,
            "lamps": self.sun or self.sun_at or any(getattr(self, kind) for kind in FORMS),
        }
        if wrong := [option for option, value in mixed.items() if value]:
            line = f"{name('match')} finds all of the light; expected it without {', '.join(wrong)}"
            raise wording.error(self.kind, line)
        # Cameras belong to pictures by their order, so there are none or as many.
        if self.match_cameras and len(self.match_cameras) != len(self.match):
            expected = f"{len(self.match)} {name('match_cameras')}, one for each picture"
            raise wording.error(self.kind, f"expected {expected}, got {len(self.match_cameras)}")

    def files(self) -> tuple[Path, ...]:
        # Names of skies and rigs that come with the package are words here and no files.
        named = [(self.hdri, SKIES), (self.rig, RIGS)]
        return (*super().files(), *(Path(name) for name, names in named if name and name not in names))

    def lights(self, report: Report, held: Mapping[str, bytes]) -> Lights:
        lights = Lights(up=self.up)
        # The rig first and the options over it, so that a rig can be varied from the command line.
        if self.rig:
            lights, passed_over = read_rig(self.rig, self.up, self.full_range)
            lights = lights if self.up == "auto" else replace(lights, up=self.up)
            for line in passed_over:
                report.warn(line)
        lights = self._added_to(lights)
        if "hdri" in held:
            lights = replace(lights, sky=sky_of_png(held["hdri"], self.hdri))
        elif self.hdri:
            lights = replace(lights, sky=parse_sky(self.hdri, self.full_range))
        # The light of another asset is estimated from its colours and then used like any environment.
        if self.match_asset is not None:
            captured = captured_light(read(self.match_asset), self.shadows, self.up)
            lights = replace(lights, sky=sky_of(captured.coefficients, self.up, self.match_asset.name))
            report.warn(f"{self.match_asset.name}: {captured.note}")
        # Only now all lights are there, so only now it can be said whether they go together.
        lights.check()
        return lights

    def packed(self) -> tuple[Operation, dict[str, bytes]]:
        packed, held = super().packed()
        assert isinstance(packed, Relight)
        # A rig becomes the lights that are in it: they can be changed one by one, and need no file.
        sky, name = None, Path(self.hdri).name
        if self.rig and self.rig not in RIGS:
            rig, _ = read_rig(self.rig, self.up, self.full_range)
            packed, sky = replace(packed, rig="", **rig_options(packed, rig)), rig.sky
            name = name or (sky.name if sky is not None else "")
        if self.match_asset is not None:
            captured = captured_light(read(self.match_asset), self.shadows)
            name = self.match_asset.name
            packed, sky = replace(packed, match_asset=None), sky_of(captured.coefficients, self.up, name)
        if self.hdri:
            sky = parse_sky(self.hdri, self.full_range)
        if sky is None or name in SKIES:
            return replace(packed, hdri=name), held
        return replace(packed, hdri=name), {**held, "hdri": sky_to_png(sky)}

    def turned(self, degrees: float, center: np.ndarray) -> Relight:
        """With its lights turned about the vertical through a centre ([3], world coordinates), counter-clockwise seen
        from above. A rig must be one that needs no file. Raises ValueError."""
        lights = read_rig(self.rig, self.up)[0] if self.rig in RIGS else Lights(up=self.up)
        lights = turned_lights(self._added_to(replace(lights, up=self.up)), degrees, center)
        # As options again: what stands for them is the same at every angle, so that nothing flickers.
        alone = replace(self, **{kind: () for kind in FORMS}, sun=(), sun_at=(), rig="", rotate=0.0, exposure=0.0)
        return replace(alone, **rig_options(replace(alone, fill=None), lights))

    def glance(self, splats: Splats, tools: Tools) -> np.ndarray | None:
        if self.match or self.match_asset or self.where:
            return None
        self.check()
        lights, source = self.lights(Report(), tools.held), self.source(tools.held)
        return glance(splats, lights, mix=self.mix, shadows=self.shadows, source=source, unlit=tools.unlit)

    def ready(self, tools: Tools) -> ReadyOperation:
        if self.match:
            return self._matched(tools)
        # Light from options and rigs; what was asked for as files is written beside the edit, from the same lights.
        relit = super().ready(tools)

        def lit(asset: Asset, report: Report) -> Asset:
            edited = relit(asset, report)
            if self.outputs():
                self._write_lights_of(asset.splats, self.lights(Report(), tools.held), report)
            return edited

        return lit

    def _matched(self, tools: Tools) -> ReadyOperation:
        """The light of --match: found in pictures, and the painter beside it where that is better."""
        from splatpainter.pictures import edit_from_files

        # Pictures may carry their cameras, or lie with them beside the asset, as those of `render` do.
        cameras = self.match_cameras or (None,) * len(self.match)
        folders = () if tools.asset is None else (tools.asset.parent, tools.asset.parent / "views")
        pictures = [edit_from_files(*files, folders=folders) for files in zip(self.match, cameras, strict=True)]
        source = read_sky(self.source_light, self.full_range) if self.source_light else None
        target = parse_sky(self.hdri, self.full_range) if self.hdri else None
        axes = axes_of(self.up)

        def lit(asset: Asset, report: Report) -> Asset:
            # What was odd about a picture is said before the result that it led to.
            for picture in pictures:
                for note in picture.notes:
                    report.warn(f"{picture.path.name}: {note}")
            result = match_light(
                # Pictures that are meant to light the whole asset are edits of mode global: all of it may change.
                asset.splats,
                [picture.edit(asset.splats, "global") for picture in pictures],
                (tools.painter or Painter.load(modes=("global",))) if self.painter else None,
                shadows=self.shadows,
                source=None if source is None else turned_sky(source, axes),
                target=None if target is None else turned_sky(target, axes, self.rotate),
                up=self.up,
                region=Region.parse(self.where) if self.where else None,
                mix=self.mix,
            )
            if result.environment is not None and result.environment.trust is None:
                report.warn(f"--hdri {self.hdri}: not used: {result.environment.reason}; light of the pictures alone")
            # The light that was found is what the user may want to keep; it is written for --hdri.
            self._write_lights(result.before.coefficients, result.after)
            return replace(result.asset, original=asset.original or asset.splats)

        return lit

    def _write_lights_of(self, splats: Splats, lights: Lights, report: Report) -> None:
        if self.save_rig is not None:
            for line in write_rig(self.save_rig, lights, splats.offset):
                report.warn(line)
        if self.balls or self.save_light or self.save_source:
            # Both environments are given in the asset's axes, so that they can be compared and used again.
            axes = axes_of(lights.up)
            if self.source_light is None:
                before = captured_light(splats, self.shadows, lights.up).coefficients
            else:
                before = turned_sky(read_sky(self.source_light, self.full_range), axes)
            self._write_lights(before, distant_light(lights, axes))

    def _write_lights(self, before: np.ndarray, after: np.ndarray) -> None:
        """What was asked for of two environments, SH [9, 3] in the asset's axes."""
        if self.balls is not None:
            ball_sheet(self.balls, {"before": before, "new": after}, self.up)
        if self.save_light is not None:
            write_sky(self.save_light, sky_of(after, self.up, "new"))
        if self.save_source is not None:
            write_sky(self.save_source, sky_of(before, self.up, "before"))

    def _added_to(self, lights: Lights) -> Lights:
        """Other lights with the options' own, but for the environment. Raises ValueError: words that are no light."""
        # Suns and lamps that name no colour get that of --kelvin.
        white = white_of(self.kelvin)
        suns = [parse_sun(text, self.sun_size, white) for text in self.sun]
        suns += [parse_sun_at(text, self.north, self.sun_size, white) for text in self.sun_at]
        lamps = [parse_lamp(kind, text, white) for kind in FORMS for text in getattr(self, kind)]
        # Added to those of a rig and not in place of them; a fill that is given holds against the rig's.
        return replace(
            lights,
            suns=(*lights.suns, *suns),
            lamps=(*lights.lamps, *lamps),
            rotate=lights.rotate + self.rotate,
            exposure=lights.exposure + self.exposure,
            fill=lights.fill if self.fill is None else self.fill,
            add=lights.add or self.add,
        )


def rig_options(options: Relight, rig: Lights) -> dict[str, Any]:
    """Options of a light with the lights of a rig besides its own, but for the sky."""
    # Of one level with the sky, which has none as an option: the other lights and the exposure make up for it.
    level = 1.0 if rig.sky is None else rig.sky_intensity
    suns = [replace(sun, intensity=sun.intensity / level) for sun in rig.suns]
    lamps = [replace(lamp, intensity=lamp.intensity / level) for lamp in rig.lamps]
    words = {kind: [lamp_words(lamp) for lamp in lamps if lamp.kind == kind] for kind in FORMS}
    fill = options.fill if options.fill is not None else None if rig.fill is None else rig.fill / level
    return {
        "sun": (*map(sun_words, suns), *options.sun),
        **{kind: (*words[kind], *getattr(options, kind)) for kind in FORMS},
        "rotate": rig.rotate + options.rotate,
        "exposure": rig.exposure + options.exposure + portable.log(level) / portable.LN_2,
        "fill": fill,
        "add": rig.add or options.add,
        "up": rig.up if options.up == "auto" else options.up,
    }


@dataclass(frozen=True)
class Delight(LightBefore):
    """Take the light and the shadows out of an asset's colours, as far as they can be estimated: what is left is its
    look in white light from all around."""

    kind: ClassVar[str] = "delight"

    shadows: bool = parameter(True, shared=True)
    """Shadows and occlusion by the asset itself, in the light before."""
