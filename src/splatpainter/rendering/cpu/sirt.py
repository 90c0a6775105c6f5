"""Steps of SIRT in the colours of some Gaussians: what they weigh in every pixel is found once, and a step then costs
what they cost.

A picture is linear in the Gaussians' colours, so where only some of them move the others need not be rasterized again:
C = rest + sum over the movable Gaussians of w_ip c_i. Their weights are cached as blocks of 16 pixels, in the order of
the tile's list. The same weights as of rasterize.py and backproject.py; sums are the same bits for any number of
threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import carray

from splatpainter.kernels import simd
from splatpainter.kernels.parallel import run
from splatpainter.kernels.simd import LANES, device, kernel, prefetch, scratch, sum_lanes
from splatpainter.rendering.cpu import backproject
from splatpainter.rendering.cpu.backproject import STATE, load_mask
from splatpainter.rendering.cpu.compositing import (
    BLOCKS,
    PIXELS,
    PREFETCH_ENTRIES,
    SIDE,
    accept,
    alpha_of,
    block_box,
    falloff,
    footprint,
    is_done,
    offset,
    open_tile,
    pixel_of,
)
from splatpainter.rendering.cpu.geometry import BLUE, EXTENT_X, EXTENT_Y, GREEN, MEAN_X, MEAN_Y, RED, TILE
from splatpainter.rendering.cpu.projected_view import ProjectedView

MAX_CACHED_BLOCKS = 1 << 20
"""64 MiB in float32. A Gaussian of 1 px touches about 4 blocks, one of 4 px about 30."""
FIELDS = 4
"""Fields of a tile between steps: what the movable Gaussians are to make up (3), and the pixels' weight m."""
TILE_STATE = FIELDS * PIXELS
LANE_SUMS = FIELDS * LANES


def sirt_steps(
    view: ProjectedView, target: np.ndarray, mask: np.ndarray, movable: np.ndarray
) -> CachedWeights | UncachedWeights:
    """Steps towards a picture with C movable Gaussians of a view's M; the others have the view's colours. movable: [M]
    bool; target: [H, W, 3]; mask: [H, W] weights m_p >= 0."""
    return CachedWeights.of(view, target, mask, movable) or UncachedWeights(view, target, mask, movable)


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

    @staticmethod
    def of(view: ProjectedView, target: np.ndarray, mask: np.ndarray, movable: np.ndarray) -> CachedWeights | None:
        """None where there would be more than MAX_CACHED_BLOCKS."""
        dtype = view.projected.dtype
        target, mask = simd.readonly(target, dtype), simd.readonly(mask, dtype)
        pairs = np.flatnonzero(movable[view.flatten_ids])
        begins = np.searchsorted(pairs, view.isect_offsets)
        tile = np.repeat(view.tile_ids, np.diff(begins))
        boxes = _block_boxes(view, view.flatten_ids[pairs], tile)
        hit = (boxes[:, 1] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 2])
        block_offsets = np.concatenate([[0], np.cumsum(hit)])
        if block_offsets[-1] > MAX_CACHED_BLOCKS:
            return None
        weights = simd.aligned((int(block_offsets[-1]), LANES), dtype)
        remainder = simd.aligned((len(view.tile_ids), FIELDS, BLOCKS, LANES), dtype)
        background = simd.readonly(np.array(view.camera.background), dtype)
        movable_lists = (pairs, begins, boxes, block_offsets)
        run(cache_tiles, *view.tile_lists(view.projected), background, target, mask, *movable_lists, weights, remainder)
        entries = (np.cumsum(movable) - 1)[view.flatten_ids[pairs]]
        pair_ids = np.empty(len(pairs), np.int64)
        pair_ids[np.argsort(entries, kind="stable")] = np.arange(len(pairs))
        num_movable = int(movable.sum())
        pair_offsets = np.concatenate([[0], np.cumsum(np.bincount(entries, minlength=num_movable))])
        lists = (begins, boxes, block_offsets, entries, pair_ids, weights)
        sums = _step_sums(lists, remainder, len(pairs), pair_offsets, np.zeros((num_movable, 3), dtype))
        return CachedWeights(sums[:, 3], lists, remainder, len(pairs), pair_offsets)

    def residual(self, colors: np.ndarray) -> np.ndarray:
        """[C, 3] sum_p w_ip m_p (target_p - image_p) with these colours ([C, 3], in the view's order)."""
        return _step_sums(self._lists, self._remainder, self._num_pairs, self._pair_offsets, colors)[:, :3]


def _block_boxes(view: ProjectedView, entries: np.ndarray, tile: np.ndarray) -> np.ndarray:
    """[Q, 4] int64 blocks of each pair's tile that its ellipse touches, rows and columns from, to (see blocks_hit)."""
    projected, across = view.projected[entries], view.tiles.shape[1]
    out = np.empty((len(entries), 4), np.int64)
    for k, (mean, extent, first) in enumerate(
        [(MEAN_Y, EXTENT_Y, tile // across * TILE), (MEAN_X, EXTENT_X, tile % across * TILE)]
    ):
        m, e = projected[:, mean] - (first + 0.5).astype(projected.dtype), projected[:, extent]
        out[:, 2 * k] = np.clip(m - e, 0, TILE - 1).astype(np.int64) >> 2
        out[:, 2 * k + 1] = (np.clip(m + e, 0, TILE - 1).astype(np.int64) >> 2) + 1
    return out


def _step_sums(
    lists: tuple[np.ndarray, ...], remainder: np.ndarray, num_pairs: int, pair_offsets: np.ndarray, colors: np.ndarray
) -> np.ndarray:
    """[C, 6]: residuals by weight (3), weights, two unused."""
    dtype = remainder.dtype
    sums, out = simd.aligned((num_pairs, backproject.SUMS), dtype), np.empty((len(colors), 6), dtype)
    run(cached_step_tiles, *lists, remainder, simd.readonly(colors, dtype), sums)
    run(backproject.reduce_pairs, pair_offsets, sums, out)
    return out


@device
def cache_tile(
    projected, flatten_ids, begin, end, x0, y0, pairs, first, last, boxes, block_offsets, state, closed, weights
):
    """Fields T, r, g, b of a tile without the movable Gaussians; the weights of these into `weights`."""
    zero = projected.dtype.type(0)
    lane_weights = carray(scratch(projected, LANES), (LANES,))
    q = first
    for p in range(begin, end):
        i = flatten_ids[p]
        prefetch(projected, flatten_ids[min(p + PREFETCH_ENTRIES, end - 1)])
        mx, my, a2, b1, c2, opacity = footprint(projected, i, x0, y0)
        red = projected[i, RED]
        green = projected[i, GREEN]
        blue = projected[i, BLUE]
        movable = q < last and pairs[q] == p
        if movable:
            by0, by1, bx0, bx1 = boxes[q, 0], boxes[q, 1], boxes[q, 2], boxes[q, 3]
            slot = block_offsets[q]
            red = green = blue = zero
            q += 1
        else:
            by0, by1, bx0, bx1 = block_box(projected, i, mx, my)
            slot = 0
        for by in range(by0, by1):
            for bx in range(bx0, bx1):
                b = by * SIDE + bx
                if closed[b]:
                    if movable:
                        weights[slot, :] = zero
                        slot += 1
                    continue
                for l in range(LANES):
                    dx, dy = offset(mx, my, bx, by, l)
                    alpha = alpha_of(opacity, falloff(dx, dy, a2, b1, c2), None)
                    w = accept(state, b, l, alpha, None)
                    lane_weights[l] = w
                    state[1, b, l] += w * red
                    state[2, b, l] += w * green
                    state[3, b, l] += w * blue
                if movable:
                    for l in range(LANES):
                        weights[slot, l] = lane_weights[l]
                    slot += 1
        if is_done(p - begin, state, closed):
            break
    for k in range(block_offsets[q], block_offsets[last]):
        for l in range(LANES):
            weights[k, l] = zero


@kernel
def cache_tiles(
    projected,  # [M, 16]
    flatten_ids,  # [P]
    pair_ids,  # [P] unused
    tile_ids,  # [T]
    isect_offsets,  # [T + 1]
    background,  # [3]
    target,  # [H, W, 3]
    mask,  # [H, W] >= 0
    pairs,  # [Q] where in flatten_ids the movable Gaussians stand
    begins,  # [T + 1] of each tile in the pairs
    boxes,  # [Q, 4] blocks that each pair touches
    block_offsets,  # [Q + 1] of each pair's blocks in the weights
    weights,  # out [B, 16]
    remainder,  # out [T, 4, 16, 16] target minus what the other Gaussians make, and m
    thread,
    threads,
):
    F = projected.dtype.type
    height, width = mask.shape
    state = carray(scratch(projected, STATE), (5, BLOCKS, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tile_ids.shape[0], threads):
        x0, y0 = open_tile(tile_ids[k], width, height, state)
        if not load_mask(mask, x0, y0, state, closed):
            remainder[k] = F(0)
            weights[block_offsets[begins[k]] : block_offsets[begins[k + 1]]] = F(0)
            continue
        begin, end, first, last = isect_offsets[k], isect_offsets[k + 1], begins[k], begins[k + 1]
        cache_tile(
            projected, flatten_ids, begin, end, x0, y0, pairs, first, last, boxes, block_offsets, state, closed, weights
        )
        for b in range(BLOCKS):
            for l in range(LANES):
                x, y = pixel_of(x0, y0, b, l)
                T = abs(state[0, b, l])
                for c in range(3):
                    rest = state[1 + c, b, l] + T * background[c]
                    remainder[k, c, b, l] = target[min(y, height - 1), min(x, width - 1), c] - rest
                remainder[k, 3, b, l] = state[4, b, l]


@kernel
def cached_step_tiles(
    begins,  # [T + 1] of each tile in the pairs
    boxes,  # [Q, 4] blocks that each pair touches
    block_offsets,  # [Q + 1] of each pair's blocks in the weights
    entries,  # [Q] which movable Gaussian each pair is of
    pair_ids,  # [Q] where each pair keeps its sums
    weights,  # [B, 16]
    remainder,  # [T, 4, 16, 16]
    colors,  # [C, 3]
    sums,  # out [Q, 8]
    thread,
    threads,
):
    F = weights.dtype.type
    zero = F(0)
    state = carray(scratch(weights, TILE_STATE), (FIELDS, BLOCKS, LANES))
    lanes = carray(scratch(weights, LANE_SUMS), (FIELDS, LANES))
    for k in range(thread, remainder.shape[0], threads):
        if begins[k] == begins[k + 1]:
            continue
        for f in range(FIELDS):
            for b in range(BLOCKS):
                for l in range(LANES):
                    state[f, b, l] = remainder[k, f, b, l]
        for q in range(begins[k], begins[k + 1]):
            red, green, blue = colors[entries[q], 0], colors[entries[q], 1], colors[entries[q], 2]
            slot = block_offsets[q]
            for by in range(boxes[q, 0], boxes[q, 1]):
                for bx in range(boxes[q, 2], boxes[q, 3]):
                    b = by * SIDE + bx
                    for l in range(LANES):
                        w = weights[slot, l]
                        state[0, b, l] -= w * red
                        state[1, b, l] -= w * green
                        state[2, b, l] -= w * blue
                    slot += 1
        for b in range(BLOCKS):
            for l in range(LANES):
                for f in range(3):
                    state[f, b, l] *= state[3, b, l]
        for q in range(begins[k], begins[k + 1]):
            for f in range(FIELDS):
                for l in range(LANES):
                    lanes[f, l] = zero
            slot = block_offsets[q]
            for by in range(boxes[q, 0], boxes[q, 1]):
                for bx in range(boxes[q, 2], boxes[q, 3]):
                    b = by * SIDE + bx
                    for l in range(LANES):
                        w = weights[slot, l]
                        for f in range(FIELDS):
                            lanes[f, l] += w * state[f, b, l]
                    slot += 1
            sum_lanes(lanes, 4, sums, pair_ids[q])
