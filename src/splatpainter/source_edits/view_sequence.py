"""The views of a plan one after the other: each shows what is painted already, and is asked for what no earlier one
reached. Knows not who paints, nor on what: an asset, or layers of a session."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from splatpainter.gatekeeper.gatekeeper import RefusedPicture
from splatpainter.source_edits.coverage import SurfaceView, ViewPlan, ViewShare, unreached, worth_asking
from splatpainter.source_edits.view_edit import AnsweredView, SourceBrief, ask_for_edit
from splatpainter.sources.picture_source import CancelFlag, PictureSource, Progress, SourceCancelled, SourceError
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.surface.estimate import Surface

WITHOUT_SHEETS: dict[str, Any] = {"resurface": False, "max_error": 1.0}
"""LocalOptions of views that are painted one after the other. Gaussians are split and recoloured, not replaced by
sheets, and get no detail layer: those of one view stand in the way of the next. Nine views of the still life, of
300 px, its colours exchanged: 23.5 to 28.2 dB from eight other views against the asset whose own colours were
exchanged; with sheets 19.5 to 25.8."""


@dataclass(frozen=True)
class AnsweredViews:
    """The views of a plan, as far as a source answered them."""

    edits: tuple[AnsweredView, ...]
    """Those that were painted."""
    notes: tuple[str, ...] = ()
    """Why further views were not, one line each."""
    cancelled: bool = False
    refused: tuple[RefusedPicture, ...] = ()
    """Refusals, with what came back."""


def edit_views_in_order(
    splats: Splats,
    source: PictureSource,
    brief: SourceBrief,
    plan: ViewPlan,
    *,
    present: Callable[[], Splats],
    paint: Callable[[AnsweredView], None],
    progress: Progress,
    cancel: CancelFlag,
    surface: Callable[[], Surface] | None = None,
    allowed: ViewShare | None = None,
    entered: Callable[[int, int], None] | None = None,
    keep_when_cancelled: bool = False,
) -> AnsweredViews:
    """Ask a source for each view of a plan, and have its picture painted before the next one is rendered.

    splats: the asset (numpy) before; present: gives it with what was painted since; paint: paints one view's edit, or
    raises ValueError where that cannot be done, which is noted; surface: for the maps that a source takes; allowed:
    what of each view may change; entered: called with (view, views) before each. keep_when_cancelled: a cancellation
    after the first painted view ends the turns, and what was painted is returned.

    A picture that is refused leaves its part as it was, and is noted; if none was painted, the last error is raised.
    Where the source fails later than in the first view, the views before it stay and the note says where it stopped.
    Raises SourceError, SourceCancelled, ValueError: nothing to paint in any view."""
    from splatpainter.view_files import normals_of

    normals, count = normals_of(splats), len(plan.cameras)
    edits: list[AnsweredView] = []
    notes: list[str] = []
    refused: list[RefusedPicture] = []
    reached: list[tuple[SurfaceView, np.ndarray]] = []
    error: ValueError | None = None
    try:
        for k, camera in enumerate(plan.cameras):
            if cancel.is_set():
                raise SourceCancelled
            if entered is not None:
                entered(k, count)
            # What views before it reached is theirs: two pictures of one place would be mixed to mush.
            view = SurfaceView.of(splats, camera, normals)
            mask = unreached(view, reached)
            if allowed is not None:
                mask = np.minimum(mask, allowed(camera)).astype(np.float32)
            if not worth_asking(mask, view):
                continue
            # Of the asset with what was painted so far, so that the picture goes on from it.
            try:
                sourced = ask_for_edit(
                    present(),
                    camera,
                    source,
                    brief,
                    progress=part_of(progress, k, count),
                    cancel=cancel,
                    mask=mask,
                    surface=surface,
                    name=f"{source.name} view {k + 1}",
                )
            except RefusedPicture as refusal:
                error = refusal
                refused.append(refusal)
                notes.append(str(refusal))
                continue
            except SourceError as failure:
                # A source that fails now will fail for the next view, too, and each may be paid for.
                if not edits:
                    raise
                notes.append(f"stopped before view {k + 1} of {count}, the earlier ones are painted: {failure}")
                break
            # Painted at once; a picture that cannot be painted covers nothing for the views after it.
            try:
                paint(sourced)
            except ValueError as failure:
                error = failure
                notes.append(f"{source.name} view {k + 1}: not painted ({failure})")
                continue
            edits.append(sourced)
            reached.append((view, mask))
    # A person who stops in the middle may want what there is by then.
    except SourceCancelled:
        if not (keep_when_cancelled and edits):
            raise
        return AnsweredViews(tuple(edits), tuple(notes), True, tuple(refused))
    if not edits:
        raise error or ValueError("views auto: no view shows a surface that could be painted")
    return AnsweredViews(tuple(edits), tuple(notes), refused=tuple(refused))


def part_of(progress: Progress, index: int, count: int) -> Progress:
    """The progress of one view of several, as one of all of them."""
    return lambda share, words: progress((index + share) / count, f"view {index + 1} of {count}: {words}")
