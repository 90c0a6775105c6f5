"""Holes filled: what is selected removed and filled, a circled hole closed, and a fill coloured by a picture source."""

from __future__ import annotations

from splatpainter.server.commands.context import CommandContext, RawExpr, command, layer_made, progress, python_line
from splatpainter.server.commands.selection import BESIDE_MASK
from splatpainter.server.commands.source_edit import SourceCommand, SourceWords, TicketFlag, within_limits
from splatpainter.server.describe import layer_info
from splatpainter.server.protocol import CameraInfo, Command, LayerMade, Name
from splatpainter.server.work_queue import Cancelled
from splatpainter.source_edits.edit import source_record
from splatpainter.source_edits.fill import ask_for_fill
from splatpainter.source_edits.view_edit import SourceBrief
from splatpainter.sources.picture_source import SourceCancelled
from splatpainter.sources.registry import open_source


class FillMade(LayerMade):
    note: str = ""
    """What was removed, and whether it is a part of something larger, and filled, one line; "" where only a hole was
    filled."""


class FillSelection(Command):
    """New Gaussians that continue the surface, as a layer: over a hole that the selection surrounds, or (remove) over
    what is left when another layer below hides the whole body of what is selected, or (not body) the selected
    Gaussians alone. Where that leaves no hole the layer is empty, and its note says so. Nothing is selected
    afterwards."""

    NAME = "fill.selection"
    ANSWER = FillMade
    remove: bool = False
    body: bool = True
    name: Name = "Fill"


@command(FillSelection, writes=True)
def fill_selection(context: CommandContext, request: FillSelection) -> FillMade:
    current, session = context.studio.selection, context.studio.session
    # The weights of this moment: what is selected is cleared afterwards.
    weights = current.weights()
    if weights is None:
        raise ValueError("selection: nothing is selected; select something first")
    beside = current.beside() if request.remove and request.body else None
    part = ""
    with progress(context, request.name):
        if request.remove and request.body:
            # Asked for apart, as the layer's own note counts a body but does not say that it is a part.
            weights, part = session.layers.body(weights, beside)
        layer = session.layers.fill(weights, remove=request.remove, name=request.name)
    # The part that was selected is hidden or covered now.
    current.choose(None)
    # Only what differs from the defaults belongs in the line.
    remove = True if request.remove else None
    body = True if request.remove and request.body else None
    around = None if beside is None else BESIDE_MASK
    line = python_line("session.layers.fill", RawExpr("weights"), remove=remove, body=body, beside=around)
    info = layer_info(session, layer)
    return FillMade(layer=info, python=line, note="; ".join(filter(None, (part, info.note if request.remove else ""))))


class FillSurroundings(Command):
    """Colour a fill layer by what surrounds it again."""

    NAME = "fill.surroundings"
    ANSWER = LayerMade
    layer: str


@command(FillSurroundings, writes=True)
def fill_from_surroundings(context: CommandContext, request: FillSurroundings) -> LayerMade:
    session = context.studio.session
    with progress(context, session.layers.by_id(request.layer).name):
        session.layers.fill_from(request.layer, [])
    return layer_made(context, request.layer, python_line("session.layers.fill_from", request.layer, []))


class FillSource(SourceWords, SourceCommand):
    """Send a view of a fill layer to a source, with the fill as the mask, and colour the layer by what comes back."""

    NAME = "fill.source"
    ANSWER = LayerMade
    layer: str
    camera: CameraInfo


@command(FillSource, background=True, once=True, bound=True)
def fill_from_source(context: CommandContext, request: FillSource) -> LayerMade:
    studio, source, flag = context.studio, open_source(request.source), TicketFlag(context)
    session, brief = studio.session, SourceBrief(request.prompt, seed=request.seed)
    camera = within_limits(request.camera.to_camera(), source.capabilities.max_side_px)
    # What the source is sent is of this moment; the layer may change while it works.
    new, splats = session.layers.filled_by(request.layer), session.splats.numpy()
    # Looked at before the source is asked, which may cost money.
    if session.read_only:
        raise ValueError(f"{studio.name}: {session.read_only}")
    try:
        sourced = ask_for_fill(splats, new, source, brief, camera, progress=flag.report, cancel=flag)
    except SourceCancelled:
        raise Cancelled from None

    # Runs with the commands that write: only there may the session be changed.
    def paint() -> LayerMade:
        if studio.session is not session:
            raise Cancelled  # another project was opened
        session.layers.fill_from(request.layer, [sourced.edit], source=source_record(source, brief, [sourced]))
        line = f"session.layers.fill_from({request.layer!r}, [edit])  # of {source.name!r}"
        return layer_made(context, request.layer, line)

    return context.write(paint)
