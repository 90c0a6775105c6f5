"""Layers of pictures that a source makes: the views of a plan, one layer each, or one of all of them.

plan = plan_views(session.splats, background=BACKGROUND)
made = add_source_views(session, source, SourceBrief("mossy stone"), plan)
made.layers, made.notes
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from splatpainter.painter import Method
from splatpainter.session.document.document import Layer
from splatpainter.session.session import Session
from splatpainter.source_edits.coverage import ViewPlan, ViewShare
from splatpainter.source_edits.edit import source_record
from splatpainter.source_edits.view_edit import AnsweredView, SourceBrief
from splatpainter.source_edits.view_sequence import AnsweredViews, edit_views_in_order
from splatpainter.sources.picture_source import CancelFlag, PictureSource, Progress, SourceCancelled
from splatpainter.system.quick_dataclass import dataclass

Write = Callable[[Callable[[], Layer]], Layer]
"""Runs a command of the session where such commands run."""


@dataclass(frozen=True)
class SourceLayers:
    """Layers made from a plan of views, and what failed."""

    layers: tuple[Layer, ...]
    """New ones, lowest first: one per view, or one of all of them."""
    sourced_views: AnsweredViews
    notes: tuple[str, ...]
    """Why views were not painted, and what else is to say, one line each."""


def add_source_views(
    session: Session,
    source: PictureSource,
    brief: SourceBrief,
    plan: ViewPlan,
    *,
    one_layer: bool = False,
    method: Method = "auto",
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
    allowed: ViewShare | None = None,
    write: Write | None = None,
) -> SourceLayers:
    """Ask a source for the views of a plan (`source_edits.coverage.plan_views`) and paint each as a layer on top; every
    view shows what those before it painted, and is asked for what they did not reach. Layers say who made
    them.

    one_layer: merge them at the end, which shows the same. method: of the lift. cancel: where it is set after the first
    view, what was painted stays. allowed: what of each view may change (a selection). write: where commands of the
    session have to run; None: here. Raises SourceError, SourceCancelled and ValueError, as `edit_views_in_order`: then
    there is no new layer."""
    run = write or (lambda command: command())
    title = " ".join(filter(None, [f"{source.name}:" if brief.prompt else source.name, brief.prompt]))
    title = " ".join(title.split())[:80]
    layers: list[Layer] = []

    def paint(sourced: AnsweredView) -> None:
        name = f"{title} ({len(layers) + 1})"
        # Who made the picture goes into the layer, so that receipts can say it.
        record = source_record(source, brief, [sourced])
        layers.append(
            run(
                lambda: session.layers.add(
                    "picture", [sourced.edit], name=name, method=method, split_only=True, source=record
                )
            )
        )

    sourced_views = edit_views_in_order(
        session.splats,
        source,
        brief,
        plan,
        present=lambda: session.splats,
        paint=paint,
        surface=lambda: session.surface.estimate,
        progress=progress or (lambda share, words: None),
        cancel=cancel or threading.Event(),
        allowed=allowed,
        keep_when_cancelled=True,
    )
    notes = list(sourced_views.notes)
    # Merged at the end: each view has to show what those before it painted.
    if one_layer and len(layers) > 1:
        try:
            layers = [run(lambda: session.layers.merge([layer.id for layer in layers], title))]
        except (ValueError, SourceCancelled) as error:  # somebody moved or deleted one meanwhile
            notes.append(f"the views stay layers of their own ({error})")
    return SourceLayers(tuple(layers), sourced_views, tuple(notes))
