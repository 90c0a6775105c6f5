"""Steps of SIRT in the colours of some Gaussians: what they weigh in every pixel is found once, and a step then costs
what they cost.

A picture is linear in the Gaussians' colours, so where only some of them move the others need not be rasterized again:
C = rest + sum over the movable Gaussians of w_ip c_i. Their weights are cached as blocks of 16 pixels, in the order of
the tile's list. The same weights as of rasterize.h and backproject.h; sums are the same bits for any number of
threads.
"""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Bools
from splatpainter.kernels.arrays import aligned, readonly
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run, run_sized
from splatpainter.rendering.cpu.geometry import COLUMNS, SUMS
from splatpainter.rendering.cpu.projected_view import INT32, INT64, ProjectedView
from splatpainter.system.quick_dataclass import dataclass

MAX_CACHED_BLOCKS = 1 << 20
"""64 MiB in float32. A Gaussian of 1 px touches about 4 blocks, one of 4 px about 30."""
FIELDS = 4
"""Fields of a tile between steps: what the movable Gaussians are to make up (3), and the pixels' weight m."""
BLOCKS, LANES = 16, 16
"""Blocks of 4 x 4 pixels of a tile, pixels of a block."""


def sirt_steps(
    view: ProjectedView, target: np.ndarray, mask: np.ndarray, movable: Bools, first: np.ndarray | None = None
) -> CachedWeights | UncachedWeights:
    """Steps towards a picture with C movable Gaussians of a view's M; the others have the view's colours. movable: [M]
    bool; target: [H, W, 3]; mask: [H, W] weights m_p >= 0; first: [C, 3] the very array that `residual` is asked for
    first, if known: the walk that sums the weights gives what is missing there too."""
    return CachedWeights.of(view, target, mask, movable, first) or UncachedWeights(view, target, mask, movable)


class UncachedWeights:
    """Where there would be too much to cache: the tiles are walked in every step."""

    def __init__(self, view: ProjectedView, target: np.ndarray, mask: np.ndarray, movable: np.ndarray) -> None:
        self._pictures, self._view, self._movable = (target, mask), view, movable
        self.weight = view.backproject(target, mask).weight[movable]

    def residual(self, colors: np.ndarray) -> np.ndarray:
        """As CachedWeights.residual."""
        all_colors = self._view.colors.copy()
        all_colors[self._movable] = colors
        return self._view.sirt_step(*self._pictures, all_colors)[0][self._movable]


@dataclass(frozen=True)
class CachedWeights:
    """What the movable Gaussians weigh in every pixel, and what the others leave for them to make up."""

    weight: np.ndarray
    """[C] sum_p w_ip m_p."""
    _lists: tuple[np.ndarray, ...]
    _remainder: np.ndarray
    _num_pairs: int
    _pair_offsets: np.ndarray
    _first: tuple[np.ndarray, np.ndarray]
    """Colours, and their `residual`."""

    @staticmethod
    def of(
        view: ProjectedView, target: np.ndarray, mask: np.ndarray, movable: np.ndarray, first: np.ndarray | None = None
    ) -> CachedWeights | None:
        """first: as of `sirt_steps`. None where there would be more than MAX_CACHED_BLOCKS."""
        dtype = view.projected.dtype
        target, mask = readonly(target, dtype), readonly(mask, dtype)
        pairs, begins, entries, pair_ids, pair_offsets = pairs_of(view, movable)
        boxes = np.empty((len(pairs), 4), np.int64)
        tables = (view.projected, view.flatten_ids, view.tile_ids, view.tiles.shape[1], pairs, begins)
        run_sized(COLUMNS * len(pairs), kernels.find_block_boxes, *tables, boxes)
        hit = (boxes[:, 1] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 2])
        block_offsets = np.concatenate([[0], np.cumsum(hit)])
        if block_offsets[-1] > MAX_CACHED_BLOCKS:
            return None
        weights = aligned((int(block_offsets[-1]), LANES), dtype)
        remainder = aligned((len(view.tile_ids), FIELDS, BLOCKS, LANES), dtype)
        background = readonly(np.array(view.camera.background), dtype)
        movable_lists = (pairs, begins, boxes, block_offsets)
        run(
            kernels.cache_tiles,
            *view.tile_lists(view.projected),
            background,
            target,
            mask,
            *movable_lists,
            weights,
            remainder,
        )
        lists = (begins, boxes, block_offsets, entries, pair_ids, weights)
        colors = np.zeros((len(pair_offsets) - 1, 3), dtype) if first is None else first
        sums = _step_sums(lists, remainder, len(pairs), pair_offsets, colors)
        return CachedWeights(sums[:, 3], lists, remainder, len(pairs), pair_offsets, (colors, sums[:, :3]))

    def residual(self, colors: np.ndarray) -> np.ndarray:
        """[C, 3] sum_p w_ip m_p (target_p - image_p) with these colours ([C, 3], in the view's order)."""
        if colors is self._first[0]:
            return self._first[1]
        return _step_sums(self._lists, self._remainder, self._num_pairs, self._pair_offsets, colors)[:, :3]


def pairs_of(view: ProjectedView, chosen: Bools) -> tuple[np.ndarray, ...]:
    """Of the pairs of some entries (chosen: [M] bool, C of them): ([Q] int64 where in `flatten_ids` they stand, [T + 1]
    where those of each tile begin, [Q] which of the chosen ones each is of, [Q] its place among the pairs in the order
    of these, [C + 1] where the pairs of each begin)."""
    # No more room than these take: most of what an edit moves are few of many, and their places are kept.
    count, total = int(np.diff(view.pair_offsets)[chosen].sum()), np.empty(1, np.int64)
    pairs, entries, pair_ids = aligned((3, count), INT64)
    begins, pair_offsets = np.empty(len(view.isect_offsets), np.int64), np.empty(int(chosen.sum()) + 1, np.int64)
    lists = (view.flatten_ids, view.isect_offsets, readonly(chosen, np.bool_), aligned((len(chosen),), INT32))
    kernels.list_chosen_pairs(*lists, pairs, begins, entries, pair_ids, pair_offsets, total, 0, 1)
    some = slice(int(total[0]))
    return pairs[some], begins, entries[some], pair_ids[some], pair_offsets


def _step_sums(
    lists: tuple[np.ndarray, ...], remainder: np.ndarray, num_pairs: int, pair_offsets: np.ndarray, colors: np.ndarray
) -> np.ndarray:
    """[C, 6]: residuals by weight (3), weights, two unused."""
    dtype = remainder.dtype
    sums, out = aligned((num_pairs, SUMS), dtype), aligned((len(colors), 6), dtype)
    run_sized(
        lists[-1].size + remainder.size, kernels.cached_step_tiles, *lists, remainder, readonly(colors, dtype), sums
    )
    run_sized(sums.size, kernels.reduce_pairs, pair_offsets, sums, out)
    return out
