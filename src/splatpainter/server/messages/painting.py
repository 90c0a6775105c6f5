"""Strokes with their preview, and layers from edited pictures."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from splatpainter.server.messages.base import PIXELS, Answer, Command, Name
from splatpainter.server.messages.state import Blend, Blob, Camera, LayerInfo, Method, Mode, Model, Unit


class StrokeStarted(Answer):
    stroke: str


class PaintBegin(Command):
    """Start a stroke on a view; the server keeps the view's projection, so that dabs are quick. One stroke per client:
    a second one cancels the first."""

    NAME = "paint.begin"
    ANSWER = StrokeStarted
    camera: Camera
    kind: Literal["paint", "clone", "erase"] = "paint"
    """erase: back to the original; the patches' alpha counts, their colours do not."""


class Previewed(Answer):
    rows: int
    """Whose colours the preview changed; they come as a binary frame with the PREVIEW flag."""


class PaintDab(Command):
    """New pixels of the stroke. The patch replaces what the stroke holds in that rectangle (send the composite of all
    dabs so far). Straight alpha: 0 is unpainted, colours are what the view shall show where alpha is 1."""

    NAME = "paint.dab"
    ANSWER = Previewed
    stroke: str
    x: int = Field(ge=0)
    y: int = Field(ge=0)
    """Left upper corner in pixels of the view."""
    width: int = Field(ge=1, le=16384)
    height: int = Field(ge=1, le=16384)
    rgba: str = Field(max_length=6 * PIXELS)
    """Base64 of width * height * 4 bytes, row by row from the top (canvas ImageData)."""


class LayerMade(Answer):
    layer: LayerInfo


class PaintEnd(Command):
    """Commit the stroke as a layer (the chosen method runs on the server's own copy of the stroke's pixels, over its
    float render: nothing to upload). Its rows come as a delta; previewed rows that it leaves alone are put back."""

    NAME = "paint.end"
    ANSWER = LayerMade
    stroke: str
    name: Name = "Stroke"
    method: Method = "auto"
    opacity: Unit = 1.0
    blend: Blend = "normal"


class PaintCancel(Command):
    """Drop the stroke; previewed rows are put back."""

    NAME = "paint.cancel"
    stroke: str


class EditView(Model):
    """One edited picture, of its camera's size (other sizes of the same shape are resampled)."""

    camera: Camera
    picture: Blob
    """Transparent pixels: unchanged."""
    mask: Blob | None = None
    """What is not black was edited; None: found by comparing with the render."""


class Edit(Command):
    """A layer from 1 to 4 edited pictures. mode local: only what was edited; global: regrades or relights everything.
    kind erase: rows that the masks reach go back to the original."""

    NAME = "edit"
    ANSWER = LayerMade
    views: list[EditView] = Field(min_length=1, max_length=4)
    kind: Literal["paint", "picture", "clone", "erase"] = "picture"
    mode: Mode = "local"
    method: Method = "auto"
    name: Name = "Picture"
    opacity: Unit = 1.0
    blend: Blend = "normal"
    within: bool = False
    """Of mode global: only rows that the masks reach change, and only masked pixels count."""
    stroke: str | None = None
    """A previewed stroke that this edit replaces."""
