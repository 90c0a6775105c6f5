"""What every client of the studio knows about the session: the `state` of messages. Values only; knows no session."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Blob = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
"""Hex SHA-256 of bytes that were sent to POST /api/blobs, or that the server made; GET /api/blobs/{blob} has them."""
Unit = Annotated[float, Field(ge=0, le=1)]
Rgb = Annotated[list[float], Field(min_length=3, max_length=3)]
Point = Annotated[list[float], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]
Mode = Literal["local", "global"]
Method = Literal["auto", "ttt", "lift", "fit"]
Blend = Literal["normal", "color", "luminosity", "darken", "lighten"]
LayerKind = Literal["paint", "picture", "look", "clone", "erase", "merged"]


class Model(BaseModel):
    """Base of everything that travels: unknown fields are errors, NaN and infinity are too."""

    model_config = ConfigDict(
        extra="forbid",
        allow_inf_nan=False,
        use_attribute_docstrings=True,
        json_schema_serialization_defaults_required=True,
    )


class Camera(Model):
    """splatpainter.cameras.Camera as JSON: OpenCV axes (x right, y down, z forward), pixel centres at +0.5."""

    version: Literal[1]
    width: int = Field(ge=1, le=16384)
    height: int = Field(ge=1, le=16384)
    fx: float = Field(gt=0)
    """Pixels."""
    fy: float = Field(gt=0)
    cx: float
    """Principal point, pixels (width / 2 for a centred one)."""
    cy: float
    world_to_camera: list[Row4] = Field(min_length=4, max_length=4)
    """4 x 4, row-major, rigid."""
    background: Rgb
    """Behind the asset, 0..1, in the asset's colour space."""
    asset_sha256: str | None = None


class AssetInfo(Model):
    """The asset that is open, as it is shown now."""

    name: str
    format: str
    """Key of the file format it came from; "" for the demo asset."""
    sha256: str
    """Of the original."""
    rows: int
    """Now, appended ones included."""
    rows_original: int
    rows_same: int
    """Rows of the original that are bit for bit what they were."""
    sh_coefficients: int
    """K per row and channel: 1, 4, 9, 16 or 25."""
    color_space: Literal["srgb", "linear"]
    antialiased: bool
    center: Point
    """Of nearly all opaque rows, world units."""
    radius: float
    up: Point
    """Unit vector, world axes, that is up on the screen."""
    home: Camera
    """A good first view; keep its field of view and change its size to that of the window."""
    frame: str
    """Which way the numbers in the file point, and who says so; "" for rows without a file."""
    frame_said: bool
    """False: files of this format differ in it and this one does not say, so it may be upside down (`asset.up`)."""
    problems: list[str]
    """What the reader found odd, one line each."""


class LayerView(Model):
    """One edited picture of a layer."""

    camera: Camera
    picture: Blob | None = None
    mask: Blob | None = None
    psnr_before: float | None = None
    """dB against the picture inside the mask, before the layer (999: identical; None: no such pixel, or not known)."""
    psnr_after: float | None = None
    psnr_outside: float | None = None
    """dB of the render after against the one before, outside the mask."""


class LayerInfo(Model):
    """One layer; the list of layers goes from bottom to top."""

    id: str
    name: str
    kind: LayerKind
    visible: bool
    opacity: Unit
    blend: Blend
    mode: Mode
    method: Method
    views: list[LayerView]
    parameters: dict[str, Any]
    rows_touched: int
    rows_appended: int
    seconds: float
    """That its computation took."""
    note: str = ""
    """Why the method was chosen, or what could not be painted."""
    problem: str = ""
    """Why it changes nothing where it now stands (its rows are hidden below); "" where it works."""
    thumbnail: Blob | None = None
    """PNG of what was edited, 96 pixels at most."""


class Step(Model):
    """One entry of the history, oldest first."""

    id: int
    label: str


class Conflict(Model):
    """A layer overwrites rows that another layer touched from another view."""

    lower: str
    """Layer id."""
    upper: str
    rows: int
    share: Unit
    """Of the lower layer's touched rows."""
    policy: Literal["latest", "first", "blend"]


class Bookmark(Model):
    id: str
    name: str
    camera: Camera


class ProjectInfo(Model):
    """Where the session lives. There is no unsaved state: every acknowledged command is in the file."""

    name: str
    file: str | None
    """Its name in the studio's folder; None while it only lives in the studio's own data folder (autosave)."""
    read_only: bool
    """Nothing can be changed: somebody else has it open, or it cannot be written."""
    read_only_reason: str = ""
    """Why, one line; "" where it can be changed."""


class Present(Model):
    """What is so now, and bounded by what is on the screen."""

    session: str
    """Changes when another asset or project is opened: forget all versions and sync."""
    version: int
    """Of the asset; goes up by one or more with every change of its rows."""
    asset: AssetInfo
    layers: list[LayerInfo]
    cursor: int
    """Place in the history of the step in effect: undo: cursor - 1, redo: cursor + 1; 0 is as it was opened, or the
    oldest step that is still kept."""
    conflicts: list[Conflict]
    project: ProjectInfo
    methods: list[Method]
    """That work on this machine with what is installed (trained weights or not)."""
    folder: str | None
    """Name of the watched folder, for people; None: there is none."""
    clients: int
    """Browser windows on this session."""
    formats: list[str]
    """File name endings that `export` can write."""


class State(Present):
    """Everything but pixels and rows."""

    history: list[Step]
    bookmarks: list[Bookmark]


class HistoryChange(Model):
    """How a history became another: without its first `dropped` steps, with the next `kept`, and then `steps`."""

    dropped: int
    kept: int
    steps: list[Step]
