"""What the latest edit saw, before and after it: the next one from its camera, paint over paint or another try after an
undo, starts with that view in place of projecting all Gaussians and drawing them again.

One edit's is kept in all, and only for its two assets: not for others of the same arrays, which may have been written
to since.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import field, fields
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.cameras import Camera, same_camera
from splatpainter.kernels.arrays import keeps_idle_memory
from splatpainter.painting.asset import Asset
from splatpainter.system.quick_dataclass import dataclass

if TYPE_CHECKING:
    from splatpainter.rendering.cpu.projected_view import ProjectedView
    from splatpainter.rendering.cpu.recent_views import DrawnView
    from splatpainter.rendering.partial import PartialRender

MAX_VIEW_BYTES = 128 << 20
"""Of a view: a million Gaussians take 100 MB."""


@dataclass(frozen=True, eq=False)
class _AssetView:
    """One asset from one camera."""

    asset: weakref.ref[Asset]
    camera: Camera
    view: Callable[[], ProjectedView] = field(repr=False)
    """Puts it together."""
    pictures: tuple[np.ndarray, np.ndarray, np.ndarray] = field(repr=False)
    """As of DrawnView."""


_latest: list[_AssetView] = []
"""Of the asset after the latest edit and of that before it, or none."""


def keep_view(before: Asset, after: Asset, renders: tuple[PartialRender, PartialRender]) -> None:
    """Keep what an edit saw. renders: both assets from its camera, as of `PartialRender.after`."""
    _latest.clear()
    old, new = renders
    if old.view is None or not old.tiles.all() or not keeps_idle_memory() or _size(old.view) > MAX_VIEW_BYTES:
        return
    view_before = old.view.twin()  # which nobody finds by the arrays alone
    for asset, render, view in ((after, new, new.full_view), (before, old, lambda: view_before)):
        if view is not None:
            pictures = (render.colors, render.alphas, render.depths)
            _latest.append(_AssetView(weakref.ref(asset, _forget), render.camera, view, pictures))


def latest_view(asset: Asset, camera: Camera) -> DrawnView | None:
    """What `drawn_view` would give of an asset before or after the latest edit, from the same camera; others find it
    while the caller holds it. None where it is not kept; what is kept then goes, to make room."""
    from splatpainter.rendering.cpu.recent_views import offered

    for entry in _latest:
        if entry.asset() is asset and same_camera(entry.camera, camera):
            return offered(asset.splats, entry.view().twin(), entry.pictures)
    _latest.clear()
    return None


def _size(view: ProjectedView) -> int:
    """Bytes of a view's arrays."""
    values = (getattr(view, entry.name) for entry in fields(view))
    return sum(value.nbytes for value in values if isinstance(value, np.ndarray))


def _forget(_: weakref.ref[Asset]) -> None:
    """An asset is gone: what is kept goes with the last of them."""
    if all(entry.asset() is None for entry in _latest):
        _latest.clear()
