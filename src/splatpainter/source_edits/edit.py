"""Assets edited by a picture source, from one view or from as many as their surface needs.

source = open_source("command", {"run": "stylise {image} {out}"})
asset = edit_with_source(splats, source, "weathered bronze", views="auto")
asset.splats, asset.receipt.source
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.painter import MAX_VIEWS, Asset, Method, Mode, Painter
from splatpainter.receipts import Receipt, untouched_hashes
from splatpainter.source_edits.coverage import ViewPlan, plan_views
from splatpainter.source_edits.view_edit import AnsweredView, SourceBrief, ask_for_edit
from splatpainter.source_edits.view_sequence import WITHOUT_SHEETS, edit_views_in_order, part_of
from splatpainter.sources.picture_source import (
    MAX_PROMPT_CHARACTERS,
    CancelFlag,
    PictureSource,
    Progress,
    SourceCancelled,
)
from splatpainter.splats import Splats, changed_rows
from splatpainter.system.quick_dataclass import dataclass

BACKGROUND = (0.25, 0.25, 0.25)
"""Behind the asset in the views that a source gets, in the asset's colour space."""


@dataclass(frozen=True)
class SourcedAsset:
    """An asset edited by a source."""

    asset: Asset
    """The edited asset, with the receipt of all views, which names the source."""
    edits: tuple[AnsweredView, ...]
    refused: tuple[str, ...] = ()
    """Why pictures of further views were not taken, one line each."""


def edit_with_source(
    splats: Splats,
    source: PictureSource,
    prompt: str | SourceBrief = "",
    *,
    camera: Camera | None = None,
    views: Literal["", "auto"] = "",
    mask: np.ndarray | None = None,
    mode: Mode = "local",
    method: Method = "auto",
    max_views: int = 8,
    size: int = 800,
    painter: Painter | None = None,
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Asset:
    """The asset after a picture source (`sources.registry.open_source`) has edited views of it.

    prompt: what it should do, in words, or all that is wanted of it (`SourceBrief`: references, a seed, a scale, how
    much its pictures may differ). camera: the view that is rendered and sent; by default the first of `render`'s ring,
    or with views="auto" the one that shows most. views: "auto" goes on to the view that shows most of what none before
    it did, and asks for that alone, until at most `max_views` have covered the surface. mask: [H, W] 0..1 of the
    camera's picture, where it may change. size: pixels of views that are chosen here. The receipt's `source` says who
    made the pictures and what was corrected.

    Raises SourceError: more is asked than the source takes, the source fails, its picture is refused; SourceCancelled;
    ValueError as `Painter.apply`."""
    # Everything that can be refused is, before the source is asked: each of its pictures may be paid for.
    brief = SourceBrief.of(prompt)
    painter = painter or Painter.load(modes=[mode])
    asset = painter.encode(splats, method, [mode])
    reported = progress or (lambda share, words: None)
    flag = cancel or threading.Event()
    if views == "auto":
        if mask is not None or mode != "local":
            raise ValueError("views auto: is for edits of mode local without a mask; it makes its own masks")
        # Planned on the asset as it is: what a source paints changes colours, not what a view shows.
        plan = plan_views(asset.splats, size=size, max_views=max_views, first=camera, background=BACKGROUND)
        return cover(painter, asset, source, brief, plan, method=method, progress=reported, cancel=flag).asset
    camera = camera or orbit_cameras(asset.splats, 1, size=size, background=BACKGROUND)[0]
    return edit_view(
        painter, asset, source, brief, camera, mask, mode=mode, method=method, progress=reported, cancel=flag
    ).asset


def edit_view(
    painter: Painter,
    asset: Asset,
    source: PictureSource,
    brief: SourceBrief,
    camera: Camera,
    mask: np.ndarray | None,
    *,
    mode: Mode,
    method: Method,
    progress: Progress,
    cancel: CancelFlag,
) -> SourcedAsset:
    """One view, edited and painted. Arguments and errors as of `edit_with_source`."""
    sourced = ask_for_edit(
        asset.splats,
        camera,
        source,
        brief,
        progress=progress,
        cancel=cancel,
        mask=mask,
        mode=mode,
        surface=lambda: asset.surface,
    )
    edited = painter.apply(asset, [sourced.edit], mode, method)
    assert edited.receipt is not None
    # The receipt is the painter's; that the picture was not drawn by a person is added to it.
    receipt = replace(edited.receipt, source=source_record(source, brief, [sourced]))
    return SourcedAsset(replace(edited, receipt=receipt), (sourced,))


def _without_sheets(painter: Painter) -> Painter:
    from splatpainter.lift.options import LOCAL_DEFAULTS

    local = replace(painter.settings.local_options or LOCAL_DEFAULTS, **WITHOUT_SHEETS)
    return painter.with_settings(local_options=local)


def refine(
    splats: Splats,
    cameras: Sequence[Camera],
    *,
    upscale: str | Path | None = None,
    source: PictureSource | None = None,
    prompt: str | SourceBrief = "",
    scale: int | None = None,
    method: Method = "lift",
    painter: Painter | None = None,
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Asset:
    """The asset, sharper where views of it are looked at closely, as by `splatpainter refine`: each view is rendered,
    enlarged, and all are lifted together at the enlarged size.

    cameras: 1 to 16. upscale: a super-resolution model that spandrel opens (.safetensors); None: Lanczos and gentle
    sharpening, which invent nothing. source: another picture source instead; prompt: for one that takes it, or
    all that is wanted of it (`SourceBrief`). scale: how many times larger than its view each picture is made; None:
    as the brief says, with words alone `usual_scale`. method: "lift", or "fit" for
    seconds of optimisation after it. The receipt's `source` says who made the pictures. Raises as
    `edit_with_source`."""
    from splatpainter.sources.registry import open_source

    if source is not None and upscale is not None:
        raise ValueError("refine: expected a model for upscale, or a source, got both")
    if not 1 <= len(cameras) <= MAX_VIEWS:
        raise ValueError(f"refine: expected 1 to {MAX_VIEWS} cameras, got {len(cameras)}")
    # A model that enlarges is a source like others; without either, pictures are sharpened without invention.
    options = {} if upscale is None else {"model": str(upscale)}
    painter, brief = painter or Painter.load("lift"), SourceBrief.of(prompt)
    source = source or open_source("upscale", options)
    # Lifted together: views that overlap would undo each other's detail one by one.
    return refine_views(
        painter,
        painter.encode(splats, method, ["local"]),
        source,
        replace(brief, scale=scale or (usual_scale(source) if isinstance(prompt, str) else brief.scale)),
        cameras,
        method=method,
        progress=progress or (lambda share, words: None),
        cancel=cancel or threading.Event(),
    ).asset


def usual_scale(source: PictureSource) -> int:
    """How many times larger `refine` has pictures made where nobody says it: 2, or 1 of sources that do not enlarge."""
    return 2 if 2 in source.capabilities.scales else min(source.capabilities.scales)


def refine_views(
    painter: Painter,
    asset: Asset,
    source: PictureSource,
    brief: SourceBrief,
    cameras: Sequence[Camera],
    *,
    method: Method,
    progress: Progress,
    cancel: CancelFlag,
) -> SourcedAsset:
    """Views that a source enlarges or restores, each as the asset is, lifted together (lift/local/wide_edit.py): what
    is sharper in them is sharper on the asset. Errors as of `edit_with_source`."""
    edits: list[AnsweredView] = []
    for k, camera in enumerate(cameras):
        if cancel.is_set():
            raise SourceCancelled
        sourced = ask_for_edit(
            asset.splats,
            camera,
            source,
            brief,
            progress=part_of(progress, k, len(cameras)),
            cancel=cancel,
            surface=lambda: asset.surface,
            name=f"view {k + 1}",
        )
        # An enlarged view changed throughout: its mask is the view, also where the enlarger left a pixel as it was.
        everywhere = np.ones((sourced.edit.camera.height, sourced.edit.camera.width), bool)
        edits.append(replace(sourced, edit=replace(sourced.edit, mask=everywhere)))
    # All at once: one after the other, each view would pull at the Gaussians that the one before it had sharpened.
    refined = painter.apply(asset, [sourced.edit for sourced in edits], "local", method)
    assert refined.receipt is not None
    record = source_record(source, brief, edits)
    return SourcedAsset(replace(refined, receipt=replace(refined.receipt, source=record)), tuple(edits))


def cover(
    painter: Painter,
    asset: Asset,
    source: PictureSource,
    brief: SourceBrief,
    plan: ViewPlan,
    *,
    method: Method,
    progress: Progress,
    cancel: CancelFlag,
    entered: Callable[[int, int], None] | None = None,
) -> SourcedAsset:
    """The views of a plan one after the other (`edit_views_in_order`), lifted with WITHOUT_SHEETS.

    A picture that is refused leaves its part as it was, and is noted; if all are, the last one's error is raised. Where
    the source fails later than in the first view (a limit, a lost network), what was paid for is kept: the views before
    it are painted, and the receipt notes where it stopped. Other errors as of `edit_with_source`."""
    # Views that overlap would lay sheet over sheet; split Gaussians take the next view's paint in place.
    painter = _without_sheets(painter)
    before, receipts = asset, []

    def paint(sourced: AnsweredView) -> None:
        nonlocal asset
        asset = painter.apply(asset, [sourced.edit], "local", method)
        assert asset.receipt is not None
        receipts.append(asset.receipt)

    sourced_views = edit_views_in_order(
        before.splats,
        source,
        brief,
        plan,
        present=lambda: asset.splats,
        paint=paint,
        surface=lambda: before.surface,
        progress=progress,
        cancel=cancel,
        entered=entered,
    )
    # The proof runs from the first asset to the last; notes of single views must not break its list of notes.
    receipt = joined_receipt(before.splats, asset.splats, receipts)
    note = "; ".join(filter(None, [receipt.note, *(line.replace("; ", ", ") for line in sourced_views.notes)]))
    receipt = replace(receipt, source=source_record(source, brief, sourced_views.edits), note=note)
    return SourcedAsset(replace(asset, receipt=receipt), sourced_views.edits, sourced_views.notes)


def source_record(source: PictureSource, brief: SourceBrief, edits: Sequence[AnsweredView]) -> dict:
    """What a receipt says of a source: no keys and no addresses, for it was given none."""
    return {
        "name": source.name,
        "prompt": brief.prompt[:MAX_PROMPT_CHARACTERS],
        "strictness": brief.strictness,
        "views": [edit.record() for edit in edits],
    }


def joined_receipt(before: Splats, after: Splats, receipts: Sequence[Receipt]) -> Receipt:
    """One receipt of edits that were made one after the other, each on the result of the one before."""
    count = len(before)
    # Compared anew and not summed up: a Gaussian that a later edit put back is untouched.
    touched = changed_rows(before, after)
    hashes = untouched_hashes(before, after, touched)
    removed = touched[after.opacities[touched] == 0]
    removed = np.intersect1d(removed, np.concatenate([receipt.removed for receipt in receipts]))
    # Indices behind the first asset's are Gaussians that an earlier edit appended: no original was replaced there.
    replaced = np.concatenate([receipt.replaced for receipt in receipts])
    replaced = np.setdiff1d(np.intersect1d(replaced[replaced < count], touched), removed)
    seconds: dict[str, float] = {}
    for receipt in receipts:
        for name, value in receipt.seconds.items():
            seconds[name] = seconds.get(name, 0.0) + value
    first = receipts[0]
    # Each note once, in the order in which they came.
    notes = dict.fromkeys(note for receipt in receipts for note in receipt.note.split("; ") if note)
    return replace(
        first,
        asset_rows=count,
        output_rows=len(after),
        touched=touched,
        appended_rows=len(after) - count,
        untouched_sha256_before=hashes[0],
        untouched_sha256_after=hashes[1],
        views=tuple(view for receipt in receipts for view in receipt.views),
        seconds=seconds,
        note="; ".join(notes),
        replaced=replaced,
        removed=removed,
        aside=tuple(score for receipt in receipts for score in receipt.aside),
        limited_px=tuple(value for receipt in receipts for value in receipt.limited_px),
        pixelation=receipts[-1].pixelation,
    )
