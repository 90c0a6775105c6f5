"""Layers of kind "fill": Gaussians that continue the surface over a hole. A pure function of what is below, of the
selection that says where (parameter SELECTION) and of pictures of the layer, if it has some. Appends only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np

from splatpainter.holes.fill import Picture, fill_hole, painted
from splatpainter.jsonio import brief
from splatpainter.session.replay.delta import Delta, between
from splatpainter.splats import Splats

FILL = "fill"
"""Name of the parameter of such a layer: what its selection is."""
FillWhere = Literal["removed", "around"]
SELECTED = 0.5
"""Weight from which a Gaussian counts as removed, or as lying around the hole."""


def fill_delta(
    splats: Splats, weights: np.ndarray, parameters: dict[str, Any], pictures: Sequence[Picture]
) -> tuple[Delta, dict[str, Any]]:
    """(what a fill layer does to `splats` (numpy), its facts). weights: [N] of its selection. Raises ValueError as
    fill_hole."""
    where = parameters.get(FILL)
    if where not in get_args(FillWhere):
        raise ValueError(f"fill: expected {FILL} of {', '.join(get_args(FillWhere))}, got {brief(where)}")
    chosen = weights >= SELECTED
    filled = fill_hole(splats, removed=chosen) if where == "removed" else fill_hole(splats, around=chosen)
    appended = painted(splats, filled.appended, pictures) if filled.holes else filled.appended
    bare = replace(splats, source=None, origin=None)
    # Of no family: an eraser or a split of what is near is none of theirs.
    delta = between(bare, bare.append(appended))
    removed = f"{int(chosen.sum()):,} Gaussians removed; " if where == "removed" else ""
    return delta, {"note": removed + filled.note}


def fading(delta: Delta, opacity: float, mask: np.ndarray | None) -> Delta:
    """The delta at an opacity of 0..1: new Gaussians are as opaque. mask: [A] 0..1, a factor of it."""
    share = np.full(len(delta.appended), opacity) if mask is None else opacity * mask
    opacities = (delta.appended.opacities * share).astype(np.float32)
    return replace(delta, appended=replace(delta.appended, opacities=opacities))
