"""`splatpainter light`: an asset, or a region of it, under other lights, verified like an edit."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from splatpainter.cameras import UpAxis
from splatpainter.commands import Outcome
from splatpainter.commands.asset_doubts import warn_of_doubts
from splatpainter.commands.option_parsing import AssetFile, AxesOption, FrameOption, OutFile
from splatpainter.commands.terminal import count, seconds, stages
from splatpainter.commands.verified_write import check_outputs, proved_record, write_proved
from splatpainter.commands.verify import same_words
from splatpainter.io import read
from splatpainter.lights.lamps import SUN_DEGREES
from splatpainter.lights.light_words import FORMS, parse_lamp, parse_sky, parse_sun, white_of
from splatpainter.lights.relight import Lights, delight, relight
from splatpainter.lights.sky_maps import SkyMap, read_sky
from splatpainter.operations.region import Region
from splatpainter.receipts import receipt_of

Words = Annotated[tuple[str, ...], arg(metavar="LIGHT ...", help_behavior_hint="")]


@dataclass(frozen=True)
class Config:
    """Light an asset, or a region of it: an environment, suns, lamps, with the asset's own shadows, baked into its
    colours. The light that is in them already is estimated, or given; colours change by the ratio of both.

    A light is numbers with commas between, then perhaps a colour and an intensity: 120,35,#ffe0b0,2. An intensity of 1
    is as bright as white light from all around, on a surface that faces the sun, or stands one world unit from a lamp.
    Lights that begin with a minus need an equals sign: --point=-1,0,2. WHERE is as `splatpainter grade` has it.

    example:
      splatpainter light vase.ply --hdri sunset --rotate 40 --out evening.ply
      splatpainter light vase.ply --hdri sky.hdr --source-light studio.hdr --out outside.ply
      splatpainter light room.ply --point 0,-1.2,0.5,#ffe0b0,2 --add --out lamp_on.ply
    """

    asset: AssetFile
    """The splat file; it is not changed."""
    out: OutFile
    """The file to write; its name says the format."""
    hdri: Annotated[str, arg(metavar="SKY", help_behavior_hint="")] = ""
    """Environment: studio, noon, overcast, sunset, or a lat-long picture (.hdr, .exr; .png ends at white). Its mean
    counts as that of the light before: brighter or darker by --exposure."""
    rotate: float = 0.0
    """Degrees by which the environment turns, counter-clockwise seen from above."""
    exposure: float = 0.0
    """Stops, of all lights."""
    sun: Words = ()
    """Suns: AZIMUTH,ELEVATION in degrees, azimuths as of cameras."""
    sun_size: float = SUN_DEGREES
    """Angular diameter of the suns, degrees: softness of their shadows."""
    point: Words = ()
    """Points: X,Y,Z in world units, as `splatpainter info` prints bounds."""
    spot: Words = ()
    """Spots: X,Y,Z, where they look to, and the full angle in degrees."""
    rect: Words = ()
    """Rectangles: X,Y,Z, where they look to, width, height."""
    disk: Words = ()
    """Disks: X,Y,Z, where they look to, radius."""
    sphere: Words = ()
    """Spheres: X,Y,Z, radius."""
    kelvin: Annotated[float | None, arg(metavar="K", help_behavior_hint="")] = None
    """Colour of suns and lamps that say none, as a temperature: 1667 to 25000; 2700 a bulb, 6500 about white."""
    fill: Annotated[float | None, arg(metavar="LEVEL", help_behavior_hint="")] = None
    """White light from all around besides; default: 0.15 where suns and lamps come without --hdri, else 0."""
    add: bool = False
    """Add the lights to the one that is baked in; default: they replace it."""
    mix: float = 1.0
    """How much of the new look, 0 .. 1; the rest is the captured one."""
    shadows: bool = True
    """Shadows and occlusion by the asset itself, in the light before and now."""
    source_light: Annotated[Path | None, arg(metavar="SKY", help_behavior_hint="")] = None
    """The environment that the asset was captured in (lat-long .hdr, .exr); default: estimated from its colours."""
    full_range: bool = False
    """Environments with suns and lamps as bright as they are stored; default: limited to what 99.9 % of their values
    stay below. A sun comes back by `splatpainter light --sun`."""
    where: Annotated[tuple[str, ...], arg(metavar="WHERE ...", help_behavior_hint="")] = ()
    """Region that changes; default: everything. What is outside casts shadows all the same."""
    up: UpAxis = "auto"
    """Which way is up for environments and suns; auto: -y, as captures have it."""
    frame: FrameOption = "auto"
    """Axes of ASSET's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    axes: AxesOption = "auto"
    """Axes of OUT's numbers; auto: those of ASSET if both are of one format, else what OUT's format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    receipt: Annotated[Path | None, arg(metavar="R.json", help_behavior_hint="")] = None
    """Where the receipt goes; default: OUT.receipt.json."""
    overwrite: bool = False
    """Replace OUT and the receipt if they exist."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Check, read, light, write, verify."""
    inputs = [Path(config.hdri)] if Path(config.hdri).suffix else []
    return write_lit(config, lights_of(config), inputs)


def lights_of(config: Config) -> Lights:
    """What the options ask for. Raises ValueError."""
    white = white_of(config.kelvin)
    lights = Lights(
        sky=parse_sky(config.hdri, config.full_range) if config.hdri else None,
        suns=tuple(parse_sun(text, config.sun_size, white) for text in config.sun),
        lamps=tuple(parse_lamp(kind, text, white) for kind in FORMS for text in getattr(config, kind)),
        rotate=config.rotate,
        exposure=config.exposure,
        fill=config.fill,
        add=config.add,
        up=config.up,
    )
    lights.check()
    return lights


def write_lit(config: Any, lights: Lights | None, inputs: list[Path]) -> Outcome:
    """What `light` and `delight` (no lights) share. Raises ValueError."""
    receipt_path = config.receipt or receipt_of(config.out)
    inputs = inputs + ([config.source_light] if config.source_light else [])
    check_outputs(config.out, receipt_path, config.overwrite, config.asset, inputs)
    if not 0 < config.mix <= 1:
        raise ValueError(f"splatpainter: expected --mix above 0, up to 1, got {config.mix:g}")
    source: SkyMap | None = read_sky(config.source_light, config.full_range) if config.source_light else None
    region = Region.parse(config.where) if config.where else None
    with stages(4) as bar:
        bar.enter("reading")
        clock = time.perf_counter()
        splats = read(config.asset, frame=config.frame, lenient=config.lenient)
        read_seconds = time.perf_counter() - clock
        warn_of_doubts(splats, config.asset)
        bar.enter("lighting")
        shared = {"mix": config.mix, "shadows": config.shadows, "source": source}
        if lights is None:
            edited = delight(splats, region, up=config.up, **shared)
        else:
            edited = relight(splats, lights, region, **shared)
        receipt, verification = write_proved(splats, edited, config.out, receipt_path, config.axes, bar, read_seconds)
    changed = f"{count(len(receipt.touched), 'Gaussian')} changed"
    same = f"{verification.same:,} of {count(verification.rows, 'Gaussian')} {same_words(verification)}, verified"
    lines = [
        f"{config.asset} -> {config.out}",
        *([f"frame: {verification.frame}"] if verification.frame_is_news else []),
        *(part for part in receipt.note.split("; ") if part),
        changed,
        same,
        seconds(receipt.seconds),
    ]
    return Outcome(proved_record(config.out, receipt_path, receipt, verification), lines)
