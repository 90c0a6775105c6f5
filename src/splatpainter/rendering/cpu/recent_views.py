"""Whole views that somebody holds, such as that of a stroke while it is drawn: whoever looks at the same Gaussians from
the same camera cuts out of one what they need. Nothing is held here: a view is gone when its owner drops it.
"""

from __future__ import annotations

import weakref
from collections import deque

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.splats import ATTRIBUTES, Splats

MAX_RECENT = 8
"""Views that are looked through."""
_recent: deque[tuple[weakref.ref[ProjectedView], tuple[weakref.ref[np.ndarray], ...], bool]] = deque(maxlen=MAX_RECENT)
"""(view, attributes of the Gaussians that were projected, whether antialiased), the latest last."""


def note_view(splats: Splats, view: ProjectedView) -> None:
    """Offer a view of numpy `splats` in which all tiles are drawn."""
    assert view.tiles.all() and view.num_gaussians == len(splats)
    arrays = tuple(weakref.ref(getattr(splats, name)) for name in ATTRIBUTES)
    _recent.append((weakref.ref(view), arrays, splats.antialiased))


def recent_view(splats: Splats, camera: Camera) -> ProjectedView | None:
    """What `project` would give, up to Gaussians that touch no tile, where somebody holds it. Of arrays that are the
    very same: they are not written to."""
    for reference, arrays, antialiased in reversed(tuple(_recent)):
        view = reference()
        if view is None or antialiased != splats.antialiased or view.camera != camera:
            continue
        same = all(array() is getattr(splats, name) for array, name in zip(arrays, ATTRIBUTES, strict=True))
        if same and np.array_equal(view.camera.world_to_camera, camera.world_to_camera):
            return view
    return None
