"""Selecting Gaussians, on a view or in space; what is selected limits every tool. Layers that hide."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from splatpainter.cameras import UPS, Camera
from splatpainter.color import to_display
from splatpainter.pictures.picture_reader import read_picture, resample
from splatpainter.server import picking
from splatpainter.server.commands.context import (
    CommandContext,
    RawExpr,
    check_shape,
    command,
    layer_made,
    naming_errors,
    progress,
    python_line,
)
from splatpainter.server.protocol import Answer, Blob, CameraInfo, Command, LayerMade, Name, Point, Unit
from splatpainter.server.uploads.image_registration import png_bytes
from splatpainter.session.selection import selection as tools
from splatpainter.session.selection import selection_space as space
from splatpainter.session.selection.selection import Attribute, Combine

BESIDE_MASK = RawExpr("pixel_shares.beside_mask(session.splats, camera, mask)")
"""What `CurrentSelection.beside` is, as one would write it."""
MAX_RADIUS_SHARE = 1.0
"""Largest share of the asset's radius by which a selection may grow, shrink or be feathered at a time."""


class Selected(Answer):
    gaussians: int
    """Gaussians that are selected by half or more."""
    share: Unit
    """Share of the visible ones."""
    note: str = ""
    """Why nothing was selected beyond what was, one line."""


class SelectArea(Command):
    """What a mask on a view selects: of the surface that is seen, or (through) all behind it too."""

    NAME = "selection.area"
    ANSWER = Selected
    camera: CameraInfo
    mask: Blob
    """Grey picture of the view's size; white is selected, grey in part."""
    how: Combine = "replace"
    through: bool = False


@command(SelectArea, writes=True)
def select_area(context: CommandContext, request: SelectArea) -> Selected:
    studio, camera = context.studio, request.camera.to_camera()
    mask = _grey(context, request.mask, camera)
    # Weights of the Gaussians and the mask itself: the drawn edge holds on this view.
    weights = tools.in_mask(studio.session.splats, camera, mask, request.through)
    studio.selection.choose_area(weights, camera, mask, request.how)
    keyword = ", through=True" if request.through else ""
    return _selected(context, f"weights = selection.in_mask(session.splats, camera, mask{keyword})")


class SelectColor(Command):
    """Gaussians that look like a pixel: as that view shows them, or (where it does not) by their base colour."""

    NAME = "selection.color"
    ANSWER = Selected
    camera: CameraInfo
    x: float
    y: float
    """Pixels; the first pixel's centre is 0.5, 0.5."""
    tolerance: Unit = 0.12
    everywhere: bool = True
    """Whether Gaussians that the view does not show count too."""
    how: Combine = "replace"


@command(SelectColor, writes=True)
def select_color(context: CommandContext, request: SelectColor) -> Selected:
    session, camera = context.studio.session, request.camera.to_camera()
    color, _ = picking.pick(session.splats, camera, request.x, request.y)
    # As it is shown: colours are picked on the screen.
    color = np.clip(to_display(color, session.splats.color_space), 0, 1)
    weights = tools.by_color(session.splats, camera, color, request.tolerance, request.everywhere)
    _apply(context, weights, request.how)
    return _selected(context, f"weights = selection.by_color(session.splats, camera, color, {request.tolerance:g})")


class SelectByAttribute(Command):
    """Gaussians by a value of 0..1. size: rank of the largest scale; opacity; depth: from the nearest to the farthest
    of the view; height: from the lowest to the highest."""

    NAME = "selection.attribute"
    ANSWER = Selected
    camera: CameraInfo
    attribute: Attribute
    low: Unit = 0.0
    high: Unit = 1.0
    how: Combine = "replace"


@command(SelectByAttribute, writes=True)
def select_by_attribute(context: CommandContext, request: SelectByAttribute) -> Selected:
    session, camera = context.studio.session, request.camera.to_camera()
    up = np.array(UPS[session.scene.up], float)
    weights = tools.by_attribute(session.splats, request.attribute, request.low, request.high, camera, up)
    _apply(context, weights, request.how)
    args = f"{request.attribute!r}, {request.low:g}, {request.high:g}"
    return _selected(context, f"weights = selection.by_attribute(session.splats, {args}, camera, up)")


class SelectBox(Command):
    """Gaussians in a box along the world's axes."""

    NAME = "selection.box"
    ANSWER = Selected
    low: Point
    high: Point
    how: Combine = "replace"


@command(SelectBox, writes=True)
def select_box(context: CommandContext, request: SelectBox) -> Selected:
    weights = tools.in_box(context.studio.session.splats, np.array(request.low), np.array(request.high))
    _apply(context, weights, request.how)
    return _selected(
        context, python_line("weights = selection.in_box", RawExpr("session.splats"), request.low, request.high)
    )


class SelectChange(Command):
    """Everything, nothing, the rest, what was selected before; what hangs together with it; floaters; its edge moved or
    softened by `radius`."""

    NAME = "selection.change"
    ANSWER = Selected
    to: Literal["all", "none", "invert", "again", "connected", "body", "floaters", "grow", "shrink", "feather"]
    radius: float = Field(default=0.0, ge=0)
    """World units, of grow, shrink and feather; at most the asset's radius."""
    share: Unit = space.FLOATER_SHARE
    """Largest share of the largest part's surface that a floater has at most."""


@command(SelectChange, writes=True)
def change_selection(context: CommandContext, request: SelectChange) -> Selected:
    current, splats = context.studio.selection, context.studio.session.splats
    context.ticket.report(0, "selecting")
    visible = (splats.opacities > 0).astype(np.float32)
    weights = current.weights()
    if request.to == "all":
        current.choose(visible)
    elif request.to == "none":
        current.choose(None)
    elif request.to == "again":
        current.reselect()
    elif request.to == "floaters":
        current.choose(space.floaters(splats, request.share))
        if not current:
            raise ValueError("selection: there are no floaters of this size; try a larger share")
    elif weights is None:
        raise ValueError("selection: nothing is selected; select something first")
    elif request.to == "invert":
        current.invert(tools.inverted(splats, weights))
    elif request.to == "connected":
        current.choose(space.connected(splats, weights))
    elif request.to == "body":
        beside = current.beside()
        body, note = context.studio.session.layers.body(weights, beside)
        if not note:
            current.choose(body)
        line = python_line(
            "weights, note = session.layers.body", RawExpr("weights"), beside=None if beside is None else BESIDE_MASK
        )
        return _selected(context, line).model_copy(update={"note": note})
    else:
        # Bounded: a radius of many assets would take long and select everything or nothing.
        limit = MAX_RADIUS_SHARE * context.studio.state.asset.radius
        if not 0 < request.radius <= limit:
            raise ValueError(f"selection: expected a radius above 0 and up to {limit:g}, got {request.radius:g}")
        change = {"grow": space.grown, "shrink": space.shrunk, "feather": space.feathered}[request.to]
        current.choose(change(splats, weights, request.radius))
    return _selected(context)


class SelectionSave(Command):
    """Keep what is selected in the project under a name; one of that name is replaced."""

    NAME = "selection.save"
    name: Name


@command(SelectionSave, writes=True)
def save_selection(context: CommandContext, request: SelectionSave) -> Answer:
    weights = context.studio.selection.weights()
    if weights is None:
        raise ValueError("selection: nothing is selected; select something first")
    context.studio.session.selections.save(request.name, weights)
    return Answer(python=python_line("session.selections.save", request.name, RawExpr("weights")))


class SelectionRecall(Command):
    """Select what was saved under a name."""

    NAME = "selection.recall"
    ANSWER = Selected
    name: Name
    how: Combine = "replace"


@command(SelectionRecall, writes=True)
def recall_selection(context: CommandContext, request: SelectionRecall) -> Selected:
    _apply(context, context.studio.session.selections.load(request.name), request.how)
    return _selected(context, python_line("weights = session.selections.load", request.name))


class SelectionDelete(Command):
    """Forget a selection that was saved."""

    NAME = "selection.delete"
    name: Name


@command(SelectionDelete, writes=True)
def delete_selection(context: CommandContext, request: SelectionDelete) -> Answer:
    context.studio.session.selections.delete(request.name)
    return Answer(python=python_line("session.selections.delete", request.name))


class SelectionViewed(Answer):
    mask: Blob | None
    """Grey PNG of the view's size: what of each pixel is selected; None: nothing is selected at all."""
    points: list[float]
    """x, y, x, y, ... pixels: Gaussians that are selected and that the view hardly shows, as they are too faint or too
    small."""
    revision: int


class SelectionView(Command):
    """What of a view is selected."""

    NAME = "selection.view"
    ANSWER = SelectionViewed
    camera: CameraInfo


@command(SelectionView)
def view_selection(context: CommandContext, request: SelectionView) -> SelectionViewed:
    studio = context.studio
    # Read first: the answer may be newer than the number, never older.
    revision = studio.selection.revision
    seen = studio.selection.view_and_points(request.camera.to_camera())
    if seen is None:
        return SelectionViewed(mask=None, points=[], revision=revision)
    mask, points = seen
    grey = np.round(np.clip(mask, 0, 1) * 255).astype(np.uint8)
    blob = studio.blobs.put(png_bytes(np.repeat(grey[..., None], 3, 2)), "selection.png")
    # A tenth of a pixel is enough to draw a mark.
    marks = np.round(points.astype(np.float64), 1).ravel().tolist()
    return SelectionViewed(mask=blob.sha256, points=marks, revision=revision)


class SelectionHide(Command):
    """A layer that hides what is selected, or (rest) all the rest: a crop. The Gaussians stay in the file with opacity
    0; nothing is selected afterwards."""

    NAME = "selection.hide"
    ANSWER = LayerMade
    name: Name = "Hide"
    rest: bool = False


@command(SelectionHide, writes=True)
def hide_selection(context: CommandContext, request: SelectionHide) -> LayerMade:
    current, session = context.studio.selection, context.studio.session
    weights = current.weights()
    if weights is None:
        raise ValueError("selection: nothing is selected; select something first")
    # A crop hides the rest; what is selected stays.
    if request.rest:
        weights = tools.inverted(session.splats, weights)
    with progress(context, request.name):
        layer = session.layers.hide_selected(weights, request.name)
    current.choose(None)
    return layer_made(context, layer.id, python_line("session.layers.hide_selected", RawExpr("weights"), request.name))


def _apply(context: CommandContext, weights: np.ndarray, how: Combine) -> None:
    current = context.studio.selection
    # Combined in one place, so that all tools add and subtract alike.
    current.choose(tools.combined(current.weights(), weights, how))


def _selected(context: CommandContext, python: str = "") -> Selected:
    current, splats = context.studio.selection, context.studio.session.splats
    visible = max(int((splats.opacities > 0).sum()), 1)
    return Selected(gaussians=current.gaussians, share=min(current.gaussians / visible, 1.0), python=python)


def _grey(context: CommandContext, blob: str, camera: Camera) -> np.ndarray:
    """[H, W] float32 0..1 of an uploaded mask, brought to the view's size. Raises ValueError: another shape."""
    stored = context.studio.blobs.get(blob, "picture")
    name, size = stored.name or "mask", (camera.width, camera.height)
    with naming_errors(stored.path, name):
        mask = read_picture(stored.path).colors.mean(-1).astype(np.float32)
    check_shape(name, (mask.shape[1], mask.shape[0]), size)
    return mask if mask.shape[::-1] == size else np.clip(resample(mask, *size), 0, 1)
