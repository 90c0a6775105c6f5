"""What a local lift reads of the rows below it, so that a layer need not be painted anew where nothing of that changed.

A local lift of one view (lift/local_edit.py) looks at the rows of the tiles under its mask, finds those that it
reaches, and works on all rows of the tiles that these touch. `read_of` takes that set, or a larger one. Two
arrangements of layers that give it the same rows, in the same order, give the lift's arithmetic the same numbers, so
its result is the same bit for bit; only the places of the rows in the asset may differ, and `moved` puts it there. Rows
behind the surface count: splitting may let them through. Knows no layers and no cache.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.session.deltas import Delta
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.voxels.grid import VoxelGrid


@dataclass(frozen=True)
class Read:
    """Rows of one asset, and what they are."""

    rows: np.ndarray = field(repr=False)
    """[R] int32 ascending."""
    digest: str
    """Hash of their values in order, and of which of them the edit reaches (by the voxels, which all rows decide)."""


def read_of(splats: Splats, grid: VoxelGrid, camera: Camera, mask: np.ndarray) -> Read | None:
    """What a local lift of the masked pixels ([H, W] bool) reads of `splats`, whose voxels are `grid`; None where it
    could not be applied."""
    from splatpainter.lift.local_edit import gaussians_in_mask
    from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask
    from splatpainter.voxels.raycast import editable_rows, inside

    if inside(grid, grid.occupancy, camera.position):
        return None
    under = tiles_of_mask(mask)
    allowed = editable_rows(grid, splats, camera, mask)
    try:
        reached = gaussians_in_mask(splats, camera, mask, allowed, project(splats, camera, tiles=under))
    except ValueError:
        return None
    area = under | project(splats, camera, gaussian_mask=reached).tiles_of(reached)
    rows = np.sort(project(splats, camera, tiles=area).gaussian_ids)
    found = hashlib.sha256(np.packbits(reached[rows]).tobytes())
    for name in ATTRIBUTES:
        found.update(np.asarray(getattr(splats, name)[rows], "<f4").tobytes())
    return Read(rows.astype(np.int32), found.hexdigest())


def moved(delta: Delta, old: Read, new: Read, count: int) -> Delta | None:
    """The same delta on another asset, of `count` rows, in which `new` are the rows that `old` were; None where it
    speaks of rows outside (never, where `old` is what its lift read)."""
    assert old.digest == new.digest
    rows, parents = _translated(delta.rows, old, new), _translated(delta.parents, old, new)
    return None if rows is None or parents is None else Delta(count, rows, delta.values, delta.appended, parents)


def _translated(rows: np.ndarray, old: Read, new: Read) -> np.ndarray | None:
    """Places of rows (-1 stays) after the move."""
    known = rows >= 0
    if not len(old.rows):
        return None if known.any() else rows
    at = np.minimum(np.searchsorted(old.rows, rows), len(old.rows) - 1)
    if (old.rows[at] != rows)[known].any():
        return None
    return np.where(known, new.rows[at], rows).astype(np.int64)
