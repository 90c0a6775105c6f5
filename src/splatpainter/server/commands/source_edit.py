"""Views edited by a picture source: which sources there are, the present view, whose picture comes back as one that was
dropped would (registered, corrected and cut; that changes nothing), and a plan of views that become layers.

What a source runs or where it sends pictures is said where the studio is started, by environment variables: a page
gives prompts, and no options.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydantic import Field

from splatpainter.cameras import Camera
from splatpainter.color import to_display
from splatpainter.gatekeeper.gatekeeper import RefusedPicture
from splatpainter.operations.generate import USUAL_PX, USUAL_VIEWS, Generate
from splatpainter.painter import MAX_VIEWS
from splatpainter.pictures.picture_reader import resample
from splatpainter.server.commands.context import CommandContext, command, mask_from_upload
from splatpainter.server.commands.picture_check import PictureChecked, PictureWarning
from splatpainter.server.describe import layer_info
from splatpainter.server.message import options_message
from splatpainter.server.protocol import (
    MAX_VIEW_PIXELS,
    Answer,
    Blob,
    CameraInfo,
    Command,
    LayerInfo,
    Message,
    Method,
    Unit,
)
from splatpainter.server.uploads import image_registration as registration
from splatpainter.server.work_queue import Cancelled
from splatpainter.session.commands.source_layers import add_source_views
from splatpainter.session.document.document import Layer
from splatpainter.source_edits.coverage import ViewPlan, plan_views
from splatpainter.source_edits.edit import BACKGROUND, source_record
from splatpainter.source_edits.view_edit import SourceBrief, ask_for_edit
from splatpainter.sources.picture_source import Capabilities, PictureSource, SourceCancelled, SourceError, describe
from splatpainter.sources.registry import SourceStatus, describe_sources, open_source

ABILITIES = ("prompt", "needs_prompt", "mask", "seed", "scales", "paid")
"""What of a source's capabilities a page has to know."""


class SourceInfo(options_message("SourceAbilities", Capabilities, ABILITIES)):
    """A source of edited pictures."""

    name: str
    summary: str
    """One line."""
    accepts: str
    """What it takes, in words."""
    missing: str
    """Why it cannot be used, or ""."""


class Sources(Answer):
    sources: list[SourceInfo]


class SourceList(Command):
    """Which sources there are, and what they take."""

    NAME = "source.list"
    ANSWER = Sources


class SourcePicture(PictureChecked):
    """The picture that a source made, checked as a dropped one; its camera is the view that was sent."""

    name: str
    """Name of the picture."""


class SourceCommand(Command):
    """What is asked of a picture source."""

    source: str = Field(min_length=1, max_length=100)
    """Name of the source."""


SourceWords = options_message("SourceWords", Generate, ("prompt", "seed"))


class SourceEdit(SourceWords, options_message("SourceEnlarging", Generate, ("enlarge",)), SourceCommand):
    """Send a view to a source. What comes back can be edited with like a picture that was checked; one that the
    gatekeeper refuses comes with a warning that says so. Changes nothing. Enlarged without a mask, all of the view
    counts as changed, so that the layer is as sharp as the picture, as by `splatpainter refine`."""

    NAME = "source.edit"
    ANSWER = SourcePicture
    camera: CameraInfo
    mask: Blob | None = None
    """Picture of the view, not black where it may change."""


@command(SourceList, background=True)
def list_sources(context: CommandContext, request: SourceList) -> Sources:
    return Sources(sources=[_info(status) for status in describe_sources()], python="")


def _info(status: SourceStatus) -> SourceInfo:
    description, missing = status.description, "; ".join(status.missing)
    accepts, capabilities = description.accepts, description.capabilities
    # Opened to see what it takes here: options of the environment may change that.
    if not missing:
        try:
            capabilities = open_source(description.name).capabilities
            accepts = describe(capabilities)
        except SourceError as error:
            missing = str(error)
    able = capabilities or Capabilities()
    return SourceInfo(
        name=description.name,
        summary=description.summary,
        accepts=accepts,
        missing=missing,
        **{name: getattr(able, name) for name in ABILITIES},
    )


@command(SourceEdit, background=True, once=True, bound=True)
def edit_by_source(context: CommandContext, request: SourceEdit) -> SourcePicture:
    studio, source = context.studio, open_source(request.source)
    # Smaller views where the answer is enlarged, so that the enlarged one can still be painted.
    camera = within_limits(
        request.camera.to_camera(), source.capabilities.max_side_px, MAX_VIEW_PIXELS // request.enlarge**2
    )
    mask = None if request.mask is None else mask_from_upload(context, request.mask, camera)
    brief = SourceBrief(request.prompt, seed=request.seed, scale=request.enlarge)
    flag = TicketFlag(context)
    splats = studio.session.splats.numpy()
    try:
        sourced = ask_for_edit(
            splats, camera, source, brief, progress=flag.report, cancel=flag, mask=mask, name=source.name
        )
    except SourceCancelled:
        raise Cancelled from None
    except RefusedPicture as refusal:
        # A refused picture was made and perhaps paid for, so people see it and judge.
        if (refused := _refused(context, source, request.prompt, refusal)) is None:
            raise
        return refused
    # Cancelled meanwhile: nobody waits for the picture any more.
    context.ticket.check()
    image = to_display(sourced.edit.image, splats.color_space)
    # The picture carries camera and asset, as an export would, so that it can be saved and come back.
    camera = replace(sourced.edit.camera, asset_sha256=studio.session.opened.sha256)
    picture = studio.blobs.put(registration.png_bytes(image, camera), f"{name_of(source, request.prompt)}.png").sha256
    studio.note_source(picture, source_record(source, brief, [sourced]))
    changed = sourced.admitted.changed
    # Enlarged without a mask all of it counts, for the sharpness is the edit.
    if request.enlarge > 1 and mask is None:
        changed = np.ones_like(changed)
    cost = (sourced.answer.cost,) if sourced.answer.cost else ()
    return SourcePicture(
        camera=CameraInfo.of(camera),
        camera_source="given",
        picture=picture,
        mask=studio.blobs.put(registration.png_bytes(changed), "mask.png").sha256,
        share=float(changed.mean()),
        shift=(sourced.admitted.registration.right, sourced.admitted.registration.down),
        notes=[*sourced.notes, *cost],
        warnings=[],
        name=name_of(source, request.prompt),
        python=f"sp.edit_with_source(splats, open_source({source.name!r}), {request.prompt!r}, camera=camera)",
    )


def _refused(
    context: CommandContext, source: PictureSource, prompt: str, refusal: RefusedPicture
) -> SourcePicture | None:
    """A picture that was refused, as one that was dropped would be: it may have been paid for, and people see what came
    back and judge it. None: nothing came back that shows a change."""
    request, answer = refusal.request, refusal.answer
    if request is None or request.camera is None or answer is None:
        return None
    height, width = request.image.shape[:2]
    colors = resample(np.ascontiguousarray(answer.image[..., :3]), width, height)
    if answer.image.shape[2] == 4:
        # Transparent parts show the view, as if the picture had been laid over it.
        alpha = resample(np.ascontiguousarray(answer.image[..., 3]), width, height)[..., None]
        colors = alpha * colors + (1 - alpha) * request.image
    changed = registration.changed_mask(colors, request.image, request.alpha, None)
    # Outside of the mask it would be cut anyway.
    if request.mask is not None:
        changed &= request.mask > 0
    if not changed.any():
        return None
    studio = context.studio
    camera, name = replace(request.camera, asset_sha256=studio.session.opened.sha256), name_of(source, prompt)
    cost = [answer.cost] if answer.cost else []
    return SourcePicture(
        camera=CameraInfo.of(camera),
        camera_source="given",
        picture=studio.blobs.put(registration.png_bytes(colors, camera), f"{name}.png").sha256,
        mask=studio.blobs.put(registration.png_bytes(changed), "mask.png").sha256,
        share=float(changed.mean()),
        shift=(0, 0),
        notes=[*answer.notes, *cost],
        warnings=[PictureWarning(message=f"Refused; shown as received: {refusal}")],
        name=name,
        python="",
    )


class PlannedView(Message):
    camera: CameraInfo
    adds: Unit
    """Share of the surface that it is the first to show."""


class SourcePlanned(Answer):
    views: list[PlannedView]
    """One call each, at most."""
    covered: Unit
    """Share of the surface (of what is selected) that they show together."""
    paid: bool


class SourcePlan(options_message("PlanOptions", Generate, ("max_views",)), SourceCommand):
    """Which views would be sent to a source, one after the other, until the asset (or what is selected of it) is
    covered. Nothing is asked."""

    NAME = "source.plan"
    ANSWER = SourcePlanned
    camera: CameraInfo | None = None
    """View to start with; None: the one that shows most."""


class SourceCovered(Answer):
    layers: list[LayerInfo]
    """New ones, lowest first."""
    painted: int
    """Views."""
    cancelled: bool
    """Whether it was cancelled after some of them; those stay."""
    notes: list[str]
    """Why views were not painted, and what they cost, one line each."""
    refused: list[SourcePicture]
    """Pictures that were not painted, as of `source.edit`."""


class SourceCover(SourceWords, SourceCommand):
    """Send the views of a plan to a source, one after the other, and paint each as a layer: each shows those before it,
    and is asked for what they did not reach. Limited to what is selected when it begins."""

    NAME = "source.cover"
    ANSWER = SourceCovered
    views: list[CameraInfo] = Field(min_length=1, max_length=MAX_VIEWS)
    """Views of `source.plan`."""
    one_layer: bool = False
    """All views as one (merged) layer."""
    method: Method = "auto"


@command(SourcePlan, background=True)
def plan_source_views(context: CommandContext, request: SourcePlan) -> SourcePlanned:
    studio, source = context.studio, open_source(request.source)
    first = (
        None if request.camera is None else within_limits(request.camera.to_camera(), source.capabilities.max_side_px)
    )
    context.ticket.report(0, "planning")
    # The selection as a function, since the plan looks from cameras that are not known yet.
    plan = plan_views(
        studio.session.splats.numpy(),
        size=min(USUAL_PX, source.capabilities.max_side_px),
        max_views=request.max_views or USUAL_VIEWS,
        first=first,
        background=BACKGROUND,
        allowed=studio.selection.share(),
    )
    views = [
        PlannedView(camera=CameraInfo.of(camera), adds=min(gain, 1))
        for camera, gain in zip(plan.cameras, plan.gains, strict=True)
    ]
    return SourcePlanned(views=views, covered=min(plan.covered, 1), paid=source.capabilities.paid)


@command(SourceCover, background=True, once=True, bound=True)
def cover_by_source(context: CommandContext, request: SourceCover) -> SourceCovered:
    studio, source, flag = context.studio, open_source(request.source), TicketFlag(context)
    session, brief = studio.session, SourceBrief(request.prompt, seed=request.seed)
    cameras = tuple(within_limits(view.to_camera(), source.capabilities.max_side_px) for view in request.views)
    # Before the first call: what cannot be written should not be paid for.
    if session.read_only:
        raise ValueError(f"{studio.name}: {session.read_only}")

    def write(work: Callable[[], Layer]) -> Layer:
        # Views that are painted after another project was opened would go to the wrong one.
        def checked() -> Layer:
            if studio.session is not session:
                raise SourceCancelled  # another project was opened
            return work()

        return context.write(checked)

    try:
        added = add_source_views(
            session,
            source,
            brief,
            ViewPlan(cameras, (0.0,) * len(cameras)),
            one_layer=request.one_layer,
            method=request.method,
            progress=flag.report,
            cancel=flag,
            allowed=studio.selection.share(),
            write=write,
        )
    except SourceCancelled:
        raise Cancelled from None
    # Costs are told even where nothing was painted.
    notes, costs = list(added.notes), [edit.answer.cost for edit in added.sourced_views.edits if edit.answer.cost]
    if studio.session is not session:
        notes.append("another project was opened meanwhile; the painted layers are in the previous one")
    brief_line = f"SourceBrief({request.prompt!r})" if request.prompt else "SourceBrief()"
    return SourceCovered(
        layers=[layer_info(session, session.layers.by_id(layer.id)) for layer in added.layers],
        painted=len(added.sourced_views.edits),
        cancelled=added.sourced_views.cancelled,
        refused=[
            picture
            for one in added.sourced_views.refused
            if (picture := _refused(context, source, request.prompt, one)) is not None
        ],
        notes=[*notes, *([f"cost: {', '.join(costs)}"] if costs else [])],
        python=f"add_source_views(session, open_source({source.name!r}), {brief_line}, plan_views(session.splats))",
    )


def name_of(source: PictureSource, prompt: str) -> str:
    """What pictures and layers of a source are called."""
    return f"{source.name}: {' '.join(prompt.split())[:60]}".rstrip(": ")


def within_limits(camera: Camera, max_side_px: int, max_pixels: int = MAX_VIEW_PIXELS) -> Camera:
    """The same view, no larger than a source takes."""
    # Limited by side and by pixels, the shape kept.
    scale = min(max_side_px / max(camera.width, camera.height), (max_pixels / (camera.width * camera.height)) ** 0.5)
    if scale >= 1:
        return camera
    return camera.resized(max(1, int(scale * camera.width)), max(1, int(scale * camera.height)))


class TicketFlag:
    """A command's ticket as a source sees it: progress, and whether it was cancelled."""

    def __init__(self, context: CommandContext) -> None:
        self._ticket = context.ticket

    def is_set(self) -> bool:
        try:
            self._ticket.check()
        except Cancelled:
            return True
        return False

    def report(self, share: float, words: str) -> None:
        if not self.is_set():
            self._ticket.report(share, words)
