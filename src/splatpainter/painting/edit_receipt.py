"""What an edit did, for its receipt: which Gaussians changed, how near the pictures came, what could not be painted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.kernels.parallel import beside
from splatpainter.painting.asset import Asset
from splatpainter.painting.edited_picture import Mode
from splatpainter.receipts import Receipt, ViewScore, scores, untouched_hashes
from splatpainter.splats import changed_rows

if TYPE_CHECKING:
    from splatpainter.lift.edit_views import EditView
    from splatpainter.lift.edits import LiftedEdit
    from splatpainter.lift.side_views import SideViewScore
    from splatpainter.painting.edit_methods import EditMethod
    from splatpainter.painting.edit_settings import EditSettings
    from splatpainter.rendering.partial import PartialRender

LOW_ASIDE_DB = 20.0
"""Paint that scores less from the side is said to; sound paint on 24 held-out meshes has 29 on average."""
MIN_ASIDE_COVERED = 0.25
"""Share of the paint that side views must be able to check for that."""
FULL_COVER = 0.98
"""Cover of a pixel from which nothing shows through its paint: 8 bits and a little."""
MIN_NAMED_SHARE = 0.01
"""Of the edited pixels, that must be out of reach before a note says so."""


def edit_receipt(
    asset: Asset,
    result: Asset,
    lifted: LiftedEdit,
    views: Sequence[EditView],
    mode: Mode,
    method: EditMethod,
    preset: str,
    settings: EditSettings,
    note: str,
) -> tuple[Receipt, list[tuple[PartialRender, PartialRender]]]:
    """(The receipt of `result`, made of `asset`, without its timings, what each view shows of both). preset, note: of
    the painter."""
    notes = [note, _beside(views) if mode != "global" else "", _beyond_limits(views, lifted.limited), lifted.note]
    notes += method.notes(asset)

    # What changed. A lift names the Gaussians that it may have changed; a proof does not believe it.
    # Comparing named Gaussians alone is quicker, and is right only where the method changes no others.
    trusted = not settings.proof and method.names_its_gaussians
    among = lifted.ids[: np.searchsorted(lifted.ids, len(asset.splats))] if trusted else None
    touched = changed_rows(asset.splats, result.splats, among)

    # All rows are read for their hashes while views are drawn, and so are the bytes of the asset's file.
    def digests() -> tuple[tuple[str, str], str]:
        if not settings.proof:
            return ("", ""), ""
        return untouched_hashes(asset.splats, result.splats, touched, compared=True), asset.splats.sha256

    hashing = beside(digests)

    # How near it came: in the edited views, and from the side, where paint on a wrong depth comes apart.
    aside = _side_scores(asset, result, views) if settings.aside and mode != "global" else ()
    notes.append(_seen_aside(aside))
    # One picture's paint also shows in another view, so all views are drawn before any is scored.
    renders = [_before_and_after(asset, result, view, touched) for view in views]
    judged = _judged(views, renders)
    hashes, asset_sha256 = hashing()
    receipt = Receipt(
        asset_sha256=asset_sha256,
        asset_rows=len(asset.splats),
        output_sha256="",
        output_rows=len(result.splats),
        mode=mode,
        method=method.made(lifted),
        preset=method.preset(preset),
        touched=touched,
        replaced=lifted.replaced[np.isin(lifted.replaced, touched, assume_unique=True)],
        removed=lifted.removed,
        aside=tuple((score.psnr, score.covered) for score in aside),
        limited_px=tuple(round(value, 1) for value in lifted.limited),
        appended_rows=len(result.splats) - len(asset.splats),
        untouched_sha256_before=hashes[0],
        untouched_sha256_after=hashes[1],
        views=judged,
        seconds={},
        note="; ".join(filter(None, notes)),
        precision=method.arithmetic,
    )
    return receipt, renders


def _side_scores(asset: Asset, result: Asset, views: Sequence[EditView]) -> list[SideViewScore]:
    """Each view's edit from the side; of several the later ones change what the earlier ones show."""
    from splatpainter.lift.side_views import side_view_score

    return [side_view_score(asset.splats, result.splats, view) for view in views]


def _judged(views: Sequence[EditView], renders: Sequence[tuple[PartialRender, PartialRender]]) -> tuple[ViewScore, ...]:
    """Each view's score; what the other pictures painted is not outside. renders: each before and after the edit."""
    from splatpainter.lift.shared_paint import paint_of_other_views

    shared = paint_of_other_views(views, [before.depths for before, _ in renders])
    images = zip(views, renders, shared, strict=True)
    return scores([(b.colors, a.colors, v.edited, v.mask | other, _scored(v)) for v, (b, a), other in images])


def _before_and_after(
    asset: Asset, result: Asset, view: EditView, touched: np.ndarray
) -> tuple[PartialRender, PartialRender]:
    """Two renders of a view, equal where the edit changed nothing. touched: [T] Gaussians that it changed."""
    from splatpainter.rendering.partial import PartialRender

    assert view.alpha is not None and view.depth is not None and view.tiles is not None
    pictures = (view.before, view.alpha, view.depth)
    # The render before is the one that the edit started from; only what changed is drawn again.
    drawn = PartialRender(asset.splats, view.camera, view.tiles, *pictures, view.projected)
    return drawn.after(result.splats, touched)


def _scored(view: EditView) -> Bools:
    """[H, W] bool: edited pixels that the asset covers at all; not those that paint covers in part, where there are
    others: what shows through it may have changed, too."""
    assert view.alpha is not None
    scored = view.mask & (view.alpha > 0.5)
    if view.cover is None:
        return scored
    full = scored & (view.cover >= FULL_COVER)
    return full if full.any() else scored


def _beside(views: Sequence[EditView]) -> str:
    """A line about edited pixels that no Gaussian can paint, or none."""
    # A picture edited throughout has background in its mask by nature, and a note on it would say nothing.
    views = [view for view in views if not view.mask.all()]
    edited = sum(int(view.mask.sum()) for view in views)
    beside = edited - sum(int(_scored(view).sum()) for view in views)
    return (
        f"{beside} edited pixels lie beside the asset and cannot be painted"
        if beside > MIN_NAMED_SHARE * edited
        else ""
    )


def _seen_aside(scores: Sequence[SideViewScore]) -> str:
    """A line about views whose paint looks wrong from the side, or none."""
    # Where little of the paint can be checked from the side, a low score says little about it.
    low = [
        (k, score.psnr)
        for k, score in enumerate(scores)
        if score.psnr is not None and score.covered > MIN_ASIDE_COVERED and score.psnr < LOW_ASIDE_DB
    ]
    if not low:
        return ""
    which = ", ".join(f"view {k + 1}: {psnr:.1f} dB" for k, psnr in low)
    return f"seen 35 degrees from the side the paint differs from the picture ({which}): look at it from other views"


def _beyond_limits(views: Sequence[EditView], limited: Sequence[float]) -> str:
    """A line about paint that the views' limits left out, or none."""
    edited, left_out = sum(int(view.mask.sum()) for view in views), sum(limited)
    if left_out <= MIN_NAMED_SHARE * edited:
        return ""
    return (
        f"{left_out:.0f} edited pixels' worth of paint lies beyond the angle or depth-edge limit of its view and was "
        "left out: paint it from the front"
    )
