"""The present view edited by a picture source: which sources there are, and a picture that comes back as one that was
dropped would, registered, corrected and cut. Changes nothing.

What a source runs or where it sends pictures is said where the studio is started, by environment variables: a page
gives prompts, and no options.
"""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field

from splatpainter.cameras import Camera
from splatpainter.color import to_display
from splatpainter.server import image_registration as registration
from splatpainter.server.commands.context import CommandContext, command, mask_from_upload
from splatpainter.server.commands.picture_check import PictureChecked
from splatpainter.server.protocol import Answer, Blob, CameraInfo, Command, Message
from splatpainter.server.work_queue import Cancelled
from splatpainter.source_edits.view_edit import SourceBrief, ask_for_edit
from splatpainter.sources.picture_source import Capabilities, SourceCancelled, SourceError, describe
from splatpainter.sources.registry import SourceStatus, describe_sources, open_source

MAX_PROMPT_CHARACTERS = 4000


class SourceInfo(Message):
    """A source of edited pictures."""

    name: str
    summary: str
    """One line."""
    accepts: str
    """What it takes, in words."""
    missing: str
    """Why it cannot be used, or ""."""
    prompt: bool
    """Whether it takes a prompt ..."""
    needs_prompt: bool
    """... and needs one."""
    mask: bool
    """Whether it takes a mask; without, its picture is cut to it afterwards."""
    seed: bool
    paid: bool
    """Whether asking it costs money."""


class Sources(Answer):
    sources: list[SourceInfo]


class SourceList(Command):
    """Which sources there are, and what they take."""

    NAME = "source.list"
    ANSWER = Sources


class SourceEdited(PictureChecked):
    """As of a picture that was dropped; its camera is the view that was sent."""

    name: str
    """Of the picture."""


class SourceEdit(Command):
    """Send a view to a source. What comes back can be edited with like a picture that was checked. Changes nothing."""

    NAME = "source.edit"
    ANSWER = SourceEdited
    source: str = Field(min_length=1, max_length=100)
    camera: CameraInfo
    prompt: str = Field(default="", max_length=MAX_PROMPT_CHARACTERS)
    mask: Blob | None = None
    """Picture of the view, not black where it may change."""
    seed: int | None = Field(default=None, ge=0, le=2**32 - 1)


@command(SourceList, background=True)
def list_sources(context: CommandContext, request: SourceList) -> Sources:
    return Sources(sources=[_info(status) for status in describe_sources()], python="")


def _info(status: SourceStatus) -> SourceInfo:
    description, missing = status.description, "; ".join(status.missing)
    accepts, capabilities = description.accepts, description.capabilities
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
        prompt=able.prompt,
        needs_prompt=able.needs_prompt,
        mask=able.mask,
        seed=able.seed,
        paid=able.paid,
    )


@command(SourceEdit, background=True)
def edit_by_source(context: CommandContext, request: SourceEdit) -> SourceEdited:
    studio, source = context.studio, open_source(request.source)
    camera = _within(request.camera.to_camera(), source.capabilities.max_side_px)
    mask = None if request.mask is None else mask_from_upload(context, request.mask, camera)
    brief, flag = SourceBrief(request.prompt, seed=request.seed), _TicketFlag(context)
    splats = studio.session.splats.numpy()
    try:
        made = ask_for_edit(
            splats, camera, source, brief, progress=flag.report, cancel=flag, mask=mask, name=source.name
        )
    except SourceCancelled:
        raise Cancelled from None
    context.ticket.check()
    image = to_display(made.edit.image, splats.color_space)
    camera = replace(made.edit.camera, asset_sha256=studio.original.sha256)
    name = f"{source.name}: {' '.join(request.prompt.split())[:60]}".rstrip(": ")
    changed = made.admitted.changed
    cost = (made.answer.cost,) if made.answer.cost else ()
    return SourceEdited(
        camera=CameraInfo.of(camera),
        camera_source="given",
        picture=studio.blobs.put(registration.png_bytes(image, camera), f"{name}.png").sha256,
        mask=studio.blobs.put(registration.png_bytes(changed), "mask.png").sha256,
        share=float(changed.mean()),
        shift=(made.admitted.registration.right, made.admitted.registration.down),
        notes=[*made.notes, *cost],
        warnings=[],
        name=name,
        python=f"sp.edit_with_source(splats, open_source({source.name!r}), {request.prompt!r}, camera=camera)",
    )


def _within(camera: Camera, max_side_px: int) -> Camera:
    """The same view, no larger than a source takes."""
    scale = max_side_px / max(camera.width, camera.height)
    if scale >= 1:
        return camera
    return camera.resized(max(1, int(scale * camera.width)), max(1, int(scale * camera.height)))


class _TicketFlag:
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
