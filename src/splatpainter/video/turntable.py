"""A turn around an asset: its cameras, and the file that shows it. Frames are rendered as they are encoded, so that
the length of a turntable is bounded by patience, not by memory."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from splatpainter.cameras import Camera, orbit
from splatpainter.color import to_display
from splatpainter.image_files import quantized
from splatpainter.kernels.portable import arctan2, dot, length
from splatpainter.pictures.picture_reader import unpremultiplied
from splatpainter.rendering import render
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.video.mp4 import CodedFrames, avif_samples, mp4

TurntableFormat = Literal["mp4", "webp"]
MIN_FRAMES, MAX_FRAMES = 2, 7200
"""Frames of one turntable."""
MAX_SECONDS = 600.0
MAX_FPS = 120.0
MAX_SIDE_PX = 8192
"""Pixels of a frame's longer side."""
KEY_INTERVAL = 120
"""Frames between two at which a player can start, and the most that the AV1 encoder gets at a time."""
AV1_SPEED = 8
"""libaom's, 0 to 10: a third of the time of 6, for files that are a tenth larger."""
WEBP_METHOD = 2
"""libwebp's effort, 0 to 6."""


@dataclass(frozen=True)
class TurntableOptions:
    """How a turntable is written. Raises ValueError for what no turntable can be."""

    format: TurntableFormat = "mp4"
    """MP4 (AV1), or animated WebP that loops."""
    seconds: float = 6.0
    fps: float = 30.0
    transparent: bool = False
    """No background but an alpha channel: WebP only."""
    quality: int = 80
    """Quality of the encoding, 1 to 100."""
    profile: Profile = "inria"
    """Which renderer to match, as in `render`."""

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("seconds", self.seconds, 0.05, MAX_SECONDS),
            ("frames per second", self.fps, 0.1, MAX_FPS),
            ("quality", self.quality, 1, 100),
        ):
            if not low <= value <= high:
                raise ValueError(f"turntable: expected {name} from {low:g} to {high:g}, got {value:g}")
        if not MIN_FRAMES <= self.frames <= MAX_FRAMES:
            raise ValueError(f"turntable: expected {MIN_FRAMES} to {MAX_FRAMES} frames, got {self.frames}")
        if self.format not in get_args(TurntableFormat):
            raise ValueError(f"turntable: expected the format mp4 or webp, got {self.format!r}")
        if self.transparent and self.format == "mp4":
            raise ValueError("turntable: MP4 has no transparency; choose WebP, or a background")

    @property
    def frames(self) -> int:
        return round(self.seconds * self.fps)

    def check_installed(self) -> None:
        """Raises ValueError where this Pillow cannot write the format."""
        from PIL import features

        kind = {"mp4": "avif", "webp": "webp"}[self.format]
        if not features.check(kind):
            raise ValueError(f"turntable: this Pillow was built without {kind.upper()}; pip install --upgrade pillow")


def turn(camera: Camera, center: np.ndarray, up: Sequence[float], count: int, degrees: float = 360.0) -> list[Camera]:
    """`count` views from `camera` on, at its height above and distance from the centre [3], with its lens; they look
    at the centre. up: [3] world direction of the axis. degrees: of the whole turn, counter-clockwise seen from above;
    after a full one the next view would be the first again, else the last is at its end."""
    # The first view as height and angle about the axis; the others keep both distance and height.
    axis = np.asarray(up, float) / length(np.asarray(up, float))
    away = camera.position - center
    height = dot(away, axis)
    flat = away - height * axis
    distance = max(length(away), 1e-6)
    tilt = math.degrees(arctan2(height, max(length(flat), 1e-9)))
    zero = orbit(center, distance, 1, elevation=0, up=axis)[0].position - center
    start = math.degrees(arctan2(dot(np.cross(zero, flat), axis), dot(zero, flat)))
    steps = turn_angles(count, degrees)
    ring = (orbit(center, distance, 1, elevation=tilt, start=start + step, up=axis)[0] for step in steps.tolist())
    return [replace(camera, world_to_camera=view.world_to_camera) for view in ring]


def turn_angles(count: int, degrees: float = 360.0) -> np.ndarray:
    """[count] degrees from 0 on, of views or of lights that turn."""
    # A full turn ends one step before its first view, so that a loop does not stutter.
    closed = degrees % 360 == 0 and degrees != 0
    return degrees * np.arange(count) / max(count if closed else count - 1, 1)


def even(camera: Camera) -> Camera:
    """The same view without an odd last row or column: video has half as many colour samples as pixels."""
    return camera.cropped(0, 0, max(camera.width & ~1, 2), max(camera.height & ~1, 2))


def turntable_bytes(
    splats: Splats | Callable[[int], Splats],
    cameras: Sequence[Camera],
    options: TurntableOptions,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> bytes:
    """Render and encode. splats: the asset, or what it is in the k-th frame (under lights that turn). cameras: of one
    size, `options.frames` of them or as many as the turntable shall have. on_frame(done, total): called before each
    frame; what it raises ends the work. Raises ValueError."""
    options.check_installed()
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) != 1 or not MIN_FRAMES <= len(cameras) <= MAX_FRAMES:
        raise ValueError(f"turntable: expected {MIN_FRAMES} to {MAX_FRAMES} cameras of one size, got {len(cameras)}")
    longer = max(next(iter(sizes)))
    if longer > MAX_SIDE_PX:
        raise ValueError(f"turntable: expected frames of at most {MAX_SIDE_PX} pixels a side, got {longer}")
    if options.format == "mp4":
        cameras = [even(camera) for camera in cameras]

    def draw(k: int) -> np.ndarray:
        on_frame(k, len(cameras))
        return frame(splats(k) if callable(splats) else splats, cameras[k], options)

    if options.format == "mp4":
        # In parts of bounded memory, each beginning with a picture at which a player can start.
        count = -(-len(cameras) // KEY_INTERVAL)
        ends = [len(cameras) * k // count for k in range(count + 1)]  # of two frames at least: one alone is no sequence
        parts = [_av1(draw, start, end, options) for start, end in pairwise(ends)]
        return mp4(joined(parts), options.fps)
    images = _sequence(draw, 0, len(cameras))
    # WebP counts milliseconds: ends are rounded, not durations, so that errors do not add up.
    ends = np.rint(1000 / options.fps * np.arange(1, len(cameras) + 1)).astype(int)
    durations = np.diff(ends, prepend=0).tolist()
    file = io.BytesIO()
    images.save(
        file, "WEBP", save_all=True, duration=durations, loop=0, quality=options.quality, method=WEBP_METHOD
    )  # fmt: skip
    return file.getvalue()


def frame(splats: Splats, camera: Camera, options: TurntableOptions) -> np.ndarray:
    """[H, W, 3] uint8 display colours; [H, W, 4] with straight alpha where it is transparent."""
    drawn = render(splats, camera, profile=options.profile)
    colors, alpha = drawn.colors[0], drawn.alphas[0, ..., 0]
    if options.transparent:
        colors = unpremultiplied(colors - (1 - alpha[..., None]) * np.asarray(camera.background, colors.dtype), alpha)
    display = np.clip(to_display(colors, splats.color_space), 0, 1)
    return quantized(np.concatenate([display, alpha[..., None]], -1) if options.transparent else display)


def joined(parts: Sequence[CodedFrames]) -> CodedFrames:
    """Films of one size and coding one after the other."""
    keys, frames = [], []
    for part in parts:
        keys += [len(frames) + key for key in part.keys]
        frames += part.frames
    return replace(parts[0], frames=tuple(frames), keys=tuple(keys))


def format_of(path: Path) -> TurntableFormat:
    """The format that a file name asks for. Raises ValueError."""
    for name in get_args(TurntableFormat):
        if path.suffix.lower() == f".{name}":
            return name
    raise ValueError(f"{path}: expected a turntable's name ending in .mp4 or .webp")


def _av1(draw: Callable[[int], np.ndarray], start: int, end: int, options: TurntableOptions) -> CodedFrames:
    """Frames start..end, coded."""
    file = io.BytesIO()
    pictures = _sequence(draw, start, end)
    pictures.save(
        file, "AVIF", save_all=True, duration=40, quality=options.quality, speed=AV1_SPEED, range="limited",
        subsampling="4:2:0",
    )  # fmt: skip
    return avif_samples(file.getvalue())


def _sequence(draw: Callable[[int], np.ndarray], start: int, end: int):
    """A Pillow image of several frames, each of which is drawn when the encoder asks for it."""
    from PIL import Image

    class Sequence(Image.Image):
        is_animated = True
        n_frames = end - start

        def __init__(self) -> None:
            super().__init__()
            self._show(0)

        def _show(self, k: int) -> None:
            self.at = k
            self.__dict__.update(Image.fromarray(draw(start + k)).__dict__)

        def tell(self) -> int:
            return self.at

        def seek(self, frame: int) -> None:
            if not 0 <= frame < self.n_frames:
                raise EOFError(f"frame {frame} of {self.n_frames}")
            if frame > self.at:  # encoders go forward, and once back to the first at their end
                self._show(frame)

    return Sequence()
