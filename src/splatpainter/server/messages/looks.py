"""Global sliders."""

from __future__ import annotations

from pydantic import Field

from splatpainter.server.messages.base import Command, Name
from splatpainter.server.messages.painting import LayerMade, Previewed
from splatpainter.server.messages.state import Blob, Camera, Model, Unit


class HueBand(Model):
    """A change of one range of hues."""

    hue: float = Field(ge=0, lt=360)
    """Middle of the range, degrees (0 red, 120 green, 240 blue)."""
    width: float = Field(default=60, gt=0, le=360)
    """Degrees to either side over which the change fades out."""
    shift: float = Field(default=0, ge=-180, le=180)
    """Degrees."""
    saturation: float = Field(default=0, ge=-1, le=1)
    lightness: float = Field(default=0, ge=-1, le=1)


class Look(Model):
    """Global sliders; zeros change nothing."""

    exposure: float = Field(default=0, ge=-5, le=5)
    """Stops, in linear light."""
    temperature: float = Field(default=0, ge=-1, le=1)
    """-1 cold .. 1 warm."""
    tint: float = Field(default=0, ge=-1, le=1)
    """-1 green .. 1 magenta."""
    contrast: float = Field(default=0, ge=-1, le=1)
    saturation: float = Field(default=0, ge=-1, le=1)
    """-1: grey."""
    curve: list[tuple[Unit, Unit]] = Field(default=[], max_length=16)
    """Points (in, out) of a tone curve of display values, by ascending `in`; [] is the straight line."""
    hues: list[HueBand] = Field(default=[], max_length=12)
    strength: Unit = 1.0


class LookPreview(Command):
    """Show the sliders on all rows, or on those that a mask reaches, without a layer: the changed rows' colours come as
    PREVIEW frames. look None: take the preview away."""

    NAME = "look.preview"
    ANSWER = Previewed
    look: Look | None
    mask: Blob | None = None
    camera: Camera | None = None
    """The view of the mask."""


class LookCommit(Command):
    """The sliders as a layer."""

    NAME = "look.commit"
    ANSWER = LayerMade
    look: Look
    name: Name = "Look"
    mask: Blob | None = None
    camera: Camera | None = None
