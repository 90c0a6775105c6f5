"""Renders, turntables, picking, coverage."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera, orbit, to_uint8
from splatpainter.io.files import sha256, writing
from splatpainter.server import overlook
from splatpainter.server.actions import Call, handles
from splatpainter.server.actions.common import Word, camera_of, draw, python_line
from splatpainter.server.core import ExportedView
from splatpainter.server.describe import camera_to_wire, up_axis
from splatpainter.server.messages import looking as say
from splatpainter.server.pictures import png_bytes, small
from splatpainter.session.conflicts import PREDICTED, SEEN
from splatpainter.session.conflicts import coverage as covered
from splatpainter.session.export import view_files_of
from splatpainter.sources.color import to_display
from splatpainter.view_files import PictureOptions

MAX_EXPORT_PIXELS = 1 << 24
"""Of an exported view: 4096 x 4096."""
FAST = 1
"""Level of PNG compression: nobody waits for the last few per cent."""
TURN_PIXELS = 40_000_000
"""Pixels of all frames of a turntable together: they are held in memory."""
MAX_FRAME_MS = 60_000
"""How long a frame of a turntable may stay."""


@handles(say.ViewRender)
def render_view(call: Call, command: say.ViewRender) -> say.PictureMade:
    studio, camera = call.studio, camera_of(command.camera)
    splats = studio.session.splats if command.which == "now" else studio.original
    blob = studio.blobs.put(png_bytes(draw(splats, camera, command.profile), camera), "render.png")
    named = "" if command.profile == "inria" else f", profile={command.profile!r}"
    return say.PictureMade(picture=blob.sha256, python=f"sp.render(session.splats, camera{named})")


@handles(say.ViewExport, aside=True)
def export_view(call: Call, command: say.ViewExport) -> say.ViewExported:
    studio, camera = call.studio, camera_of(command.camera)
    shown = studio.session.shown
    bits, aovs = command.bits, tuple(command.aovs)
    options = PictureOptions(command.format, bits, command.transparent, aovs, command.profile, FAST)
    sized = camera if command.size is None else _sized(camera, command.size)
    image = draw(shown.splats, camera, command.profile)
    call.ticket.report(0, "rendering the view")
    made = view_files_of(shown.splats, shown.level.touches, sized, command.name, options)
    first, file, url, given = next(iter(made)), None, None, ""
    if command.to == "folder":
        file = _into_folder(call, made)
    else:
        path = studio.downloads.folder() / (first if len(made) == 2 else f"{command.name}.zip")
        with writing(path) as out:
            if len(made) == 2:  # it carries what the sidecar says
                out.write(made[first])
            else:
                with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as bundle:
                    for name, data in made.items():
                        bundle.writestr(name, data)
        url, given = studio.downloads.add(path), path.name
    plain = (options.format, options.depth, options.transparent, sized) == ("png", 8, None, camera)
    preview = made[first] if plain else png_bytes(image, camera)
    blob = studio.blobs.put(preview, f"{command.name}.png")
    studio.exports.append(ExportedView(first, sized, small(image)))
    look = {"bits": bits, "transparent": command.transparent, "aovs": list(aovs) or None}
    look["profile"] = None if command.profile == "inria" else command.profile
    line = python_line("session.export_view", first, Word("camera"), **look)
    return say.ViewExported(picture=blob.sha256, file=file, url=url, name=given, python=line)


def _sized(camera: Camera, size: int) -> Camera:
    """The same view with `size` pixels on its longer side. Raises ValueError: too many in all."""
    scale = size / max(camera.width, camera.height)
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    if width * height > MAX_EXPORT_PIXELS:
        raise ValueError(f"view: expected at most {MAX_EXPORT_PIXELS / 1e6:.1f} megapixels, got {width}x{height}")
    return camera.resized(width, height)


def _into_folder(call: Call, made: Mapping[str, bytes]) -> str:
    """Write files into the watched folder; returns the name of the first."""
    studio = call.studio
    if studio.folder is None:
        raise ValueError("view: the studio was started without a folder; download the picture instead")
    places = [studio.folder.file(name, new=True) for name in made]
    for place, data in zip(places, made.values(), strict=True):
        studio.written[place.name] = sha256(data)  # before the watcher sees it
        with writing(place) as file:
            file.write(data)
    return places[0].name


@handles(say.Turntable, aside=True)
def turntable(call: Call, command: say.Turntable) -> say.PictureMade:
    from PIL import Image

    studio, camera = call.studio, camera_of(command.camera)
    if command.frames * camera.width * camera.height > TURN_PIXELS:
        side = int((TURN_PIXELS / command.frames) ** 0.5)
        raise ValueError(
            f"turntable: {command.frames} frames of this size are too many; make them {side}x{side} or less"
        )
    splats = studio.session.splats
    pictures = []
    for k, view in enumerate(
        _turn(camera, np.array(studio.state.asset.center), command.frames, up_axis(studio.session))
    ):
        call.ticket.report(k / command.frames, "turntable")
        pictures.append(Image.fromarray(to_uint8(draw(splats, view))))
    file = io.BytesIO()
    pace = round(min(1000 / command.fps, MAX_FRAME_MS))
    pictures[0].save(
        file, "WEBP", save_all=True, append_images=pictures[1:], duration=pace, loop=0, quality=88, method=2
    )
    blob = studio.blobs.put(file.getvalue(), "turntable.webp")
    return say.PictureMade(picture=blob.sha256, python="sp.render(session.splats, sp.orbit(center, distance, frames))")


@handles(say.Pick)
def pick(call: Call, command: say.Pick) -> say.Picked:
    splats, camera = call.studio.session.splats, camera_of(command.camera)
    color, found = overlook.hit(splats, camera, command.x, command.y)
    shown = np.clip(to_display(color, splats.color_space), 0, 1).tolist()
    if found is None:
        return say.Picked(hit=False, depth=None, point=None, row=None, color=shown)
    return say.Picked(hit=True, depth=found.depth, point=found.point.tolist(), row=found.row, color=shown)


@handles(say.Coverage)
def coverage(call: Call, command: say.Coverage) -> say.Covered:
    studio, camera = call.studio, camera_of(command.camera)
    shown = studio.session.shown
    splats, kinds = shown.splats, covered(shown.level.touches, len(shown.splats))
    picture = overlook.coverage_picture(splats, kinds, camera)
    view = overlook.next_view(splats, kinds, camera, np.array(studio.state.asset.center), up_axis(studio.session))
    return say.Covered(
        seen=int((kinds == SEEN).sum()),
        predicted=int((kinds == PREDICTED).sum()),
        picture=studio.blobs.put(png_bytes(picture), "coverage.png").sha256,
        next_view=None if view is None else camera_to_wire(view),
        python="session.coverage()",
    )


def _turn(camera: Camera, center: np.ndarray, count: int, up: tuple[int, int, int]) -> list[Camera]:
    """Views around the centre, from `camera` on, at its height and distance and with its lens."""
    axis = np.asarray(up, float)
    away = camera.position - center
    height = float(away @ axis)
    flat = away - height * axis
    distance = float(np.linalg.norm(away))
    tilt = float(np.degrees(np.arctan2(height, max(np.linalg.norm(flat), 1e-9))))
    first = orbit(center, max(distance, 1e-6), 1, elevation=tilt, up=axis)[0].position - center
    first = first - (first @ axis) * axis
    turned = np.degrees(np.arctan2(float(np.cross(first, flat) @ axis), float(first @ flat)))
    ring = orbit(center, max(distance, 1e-6), count, elevation=tilt, start=float(turned), up=axis)
    return [replace(camera, world_to_camera=view.world_to_camera) for view in ring]
