"""Renders, picking, coverage, and pictures from elsewhere. Nothing here changes the asset."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from splatpainter.aovs import Aov
from splatpainter.rendering.profiles import Profile
from splatpainter.server.messages.base import Answer, Command, FileName
from splatpainter.server.messages.state import Blob, Camera, Model, Point, Rgb, Unit


class PictureMade(Answer):
    picture: Blob
    """A PNG (a WebP for `turntable`)."""
    file: str | None = None
    """Its name in the watched folder, where it was written there."""


class ViewRender(Command):
    """The server's float render of a view, as a PNG with its camera inside."""

    NAME = "view.render"
    ANSWER = PictureMade
    camera: Camera
    which: Literal["now", "original"] = "now"
    profile: Profile = "inria"
    """Whose formula for alpha; pictures to be painted on have the default."""


class ViewExported(PictureMade):
    picture: Blob
    """The exported picture where it is an 8-bit PNG with a background at the view's size, else such a preview."""
    url: str | None = None
    """To download from: the picture, or a zip of it, its AOVs and its sidecar; None for "folder"."""
    name: str = ""
    """Of what is downloaded."""


class ViewExport(Command):
    """A render to edit elsewhere. to "folder": written into the watched folder as NAME.png with its sidecar; when it is
    saved over, a `picture` event follows."""

    NAME = "view.export"
    ANSWER = ViewExported
    camera: Camera
    to: Literal["download", "folder"] = "download"
    name: FileName = "view"
    size: int | None = Field(default=None, ge=16, le=8192)
    """Pixels of the longer side; None: as the camera says."""
    format: Literal["png", "exr"] = "png"
    bits: Literal[8, 16, 32] | None = None
    """Of a colour sample: PNG 8 or 16, OpenEXR 16 or 32; None: the smaller."""
    transparent: Literal["straight", "premultiplied"] | None = None
    """An alpha channel in place of the background; OpenEXR is always premultiplied."""
    aovs: list[Aov] = Field(default_factory=list, max_length=5)
    """Files beside the picture, NAME.AOV.png or .exr."""
    profile: Profile = "inria"


class Turntable(Command):
    """An animated WebP of a turn around the asset, seen as by `camera`."""

    NAME = "turntable"
    ANSWER = PictureMade
    camera: Camera
    frames: int = Field(default=36, ge=2, le=240)
    fps: float = Field(default=18, gt=0, le=60)


class Picked(Answer):
    hit: bool
    """Whether the asset covers the pixel by more than half; else depth, point and row are None."""
    depth: float | None
    """z, world units."""
    point: Point | None
    """World coordinates."""
    row: int | None
    """The row that gives the pixel most of its colour."""
    color: Rgb
    """As seen, display sRGB 0..1."""


class Pick(Command):
    NAME = "pick"
    ANSWER = Picked
    camera: Camera
    x: float
    y: float
    """Pixels; the first pixel's centre is 0.5, 0.5."""


class Covered(Answer):
    seen: int
    """Rows that edited views show."""
    predicted: int
    """Rows that global layers changed without having seen them."""
    picture: Blob
    """PNG of the view, of its size: green seen, red predicted, transparent neither."""
    next_view: Camera | None
    """Faces the largest area that was predicted and not seen; None where there is none."""


class Coverage(Command):
    """What of the current asset was seen by edited views and what is predicted."""

    NAME = "coverage"
    ANSWER = Covered
    camera: Camera


Found = Literal["given", "chunk", "sidecar", "export"]


class PictureWarning(Model):
    message: str
    picture: Blob | None = None
    """Shows where, of the camera's size, transparent elsewhere."""


class Checked(Answer):
    camera: Camera
    found: Found
    """Where the camera came from; "export": the export that the picture resembles most."""
    picture: Blob
    """PNG at the camera's size, put straight: use this one in `edit`."""
    mask: Blob
    """PNG of the change mask (white: changed), of the camera's size."""
    share: Unit
    """Of the pixels, changed."""
    shift: tuple[float, float]
    """Pixels (right, down) that the picture had been moved by, and that were taken back."""
    notes: list[str]
    """What was done to the picture (resampled, converted from a colour profile), one line each."""
    warnings: list[PictureWarning]
    """E.g. that the whole picture changed, also where nothing was painted."""


class PictureCheck(Command):
    """What a dropped picture is: its camera, its size and place mended, what changed in it. Changes nothing."""

    NAME = "picture.check"
    ANSWER = Checked
    picture: Blob
    name: str = Field(default="", max_length=300)
    """File name, for the sidecar and the exports of the watched folder."""
    camera: Camera | None = None
    threshold: Unit | None = None
    """Differences (0..1) from which a pixel counts as changed; None: found from the picture's noise."""
