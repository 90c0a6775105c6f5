"""Soft edges of paint: pixels that a brush covers in part show a mixture of the paint and of what was there.

Who learns from them learns a weaker paint, and where the material below takes the paint's colour they are a rim of the
old one. How far each is covered is known (`Edit.cover`), so both can be undone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.color import from_display, to_display
from splatpainter.lift.edit_views import EditView
from splatpainter.splats import ColorSpace

MIN_TEACHING_COVER = 0.5
"""Cover from which a pixel says what the paint is: the 8 bits of a picture are stretched by its inverse."""


def well_covered(view: EditView) -> Bools:
    """[H, W] bool pixels of the paint that say what it is."""
    return view.mask if view.cover is None else view.mask & (view.cover >= MIN_TEACHING_COVER)


def paint_alone(view: EditView, space: ColorSpace) -> EditView:
    """The view with the paint itself in place of mixtures, where these say what it is; as it was where none do."""
    mask = well_covered(view)
    if view.cover is None or not mask.any():
        return view
    old, edited = (to_display(np.clip(picture, 0, 1), space) for picture in (view.before, view.edited))
    paint = old + (edited - old) / np.maximum(view.cover, MIN_TEACHING_COVER)[..., None]
    edited = _where(view.cover < 1, from_display(np.clip(paint, 0, 1), space), view.edited)
    return replace(view, edited=edited, mask=mask)


def on_other_ground(view: EditView, after: Floats, space: ColorSpace) -> EditView:
    """The view of an asset that shows `after` ([H, W, 3]) by now: the same paint, as thick as it is, over that."""
    edited = view.edited
    if view.cover is not None:
        old, new, picture = (to_display(np.clip(picture, 0, 1), space) for picture in (view.before, after, edited))
        mixed = picture + (1 - view.cover[..., None]) * (new - old)
        edited = _where(view.cover < 1, from_display(np.clip(mixed, 0, 1), space), edited)
    return replace(view, edited=edited, before=after, projected=None)


def _where(chosen: np.ndarray, first: np.ndarray, second: np.ndarray) -> Floats:
    """[H, W, 3] float32."""
    return np.where(chosen[..., None], first, second).astype(np.float32)
