"""Estimates of a surface that somebody holds, such as those under a stroke while it is drawn: the edit from the same
camera takes equal lines of sight out of them. They are gone when their owner drops them; those of the latest edit are
kept for the next one, which often paints there again.
"""

from __future__ import annotations

import weakref

from splatpainter.cameras import Camera, same_camera
from splatpainter.kernels.arrays import keeps_idle_memory
from splatpainter.surface.estimate import Surface
from splatpainter.surface.visible import SightEstimates
from splatpainter.system.latest import Latest
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class RecentSightLimits:
    """Source: taste."""

    most_recent: int = 8
    """Estimates that are looked through."""
    most_lines: int = 1 << 17
    """Lines of sight of those that are kept for the next edit, 20 MB."""


RECENT_SIGHTS = RecentSightLimits()

_recent = Latest[tuple[weakref.ref[SightEstimates], weakref.ref[Surface], Camera]](RECENT_SIGHTS.most_recent)
_latest: list[tuple[SightEstimates, weakref.ref[Surface]]] = []
"""Those of the latest edit, or none."""


def note_sight(surface: Surface, camera: Camera, sight: SightEstimates) -> None:
    """Offer what is known of a surface along lines of sight of a camera."""
    _recent.note((weakref.ref(sight), weakref.ref(surface), camera))


def keep_sight(surface: Surface, camera: Camera, sight: SightEstimates) -> None:
    """The same, of an edit that is done: they stay until the next one is, or the surface is gone. Processes that end
    soon keep none, and none that are large."""
    _latest.clear()
    if len(sight.pixels) <= RECENT_SIGHTS.most_lines and keeps_idle_memory():
        _latest.append((sight, weakref.ref(surface, lambda _: _latest.clear())))
        note_sight(surface, camera, sight)


def recent_sight(surface: Surface, camera: Camera) -> SightEstimates | None:
    """The latest that somebody holds, of the very same surface and the same camera; None where there is none."""
    for reference, of_surface, of_camera in _recent:
        sight = reference()
        if sight is not None and of_surface() is surface and same_camera(of_camera, camera):
            return sight
    return None
