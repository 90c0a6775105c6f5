"""The asset that is shown when none is given."""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

from splatpainter import demo_asset
from splatpainter.io import read, write
from splatpainter.splats import Splats
from splatpainter.user_folders import cache_folder

HALF_TURN = (-1, -1, 1)
"""The bundled asset is made with y up; the studio shows the frame of captures, y down."""


def demo(cache: Path | None = None) -> Splats:
    """The bundled still life. Making it takes some seconds, so it is kept as a PLY in `cache` (None: the user's cache
    folder) under the hash of the code that makes it."""
    place = (cache or cache_folder()) / f"demo-{_recipe()}.ply"
    with contextlib.suppress(ValueError):  # not there yet, or damaged: it is made anew
        return read(place)
    from splatpainter.io.axes import flip

    made = flip(demo_asset.demo_asset(), HALF_TURN)
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        write(place, made, overwrite=True)
        return read(place)
    except (OSError, ValueError):
        return made  # nowhere to keep it


def _recipe() -> str:
    sources = sorted(Path(demo_asset.__file__).parent.glob("*.py"))
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in sources)).hexdigest()[:16]
