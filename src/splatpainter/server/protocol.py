"""What travels between the studio and its pages: the state, the frame of commands and answers, and events.

Over the socket /ws a client sends {"id": n, "do": NAME, ...fields} and gets, for the same n, first any number of
{"re": n, "progress": 0..1, "stage": "..."} and then one of
  {"re": n, "ok": true, "python": "...", "version": v, ...fields of the answer}
  {"re": n, "ok": false, "error": {"kind", "message", "hint"}}.
A message may name the "session" that it speaks of, by its id: one that changes or exports what is open is refused (kind
"project") where another project was opened before its turn came.
Binary frames with changed Gaussians (frames.py) come BEFORE the answer of the command that changed them. The server
also sends events: {"event": "state" | "toast" | "picture" | "batch", ...}. First message of a client: `hello`.
Over HTTP the same: POST /api/do/NAME with the fields as body, the session as ?session=ID, the answer as response
(Gaussians: GET /api/splats).
Big things in: POST /api/blobs (raw body) -> {"blob": sha256, "kind": ..., "name": ...}.  Out: GET /api/blobs/{blob}.
Commands are defined beside what they do (commands/); those of the connection itself are here, client.py answers them.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError

from splatpainter.cameras import Camera
from splatpainter.io.files import printable
from splatpainter.operations.decal import LayDecal
from splatpainter.painter import LayerMethod, Method, Mode
from splatpainter.server.message import Message as Message
from splatpainter.server.message import options_message
from splatpainter.session.document.document import Policy
from splatpainter.session.document.layer_view import Blend

MAX_VIEW_PIXELS = 4_000_000
"""Most pixels of a view that is painted or rendered."""
Blob = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
"""Hex SHA-256 of bytes that were sent to POST /api/blobs, or that the server made; GET /api/blobs/{blob} has them."""
Unit = Annotated[float, Field(ge=0, le=1)]
Rgb = Annotated[list[float], Field(min_length=3, max_length=3)]
Point = Annotated[list[float], Field(min_length=3, max_length=3)]
MatrixRow = Annotated[list[float], Field(min_length=4, max_length=4)]
Name = Annotated[str, Field(min_length=1, max_length=200)]
FileName = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00-\x1f:]+$")]
"""A plain name inside the studio's folder, never a path."""


class CameraInfo(Message):
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
    world_to_camera: list[MatrixRow] = Field(min_length=4, max_length=4)
    """4 x 4, row-major, rigid."""
    background: Rgb
    """Colour behind the asset, 0..1, in the asset's colour space."""
    asset_sha256: str | None = None

    @staticmethod
    def of(camera: Camera) -> CameraInfo:
        """Relative to the asset's offset, of which the page knows nothing."""
        return CameraInfo.model_validate({key: value for key, value in camera.record().items() if key != "offset"})

    def to_camera(self, most_pixels: int = MAX_VIEW_PIXELS) -> Camera:
        """Raises ValueError: not rigid, not finite, or more than `most_pixels`."""
        # Checked before a camera is made: its size decides how much memory a render takes.
        if self.width * self.height > most_pixels:
            limit, size = most_pixels / 1e6, f"{self.width}x{self.height}"
            raise ValueError(f"camera: expected at most {limit:.3g} megapixels, got {size}; zoom out")
        return Camera.from_record({**self.model_dump(), "offset": None}, "camera")


class AssetInfo(Message):
    """The asset that is open, as it is shown now."""

    name: str
    format: str
    """Key of the file format it came from; "" for the demo asset."""
    sha256: str
    """Hash of the original."""
    gaussians: int
    """Now, appended ones included."""
    gaussians_original: int
    gaussians_unchanged: int
    """Those of the original that are bit for bit what they were."""
    sh_coefficients: int
    """K per Gaussian and channel: 1, 4, 9, 16 or 25."""
    color_space: Literal["srgb", "linear"]
    antialiased: bool
    center: Point
    """Centre of nearly all opaque Gaussians, world units."""
    offset: Point
    """World coordinates of the page's origin: assets far from the world's are drawn near 0."""
    radius: float
    up: Point
    """Unit vector, world axes, that is up on the screen."""
    home: CameraInfo
    """A good first view; keep its field of view and change its size to that of the window."""
    axes: str
    """Which way the numbers in the file point, and who says so; "" without a file."""
    axes_stated: bool
    """False: files of this format differ in it and this one does not say, so it may be upside down (`asset.up`)."""
    problems: list[str]
    """What the reader found odd, one line each."""
    doubts: list[str]
    """What looks wrong about it, one line each: what was seen, what it means, what to do."""
    fine_detail: bool
    """Whether it has fine detail, measured in its first view: paint then keeps it unless that is changed."""


class LayerViewInfo(Message):
    """One edited picture of a layer."""

    camera: CameraInfo
    picture: Blob | None = None
    mask: Blob | None = None
    psnr_before: float | None = None
    """dB against the picture inside the mask, before the layer (999: identical; None: no such pixel, or not known)."""
    psnr_after: float | None = None
    psnr_outside: float | None = None
    """dB of the render after against the one before, outside the mask."""


class Placed(options_message("PlacedFields", LayDecal, ("wrap",))):
    """A text or a picture that was laid on a view, as it can be laid there again."""

    kind: Literal["text", "sticker"]
    x: float
    """Middle, pixels of the view."""
    y: float
    scale: float = Field(gt=0, le=1e4)
    """View pixels per pixel of the picture, or of the text at its size."""
    angle: float
    """Radians, clockwise."""
    opacity: Unit
    """Opacity of the paint, besides the layer's."""
    mode: Literal["normal", "color", "darken", "lighten"]
    text: str = Field(max_length=2000)
    font: str = Field(max_length=200)
    size: float = Field(gt=0, le=4096)
    """Size of the letters, pixels."""
    bold: bool
    italic: bool
    color: str = Field(pattern=r"^#[0-9a-fA-F]{6}$")
    image: Blob | None
    """Picture of a sticker."""
    unit: float | None = Field(default=None, gt=0, le=1e9)
    """World units per pixel of the picture, where it lies on the surface under its middle; None: it was laid on the
    view."""
    view: CameraInfo | None = None
    """View on which x and y are pixels; None: that of the layer's first picture."""


class MaskInfo(Message):
    """How much of a layer shows where."""

    enabled: bool
    shows: bool
    """Whether it starts from all of the layer, or from nothing."""
    parts: int
    """Views and rules that change that."""


class SceneAssetInfo(Message):
    """One asset of the scene, and where it stands: scaled, then turned, then moved."""

    id: str
    """"": the one that was opened."""
    name: str
    visible: bool
    move: Point
    """World units, in the page's scene, whose origin is the first asset's offset."""
    moved: Point
    """World units by which it was moved in the world: zeros where it lies as it was surveyed."""
    turn: Point
    """Degrees about x, then y, then z."""
    scale: float
    center: Point
    """Centre in the scene."""
    gaussians: int
    """Gaussians as the file was read."""
    layers: int


class LayerInfo(Message):
    """One layer; the list of layers goes from bottom to top."""

    id: str
    name: str
    asset: str
    """Id of the asset that it belongs to."""
    kind: str
    """What it is: paint, look, fill, ... (session/kinds)."""
    visible: bool
    opacity: Unit
    blend: Blend
    mode: Mode
    method: LayerMethod
    """What was asked for, or, once it was made, what made it."""
    views: list[LayerViewInfo]
    """Views; of a layer of strokes: that of its latest stroke."""
    strokes: int | None = None
    """How many it holds; None: none can be painted into it."""
    placed: Placed | None = None
    """What a text or a sticker is and where, to be changed."""
    mask: MaskInfo | None = None
    parameters: dict[str, Any]
    gaussians_edited: int
    gaussians_appended: int
    seconds: float
    """Seconds that its computation took."""
    note: str = ""
    """Why the method was chosen, or what could not be painted."""
    problem: str = ""
    """Why it changes nothing at its position (its Gaussians are hidden by layers below); "" where it works."""
    thumbnail: Blob | None = None
    """PNG of what was edited, 96 pixels at most."""


class StepInfo(Message):
    """One entry of the history, oldest first."""

    id: int
    label: str


class EditFigures(Message):
    """What the latest edit did that is in effect: after an undo the one before."""

    layer: str
    """Layer id."""
    name: str
    seconds: float
    gaussians: int
    """Edited and appended ones."""
    psnr_before: float | None
    """PSNR as in LayerViewInfo, of its first view."""
    psnr_after: float | None
    psnr_outside: float | None


class ConflictInfo(Message):
    """A layer overwrites Gaussians that another layer edited from another view."""

    lower: str
    """Layer id."""
    upper: str
    lower_name: str
    """As a user reads it: of one that was merged, into which layer."""
    upper_name: str
    gaussians: int
    share: Unit
    """Share of the Gaussians that the lower layer edited."""
    reason: Literal["", "stale", "covered"]
    """Why to warn of it: the lower layer was painted on after the upper one, or one is covered largely; "": nothing."""
    policy: Policy


class BookmarkInfo(Message):
    id: str
    name: str
    camera: CameraInfo


class RecentInfo(Message):
    """A project in the studio's own folder."""

    id: str
    name: str
    changed: float
    """Time of its latest edit, seconds since 1970."""
    layers: int | None
    """None: not known before it is opened."""
    picture: Blob | None
    """Thumbnail, a small PNG."""
    is_open: bool = False


class ProjectInfo(Message):
    """Where the session lives. There is no unsaved state: every acknowledged command is in the file."""

    id: str
    """Id, the same whenever this project is open, so that a page can tell whether it is back where it was."""
    name: str
    file: str | None
    """Name in the studio's folder; None while it only lives in the studio's own data folder (autosave)."""
    read_only: bool
    """Nothing can be changed: somebody else has it open, or it cannot be written."""
    read_only_reason: str = ""
    """Why, one line; "" where it can be changed."""
    is_free: bool = False
    """Whether it is read only and nobody else has it open any more: `project.take_over` goes on in it."""
    noted_computer: str = ""
    """Name of the computer that, as a note says, has it open or did not close it, where nobody here has; "": none. Its
    user decides: `project.take_over` with `despite_note` goes on in it."""


class SelectionInfo(Message):
    """What is selected, the same for all windows; it limits what tools change."""

    revision: int
    """Changes with it: then ask for `selection.view`."""
    gaussians: int
    """0: nothing is selected, everything may change."""
    names: list[str]
    """Selections that the project keeps."""
    undo: int
    """How many selections `undo` goes back through before it takes back the step at `cursor`."""
    redo: int
    """How many selections `redo` goes forward through before it redoes the step after `cursor`."""


class Present(Message):
    """What is so now, and bounded by what is on the screen."""

    session: str
    """Changes when another asset or project is opened: forget all versions and sync."""
    version: int
    """Version of the asset; goes up by one or more with every change of its Gaussians."""
    asset: AssetInfo
    assets: list[SceneAssetInfo]
    """All assets of the scene, that which was opened first."""
    layers: list[LayerInfo]
    cursor: int
    """Index in the history of the step in effect: undo: cursor - 1, redo: cursor + 1; 0 is as it was opened, or the
    oldest step that is still stored."""
    latest_edit: EditFigures | None
    """None: nothing was edited, or all of it is hidden."""
    conflicts: list[ConflictInfo]
    earlier: list[RecentInfo]
    """Projects with layers over the same original, latest first, while nothing was done in this one: to continue."""
    project: ProjectInfo
    selection: SelectionInfo
    methods: list[Method]
    """Methods that work on this machine with what is installed (trained weights or not)."""
    folder: str | None
    """Name of the watched folder, for people; None: there is none."""
    clients: int
    """Browser windows on this session."""
    formats: list[str]
    """File name endings that `export` can write."""


class State(Present):
    """Everything but pixels and Gaussians."""

    history: list[StepInfo]
    bookmarks: list[BookmarkInfo]


class HistoryChange(Message):
    """How a history became another: without its first `dropped` steps, with the next `kept`, and then `steps`."""

    dropped: int
    kept: int
    steps: list[StepInfo]


class Answer(Message):
    """What every command returns when it worked; most add fields."""

    re: int = 0
    ok: Literal[True] = True
    python: str = ""
    """The equivalent Python line; "" where there is none (looking at things)."""
    version: int = 0
    """Version of the asset after the request."""
    seconds: float = 0.0
    """Seconds in the server, waiting for earlier work not included."""


class Command(Message):
    """Base of all commands. NAME is what `do` says, ANSWER the class of the answer."""

    NAME: ClassVar[str]
    ANSWER: ClassVar[type[Answer]] = Answer


class CommandProgress(Message):
    re: int
    progress: Unit
    stage: str


class Problem(Message):
    kind: Literal["input", "cancelled", "busy", "schema", "storage", "project", "fault"]
    """input: the user can mend it; busy: too much is waiting; schema: reload the page; storage: the project cannot be
    written where it is (a full disk), see `project.folders`; project: another one is open than the command was meant
    for; fault: ours."""
    message: str
    hint: str = ""


class Failure(Message):
    re: int
    ok: Literal[False] = False
    error: Problem


class LayerMade(Answer):
    layer: LayerInfo


class Previewed(Answer):
    gaussians: int
    """Gaussians whose colours the preview changed; they come as a binary frame with the PREVIEW flag."""


class Exported(Answer):
    url: str
    """Address of the download, valid until the studio ends."""
    file: str
    bytes: int
    receipt_url: str | None = None
    """Where the receipt of an asset is."""
    lost: str = ""
    """What an asset's file does not hold of it, as measured: one line, the worst first; "" where nothing is lost."""


class Greeting(Answer):
    schema_hash: str
    client: str
    """This connection's name."""
    returning: bool
    """Whether this page has been here before: then commands that it sends again are not carried out again."""
    state: State


class Hello(Command):
    """Start, or go on after a lost connection. Missing Gaussians come as a binary frame before the answer: a delta
    if `session` and `since` are those of the server, else a snapshot; none if nothing changed."""

    NAME = "hello"
    ANSWER = Greeting
    schema_hash: str
    """SCHEMA_HASH of messages.ts; where it differs the error says to reload the page."""
    session: str | None = None
    since: int | None = None
    page: str | None = Field(default=None, pattern=r"^[0-9a-f]{32}$")
    """A random name that a page keeps over all its connections. Its command ids must then never repeat: one that came
    before is answered with what came of it, and not carried out again."""


class Sync(Command):
    """Ask for the Gaussians again (a frame's version_from was not the version you have). since None: a snapshot."""

    NAME = "sync"
    since: int | None = None


class Cancel(Command):
    """Stop the command `of` (its id) of this connection; that command then fails with kind "cancelled"."""

    NAME = "cancel"
    of: int


class StateEvent(Message):
    """After every change of anything in the state, by whomever: what is so now, and what is new in the long lists."""

    event: Literal["state"] = "state"
    state: Present
    history: HistoryChange | None = None
    """Against the state that this connection was sent before; None: as it was."""
    bookmarks: list[BookmarkInfo] | None = None
    """All bookmarks; None: as they were."""


class ToastEvent(Message):
    event: Literal["toast"] = "toast"
    level: Literal["info", "warning", "error"]
    message: str
    hint: str = ""


class PictureEvent(Message):
    """A picture was saved into the watched folder: check it and offer it as an edit."""

    event: Literal["picture"] = "picture"
    picture: Blob
    name: str


class BatchJobInfo(Message):
    """One result of a batch."""

    number: int
    name: str
    """Name of its file."""
    asset: str
    words: str
    """What is done for it."""
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    line: str
    """What was proved of it, or why it failed; "" before that."""
    warnings: list[str]
    bytes: int | None
    """Bytes of its file."""
    url: str | None
    """Address of the download."""
    receipt_url: str | None
    """Address of its receipt."""
    before_url: str | None
    """Addresses of small pictures of the asset, here, and of the result."""
    after_url: str | None


class BatchInfo(Message):
    """A batch; it outlives the pages that asked for it."""

    id: str
    state: Literal["planned", "running", "cancelling", "done", "cancelled"]
    title: str
    """What it is, one line."""
    jobs: list[BatchJobInfo]
    page_url: str | None
    """The summary page; None: it is not written yet."""
    zip_url: str | None
    """Address of the ZIP of all results so far; None: there are none."""


class BatchEvent(Message):
    """Something happened to the studio's batch."""

    event: Literal["batch"] = "batch"
    revision: int
    """Rises with every change: events and answers overtake one another, and the highest one holds."""
    batch: BatchInfo | None = None
    """The whole batch, where its state changed; None with a job: only that job changed; None without: there is no batch
    any more."""
    id: str = ""
    job: BatchJobInfo | None = None
    zip_url: str | None = None
    """Address of the ZIP as in BatchInfo, with a job."""


def first_fault(error: ValidationError, where: str) -> str:
    """One line about the first field that is wrong."""
    # Without input and context: they may be as large as the message, or hold what is private.
    fault = error.errors(include_url=False, include_context=False, include_input=False)[0]
    field_path = printable(".".join(map(str, fault["loc"])))  # a client's own words
    return f"{where}: {field_path}: {fault['msg']}" if field_path else f"{where}: {fault['msg']}"
