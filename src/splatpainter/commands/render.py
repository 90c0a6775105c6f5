"""`splatpainter render`: pictures of an asset that carry their camera, ready to be painted on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from splatpainter.cameras import Camera
from splatpainter.commands import Outcome
from splatpainter.commands.options import AssetFile, CameraFiles, FrameOption
from splatpainter.commands.targets import check_folder, check_target, make_folder, save_picture
from splatpainter.commands.terminal import count, progress
from splatpainter.framing import around
from splatpainter.io import frame_line, read
from splatpainter.sources.color import from_display, to_display
from splatpainter.splats import Splats

LARGEST = 8192
"""Pixels of the longer side."""
MOST_VIEWS = 1000


@dataclass(frozen=True)
class Config:
    """Render pictures of an asset: a ring of views around it, or the cameras that you give.

    Every PNG carries its camera (in a text chunk, and in NAME.json beside it), so that `edit` knows where a painted
    picture was seen from.

    example:
      splatpainter render vase.ply --out views --views 8 --size 800
      splatpainter render vase.ply --out views --camera views/view_003.json --size 1600
    """

    asset: AssetFile
    """The splat file."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for view_000.png, view_000.json, ...; made if missing."""
    views: int = 8
    """How many views around the asset."""
    camera: CameraFiles = ()
    """Use these cameras instead (CAM.json, or PNGs that carry one); --views, --up and so on do not count then."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Pixels of the longer side; default: 800, or what the camera says."""
    background: Annotated[str | None, arg(metavar="R,G,B", help_behavior_hint="")] = None
    """Colour behind the asset, 0..1 or #rrggbb; default: 0.25,0.25,0.25, or what the camera says."""
    frame: FrameOption = "auto"
    """Axes of the file's numbers: rub is y up, rdf y down; auto: what the file says, else what its format has."""
    lenient: bool = False
    """Also open a file that was cut off behind its last whole row; what is left of the cut part is kept."""
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = "auto"
    """Direction that is up in the pictures; auto: -y, the habit of captures (GLB and SPZ are turned when read)."""
    elevation: float = 15.0
    """Degrees above the horizon."""
    fov: float = 40.0
    """Vertical field of view, degrees."""
    distance: Annotated[float | None, arg(metavar="FLOAT", help_behavior_hint="")] = None
    """From the asset's centre, world units; default: so that it fills the picture."""
    overwrite: bool = False
    """Replace pictures that exist (they may have been painted on)."""
    json: bool = False
    """Print one JSON object instead of text."""


def run(config: Config) -> Outcome:
    """Render and save."""
    _check(config)
    given = _given(config)
    names = [config.out / f"view_{k:03d}.png" for k in range(len(given) or config.views)]
    check_folder(config.out)
    if config.out.is_dir():
        for name in names:
            check_target(name, config.overwrite)
            check_target(name.with_suffix(".json"), config.overwrite)
    splats = read(config.asset, frame=config.frame, lenient=config.lenient)
    cameras = given or around(
        splats,
        config.views,
        size=config.size or 800,
        up=config.up,
        elevation=config.elevation,
        fov=config.fov,
        distance=config.distance,
        background=color(config.background or "0.25,0.25,0.25", splats),
    )
    if given and config.background is not None:
        cameras = [replace(camera, background=color(config.background, splats)) for camera in cameras]
    cameras = [replace(camera, asset_sha256=splats.sha256) for camera in cameras]
    make_folder(config.out)
    for _ in progress(_save_all(splats, cameras, names), len(cameras), "rendering"):
        pass
    hidden = int((~splats.finite).sum())
    record = {
        "asset": {"file": config.asset, "sha256": splats.sha256, "rows": len(splats), "rows_not_drawn": hidden},
        "views": [
            {"file": name, "camera": name.with_suffix(".json"), "width": camera.width, "height": camera.height}
            for name, camera in zip(names, cameras, strict=True)
        ],
    }
    lines = [f"{count(len(names), 'picture')} in {config.out}: {names[0].name} ... each with its camera inside"]
    assert splats.source is not None
    lines.append(f"frame: {frame_line(splats.source)}")
    if hidden:
        lines.append(f"{count(hidden, 'row')} of {len(splats):,} cannot be drawn")
    return Outcome(record, lines)


def _save_all(splats: Splats, cameras: list[Camera], names: list[Path]) -> Iterator[Path]:
    from splatpainter.render import render
    from splatpainter.warmup import ensure_compiled

    ensure_compiled()
    for camera, name in zip(cameras, names, strict=True):
        colors = render(splats, camera).colors[0]
        save_picture(name, to_display(colors, splats.color_space), camera)
        yield name


def _check(config: Config) -> None:
    for name, value, low, high in (
        ("--views", config.views, 1, MOST_VIEWS),
        ("--size", config.size or 1, 1, LARGEST),
        ("--elevation", config.elevation, -90, 90),
        ("--fov", config.fov, 1, 170),
    ):
        if not low <= value <= high:
            raise ValueError(f"splatpainter render: expected {name} from {low} to {high}, got {value}")
    if config.size == 0:
        raise ValueError(f"splatpainter render: expected --size from 1 to {LARGEST}, got 0")
    if config.distance is not None and not 0 < config.distance < float("inf"):
        raise ValueError(f"splatpainter render: expected --distance above 0, got {config.distance}")
    if config.background is not None:
        rgb(config.background)


def _given(config: Config) -> list[Camera]:
    from splatpainter.sources.files import camera_from

    cameras = [camera_from(path) for path in config.camera]
    if config.size is not None:
        scales = [config.size / max(camera.width, camera.height) for camera in cameras]
        cameras = [
            camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
            for camera, scale in zip(cameras, scales, strict=True)
        ]
    return cameras


def rgb(text: str) -> tuple[float, float, float]:
    """Display colour 0..1 from "0.2,0.5,1" or "#3380ff". Raises ValueError."""
    try:
        if text.startswith("#") and len(text) == 7:
            red, green, blue = (int(text[k : k + 2], 16) / 255 for k in (1, 3, 5))
        else:
            red, green, blue = (float(part) for part in text.split(","))
        if all(0 <= value <= 1 for value in (red, green, blue)):
            return red, green, blue
    except ValueError:
        pass
    raise ValueError(f"splatpainter render: expected --background as R,G,B from 0 to 1, or #rrggbb, got {text!r}")


def color(text: str, splats: Splats) -> tuple[float, float, float]:
    """A display colour, in the asset's colour space."""
    import numpy as np

    red, green, blue = from_display(np.array(rgb(text)), splats.color_space).tolist()
    return red, green, blue
