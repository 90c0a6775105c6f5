"""The eraser: rows that masks reach go back to what they were in the original. Rows are never removed.

A row of the original and the rows that were split from it are one family. Of a row that is reached, the colours return
to the original row's. Where every row of a family that still shows has the original's colours then, its geometry
returns too: the old row has the original's bytes again and the appended ones get opacity 0. Where only a part of a
family is reached its rows keep their places, or the split row would cover its unreached children, or leave a hole.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.session.deltas import Delta, bare
from splatpainter.splats import ATTRIBUTES, Splats

INSIDE = 0.5
"""Share of a row's weight in the view that the mask must hold: rows that straddle its edge do not bleed outwards."""


def reached(splats: Splats, views: Sequence[tuple[Camera, np.ndarray]]) -> np.ndarray:
    """[N] bool: rows that some masked view ((camera, [H, W] bool)) shows, mostly inside its mask; with a row also those
    of its family that lie hidden under the mask, or paint would stay behind. Raises ValueError where a mask is empty or
    reaches no row."""
    from splatpainter.lift.local_edit import gaussians_in_mask
    from splatpainter.rendering.cpu.projected_view import project
    from splatpainter.voxels.grid import voxelize
    from splatpainter.voxels.raycast import editable_rows

    grid = voxelize(splats)
    out = np.zeros(len(splats), bool)
    for camera, mask in views:
        if not mask.any():
            raise ValueError("edit: nothing to do, the mask is empty")
        shown = gaussians_in_mask(splats, camera, mask, editable_rows(grid, splats, camera, mask))
        frame = project(splats, camera)
        nothing = np.zeros((*mask.shape, 3), np.float32)
        inside = frame.backproject(nothing, mask.astype(np.float32))
        whole = frame.backproject(nothing, np.ones(mask.shape, np.float32))
        here = np.zeros(len(splats), bool)
        here[frame.gaussian_ids] = shown[frame.gaussian_ids] & (inside.weight >= INSIDE * whole.weight)
        if splats.origin is not None:
            under = frame.gaussian_ids[(inside.alpha > 0) & (inside.alpha >= INSIDE * whole.alpha)]
            here[under] |= np.isin(splats.origin[under], splats.origin[here]) & (splats.origin[under] >= 0)
        out |= here
    return out


def erased(below: Splats, original: Splats, rows: np.ndarray) -> Delta:
    """The delta that takes rows ([N] bool) of an edited asset back. `below.origin` [N]: the original's row that each
    comes from (-1: none; such rows are hidden)."""
    n, first = len(below), len(original)
    family = np.arange(n) if below.origin is None else below.origin
    known = family >= 0
    place = np.where(known, family, 0)
    shows = below.opacities > 0
    shows[:first] = True
    foreign = (below.sh.view(np.uint32) != original.sh[place].view(np.uint32)).reshape(n, -1).any(1)
    whole_families = np.zeros(first, bool)
    whole_families[place[known & rows]] = True
    whole_families[place[known & shows & foreign & ~rows]] = False
    chosen = np.flatnonzero(rows | (known & whole_families[place]))
    home = place[chosen]
    whole = known[chosen] & whole_families[home]
    values = {name: getattr(below, name)[chosen] for name in ATTRIBUTES}
    values["sh"][known[chosen]] = original.sh[home[known[chosen]]]
    old = whole & (chosen < first)
    for name in ATTRIBUTES:
        values[name][old] = getattr(original, name)[home[old]]
    values["opacities"][(whole & (chosen >= first)) | ~known[chosen]] = 0
    differs = np.zeros(len(chosen), bool)
    for name in ATTRIBUTES:
        before, after = getattr(below, name)[chosen].view(np.uint32), values[name].view(np.uint32)
        differs |= (before != after).reshape(len(chosen), -1).any(1)
    none = bare(below.take(np.zeros(0, np.int64)))
    return Delta(n, chosen[differs], Splats(**values).take(differs), none, np.zeros(0, np.int64))
