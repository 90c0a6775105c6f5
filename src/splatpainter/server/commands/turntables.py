"""Turntables: a turn around the asset as it is, moving."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from splatpainter.io.files import writing
from splatpainter.rendering.profiles import Profile
from splatpainter.server.commands.context import CommandContext, RawExpr, command, python_line
from splatpainter.server.commands.viewing import MAX_EXPORT_PIXELS, resized
from splatpainter.server.describe import up_axis
from splatpainter.server.protocol import CameraInfo, Command, Exported, FileName
from splatpainter.splats import Splats
from splatpainter.video.turntable import (
    MAX_FPS,
    MAX_FRAMES,
    MAX_SECONDS,
    MIN_FRAMES,
    TurntableFormat,
    TurntableOptions,
    turn,
    turn_angles,
    turntable_bytes,
)


class Turntable(Command):
    """A video of a turn around the asset, from `camera` on."""

    NAME = "turntable"
    ANSWER = Exported
    camera: CameraInfo
    size: int | None = Field(default=None, ge=16, le=8192)
    """Pixels of the longer side; None: as the camera says. MP4 has an even number of rows and columns."""
    format: TurntableFormat = "webp"
    """Animated WebP, or MP4 (AV1)."""
    seconds: float = Field(default=2, gt=0, le=MAX_SECONDS)
    fps: float = Field(default=18, gt=0, le=MAX_FPS)
    frames: int | None = Field(default=None, ge=MIN_FRAMES, le=MAX_FRAMES)
    """Frames, in place of `seconds`."""
    degrees: float = Field(default=360, ge=-3600, le=3600)
    """Counter-clockwise seen from above."""
    turns: Literal["camera", "lights", "both"] = "camera"
    """What turns: the camera about the asset, the lights of its light layers about it, or all but the asset."""
    transparent: bool = False
    """An alpha channel in place of the camera's background; WebP only."""
    quality: int = Field(default=88, ge=1, le=100)
    profile: Profile = "inria"
    name: FileName = "turntable"


@command(Turntable, background=True, bound=True)
def turntable(context: CommandContext, request: Turntable) -> Exported:
    studio, camera = context.studio, request.camera.to_camera(MAX_EXPORT_PIXELS)
    # Frames may be given in place of seconds, for programs that count them.
    seconds = request.seconds if request.frames is None else request.frames / request.fps
    options = TurntableOptions(
        request.format, seconds, request.fps, request.transparent, request.quality, request.profile
    )
    sized = camera if request.size is None else resized(camera, request.size)
    # The centre of the asset as it was opened, so that the turn does not depend on the edits.
    session, snapshot = studio.session, studio.session.snapshot
    center = np.array(studio.state.asset.center)
    turning = request.degrees if request.turns != "lights" else 0.0
    cameras = turn(sized, center, up_axis(session), options.frames, turning)
    angles, world = turn_angles(options.frames, request.degrees), center + np.array(session.original.offset)

    def lit(k: int) -> Splats:
        return session.layers.under_turned_lights(float(angles[k]), world, snapshot)

    splats = snapshot.splats if request.turns == "camera" else lit
    data = turntable_bytes(splats, cameras, options, lambda k, n: context.ticket.report(k / n, f"frame {k + 1} of {n}"))
    path = studio.downloads.folder() / f"{request.name}.{request.format}"
    with writing(path) as file:
        file.write(data)
    line = python_line("turntable_bytes", RawExpr("session.splats"), RawExpr("turn(camera, center, up, frames)"))
    return Exported(url=studio.downloads.add(path), file=path.name, bytes=len(data), python=line)
