"""Layers that a page hides only while it changes their text or sticker. A page can be closed, reloaded or lost at any
moment, and the studio killed: the layer is shown again all the same.

The gesture of the step that hides it says so, HELD LAYER ANYTHING, and stays in the project file.
"""

from __future__ import annotations

import contextlib

from splatpainter.server.page_state import PageState
from splatpainter.session import Session

HELD = "held "
"""Begins such a gesture."""


class HeldLayers:
    """Those of the session that is open."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[PageState, str]] = {}
        """Layer -> who hides it, and the gesture."""

    def note(self, page: PageState, layer: str, visible: bool, gesture: str | None) -> None:
        """A layer was shown or hidden, by whatever gesture."""
        self._held.pop(layer, None)
        if not visible and gesture is not None and gesture.startswith(HELD):
            self._held[layer] = page, gesture

    def of(self, page: PageState) -> bool:
        """Whether a page hides any."""
        return any(holder is page for holder, _ in self._held.values())

    def show(self, session: Session, page: PageState | None = None) -> None:
        """Show what a page (None: any) hides, in the step that hid it where that is still the latest."""
        for layer, (holder, gesture) in list(self._held.items()):
            if page is None or holder is page:
                del self._held[layer]
                _show(session, layer, gesture)


def show_left_behind(session: Session) -> None:
    """Show the layer that the latest step of a project hides so: its studio was killed then."""
    gesture = session.history.gesture
    if gesture.startswith(HELD):
        _show(session, gesture.split(" ")[1], gesture)


def _show(session: Session, layer: str, gesture: str) -> None:
    if session.read_only or not any(one.id == layer and not one.visible for one in session.layers):
        return  # it is shown, or gone, already
    # A disk that is full refuses this like anything else; it is one step back then.
    with contextlib.suppress(ValueError, OSError):
        session.layers.set(layer, visible=True, gesture=gesture)
