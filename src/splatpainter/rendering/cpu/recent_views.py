"""Whole views that somebody holds, such as that of a stroke while it is drawn: whoever looks at the same Gaussians from
the same camera cuts out of one what they need. A view is gone when its owner drops it, but for one: that of the latest
edit stays (`hold`) until its Gaussians are gone, for the next edit from there.
"""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Callable

import numpy as np

from splatpainter.cameras import Camera, same_camera
from splatpainter.kernels.arrays import keeps_idle_memory
from splatpainter.rendering import check_views
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class RecentViewLimits:
    """Source: taste."""

    most_recent: int = 8
    """Views that are looked through."""
    most_held_bytes: int = 160 << 20
    """Of the one view that is held here and its pictures: that of a million Gaussians takes about 110 MB."""


RECENT_VIEWS = RecentViewLimits()


@dataclass(frozen=True)
class _Source:
    """What was projected: views of other arrays or another camera are no use, whatever they hold."""

    arrays: tuple[weakref.ref[np.ndarray], ...]
    antialiased: bool

    @staticmethod
    def of(splats: Splats, gone: Callable[[object], None] | None = None) -> _Source:
        """gone: called when any of the arrays is."""
        return _Source(tuple(weakref.ref(getattr(splats, name), gone) for name in ATTRIBUTES), splats.antialiased)

    def is_of(self, splats: Splats) -> bool:
        if self.antialiased != splats.antialiased:
            return False
        return all(array() is getattr(splats, name) for array, name in zip(self.arrays, ATTRIBUTES, strict=True))


_recent: deque[tuple[weakref.ref[ProjectedView], _Source]] = deque(maxlen=RECENT_VIEWS.most_recent)
"""The latest last."""


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


_drawn: deque[weakref.ref[DrawnView]] = deque(maxlen=RECENT_VIEWS.most_recent)
"""The latest last."""


def note_view(splats: Splats, view: ProjectedView) -> None:
    """Offer a view of numpy `splats` in which all tiles are drawn."""
    assert view.tiles.all() and view.num_gaussians == len(splats)
    _recent.append((weakref.ref(view), _Source.of(splats)))


def recent_view(splats: Splats, camera: Camera) -> ProjectedView | None:
    """What `project` would give, up to Gaussians that touch no tile, where somebody holds it. Of arrays that are the
    very same: they are not written to."""
    for reference, source in reversed(tuple(_recent)):
        view = reference()
        if view is not None and same_camera(view.camera, camera) and source.is_of(splats):
            return view
    return None


def drawn_view(splats: Splats, camera: Camera) -> DrawnView:
    """A whole view of numpy `splats`, drawn as `render` draws it: the one that somebody holds, or a new one, which
    serves others for as long as the caller holds it. Raises ValueError for sizes that `render` does not draw."""
    check_views([camera])
    camera = camera.within(splats.offset)
    view = recent_view(splats, camera)
    for reference in reversed(tuple(_drawn)):
        drawn = reference()
        if drawn is not None and drawn.view is view:
            return drawn
    edited = _edited
    if (
        view is None
        and edited is not None
        and same_camera(edited.camera, camera)
        and edited.source.is_of(splats)
        and splats.is_fixed
    ):
        view, pictures = edited.view(), edited.pictures
        note_view(splats, view)
        return _noted(view, pictures)
    if view is None:
        view = project(splats, camera)
        note_view(splats, view)
    return _noted(view, view.rasterize())


def _noted(view: ProjectedView, pictures: tuple[np.ndarray, ...]) -> DrawnView:
    for picture in pictures:
        picture.flags.writeable = False
    drawn = DrawnView(view, *pictures)
    _drawn.append(weakref.ref(drawn))
    return drawn


# ---- the one view that is held here


@dataclass(frozen=True)
class _Held:
    source: _Source
    drawn: DrawnView


@dataclass(frozen=True)
class _EditedView:
    """What an edit makes of the held view; it becomes a view when somebody looks."""

    source: _Source
    camera: Camera
    view: Callable[[], ProjectedView]
    pictures: tuple[np.ndarray, ...]


_held: _Held | None = None
_edited: _EditedView | None = None


def hold(splats: Splats, drawn: DrawnView) -> None:
    """Hold a view of numpy `splats` for the next edit from the same camera, in place of the one before, as long as all
    arrays of the splats are there. Not where anybody may write to these, where it is too large, or where the process
    keeps no idle memory."""
    global _held, _edited
    if _held is not None and _held.drawn is drawn:
        return
    arrays = (*vars(drawn.view).values(), drawn.colors, drawn.alphas, drawn.depths)
    size = sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))
    # Between two edits nothing else says that the arrays still hold what was projected.
    if not splats.is_fixed or size > RECENT_VIEWS.most_held_bytes or not keeps_idle_memory():
        _held = _edited = None
        return

    def drop(_: object) -> None:
        # Only its own: another view may have taken its place.
        global _held
        if _held is held:
            _held = None

    held = _Held(_Source.of(splats, drop), drawn)
    _held, _edited = held, None


def note_edited(
    before: ProjectedView, splats: Splats, view: Callable[[], ProjectedView], pictures: tuple[np.ndarray, ...]
) -> None:
    """Offer what an edit made of the held view, where it is `before`. splats: the edited ones, numpy; view: makes that
    of all tiles; pictures: colours, alphas, depths of all tiles."""
    global _edited
    if _held is None or _held.drawn.view is not before:
        return

    def drop(_: object) -> None:
        global _edited
        if _edited is edited:
            _edited = None

    edited = _EditedView(_Source.of(splats, drop), before.camera, view, pictures)
    _edited = edited
