"""Whole views that somebody holds, such as that of a stroke while it is drawn: whoever looks at the same Gaussians from
the same camera cuts out of one what they need. Nothing is held here: a view is gone when its owner drops it.
"""

from __future__ import annotations

import weakref

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.cameras import Camera, same_camera
from splatpainter.rendering import check_views
from splatpainter.rendering.cpu.projected_view import ProjectedView, copy_tiles, project
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.latest import Latest
from splatpainter.system.quick_dataclass import dataclass

MAX_RECENT = 8
"""Views that are looked through."""
_recent = Latest[tuple[weakref.ref[ProjectedView], tuple[weakref.ref[np.ndarray], ...], bool]](MAX_RECENT)
"""(view, attributes of the Gaussians that were projected, whether antialiased)."""


@dataclass(frozen=True, eq=False)
class DrawnView:
    """All tiles of a view and the pictures that they make, not to be written."""

    view: ProjectedView
    colors: np.ndarray
    """[H, W, 3]"""
    alphas: np.ndarray
    """[H, W]"""
    depths: np.ndarray
    """[H, W] expected z-depth."""

    def within(self, tiles: Bools) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What `view.rasterize(tiles=tiles)` would give, without drawing it again."""
        out = (self.view.empty_picture(), np.zeros_like(self.alphas), np.zeros_like(self.depths))
        for picture, source in zip(out, (self.colors, self.alphas, self.depths), strict=True):
            copy_tiles(picture, source, tiles)
        return out


_drawn = Latest[weakref.ref[DrawnView]](MAX_RECENT)


def note_view(splats: Splats, view: ProjectedView) -> None:
    """Offer a view of numpy `splats` in which all tiles are drawn."""
    assert view.tiles.all() and view.num_gaussians == len(splats)
    arrays = tuple(weakref.ref(getattr(splats, name)) for name in ATTRIBUTES)
    _recent.note((weakref.ref(view), arrays, splats.antialiased))


def recent_view(splats: Splats, camera: Camera) -> ProjectedView | None:
    """What `project` would give, up to Gaussians that touch no tile, where somebody holds it. Of arrays that are the
    very same: they are not written to."""
    for reference, arrays, antialiased in _recent:
        view = reference()
        if view is None or antialiased != splats.antialiased or not same_camera(view.camera, camera):
            continue
        if all(array() is getattr(splats, name) for array, name in zip(arrays, ATTRIBUTES, strict=True)):
            return view
    return None


def recent_drawing(splats: Splats, camera: Camera) -> DrawnView | None:
    """What `drawn_view` would give, where somebody holds it."""
    view = recent_view(splats, camera.within(splats.offset))
    for reference in _drawn:
        drawn = reference()
        if drawn is not None and drawn.view is view:
            return drawn
    return None


def drawn_view(splats: Splats, camera: Camera) -> DrawnView:
    """A whole view of numpy `splats`, drawn as `render` draws it: the one that somebody holds, or a new one, which
    serves others for as long as the caller holds it. Raises ValueError for sizes that `render` does not draw."""
    check_views([camera])
    drawn = recent_drawing(splats, camera)
    if drawn is not None:
        return drawn
    camera = camera.within(splats.offset)
    view = recent_view(splats, camera)
    if view is None:
        view = project(splats, camera)
        note_view(splats, view)
    return _noted(view, view.rasterize())


def offered(splats: Splats, view: ProjectedView, pictures: tuple[np.ndarray, np.ndarray, np.ndarray]) -> DrawnView:
    """The whole view of numpy `splats` that somebody has at hand: it serves others for as long as the caller holds it.
    pictures: colours, alphas and depths, as of DrawnView."""
    note_view(splats, view)
    return _noted(view, pictures)


def _noted(view: ProjectedView, pictures: tuple[np.ndarray, np.ndarray, np.ndarray]) -> DrawnView:
    for picture in pictures:
        picture.flags.writeable = False
    drawn = DrawnView(view, *pictures)
    _drawn.note(weakref.ref(drawn))
    return drawn
