"""Strokes with their preview, and layers from edited pictures."""

from __future__ import annotations

import base64
import binascii
import secrets
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from splatpainter.color import from_display
from splatpainter.image_files import find_alpha
from splatpainter.lift.masks import change_mask
from splatpainter.painter import Edit, Method, Mode
from splatpainter.pictures.edit_files import PictureFile, unmultiplied
from splatpainter.pictures.picture_reader import read_picture
from splatpainter.rendering import render
from splatpainter.server import frames
from splatpainter.server.commands.context import (
    CommandContext,
    RawExpr,
    check_shape,
    command,
    layer_made,
    mask_from_upload,
    naming_errors,
    progress,
    python_line,
    render_alpha,
    render_display,
)
from splatpainter.server.option_fields import PaintedOptions, PaintLimits
from splatpainter.server.protocol import (
    MAX_VIEW_PIXELS,
    Answer,
    Blob,
    CameraInfo,
    Command,
    LayerMade,
    Message,
    Name,
    Placed,
    Point,
    Previewed,
    Unit,
)
from splatpainter.server.strokes.mirrored_stroke import MirroredStroke, merged
from splatpainter.server.strokes.stroke import Stroke
from splatpainter.server.studio import Studio
from splatpainter.session import Session
from splatpainter.session.document.layer_operation import layer_class, operation_of_layer
from splatpainter.session.document.layer_view import Blend
from splatpainter.session.kinds.erase_layers import EraseLayer
from splatpainter.session.kinds.painted_layers import PaintedLayer
from splatpainter.session.measures.mirror_plane import mirrored_camera, parsed_plane

NO_LIMITS = {"angle_limit": None, "depth_edge_limit": None}
"""Options of paint as the painter has them: other pictures of a layer bring limits of their own, or none."""
MIN_MIRRORED_ALPHA = 0.5
"""The asset's, somewhere under the mirrored half of a stroke; else there is nothing to paint on."""


class StrokeStarted(Answer):
    stroke: str


class Symmetry(Message):
    """A plane of symmetry: what is painted on the one side comes to the other."""

    normal: Point
    """World axes; need not be unit."""
    offset: float
    """normal x = offset of its points."""
    keep: Unit = 0.0
    """How far the stroke's colours are those below with a difference, which then goes to what is below on the other
    side: paint that keeps shading."""


class PaintBegin(Command):
    """Start a stroke on a view; the server keeps the view's projection, so that dabs are quick. One stroke per page:
    a second one cancels the first."""

    NAME = "paint.begin"
    ANSWER = StrokeStarted
    camera: CameraInfo
    kind: Literal["paint", "clone", "erase", "mask"] = "paint"
    """erase: back to the original; the patches' alpha counts, their colours do not. mask: of the layer that `paint.end`
    names: black hides it, white shows it, alpha is how far; there are no previews."""
    layer: str | None = None
    """For an eraser: the paint layer whose paint it takes away; None: back to the original."""
    mirror: Symmetry | None = None
    """Paint on the mirrored view, too (not of masks)."""


@command(PaintBegin, bound=True)
def begin(context: CommandContext, request: PaintBegin) -> StrokeStarted:
    session = context.studio.session
    # An eraser within a layer shows what is below it; without one, the original.
    beneath = None if request.layer is None or request.kind != "erase" else session.layers.below(request.layer)
    camera = request.camera.to_camera()
    selected = context.studio.selection.view(camera)
    stroke = Stroke(camera, request.kind == "erase", session, beneath, selected)
    stroke.masks = request.kind == "mask"
    snapshot = session.snapshot
    # Projected when the pen goes down, so that the first dab is as quick as the others.
    stroke.prepare(snapshot.splats, session.original, snapshot.version)
    context.studio.prepare_edit(camera, stroke)  # ready when the pen goes up
    context.clear_preview = True
    name = secrets.token_hex(6)
    # One stroke for each page: a new one replaces what was not ended.
    context.page.strokes, context.page.mirrored = {name: stroke}, {}
    if request.mirror is not None and not stroke.masks:
        # The other half is a stroke on the mirrored view, with its own projection.
        plane = parsed_plane(request.mirror.normal, request.mirror.offset)
        other = mirrored_camera(camera, plane)
        half = MirroredStroke(other, stroke.erase, session, beneath, context.studio.selection.view(other))
        half.keep = 0.0 if stroke.erase else request.mirror.keep
        half.prepare(snapshot.splats, session.original, snapshot.version)
        context.page.mirrored = {name: half}
    return StrokeStarted(stroke=name)


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
    rgba: str = Field(max_length=6 * MAX_VIEW_PIXELS)
    """Base64 of width * height * 4 bytes, row by row from the top (canvas ImageData)."""


@command(PaintDab)
def dab(context: CommandContext, request: PaintDab) -> Previewed:
    session = context.studio.session
    # A stroke of another session would change the wrong Gaussians.
    stroke = _stroke(context, request.stroke, session)
    try:
        rgba = base64.b64decode(request.rgba, validate=True)
    except binascii.Error:
        raise ValueError("dab: expected base64 of RGBA bytes") from None
    box = stroke.patch(request.x, request.y, request.width, request.height, rgba)
    # Masks have no preview: they change what a layer shows and not a colour.
    if stroke.masks:
        return Previewed(gaussians=0)
    snapshot = session.snapshot
    ids, sh = stroke.preview(snapshot.splats, session.original, snapshot.version, box)
    context.studio.look_under(stroke)  # what the edit asks when the pen goes up
    # The other half follows dab by dab, so that both sides grow together.
    half = context.page.mirrored.get(request.stroke)
    if half is not None:
        mirrored_box = half.follow(stroke, box, snapshot.splats, session.original, snapshot.version)
        ids, sh = merged((ids, sh), half.preview(snapshot.splats, session.original, snapshot.version, mirrored_box))
    if len(ids):
        context.preview = frames.preview_colors(sh, ids, len(snapshot.splats), snapshot.version)
        context.previewed_ids = ids
    return Previewed(gaussians=len(ids))


class PaintEnd(Command):
    """Commit the stroke (the chosen method runs on the server's own copy of the stroke's pixels, over its float render:
    nothing to upload): into a paint layer, as a new layer, or in place of what a layer of a text or a picture was. Its
    Gaussians come as a delta; previewed ones that it leaves alone get their colours back."""

    NAME = "paint.end"
    ANSWER = LayerMade
    stroke: str
    layer: str | None = None
    """Paint layer that it goes into, or of an eraser also a layer that goes back to the original, if it is of this
    view (else a new one); None: a new layer. Paint for one that is gone or hidden by now goes into a new one."""
    into_new: Name | None = None
    """Name of a new paint layer on top that it is the first stroke of."""
    replaces: str | None = None
    """Layer of a text or a picture whose content it becomes; it keeps its position, opacity and blend."""
    placed: Placed | None = None
    """What can be changed later; such a layer takes no strokes."""
    gesture: Name | None = None
    """Gesture as in layer.set, with `replaces`."""
    name: Name = "Stroke"
    method: Method = "auto"
    opacity: Unit = 1.0
    blend: Blend = "normal"
    limits: PaintLimits = PaintLimits()
    """Limits; an eraser has none."""
    spread: Unit | None = None
    """Threshold of mode spread, in which the stroke becomes a new layer; None: mode local."""


@command(PaintEnd, writes=True)
def end(context: CommandContext, request: PaintEnd) -> LayerMade:
    session = context.studio.session
    stroke = _stroke(context, request.stroke, session)
    # An empty stroke is told, with the likeliest reason.
    if not stroke.mask.any():
        where = " where something is selected" if context.studio.selection else ""
        raise ValueError(f"stroke: nothing was painted{where}")
    # A stroke goes to one place; more than one given is a fault of the page's.
    if (request.layer, request.into_new, request.replaces).count(None) < 2:
        raise ValueError("stroke: expected one of layer, into_new and replaces")
    if request.placed is not None and (request.layer or request.into_new):
        raise ValueError("stroke: a text or a picture that can be changed is a layer of its own")
    # Masks go their own way: there is no picture to lift.
    if stroke.masks:
        return _masked(context, request, stroke)
    # Another window may have removed the layer meanwhile; the paint must not be lost for it.
    request = _with_present_layer(session, request, stroke.erase)
    alone = (request.layer, request.into_new, request.replaces, request.placed) == (None,) * 4
    if request.spread is not None and (stroke.erase or not alone):
        raise ValueError("stroke: one that spreads is a new layer of its own")
    target = None if request.layer is None else session.layers.by_id(request.layer).operation
    goes_on_erasing = isinstance(target, EraseLayer)
    # Painted over what the layer has below it, so that the difference is the stroke and nothing else.
    with progress(context, "painting"):
        if request.layer is not None and not goes_on_erasing:
            splats = session.strokes.painted_on(request.layer)
        elif request.replaces is not None:
            splats = session.layers.below(request.replaces)
        else:
            splats = session.splats
        snapshot = session.snapshot
        # The view that the stroke was drawn on is projected already; another base has to be rendered.
        if splats is snapshot.splats:
            picture = stroke.picture(snapshot.splats, session.original, snapshot.version)
        else:
            picture = stroke.over(render_display(splats, stroke.camera))
        image = from_display(np.asarray(picture, np.float32), splats.color_space)
        cover = None if request.spread is None else stroke.cover
        edits = [Edit(image, stroke.camera, stroke.mask, request.name, cover)]
        half = context.page.mirrored.get(request.stroke) if request.spread is None else None  # it goes all around
        # Under the other half there may be nothing of the asset to paint on.
        if half is not None and (half.mask & (render_alpha(splats, half.camera) > MIN_MIRRORED_ALPHA)).any():
            image = half.over(render_display(splats, half.camera)).astype(np.float32)
            edits.append(Edit(from_display(image, splats.color_space), half.camera, half.mask, request.name))
        if request.layer is not None and goes_on_erasing:
            # An eraser goes on in its layer only on the same view; elsewhere it is a new one, with a free name.
            if not session.strokes.erases_on(request.layer, [edit.camera for edit in edits]):
                taken = {layer.name for layer in session.layers}
                names = (f"{request.name} {k}" if k > 1 else request.name for k in count(1))
                name = next(name for name in names if name not in taken)
                request = request.model_copy(update={"layer": None, "name": name})
        layer, line = _committed(context, request, edits, stroke.erase)
    # Taken off only now: where the edit failed the page can try again.
    context.page.strokes.pop(request.stroke, None)
    context.page.mirrored.pop(request.stroke, None)
    context.clear_preview = True
    return layer_made(context, layer, line)


def _with_present_layer(session: Session, request: PaintEnd, erase: bool) -> PaintEnd:
    """The request where another window took its layer away, or hid it, while the pen was down: paint goes into a new
    layer, so that no stroke is lost. Raises ValueError for an eraser, which has nothing to erase then."""
    # A layer that shows nothing counts as gone: paint in it would not be seen.
    present = {layer.id for layer in session.layers if layer.visible and layer.opacity > 0}
    if request.layer is not None and request.layer not in present:
        if erase:
            raise ValueError("stroke: the layer that it erases in is gone or hidden; nothing is left to erase")
        return request.model_copy(update={"layer": None, "into_new": "Paint"})
    if request.replaces is not None and request.replaces not in {layer.id for layer in session.layers}:
        return request.model_copy(update={"replaces": None, "gesture": None})
    return request


def _masked(context: CommandContext, request: PaintEnd, stroke: Stroke) -> LayerMade:
    if request.layer is None:
        raise ValueError("mask: expected the layer whose mask is painted")
    shows, share = stroke.rgba[..., 0].astype(np.float32) / 255, stroke.rgba[..., 3].astype(np.float32) / 255
    with progress(context, "mask"):
        layer = context.studio.session.masks.paint(request.layer, stroke.camera, shows, share, name=request.name)
    context.page.strokes.pop(request.stroke, None)
    context.clear_preview = True
    line = python_line("session.masks.paint", layer.id, *map(RawExpr, ("camera", "shows", "share")))
    return layer_made(context, layer.id, line)


def _committed(context: CommandContext, request: PaintEnd, edits: list[Edit], erase: bool) -> tuple[str, str]:
    """(id of the layer that a stroke is in now, the Python line)."""
    session, kind = context.studio.session, "erase" if erase else "paint"
    how: dict[str, Any] = {} if erase else {"method": request.method, **request.limits.options()}
    thick = "" if edits[0].cover is None else ", cover=cover"
    words = [RawExpr(f"sp.Edit(picture{k or ''}, camera{k or ''}, mask{k or ''}{thick})") for k in range(len(edits))]
    attached: list[bytes] = []
    # A text's picture is stored with it, so that it can be changed when the upload is gone.
    if request.placed is not None:
        if request.placed.image is not None:
            attached = [context.studio.picture_bytes(request.placed.image)[0]]
        how["placed"] = request.placed.model_dump()
    # Its other options stay; the limits are of this picture.
    if request.replaces is not None:
        but_method = {name: value for name, value in how.items() if name != "method"}
        options: dict[str, Any] = {"name": request.name, **NO_LIMITS, **but_method}
        layer = session.layers.replace_views(
            request.replaces, edits, **options, gesture=request.gesture, attached=attached
        ).id
        return layer, python_line("session.layers.replace_views", layer, words, **options)
    if request.layer is not None and erase and isinstance(session.layers.by_id(request.layer).operation, EraseLayer):
        layer = session.strokes.erase_more(request.layer, edits, name=request.name).id
        return layer, python_line("session.strokes.erase_more", layer, words, name=request.name)
    if request.layer is not None or request.into_new is not None:
        options = {"name": request.name, "kind": kind, **how}
        layer, line = request.layer, ""
        if layer is None:
            layer = session.strokes.paint_new(request.into_new, edits, **options).id
            line = f"layer = session.layers.new({request.into_new!r}); "
        else:
            session.strokes.paint(layer, edits, **options)
        return layer, line + python_line("session.strokes.paint", layer, words, **options)
    # Neither a layer nor a name for one: a layer of its own.
    options = {"name": request.name, "opacity": request.opacity, "blend": request.blend, **how}
    # The selection limits how far the material spreads, so it is kept with the layer.
    if request.spread is not None:
        options |= {"mode": "spread", "method": "auto", "spread_threshold": request.spread}
        if (stored := context.studio.selection.stored()) is not None:
            options["selection"] = stored[0]
            attached.append(stored[1])
    return session.layers.add(kind, edits, **options, attached=attached).id, python_line(
        "session.layers.add", kind, words, **options
    )


class PaintCancel(Command):
    """Drop the stroke; previewed Gaussians get their colours back."""

    NAME = "paint.cancel"
    stroke: str


@command(PaintCancel)
def cancel(context: CommandContext, request: PaintCancel) -> Answer:
    context.page.strokes.pop(request.stroke, None)
    context.page.mirrored.pop(request.stroke, None)
    context.clear_preview = True
    return Answer()


class EditedView(Message):
    """One edited picture, of its camera's size (other sizes of the same shape are resampled)."""

    camera: CameraInfo
    picture: Blob
    """Transparent pixels: unchanged."""
    mask: Blob | None = None
    """What is not black was edited; None: found by comparing with the render."""


class EditAdd(PaintedOptions, Command):
    """A layer from 1 to 4 edited pictures. mode local: only what was edited; global: regrades or relights everything;
    spread: what was edited is a material that changes all around. kind erase: Gaussians that the masks reach go back to
    the original."""

    NAME = "edit"
    ANSWER = LayerMade
    views: list[EditedView] = Field(min_length=1, max_length=4)
    kind: Literal["paint", "picture", "clone", "erase"] = "picture"
    name: Name = "Picture"
    opacity: Unit = 1.0
    blend: Blend = "normal"
    limits: PaintLimits = PaintLimits()
    """Limits in modes local and spread; an eraser has none."""
    spread: Unit | None = None
    """Threshold of mode spread; None: the default."""
    stroke: str | None = None
    """A previewed stroke that this edit replaces."""
    replaces: str | None = None
    """Layer of pictures whose content these become; it keeps its position, opacity, blend, mode and method."""


@command(EditAdd, writes=True)
def add_edit(context: CommandContext, request: EditAdd) -> LayerMade:
    session, studio = context.studio.session, context.studio
    options: dict[str, Any] = {"name": request.name, "opacity": request.opacity, "blend": request.blend}
    how, attached = _options_of(context, request)
    operation = operation_of_layer({"kind": request.kind, **how}, "edit")
    # What is edited: pictures or masks alone, inside what is selected unless all of the asset is meant.
    upload = edit_from_upload if operation.takes_pictures else _eraser_from_upload
    edits = [upload(context, view, request.mode) for view in request.views]
    if operation.needs_masks:
        edits = [edit for edit in (within_selection(studio, edit) for edit in edits) if edit is not None]
    # A look of the whole is limited by masks that were drawn, where that is wanted.
    if how.get("within"):
        edits = [edit for edit in edits if edit.mask is not None]
        if not edits:
            raise ValueError("edit: expected a mask in one of the views; select an area on one of them")
    if attached:
        options["attached"] = attached
    # In place of old content: position, opacity and method stay as they are.
    if request.replaces is not None:
        name = session.layers.by_id(request.replaces).name
        with progress(context, name):
            anew = {name: value for name, value in how.items() if name not in ("mode", "method")}
            layer = session.layers.replace_views(request.replaces, edits, **{**NO_LIMITS, "source": None, **anew})
        line = python_line("session.layers.replace_views", layer.id, [RawExpr("sp.Edit(picture, camera, mask)")])
        context.clear_preview = True
        return layer_made(context, layer.id, line)
    with progress(context, "editing"):
        layer = session.layers.add(request.kind, edits, **options, **how)
    # The stroke that this picture was made of is done with.
    if request.stroke is not None:
        context.page.strokes.pop(request.stroke, None)
    context.clear_preview = True
    words = [RawExpr(f"sp.Edit(picture{k or ''}, camera{k or ''}, mask{k or ''})") for k in range(len(edits))]
    return layer_made(context, layer.id, python_line("session.layers.add", request.kind, words, **options, **how))


def _options_of(context: CommandContext, request: EditAdd) -> tuple[dict[str, Any], list[bytes]]:
    """(options of the new layer's kind, the pictures that they name)."""
    # An eraser has neither method nor limits.
    if not layer_class(request.kind, "edit")().takes_pictures:
        return {}, []
    how: dict[str, Any] = {"mode": request.mode, "method": request.method}
    painted = PaintedLayer(mode=request.mode)
    if request.within and painted.regrades:
        how["within"] = True
    if not painted.regrades:
        how |= request.limits.options()
    if painted.spreads:
        how |= {"method": "auto"} | ({} if request.spread is None else {"spread_threshold": request.spread})
    if (source := context.studio.source_of([view.picture for view in request.views])) is not None:
        how["source"] = source
    # A local edit is cut to what is selected; what changes more keeps to the selection itself.
    stored = None if painted.is_local_paint else context.studio.selection.stored()
    if stored is None:
        return how, []
    return {**how, "selection": stored[0]}, [stored[1]]


def within_selection(studio: Studio, edit: Edit, required: bool = True) -> Edit | None:
    """A local edit of what is selected. Where none of it is: raises ValueError if `required`, else None."""
    # Cut in the view: there paint ends at the edge as it was drawn.
    part = studio.selection.view(edit.camera)
    if part is None:
        return edit
    mask = edit.mask
    if mask is None:
        # Without a mask all that differs was edited, and that is what is cut.
        mask = change_mask(edit.image, render(studio.session.splats, edit.camera).colors[0])
    if (mask & (part > 0.5)).any():
        return replace(edit, mask=mask & (part > 0.5))
    if required:
        raise ValueError(f"{edit.name}: changes nothing of what is selected; deselect first")
    return None


def edit_from_upload(context: CommandContext, view: EditedView, mode: Mode) -> Edit:
    """An uploaded picture as an edit of the asset as it now is; transparent pixels change nothing."""
    camera = view.camera.to_camera()
    blob = context.studio.blobs.get(view.picture, "picture")
    name = Path(blob.name or "picture")
    with naming_errors(blob.path, str(name)):
        # Inks are refused: their colours on a screen are a matter of choice.
        picture = read_picture(blob.path, inks=False)
    check_shape(str(name), picture.size, (camera.width, camera.height))
    mask = None if view.mask is None else mask_from_upload(context, view.mask, camera)
    alpha = find_alpha(blob.path)
    # Colours that were multiplied by alpha would be painted too dark.
    resized = unmultiplied(picture, alpha).resized(camera.width, camera.height)
    source = PictureFile(name, resized, picture.size, camera, mask, picture.notes, cut_out=alpha is not None)
    return source.edit(context.studio.session.splats, mode)


def _eraser_from_upload(context: CommandContext, view: EditedView, mode: Mode) -> Edit:
    """An eraser's edit from an upload: only its mask counts, the mask given, else the picture as one."""
    camera = view.camera.to_camera()
    # An eraser's picture is only a shape.
    mask = mask_from_upload(context, view.mask or view.picture, camera)
    return Edit(np.zeros((camera.height, camera.width, 3), np.float32), camera, mask, "erase")


def _stroke(context: CommandContext, name: str, session: Session) -> Stroke:
    """A page's stroke on this session. Raises ValueError where there is none: another asset may have been opened."""
    # The stroke is dropped with the session that it was on, so that the page begins a new one.
    stroke = context.page.strokes.get(name)
    if stroke is None or not stroke.belongs_to(session):
        context.page.strokes.pop(name, None)
        raise ValueError("stroke: no longer available; begin a new one")
    return stroke
