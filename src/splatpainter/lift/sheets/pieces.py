"""What remains of some Gaussians beside a sheet, and the view of both: cut out of the view that there is, not projected
anew."""

from __future__ import annotations

from dataclasses import field, replace

import numpy as np

from splatpainter.array_types import Bools, Ids
from splatpainter.kernels.rows import take
from splatpainter.lift.local.split import Lattice
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class Pieces:
    """What remains beside a sheet of the N Gaussians: P pieces of those that were cut, and the others as they were."""

    cut_ids: Ids = field(repr=False)
    """[K] int64 those that are no more as they were, some of them several times."""
    parent_ids: Ids = field(repr=False)
    """[P] int64 ascending: the Gaussian that each piece is of."""
    slot: Bools = field(repr=False)
    """[P] bool: pieces that stay at their parent's index."""
    splats: Splats
    """P Gaussians."""

    @staticmethod
    def of(lattice: Lattice, gone: Bools) -> Pieces:
        """lattice: of some of the Gaussians that are its base; gone: [S] bool, which the sheet replaces."""
        # Halved ones are replaced by their pieces; those that go leave nothing.
        halved = (lattice.level[:, 0] | lattice.level[:, 1]) > 0
        pieces = lattice.take(np.flatnonzero(halved & ~gone))
        return Pieces(lattice.parent[halved | gone], pieces.parent, pieces.slot, pieces.splats())

    def remaining_gaussians(self, base: Splats) -> tuple[Splats, np.ndarray]:
        """(all that remain, in the order of these, [R] int64 the Gaussian of the base that each is or is of)."""
        left = np.ones(len(base), bool)
        left[self.cut_ids] = False
        ids = np.flatnonzero(left)
        parent_ids = np.concatenate([ids, self.parent_ids])
        order = np.argsort(parent_ids, kind="stable")
        return take(base.take(ids).append(self.splats), order), parent_ids[order]


def joined_view(pieces: Pieces, new: Splats, around: ProjectedView, tiles: np.ndarray) -> ProjectedView:
    """Some tiles of a view of N Gaussians with what remains of these, pieces in the place of those that were cut, and
    with the sheet behind them all; numbered: those of the N as they were, pieces from N on, then the sheet. new: the
    pieces, then the sheet."""
    count, fresh = around.num_gaussians, project(new, around.camera, tiles=tiles)
    sheet = np.arange(len(new) - len(pieces.parent_ids))
    order = np.concatenate([pieces.parent_ids, count + sheet])  # of Gaussians at equal depths
    ties = order[fresh.gaussian_ids]
    fresh = replace(fresh, gaussian_ids=count + fresh.gaussian_ids, num_gaussians=count + len(order))
    # Only what is new is projected; the lists of the rest are cut out of the view at hand.
    return around.merged(fresh, tiles=tiles, without=pieces.cut_ids, ties=ties)
