"""Holes filled, and things removed, with a receipt; in colours of what surrounds them, or of a picture source's picture
of the filled view.

    asset = fill(splats, removed=weights)
    asset = fill(splats, around=weights, source=open_source("gemini"), prompt="mossy stone")
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera, look_at
from splatpainter.holes.body import body_or_selection
from splatpainter.holes.fill import Filled, fill_hole, painted
from splatpainter.kernels.portable import tan
from splatpainter.lift.masks import dilated
from splatpainter.painter import Asset
from splatpainter.receipts import Receipt, untouched_hashes
from splatpainter.rendering.pixel_shares import share_of
from splatpainter.source_edits.edit import BACKGROUND, source_record
from splatpainter.source_edits.view_edit import AnsweredView, SourceBrief, ask_for_edit
from splatpainter.sources.picture_source import CancelFlag, PictureSource, Progress, SourceError
from splatpainter.splats import Splats, changed_rows

SELECTED = 0.5
"""Weight from which a Gaussian counts."""
VIEW_PX, LOOK_PX = 800, 100
"""Side of a view that is chosen here, and of those among which it is."""
VIEW_FOV = 35.0
VIEW_SIDES = 2.5
"""Width of the view, in widths of the hole: a source has to see what it continues."""
MIN_SHARE = 0.5
"""Least share of a pixel that new Gaussians make from which it is part of the mask."""
MASK_MARGIN_PX = 3
MIN_MASK_PX = 64
"""Fewest pixels of a hole in the view that a source gets."""


def fill(
    splats: Splats,
    removed: np.ndarray | None = None,
    *,
    around: np.ndarray | None = None,
    body: bool = False,
    beside: np.ndarray | None = None,
    source: PictureSource | None = None,
    prompt: str | SourceBrief = "",
    camera: Camera | None = None,
    progress: Progress | None = None,
    cancel: CancelFlag | None = None,
) -> Asset:
    """The asset with a hole filled by new Gaussians, appended at the end, on a surface that continues the border.

    removed: [N] bool or 0..1 weights: Gaussians that go first; they stay as rows of opacity 0; where the surface behind
    them is closed that is all, and the receipt's note says so. body: what goes is the whole connected body that they
    are of (holes/body.py), or they alone where they are a spot on something larger; beside: [N] bool, where an outline
    on a view chose them: Gaussians drawn beside it (pixel_shares.beside_mask), so that a neighbour stays. around:
    instead, those that lie around a hole that is there, as one selects them by circling it. The new Gaussians take the
    colours and the texture of what surrounds them; or, with a source, those of its picture of the filled view, in which
    the fill is the mask. camera: that view; by default one that faces the hole. prompt: what the source should paint
    there, in words, or all that is wanted of it (`SourceBrief`). The receipt says what was removed and added, and who
    made the picture.

    Raises ValueError in one line where there is nothing to fill (holes/fill.py); SourceError and SourceCancelled as
    `edit_with_source`."""
    # What is to go, and the asset without it: rows stay and lose their opacity.
    start = time.perf_counter()
    splats = splats.numpy()
    if (removed is None) == (around is None):
        raise ValueError("fill: expected Gaussians to remove, or those around a hole")
    chosen = _chosen(removed if removed is not None else around, len(splats))
    emptied, words = splats, ""
    if removed is not None and body:
        chosen, words = body_or_selection(splats, chosen, beside)
    if removed is not None:
        emptied = replace(splats, opacities=np.where(chosen, np.float32(0), splats.opacities))
    # The surface goes on from the border first; a source paints on what is there.
    filled = fill_hole(emptied, removed=chosen) if removed is not None else fill_hole(emptied, around=chosen)
    edits: tuple[AnsweredView, ...] = ()
    appended = filled.appended
    brief = SourceBrief.of(prompt)
    if source is not None and not filled.holes:
        raise ValueError(f"fill: there is nothing for {source.name} to paint: {filled.reason}; fill without a source")
    # The source sees the fill in its place, and may change that alone.
    if source is not None:
        with_fill = replace(emptied, source=None, origin=None).append(appended)
        flag, report = cancel or threading.Event(), progress or (lambda share, words: None)
        new = np.arange(len(with_fill)) >= len(splats)
        view = camera or facing(filled, with_fill, new)
        sourced = ask_for_fill(with_fill, new, source, brief, view, progress=report, cancel=flag)
        edits = (sourced,)
        appended = painted(emptied, appended, [(sourced.edit.camera, sourced.edit.image, _mask_of(sourced))])
    # The new rows come from no file, so their bytes are made when they are written.
    after = emptied.append(replace(appended, source=None, origin=None))
    touched = changed_rows(splats, after)
    hashes = untouched_hashes(splats, after, touched)
    receipt = Receipt(
        asset_sha256=splats.sha256,
        asset_rows=len(splats),
        output_sha256="",
        output_rows=len(after),
        mode="fill",
        method="surroundings" if source is None else "source",
        preset="",
        touched=touched,
        removed=touched,
        appended_rows=len(appended),
        untouched_sha256_before=hashes[0],
        untouched_sha256_after=hashes[1],
        seconds={"fill": time.perf_counter() - start},
        note="; ".join(filter(None, (words, filled.note))),
        source=None if source is None else source_record(source, brief, edits),
    )
    return Asset(after, receipt, original=splats)


def facing(filled: Filled, splats: Splats, new: np.ndarray, size: int = VIEW_PX) -> Camera:
    """A view of the largest hole, with some of what surrounds it. splats: with the new Gaussians ([N] bool); of
    the two sides of the surface that which shows more of them."""
    center = splats.means[new].astype(np.float64).mean(0)
    towards = filled.camera
    assert towards is not None
    width = filled.size_px * float(towards.to_camera(center)[2]) / towards.fx
    distance = VIEW_SIDES * width / (2 * tan(math.radians(VIEW_FOV / 2)))
    cameras = []
    for side in (-1, 1):
        eye = center + side * distance * towards.forward
        up = -towards.world_to_camera[1, :3]
        cameras.append(look_at(eye, center, up, width=size, height=size, fov=VIEW_FOV, background=BACKGROUND).local)
    areas = [int(fill_mask(splats, new, camera.resized(LOOK_PX, LOOK_PX)).sum()) for camera in cameras]
    return cameras[int(np.argmax(areas))]


def ask_for_fill(
    splats: Splats,
    new: np.ndarray,
    source: PictureSource,
    brief: SourceBrief,
    camera: Camera,
    *,
    progress: Progress,
    cancel: CancelFlag,
) -> AnsweredView:
    """A source's picture of a view of `splats` (numpy), some of whose Gaussians (new: [N] bool) fill a hole: these are
    the mask. Raises SourceError: the view does not show them; and as ask_for_edit."""
    mask = fill_mask(splats, new, camera)
    if mask.sum() < MIN_MASK_PX:
        raise SourceError(f"{source.name}: the view does not show the hole; choose another one")
    return ask_for_edit(
        splats, camera, source, brief, progress=progress, cancel=cancel, mask=mask.astype(np.float32), name=source.name
    )


def fill_mask(splats: Splats, new: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W] bool: where a view shows new Gaussians ([N] bool), and a little around them."""
    return dilated(share_of(splats, camera, new) > MIN_SHARE, MASK_MARGIN_PX)


def _mask_of(sourced: AnsweredView) -> np.ndarray:
    mask = sourced.edit.mask
    return np.ones(sourced.edit.image.shape[:2], np.float32) if mask is None else mask.astype(np.float32)


def _chosen(weights: np.ndarray | None, count: int) -> np.ndarray:
    """[N] bool. Raises ValueError: another shape, not finite."""
    values = np.asarray(weights)
    if values.shape != (count,) or values.dtype.kind not in "bfiu" or not np.isfinite(values).all():
        raise ValueError(f"fill: expected [{count}] weights of 0 to 1, got {values.dtype} {list(values.shape)}")
    return values >= SELECTED
