"""Layers, history, conflicts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from splatpainter.grading.color_grading import GRADE, GradeSettings
from splatpainter.server import frames
from splatpainter.server.commands.context import (
    CommandContext,
    RawExpr,
    command,
    layer_made,
    mask_from_upload,
    naming_errors,
    progress,
    python_line,
)
from splatpainter.server.describe import conflict_infos, page_parameters, up_axis
from splatpainter.server.option_fields import OperationOptions
from splatpainter.server.protocol import (
    Answer,
    Blob,
    CameraInfo,
    Command,
    ConflictInfo,
    Exported,
    LayerMade,
    Message,
    Name,
    Previewed,
    Unit,
)
from splatpainter.session.document.layer_mask import LayerMask, by_rule
from splatpainter.session.document.layer_operation import LayerOperation, operation_of_layer
from splatpainter.session.document.layer_view import Blend, is_hash
from splatpainter.session.kinds.look_layers import LookLayer, look_of
from splatpainter.session.replay.delta import GEOMETRY
from splatpainter.splats import ColorSpace


class LayersPreviewed(Previewed):
    possible: bool
    """Whether these layers can be shown so; else layer.set has to."""


class LayerNew(Command):
    """An empty paint layer, which strokes can go into; on top, or above another."""

    NAME = "layer.new"
    ANSWER = LayerMade
    name: Name | None = None
    above: str | None = None
    asset: str = ""
    """Asset, of several, that the layer belongs to; above a layer: that layer's."""


@command(LayerNew, writes=True)
def new_layer(context: CommandContext, request: LayerNew) -> LayerMade:
    session = context.studio.session
    at, asset = None, request.asset
    # Above a layer: in the same asset as that one, or it would show nothing.
    if request.above is not None:
        asset = session.layers.by_id(request.above).asset
        at = 1 + [layer.id for layer in session.layers].index(request.above)
    layer = session.layers.new(request.name, index=at, asset=asset)
    line = python_line("session.layers.new", request.name, index=at, asset=asset or None)
    return layer_made(context, layer.id, line)


class LayerAdd(Command):
    """An operation as a layer on top, on everything or on what is selected."""

    NAME = "layer.add"
    ANSWER = LayerMade
    operation: OperationOptions
    held: dict[str, Blob] = {}
    """Option -> what the project is to hold of the file that it names (SkyInfo.held)."""
    name: Name | None = None
    opacity: Unit = 1.0
    asset: str | None = None
    """Asset, of several, that it is for; None: a layer for each that it reaches."""


@command(LayerAdd, writes=True)
def add_layer(context: CommandContext, request: LayerAdd) -> LayerMade:
    session, stored = context.studio.session, context.studio.selection.stored()
    # Only what is not at its default is stored, as everywhere in a project.
    record = request.operation.model_dump(exclude_defaults=True)
    # The selection of this moment goes with the layer.
    options = record | ({} if stored is None else {"selection": stored[0]})
    options |= {"held": request.held} if request.held else {}
    operation = operation_of_layer(options, "layer")
    words: dict[str, Any] = {"name": request.name, "opacity": None if request.opacity == 1 else request.opacity}
    words["asset"] = request.asset
    with progress(context, request.operation.kind):
        attached = [] if stored is None else [stored[1]]
        attached += _held(context, request.held)
        how: dict[str, Any] = {"name": request.name, "opacity": request.opacity, "asset": request.asset}
        layer = session.layers.add(operation, attached=attached, **how)
    line = python_line("session.layers.add", operation.kind, **operation.changes(), **words)
    return layer_made(context, layer.id, line)


class LayerSet(Command):
    """Change what is given; the rest stays."""

    NAME = "layer.set"
    ANSWER = LayerMade
    layer: str
    name: Name | None = None
    visible: bool | None = None
    opacity: Unit | None = None
    blend: Blend | None = None
    parameters: dict[str, Any] | None = None
    """Options of its kind that change; of an adjustment layer with sliders the fields of GradeSliders."""
    gesture: Name | None = None
    """Steps of one gesture (a slider that is dragged) that follow each other are one step of the history. One that is
    called "held LAYER ANYTHING" hides the layer only as long as the page is there (held_layers.py)."""


@command(LayerSet, writes=True)
def set_layer(context: CommandContext, request: LayerSet) -> LayerMade:
    values: dict[str, Any] = {
        name: getattr(request, name)
        for name in ("name", "visible", "opacity", "blend")
        if getattr(request, name) is not None
    }
    session = context.studio.session
    # What was dragged is let go: what it comes to takes the place of its preview, also where it is refused.
    if request.layer in context.page.dragged_layers:
        context.clear_preview, context.page.dragged_layers = True, set()
    # Options are those of the layer's kind, so the layer is looked up first.
    layer = session.layers.by_id(request.layer)
    if request.parameters is not None:
        values |= _options(layer.operation, request.parameters, session.original.color_space)
        if not values:  # dragged, and let go where it was
            return layer_made(context, request.layer, "")
    with progress(context, "layers"):
        # What is slow to compute is shown at once in a simpler way.
        _preview_blend(context, request)
        attached = _held(context, values.get("held", {}))
        session.layers.set(request.layer, gesture=request.gesture, attached=attached, **values)
    if request.visible is not None:
        context.studio.held_layers.note(context.page, request.layer, request.visible, request.gesture)
    return layer_made(context, request.layer, python_line("session.layers.set", request.layer, **values))


class LayerDragged(Message):
    """A layer as it is being dragged."""

    layer: str
    parameters: dict[str, Any] = {}
    """As of layer.set."""
    opacity: Unit | None = None


class LayerPreview(Command):
    """Show layers with other options, nearly as layer.set would, in a fraction of the time: nothing is changed, stored
    or a step of the history. None: end the preview, which layer.set of one of them does, too."""

    NAME = "layer.preview"
    ANSWER = LayersPreviewed
    layers: list[LayerDragged] = Field(default=[], max_length=64)


@command(LayerPreview)
def preview_layers(context: CommandContext, request: LayerPreview) -> LayersPreviewed:
    session = context.studio.session
    # A new preview replaces the one before, also where it shows nothing.
    context.clear_preview = True
    context.page.dragged_layers = {one.layer for one in request.layers}
    snapshot, previews = session.snapshot, []
    for one in request.layers:
        operation = session.layers.by_id(one.layer).operation
        options = _options(operation, one.parameters, session.original.color_space)
        try:
            preview = session.layers.color_preview(one.layer, opacity=one.opacity, **options)
        except ValueError:
            # A lamp is dragged through an object, say: what is wrong with it is said when it is let go there.
            return LayersPreviewed(gaussians=0, possible=True)
        if preview is None:
            context.page.dragged_layers = set()
            return LayersPreviewed(gaussians=0, possible=False)
        previews.append(preview)
    if not previews:
        return LayersPreviewed(gaussians=0, possible=True)
    ids, sh = previews[0][0], previews[0][1].sh
    if len(previews) > 1:
        # Layers of several assets, which have Gaussians of their own; where they share some the last one has them.
        ids, first = np.unique(np.concatenate([ids for ids, _ in reversed(previews)]), return_index=True)
        sh = np.concatenate([splats.sh for _, splats in reversed(previews)])[first]
    context.preview = frames.preview_colors(sh, ids, len(snapshot.splats), snapshot.version)
    context.previewed_ids = ids
    return LayersPreviewed(gaussians=len(ids), possible=True)


def _held(context: CommandContext, held: dict[str, str]) -> list[bytes]:
    """The bytes that options name by their hash, of uploads or of the project itself. Raises ValueError."""
    if not isinstance(held, dict) or not all(map(is_hash, held.values())):
        raise ValueError("layer: expected held as options with hashes of pictures")
    return [context.studio.picture_bytes(sha256)[0] for sha256 in held.values()]


def _options(operation: LayerOperation, given: dict[str, Any], space: ColorSpace) -> dict[str, Any]:
    """What a page says of a layer's kind, as options of it: sliders of a grade are its settings."""
    # Sliders travel one by one and are stored as one value.
    if isinstance(operation, LookLayer) and operation.look == GRADE:
        sliders = {name: value for name, value in given.items() if name not in ("look", "selection")}
        return {"settings": look_of(GradeSettings.from_dict({**sliders, "space": space}).to_dict()).settings}
    present = page_parameters(operation)
    return {name: value for name, value in given.items() if value != present.get(name)}


def _preview_blend(context: CommandContext, request: LayerSet) -> None:
    """Show a layer hidden, or with another opacity or blend, at once, where all that changes with it takes time."""
    # Other changes are too quick, or too different, to be previewed.
    if request.opacity is None and request.blend is None and request.visible is None:
        return
    snapshot = context.studio.session.snapshot
    preview = context.studio.session.layers.blend_preview(
        request.layer, opacity=request.opacity, blend=request.blend, visible=request.visible
    )
    if preview is None or not len(preview[0]):
        return
    # Appended Gaussians may be among them, which the page does not know yet.
    (ids, splats), count = preview, len(snapshot.splats)
    total = max(count, int(ids[-1]) + 1)
    # Shapes are sent only where something moved: they are most of the bytes.
    shapes = total > count or any(
        not np.array_equal(getattr(splats, name), getattr(snapshot.splats, name)[ids]) for name in GEOMETRY
    )
    context.clear_preview = True
    context.show(frames.preview(splats, ids, total, snapshot.version, shapes), ids)


class MaskSet(Command):
    """Another mask of a layer. reveal, hide: all of it; remove: none; on, off: as it is, in force or not; selection:
    what is selected, and nothing else; area: the same on one view alone; a rule: what lies from low to high, with a
    ramp of `soft` on both sides."""

    NAME = "layer.mask"
    ANSWER = LayerMade
    layer: str
    mask: Literal[
        "reveal", "hide", "remove", "on", "off", "selection", "area", "height", "slope", "coverage", "curvature"
    ]
    camera: CameraInfo | None = None
    """Camera of an area."""
    area: Blob | None = None
    """Area: a mask picture of the camera's shape; what is not black is selected, by its brightness."""
    low: float = 0.0
    """Lower end of a rule: share of the height (0..1), degrees from `up` (0..180), coverage (0: as the original, 1:
    seen in a view of the layers below, 2: predicted), or degrees of bend (-180..180: crevices below 0, edges above)."""
    high: float = 1.0
    soft: float = Field(default=0.0, ge=0)
    gesture: Name | None = None
    """Gesture as in layer.set."""


@command(MaskSet, writes=True)
def set_mask(context: CommandContext, request: MaskSet) -> LayerMade:
    session = context.studio.session
    before = session.layers.by_id(request.layer).mask
    with progress(context, "mask"):
        # Masks come in three ways: drawn on a view, from what is selected, or by a rule of the surface.
        if request.mask == "area":
            if request.camera is None or request.area is None:
                raise ValueError("mask: expected a camera and an area; select something on a view")
            camera = request.camera.to_camera()
            shows = mask_from_upload(context, request.area, camera).astype(np.float32)
            session.masks.set_area(request.layer, camera, shows)
        elif request.mask == "selection":
            weights = context.studio.selection.weights()
            if weights is None:
                raise ValueError("mask: nothing is selected; select something first")
            session.masks.set_selection(request.layer, weights)
            return layer_made(
                context, request.layer, python_line("session.masks.set_selection", request.layer, RawExpr("weights"))
            )
        else:
            mask: LayerMask | None = LayerMask(shows=request.mask != "hide")
            if request.mask == "remove":
                mask = None
            elif request.mask in ("on", "off"):
                # On and off keep the mask: switching it off to look must not lose it.
                mask = replace(before or LayerMask(), enabled=request.mask == "on")
            elif request.mask in ("height", "slope", "coverage", "curvature"):
                axis = up_axis(session)
                mask = LayerMask(parts=(by_rule(request.mask, request.low, request.high, request.soft, axis),))
            session.masks.set(request.layer, mask, what=f"mask ({request.mask})", gesture=request.gesture)
    return layer_made(context, request.layer, python_line("session.masks.set", request.layer, RawExpr("mask")))


class LayerMove(Command):
    """Reorder: `to` is the new position, 0 the lowest."""

    NAME = "layer.move"
    layer: str
    to: int = Field(ge=0)


@command(LayerMove, writes=True)
def move_layer(context: CommandContext, request: LayerMove) -> Answer:
    with progress(context, "layers"):
        context.studio.session.layers.move(request.layer, request.to)
    return Answer(python=python_line("session.layers.move", request.layer, request.to))


class LayerDuplicate(Command):
    NAME = "layer.duplicate"
    ANSWER = LayerMade
    layer: str


@command(LayerDuplicate, writes=True)
def duplicate_layer(context: CommandContext, request: LayerDuplicate) -> LayerMade:
    with progress(context, "layers"):
        layer = context.studio.session.layers.duplicate(request.layer)
    return layer_made(context, layer.id, python_line("session.layers.duplicate", request.layer))


class LayerDelete(Command):
    NAME = "layer.delete"
    layer: str


@command(LayerDelete, writes=True)
def delete_layer(context: CommandContext, request: LayerDelete) -> Answer:
    with progress(context, "layers"):
        context.studio.session.layers.delete(request.layer)
    return Answer(python=python_line("session.layers.delete", request.layer))


class LayerMerge(Command):
    """Neighbouring layers become one, which shows the same."""

    NAME = "layer.merge"
    ANSWER = LayerMade
    layers: list[str] = Field(min_length=2)
    name: Name | None = None


@command(LayerMerge, writes=True)
def merge_layers(context: CommandContext, request: LayerMerge) -> LayerMade:
    with progress(context, "layers"):
        layer = context.studio.session.layers.merge(request.layers, request.name)
    return layer_made(context, layer.id, python_line("session.layers.merge", request.layers, name=request.name))


class LayerExport(Command):
    """One layer with its pictures as a .splatlayer file, to download."""

    NAME = "layer.export"
    ANSWER = Exported
    layer: str


@command(LayerExport, bound=True)
def export_layer(context: CommandContext, request: LayerExport) -> Exported:
    studio = context.studio
    # The name becomes a file, so anything but letters and digits goes.
    name = "".join(c if c.isalnum() or c in "-_ " else "_" for c in studio.session.layers.by_id(request.layer).name)
    path = studio.downloads.folder() / f"{name.strip()[:60] or 'layer'}.splatlayer"
    studio.session.files.export_layer(request.layer, path)
    line = python_line("session.files.export_layer", request.layer, path.name)
    return Exported(url=studio.downloads.add(path), file=path.name, bytes=path.stat().st_size, python=line)


class LayerImport(Command):
    """The layer of a .splatlayer file that was sent, on top."""

    NAME = "layer.import"
    ANSWER = LayerMade
    blob: Blob


@command(LayerImport, writes=True)
def import_layer(context: CommandContext, request: LayerImport) -> LayerMade:
    blob = context.studio.blobs.get(request.blob, "layer")
    with progress(context, "layers"), naming_errors(blob.path, blob.name or "layer"):
        layer = context.studio.session.files.import_layer(blob.path)
    return layer_made(context, layer.id, python_line("session.files.import_layer", blob.name or "layer.splatlayer"))


class Undo(Command):
    """One selection back or, where none was made since the latest step, that step."""

    NAME = "undo"


@command(Undo, writes=True)
def undo(context: CommandContext, request: Undo) -> Answer:
    # Selections lie between the steps, so they are gone through first.
    if context.studio.selection.undo():
        return Answer()
    session = context.studio.session
    label = session.history[session.history.cursor].label
    with progress(context, "undo"):
        if session.undo():
            # Another window's screen changes without its doing; it is told why.
            context.notice = f"Another window undid: {label}."
    # What was selected at that step is selected again.
    context.studio.selection.follow()
    return Answer(python="session.undo()")


class Redo(Command):
    """One selection forward or, where there is none, one step."""

    NAME = "redo"


@command(Redo, writes=True)
def redo(context: CommandContext, request: Redo) -> Answer:
    if context.studio.selection.redo():
        return Answer()
    session = context.studio.session
    with progress(context, "redo"):
        if session.redo():
            context.notice = f"Another window redid: {session.history[session.history.cursor].label}."
    context.studio.selection.follow()
    return Answer(python="session.redo()")


class Jump(Command):
    """Jump to a step of the history; 0 is the asset as it was opened."""

    NAME = "jump"
    cursor: int = Field(ge=0)


@command(Jump, writes=True)
def jump_in_history(context: CommandContext, request: Jump) -> Answer:
    session = context.studio.session
    with progress(context, "history"):
        session.history.jump(request.cursor)
    context.notice = f"Another window jumped in the history to: {session.history[session.history.cursor].label}."
    context.studio.selection.follow()
    return Answer(python=python_line("session.history.jump", request.cursor))


class ConflictsListed(Answer):
    conflicts: list[ConflictInfo]


class ConflictsList(Command):
    NAME = "conflicts"
    ANSWER = ConflictsListed


@command(ConflictsList)
def list_conflicts(context: CommandContext, request: ConflictsList) -> ConflictsListed:
    return ConflictsListed(conflicts=conflict_infos(context.studio.session), python="session.layers.conflicts()")


class ConflictSet(Command):
    """Which layer wins where two edited the same Gaussians."""

    NAME = "conflict.set"
    lower: str
    upper: str
    policy: Literal["latest", "first", "blend"]


@command(ConflictSet, writes=True)
def set_conflict(context: CommandContext, request: ConflictSet) -> Answer:
    args = (request.lower, request.upper, request.policy)
    with progress(context, "layers"):
        context.studio.session.layers.resolve_conflict(*args)
    return Answer(python=python_line("session.layers.resolve_conflict", *args))
