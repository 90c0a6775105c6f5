"""Edited pictures beside what the asset shows now: where they differ, which pixels count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.painting.asset import Asset
from splatpainter.painting.edited_picture import Edit, Mode

if TYPE_CHECKING:
    from splatpainter.lift.edit_views import EditView


def prepared_views(asset: Asset, edits: Sequence[Edit], mode: Mode, partly: bool) -> list[EditView]:
    """Each edit with the render that it is of. partly: under an edit's mask, where it has one, that is enough. Raises
    ValueError, naming the edit, where there is nothing to do."""
    # One view goes with its edit up to the receipt; many of a large asset would be more memory than time.
    keep = len(edits) == 1
    return _changed_together([_prepare(asset, edit, mode, partly, keep) for edit in edits], edits)


def _prepare(asset: Asset, edit: Edit, mode: Mode, partly: bool, keep: bool) -> EditView:
    """The edit beside what the asset shows; partly: under the edit's mask, where it has one, that is enough; keep:
    whether it keeps the projected view. Raises ValueError, naming the edit, where there is nothing to do."""
    from splatpainter.lift.edit_views import EditView, errors_name
    from splatpainter.lift.masks import dilated, edited_mask
    from splatpainter.lift.sheets.resurface import RING_PX
    from splatpainter.rendering.cpu.projected_view import tiles_of_mask
    from splatpainter.rendering.cpu.recent_views import recent_view
    from splatpainter.rendering.partial import PartialRender
    from splatpainter.voxels.raycast import is_inside

    with errors_name(edit.name):
        if is_inside(asset.splats, lambda: asset.grid, edit.camera.position):
            raise ValueError("edit: the camera is inside the object; step back until the surface is in view")
        mask = edit.mask
        # A ring beside the mask is projected as well: a sheet covers that too.
        tiles = beside = view = None
        if partly and mask is not None and mask.any():
            tiles, beside = tiles_of_mask(mask), tiles_of_mask(dilated(mask, RING_PX))
            view = recent_view(asset.splats, edit.camera)
        drawn = PartialRender.of(asset.splats, edit.camera, tiles, beside, view, keep=keep)
        if mask is None:
            mask = drawn.alphas > 0.5 if mode == "global" else edited_mask(edit.image, drawn.colors, drawn.alphas)
        # Which reason is named tells what to do: turn the camera, change the picture, or paint a mask.
        if not mask.any():
            unchanged = (
                "the asset is not in view" if mode == "global" else "the picture does not differ from the render"
            )
            what = unchanged if edit.mask is None else "the mask is empty"
            raise ValueError(f"edit: nothing to do, {what}")
    return EditView(
        *(edit.camera, edit.image, mask, drawn.colors, drawn.depths, drawn.alphas, edit.name, drawn.tiles, drawn.view),
        cover=edit.cover,
    )


def _changed_together(views: list[EditView], edits: Sequence[Edit]) -> list[EditView]:
    """Where one picture without a mask changed throughout, others of the edit that changed at most pixels did too."""
    from splatpainter.lift.masks import MIN_MEDIAN_CHANGE, median_change

    # Masks that people gave are never widened: what they say is meant.
    free = [edit.mask is None and view.alpha is not None for view, edit in zip(views, edits, strict=True)]
    if not any(view.mask.all() for view, unmasked in zip(views, free, strict=True) if unmasked):
        return views
    return [
        replace(view, mask=np.ones(view.mask.shape, bool))
        if unmasked and median_change(view.edited, view.before, np.asarray(view.alpha)) > MIN_MEDIAN_CHANGE
        else view
        for view, unmasked in zip(views, free, strict=True)
    ]
