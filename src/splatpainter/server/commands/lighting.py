"""What the light panel asks for: the environments that need no file, with their pictures. The light itself is a layer
(`layer.add`, `layer.set`)."""

from __future__ import annotations

from functools import cache

import numpy as np

from splatpainter.color import linear_to_srgb
from splatpainter.lights.skies import SKIES, sky
from splatpainter.server.commands.context import CommandContext, command
from splatpainter.server.protocol import Answer, Blob, Command, Message
from splatpainter.server.uploads.image_registration import png_bytes

THUMBNAIL_MEAN = 0.25
"""Mean of a thumbnail, linear: as light they all have the same mean, too."""


class SkyInfo(Message):
    """An environment that needs no file."""

    name: str
    """As the option `hdri` takes it."""
    picture: Blob
    """PNG, lat-long, of 128 x 64 pixels."""


class SkiesListed(Answer):
    skies: list[SkyInfo]


class SkiesList(Command):
    """The environments that need no file."""

    NAME = "light.skies"
    ANSWER = SkiesListed


@command(SkiesList)
def list_skies(context: CommandContext, request: SkiesList) -> SkiesListed:
    blobs = context.studio.blobs
    return SkiesListed(
        skies=[SkyInfo(name=name, picture=blobs.put(_thumbnail(name), f"{name}.png").sha256) for name in SKIES]
    )


@cache
def _thumbnail(name: str) -> bytes:
    radiance = sky(name).radiance
    return png_bytes(linear_to_srgb(np.clip(radiance * (THUMBNAIL_MEAN / radiance.mean()), 0, 1)))
