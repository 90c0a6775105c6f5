"""What the light panel asks for besides layers (`layer.add`, `layer.set`, `layer.preview`), which the light itself is:
environments with their pictures, and the lights that are in files, in the sky at some hour, or in a picture."""

from __future__ import annotations

import contextlib
import math
from datetime import datetime
from functools import cache
from typing import cast

import numpy as np
from pydantic import Field

from splatpainter.cameras import UpAxis
from splatpainter.color import linear_to_srgb
from splatpainter.image_files import find_camera
from splatpainter.lights.held_skies import sky_of_png, sky_to_png
from splatpainter.lights.match import match_light, sky_of
from splatpainter.lights.rig_files import read_rig
from splatpainter.lights.skies import HEIGHT, SKIES, sky
from splatpainter.lights.sky_maps import SkyMap, read_sky
from splatpainter.lights.solar import sun_at
from splatpainter.lights.studio_rigs import RIGS
from splatpainter.operations.light import Relight, rig_options
from splatpainter.server.commands.context import CommandContext, command, naming_errors
from splatpainter.server.commands.painting import EditedView, edit_from_upload
from splatpainter.server.option_fields import LightOptions
from splatpainter.server.protocol import Answer, Blob, CameraInfo, Command, Message
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.session.kinds.operation_layers import OperationLayer

THUMBNAIL_MEAN = 0.25
"""Mean of a thumbnail, linear: as light they all have the same mean, too."""
SKY = "hdri"
"""The option of a light that names its environment."""


class SkyInfo(Message):
    """An environment."""

    name: str
    """As the option `hdri` takes it."""
    picture: Blob
    """PNG, lat-long, of 128 x 64 pixels."""
    held: Blob | None = None
    """Of one from a file: what a layer holds of it (`held` of layer.add); None: it needs no file."""


class SkiesListed(Answer):
    skies: list[SkyInfo]
    """First those that need no file, then those that layers hold."""
    rigs: list[str]
    """Names of rigs that need no file."""


class SkiesList(Command):
    """The environments and rigs that there are."""

    NAME = "light.skies"
    ANSWER = SkiesListed


@command(SkiesList)
def list_skies(context: CommandContext, request: SkiesList) -> SkiesListed:
    blobs, session = context.studio.blobs, context.studio.session
    skies = [SkyInfo(name=name, picture=blobs.put(_thumbnail(name), f"{name}.png").sha256) for name in SKIES]
    seen = set()
    for layer in session.layers:
        for operation in (leaf.operation for leaf in layer.leaves()):
            held = operation.held.get(SKY) if isinstance(operation, OperationLayer) else None
            if held is None or held in seen:
                continue
            seen.add(held)
            name = operation.record()[SKY]
            skies.append(_sky_info(context, sky_of_png(session.files.blob(held), name), held))
    return SkiesListed(skies=skies, rigs=[*RIGS])


class SkyRead(Answer):
    sky: SkyInfo
    note: str
    """What one should know of its light; "": nothing."""


class SkyFile(Command):
    """An environment of a file that was sent: reduced to what light needs of it, for layers to hold."""

    NAME = "light.sky"
    ANSWER = SkyRead
    file: Blob


@command(SkyFile, background=True)
def read_sky_file(context: CommandContext, request: SkyFile) -> SkyRead:
    blob = context.studio.blobs.get(request.file)
    if blob.info.kind not in ("sky", "picture"):
        raise ValueError(f"{blob.name or 'the file'}: expected an environment (.hdr, .exr; .png ends at white)")
    context.ticket.report(0, "reading the sky")
    with naming_errors(blob.path, blob.name or "the sky"):
        environment = read_sky(blob.path)
    name = blob.name or environment.name
    environment = SkyMap(environment.radiance, name, environment.note.replace(blob.path.name, name))
    return SkyRead(sky=_sky_info(context, environment), note=environment.note)


class RigRead(Answer):
    operation: LightOptions
    """Its lights as options of a light; those it leaves alone are at their defaults."""
    notes: list[str]
    """What of it was passed over."""


class RigOpen(Command):
    """The lights of a rig, by its name or of a file that was sent: one of ours, UsdLux as text, KHR_lights_punctual."""

    NAME = "light.rig"
    ANSWER = RigRead
    name: str = ""
    file: Blob | None = None


@command(RigOpen)
def open_rig(context: CommandContext, request: RigOpen) -> RigRead:
    up = _up_of(context)
    if request.file is None:
        if request.name not in RIGS:
            raise ValueError(f"light: expected a rig of {', '.join(RIGS)}, or a file of one")
        lights, notes = read_rig(request.name, up)
    else:
        blob = context.studio.blobs.get(request.file, "rig")
        # Of an upload no other file is opened: it may name any of this machine.
        with naming_errors(blob.path, blob.name or "the rig"):
            lights, notes = read_rig(blob.path, up, alone=True)
    options = rig_options(Relight(), lights)
    named = "" if lights.sky is None else lights.sky.name
    fields = {name: list(value) if isinstance(value, tuple) else value for name, value in options.items()}
    return RigRead(operation=LightOptions(kind="light", hdri=named, **{**fields, "up": up}), notes=notes)


class SunPosition(Answer):
    azimuth: float
    """Degrees, as suns of a light have it."""
    elevation: float


class SunAt(Command):
    """Where the sun stands at a time and a place."""

    NAME = "light.sun_at"
    ANSWER = SunPosition
    time: str = Field(max_length=40)
    """2026-06-21T15:00+02:00, with its zone."""
    latitude: float = Field(ge=-90, le=90)
    """Degrees north."""
    longitude: float = Field(ge=-180, le=180)
    """Degrees east."""
    north: float = 0.0
    """Azimuth at which north lies, degrees."""


@command(SunAt)
def find_sun(context: CommandContext, request: SunAt) -> SunPosition:
    try:
        when = datetime.fromisoformat(request.time)
    except ValueError:
        raise ValueError(f"sun: expected a time as 2026-06-21T15:00+02:00, got {ascii(request.time[:40])}") from None
    try:
        sun = sun_at(when, request.latitude, request.longitude, request.north)
    except ValueError as error:
        raise ValueError(f"sun: {error}; choose another time or place") from None
    return SunPosition(azimuth=(sun.azimuth + 180) % 360 - 180, elevation=sun.elevation)


class LightMatched(Answer):
    sky: SkyInfo
    source: Blob
    """The light before, as layers hold it (option `source_light`)."""
    exposure: float
    """Stops that the new light is brighter."""
    note: str


class LightMatch(Command):
    """The light of 1 to 4 pictures of the asset, relit elsewhere, as an environment, and the one before."""

    NAME = "light.match"
    ANSWER = LightMatched
    pictures: list[Blob] = Field(min_length=1, max_length=4)
    camera: CameraInfo
    """View that pictures show which do not say their camera."""


@command(LightMatch, background=True)
def match_pictures(context: CommandContext, request: LightMatch) -> LightMatched:
    context.ticket.report(0, "finding the light")
    splats, up = context.studio.session.splats, _up_of(context)
    edits = []
    for picture in request.pictures:
        camera = request.camera
        # What `render` and exports write says its camera; programs that drop it give a picture of the view.
        with contextlib.suppress(ValueError):
            carried = find_camera(context.studio.blobs.get(picture, "picture").path)
            camera = CameraInfo.of(carried.relative_to(splats.offset))
        edits.append(edit_from_upload(context, EditedView(picture=picture, camera=camera), "global"))
    matched = match_light(splats, edits)
    # Environments are of one level each; how much brighter the new one is becomes the exposure.
    before, after = (sky_of(one, up, "") for one in (matched.before.coefficients, matched.after))
    levels = [float(one[0].mean()) for one in (matched.before.coefficients, matched.after)]
    name = f"light of {edits[0].name}"[:60]
    source = context.studio.blobs.put(sky_to_png(before), "before.png").sha256
    return LightMatched(
        sky=_sky_info(context, SkyMap(after.radiance, name)),
        source=source,
        exposure=round(math.log2(max(levels[1], 1e-6) / max(levels[0], 1e-6)), 3),
        note=matched.before.note,
    )


def _up_of(context: CommandContext) -> UpAxis:
    return cast(UpAxis, context.studio.session.scene.up)


def _sky_info(context: CommandContext, environment: SkyMap, held: str | None = None) -> SkyInfo:
    blobs = context.studio.blobs
    held = held or blobs.put(sky_to_png(environment), "sky.png").sha256
    # Of what is held: it is small already, and the same picture for the same sky.
    radiance = sky_of_png(context.studio.picture_bytes(held)[0], environment.name).radiance
    step = max(1, radiance.shape[0] // HEIGHT)
    picture = blobs.put(_picture(radiance[::step, ::step]), "thumbnail.png").sha256
    return SkyInfo(name=environment.name, picture=picture, held=held)


@cache
def _thumbnail(name: str) -> bytes:
    return _picture(sky(name).radiance)


def _picture(radiance: np.ndarray) -> bytes:
    return png_bytes(linear_to_srgb(np.clip(radiance * (THUMBNAIL_MEAN / radiance.mean()), 0, 1)))
