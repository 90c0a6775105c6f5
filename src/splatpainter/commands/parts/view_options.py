"""Views as the commands take them: cameras of files, or a ring around the asset, and the colour behind it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.color import from_display, from_hex
from splatpainter.rendering import MAX_SIDE_PX
from splatpainter.splats import Splats

MAX_VIEWS = 1000
BACKGROUND = "0.25,0.25,0.25"
"""Behind views that no file says the camera of."""


class RingOptions(Protocol):
    """Options of a command that renders a ring of views around an asset, or from given cameras."""

    @property
    def camera(self) -> Any: ...
    @property
    def size(self) -> int | None: ...
    @property
    def width(self) -> int | None: ...
    @property
    def height(self) -> int | None: ...
    @property
    def background(self) -> str | None: ...
    @property
    def up(self) -> Any: ...
    @property
    def elevation(self) -> float: ...
    @property
    def fov(self) -> float: ...
    @property
    def distance(self) -> float | None: ...


def ring_of_views(options: RingOptions, splats: Splats, views: int) -> list[Camera]:
    """Views around the asset, which fills the shorter side."""
    size = options.size or 800
    width, height = options.width or size, options.height or size
    short = min(width, height)
    cameras = orbit_cameras(
        splats,
        views,
        size=short,
        up=options.up,
        elevation=options.elevation,
        fov=options.fov,
        distance=options.distance,
        background=color(options.background or BACKGROUND, splats),
    )
    return [camera.cropped((short - width) // 2, (short - height) // 2, width, height) for camera in cameras]


def check_ring(command: str, options: RingOptions, least_px: int = 1) -> None:
    """Raises ValueError in the name of this command. least_px: of a side."""
    sides = {f"--{name}": getattr(options, name) for name in ("size", "width", "height")}
    check_ranges(command, {name: (value, least_px, MAX_SIDE_PX) for name, value in sides.items() if value is not None})
    check_ranges(command, {"--elevation": (options.elevation, -90, 90), "--fov": (options.fov, 1, 170)})
    if (options.width is None) != (options.height is None) or (options.width and (options.size or options.camera)):
        raise ValueError(f"splatpainter {command}: expected --width and --height together, without --size and --camera")
    if options.distance is not None and not 0 < options.distance < float("inf"):
        raise ValueError(f"splatpainter {command}: expected --distance above 0, got {options.distance}")
    if options.background is not None:
        rgb(options.background)


def check_ranges(command: str, values: dict[str, tuple[float, float, float]]) -> None:
    """values: of each option, and the least and most that it may be. Raises ValueError in the name of this command."""
    for name, (value, least, most) in values.items():
        if not least <= value <= most:
            raise ValueError(f"splatpainter {command}: expected {name} from {least} to {most}, got {value}")


def given_cameras(paths: Sequence[Path], size: int | None, asset: Path | None = None) -> list[Camera]:
    """The cameras in these files, of captures all that a path names; size: pixels of the longer side, None: as they
    say; asset: what they are for (captures.captured_views). Raises ValueError."""
    from splatpainter.captures import is_capture, named_views, split_selector
    from splatpainter.pictures.edit_files import camera_from

    cameras: list[Camera] = []
    for path in paths:
        if split_selector(path)[1] or not is_capture(path):
            cameras.append(camera_from(path, asset))
        else:
            cameras += [view.camera for view in named_views(path, asset)]
    if len(cameras) > MAX_VIEWS:
        raise ValueError(f"{paths[0]}: expected at most {MAX_VIEWS:,} cameras, got {len(cameras):,}; name one: FILE:N")
    return cameras if size is None else [camera.with_longest_side(size) for camera in cameras]


def given_camera(path: Path, size: int | None, asset: Path | None = None) -> Camera:
    """The one camera in a file, else as `given_cameras`."""
    from splatpainter.pictures.edit_files import camera_from

    camera = camera_from(path, asset)
    return camera if size is None else camera.with_longest_side(size)


def rgb(text: str) -> tuple[float, float, float]:
    """Display colour 0..1 from "0.2,0.5,1" or "#3380ff". Raises ValueError."""
    try:
        if text.startswith("#") and (parsed := from_hex(text)) is not None:
            return parsed
        red, green, blue = (float(part) for part in text.split(","))
        if all(0 <= value <= 1 for value in (red, green, blue)):
            return red, green, blue
    except ValueError:
        pass
    raise ValueError(f"--background: expected R,G,B from 0 to 1, or #rrggbb, got {text!r}")


def color(text: str, splats: Splats) -> tuple[float, float, float]:
    """A display colour, in the asset's colour space."""
    import numpy as np

    red, green, blue = from_display(np.array(rgb(text)), splats.color_space).tolist()
    return red, green, blue
