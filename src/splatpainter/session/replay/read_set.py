"""What a local lift reads of the Gaussians below it, so that a layer need not be painted again where nothing changed
there.

A local lift of one view (lift/sheets/paint.py) looks at the Gaussians of the tiles under its mask and RING_PX around
it, and works on all Gaussians of the tiles that those touch which make these pixels: first for a sheet, then for what
is left without one, by splitting (`lift.sheets.paint.read_by_edit`). `read_set_of` takes that set. Two arrangements of
layers that give it the same Gaussians, in the same order, give the lift's arithmetic the same numbers, so its result
is the same bit for bit; only their ids in the asset may differ, and `renumber` changes those. The surface is the
original's, which is the same in all arrangements; how many of the set are the original's counts, because only the
others' indices are free for any sheet Gaussian. Gaussians behind the surface count: splitting may let them through.
Knows no layers and no cache.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import field

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.session.replay.delta import Delta
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.grid import VoxelGrid


@dataclass(frozen=True)
class ReadSet:
    """Gaussians of one asset, and what they are."""

    gaussian_ids: np.ndarray = field(repr=False)
    """[R] int32 ascending."""
    digest: str
    """Hash of their values in order, of how many are the original's, and of which of them the edit may split."""


def read_set_of(
    splats: Splats, grid: Callable[[], VoxelGrid], camera: Camera, mask: np.ndarray, originals: int
) -> ReadSet | None:
    """What a local lift of the masked pixels ([H, W] bool) reads of `splats`, whose voxels `grid` makes or has; None
    where it could not be applied. originals: how many of the first are the original's, on whose surface sheets are
    laid."""
    from splatpainter.lift.local.local_edit import fills_view
    from splatpainter.lift.sheets.paint import read_by_edit
    from splatpainter.rendering.cpu.projected_view import project
    from splatpainter.voxels.raycast import is_inside

    # Such an edit is refused: it reads nothing that could be compared.
    if is_inside(splats, grid, camera.position):
        return None
    try:
        tiles, may_split = read_by_edit(splats, camera, mask)
    except ValueError:
        return None
    # In the order of the asset, which decides sums in the arithmetic and so the bits.
    gaussian_ids = np.sort(project(splats, camera, tiles=tiles).gaussian_ids)
    if fills_view(splats, camera, mask, originals):  # views from all around count (lift/local/wide_edit.py)
        gaussian_ids = np.arange(len(splats))
    # How many are the original's counts too: only the indices of the others are free.
    digest = hashlib.sha256(np.packbits(may_split[gaussian_ids]).tobytes())
    digest.update(int(np.searchsorted(gaussian_ids, originals)).to_bytes(8, "little"))
    for name in ATTRIBUTES:
        digest.update(np.asarray(getattr(splats, name)[gaussian_ids], "<f4").tobytes())
    return ReadSet(gaussian_ids.astype(np.int32), digest.hexdigest())


def renumber(delta: Delta, old: ReadSet, new: ReadSet, count: int) -> Delta | None:
    """The delta on another asset, of `count` Gaussians, in which `new` are those that `old` were; None where it
    speaks of others (never, where `old` is what its lift read)."""
    assert old.digest == new.digest
    gaussian_ids, parent_ids = (_translated(ids, old, new) for ids in (delta.gaussian_ids, delta.parent_ids))
    if gaussian_ids is None or parent_ids is None:
        return None
    return Delta(count, gaussian_ids, delta.values, delta.appended, parent_ids, faded=delta.faded)


def _translated(ids: np.ndarray, old: ReadSet, new: ReadSet) -> np.ndarray | None:
    """Ids (-1 stays) in the other asset."""
    valid = ids >= 0
    if not len(old.gaussian_ids):
        return None if valid.any() else ids
    # An id beyond the read set would be renumbered to any other: then the layer is painted anew.
    at = np.minimum(np.searchsorted(old.gaussian_ids, ids), len(old.gaussian_ids) - 1)
    if (old.gaussian_ids[at] != ids)[valid].any():
        return None
    return np.where(valid, new.gaussian_ids[at], ids).astype(np.int64)
