"""What commands that open an asset say of what looks wrong about it (doubts.py)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatpainter.cameras import Camera
from splatpainter.commands.parts.terminal import warn
from splatpainter.doubts import doubts, doubts_of_view
from splatpainter.splats import Splats


def warn_of_doubts(
    splats: Splats, asset: Path, views: Sequence[tuple[str, Camera]] = (), *, editing: bool = False
) -> list[str]:
    """One warning for each doubt about an asset that was read, and about each of these views (name, camera) in which
    nothing is seen; returns the lines. editing: an edit follows, which refuses an asset of which nothing can be drawn
    in a line of its own."""
    # The refusal says it already, in words about the edit.
    if editing and not splats.drawable.any():
        return []
    lines = [doubt.line for doubt in doubts(splats)]
    lines += [doubt.line for name, camera in views for doubt in doubts_of_view(splats, camera, name)]
    for line in lines:
        warn(f"{asset}: {line}")
    return lines
