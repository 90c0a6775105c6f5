"""An edit in one call: `sp.edit(splats, [(picture, camera)])`; a `Painter` is for many with one set of weights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.painter import Asset, Edit, Method, Mode, Painter
from splatpainter.splats import Splats

EditedPicture = Edit | tuple[np.ndarray, Camera]
"""An Edit, or [H, W, 3] the edited view (float 0..1 or uint8) and its camera."""


def edit(
    splats: Splats | Asset,
    pictures: Sequence[EditedPicture],
    *,
    mode: Mode = "local",
    method: Method = "auto",
    preset: str = "auto",
) -> Asset:
    """The asset after 1 to 16 edited pictures of it; its `splats` are the edited Gaussians and its `receipt` proves
    which stayed as they were. Give an asset that came back to go on from it.

    mode: "local": what was painted changes; "global": one regraded or relit view changes everything; "spread": what was
    painted and the rest of its material. method, preset: as of Painter. Raises ValueError as Painter.load and
    Painter.apply."""
    painter = Painter.load(preset, modes=[mode])
    edits = [one if isinstance(one, Edit) else Edit(*one, name=f"picture {k}") for k, one in enumerate(pictures, 1)]
    asset = splats if isinstance(splats, Asset) else painter.encode(splats, method, [mode])
    return painter.apply(asset, edits, mode, method)
