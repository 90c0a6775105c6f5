"""`splatpainter turntable`: a video of a turn around an asset."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from splatpainter.cameras import AUTO_UP, UPS, UpAxis, bounding_sphere
from splatpainter.commands import Outcome
from splatpainter.commands.parts.asset_doubts import warn_of_doubts
from splatpainter.commands.parts.option_marks import Argument
from splatpainter.commands.parts.option_parsing import AssetFile, InAxesOption, OutFile
from splatpainter.commands.parts.terminal import progress, size
from splatpainter.commands.parts.view_options import check_ranges, check_ring, color, given_camera, ring_of_views
from splatpainter.io import axes_news, files, read
from splatpainter.output_paths import check_target
from splatpainter.rendering.profiles import Profile
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.operations.light import Relight
    from splatpainter.splats import Splats
    from splatpainter.video.turntable import TurntableOptions

MAX_DEGREES = 3600.0
MIN_SIDE_PX = 16


@dataclass(frozen=True)
class Config:
    """Write a turntable: an MP4 (AV1) or animated WebP in which the camera turns around an asset.

    The name of OUT says which: .mp4 or .webp. Programs that do not play AV1 want H.264, which ffmpeg makes of it:
    ffmpeg -i turn.mp4 -c:v libx264 -pix_fmt yuv420p turn-h264.mp4.

    example:
      splatpainter turntable vase.ply --out turn.mp4
      splatpainter turntable vase.ply --out turn.mp4 --width 1920 --height 1080 --seconds 10 --background "#ffffff"
      splatpainter turntable vase.ply --out turn.webp --size 400 --fps 20 --transparent
      splatpainter turntable vase.ply --out day.mp4 --hdri sunset --turns lights
      splatpainter turntable vase.ply --out swing.mp4 --camera views/view_003.json --degrees 90
    """

    asset: AssetFile
    """The splat file."""
    out: OutFile
    """The video: NAME.mp4 or NAME.webp."""
    seconds: float = 6.0
    """Length of the video, seconds."""
    fps: float = 30.0
    """Frames per second."""
    degrees: float = 360.0
    """How far it turns, counter-clockwise seen from above; negative: the other way."""
    camera: Annotated[Path | None, Argument(metavar="CAM.json", help_behavior_hint="")] = None
    """The first view (CAM.json, a PNG that carries one, or FILE:N of a capture); --elevation, --fov and --distance are
    then ignored."""
    hdri: Annotated[str, Argument(metavar="SKY")] = ""
    """Light the asset by this environment, as `splatpainter light --hdri`."""
    sun: Annotated[tuple[str, ...], Argument(metavar="LIGHT ...")] = ()
    """Light it by suns, as `splatpainter light --sun`."""
    rig: Annotated[str, Argument(metavar="RIG")] = ""
    """Light it by a rig, as `splatpainter light --rig`."""
    turns: Literal["camera", "lights", "both"] = "camera"
    """What turns: the camera, the lights about the asset, or both."""
    size: Annotated[int | None, Argument(metavar="PX", help_behavior_hint="")] = None
    """Pixels of the longer side; default: 800, or what the camera says. MP4 has an even number of rows and columns."""
    width: Annotated[int | None, Argument(metavar="PX", help_behavior_hint="")] = None
    """Pixels; with --height, in place of --size."""
    height: Annotated[int | None, Argument(metavar="PX", help_behavior_hint="")] = None
    """See --width."""
    background: Annotated[str | None, Argument(metavar="R,G,B", help_behavior_hint="")] = None
    """Colour behind the asset, 0..1 or #rrggbb; default: 0.25,0.25,0.25, or what the camera says."""
    transparent: bool = False
    """No background (WebP only)."""
    quality: int = 80
    """Quality of the encoding, 1 to 100."""
    profile: Profile = "inria"
    """Which renderer to match: inria, as most assets were trained, or playcanvas (about 1 % darker)."""
    in_axes: InAxesOption = "auto"
    """Axes of the file's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    lenient: bool = False
    """Also open a file that was cut off after its last complete row; what is left of the cut part is kept."""
    up: UpAxis = "auto"
    """Axis of the turn, up in the pictures; auto: -y, as most captures have it (GLB and SPZ are turned when read)."""
    elevation: float = 15.0
    """Degrees above the horizon."""
    fov: float = 40.0
    """Field of view of the shorter side, degrees."""
    distance: Annotated[float | None, Argument(metavar="FLOAT", help_behavior_hint="")] = None
    """Camera's distance from the asset's centre, world units; default: so that it fills the picture."""
    overwrite: bool = False
    """Replace OUT if it exists."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Render, encode, save."""
    from splatpainter.video.turntable import turn, turn_angles, turntable_bytes

    # Format and options first: an encoder that is missing is told before anything is rendered.
    options = _options(config)
    _check(config)
    light = _light(config)
    given = None if config.camera is None else given_camera(config.camera, config.size, config.asset)
    check_target(config.out, config.overwrite, [config.asset])
    # The camera may come from a file or from the asset's size, so the asset is read in between.
    splats = read(config.asset, axes=config.in_axes, lenient=config.lenient)
    first = given.relative_to(splats.offset) if given else ring_of_views(config, splats, 1)[0]
    if given and config.background is not None:
        first = replace(first, background=color(config.background, splats))
    warn_of_doubts(splats, config.asset)
    # Turned about the centre of nearly all of it: strays would make it wobble.
    center, up = bounding_sphere(splats)[0], UPS[AUTO_UP if config.up == "auto" else config.up]
    cameras = turn(first, center, up, options.frames, config.degrees if config.turns != "lights" else 0.0)
    asset = splats if light is None else _lit(splats, light, config, turn_angles(options.frames, config.degrees))
    # Rendered and encoded in one go, so the bar follows frame by frame.
    with _bar(options.frames) as on_frame:
        data = turntable_bytes(asset, cameras, options, on_frame)
    with files.writing(config.out) as file:
        file.write(data)
    width, height = first.width, first.height
    # MP4 wants even sides, so the record says what was written and not what was asked for.
    record = {
        "asset": {"file": config.asset, "sha256": splats.sha256, "rows": len(splats)},
        "output": {"file": config.out, "format": options.format, "bytes": len(data)},
        "frames": options.frames,
        "seconds": options.frames / options.fps,
        "width": width - width % 2 * (options.format == "mp4"),
        "height": height - height % 2 * (options.format == "mp4"),
    }
    line = f"{config.out}: {options.frames} frames of {record['width']}x{record['height']}, {size(len(data))}"
    return Outcome(record, [line, *axes_news(splats)])


def _light(config: Config) -> Relight | None:
    """The light that the options ask for, checked. Raises ValueError."""
    from splatpainter.operations.light import Relight

    if not (config.hdri or config.sun or config.rig):
        if config.turns != "camera":
            raise ValueError(f"turntable: expected lights for --turns {config.turns}: --hdri, --sun or --rig")
        return None
    light = Relight(hdri=config.hdri, sun=config.sun, rig=config.rig, up=config.up)
    light.check()
    return light


def _lit(splats: Splats, light: Relight, config: Config, angles: np.ndarray) -> Splats | Callable[[int], Splats]:
    """The asset in that light, or what it is in each frame where the light turns."""
    from splatpainter.lights.relight import relight
    from splatpainter.lights.turning import turned_lights
    from splatpainter.operations.operation import Report

    lights = light.lights(Report(), {})
    center = bounding_sphere(splats)[0] + np.array(splats.offset)
    if config.turns == "camera":
        return relight(splats, lights).splats
    return lambda k: relight(splats, turned_lights(lights, float(angles[k]), center)).splats


@contextmanager
def _bar(total: int) -> Iterator[Callable[[int, int], None]]:
    """A progress bar, moved by a function of (frames done, frames in all)."""
    # A generator as a bar: it is stepped from the encoder's callback and closed at the end.
    steps = progress(range(total), total, "turntable")
    yield lambda done, total: (next(steps, None), None)[1]
    for _ in steps:  # it closes where it ends
        pass


def _options(config: Config) -> TurntableOptions:
    from splatpainter.video.turntable import TurntableOptions, format_of

    options = TurntableOptions(
        format_of(config.out), config.seconds, config.fps, config.transparent, config.quality, config.profile
    )
    options.check_installed()
    return options


def _check(config: Config) -> None:
    check_ring("turntable", config, least_px=MIN_SIDE_PX)
    check_ranges("turntable", {"--degrees": (config.degrees, -MAX_DEGREES, MAX_DEGREES)})
