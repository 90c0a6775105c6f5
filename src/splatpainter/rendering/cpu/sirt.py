"""Colour rounds of some rows: what they weigh in every pixel is found once, and a round then costs what they cost.

A picture is linear in the rows' colours, so where only some of them move the others need not be drawn again: C = rest +
sum over the chosen rows of w_ip c_i. The weights of a tile's chosen rows are kept as blocks of 16 pixels, in the order
of the tile's list. The same weights as of raster.py and gather.py; sums are the same bits for any number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import carray

from splatpainter.kernels import simd
from splatpainter.kernels.parallel import run
from splatpainter.kernels.simd import (
    BLOCKS,
    CAP,
    LANES,
    PIXELS,
    SIDE,
    STOP,
    THRESHOLD,
    TILE,
    device,
    exp,
    kernel,
    prefetch,
    scratch,
    sum_lanes,
)
from splatpainter.rendering.cpu import backproject
from splatpainter.rendering.cpu.backproject import load_mask
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.rendering.cpu.raster import AHEAD, STATE, blocks_hit, close_blocks, open_tile

MAX_CACHED_BLOCKS = 1 << 20
"""64 MiB in float32. A Gaussian of 1 px touches about 4 blocks, one of 4 px about 30."""
FIELDS = 4
"""Of a tile between rounds: what the chosen rows are to make up (3), and the pixels' weight m."""
_TILE, _TOTALS = FIELDS * PIXELS, FIELDS * LANES


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
        run(fill_tiles, *view.tile_lists(view.projected), background, target, mask, *movable_lists, weights, remainder)
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
    """[Q, 4] int64 blocks of each pair's tile that its ellipse touches: y from, to, x from, to (raster.blocks_hit)."""
    projected, across = view.projected[entries], view.tiles.shape[1]
    out = np.empty((len(entries), 4), np.int64)
    for k, (mean, extent, first) in enumerate(
        [(simd.MY, simd.YE, tile // across * TILE), (simd.MX, simd.XE, tile % across * TILE)]
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
    run(round_tiles, *lists, remainder, simd.readonly(colors, dtype), sums)
    run(backproject.reduce_pairs, pair_offsets, sums, out)
    return out


@device
def keep(records, members, begin, end, x0, y0, pairs, first, last, boxes, places, state, closed, kept):
    """Fields T, r, g, b of a tile from the rows that are not chosen; the weights of those that are, into `kept`."""
    F = records.dtype.type
    zero = F(0)
    half = F(0.5)
    threshold = F(THRESHOLD)
    cap = F(CAP)
    stop = F(STOP)
    cx = F(x0) + half
    cy = F(y0) + half
    weights = carray(scratch(records, LANES), (LANES,))
    q = first
    for p in range(begin, end):
        i = members[p]
        prefetch(records, members[min(p + AHEAD, end - 1)])
        mx = records[i, 0] - cx
        my = records[i, 1] - cy
        a2 = half * records[i, 2]
        b1 = records[i, 3]
        c2 = half * records[i, 4]
        opacity = records[i, 5]
        red = records[i, 6]
        green = records[i, 7]
        blue = records[i, 8]
        chosen = q < last and pairs[q] == p
        if chosen:
            by0, by1, bx0, bx1 = boxes[q, 0], boxes[q, 1], boxes[q, 2], boxes[q, 3]
            slot = places[q]
            red = green = blue = zero
            q += 1
        else:
            by0, by1 = blocks_hit(my, records[i, 10])
            bx0, bx1 = blocks_hit(mx, records[i, 11])
            slot = 0
        for by in range(by0, by1):
            myb = my - F(by << 2)
            for bx in range(bx0, bx1):
                b = by * SIDE + bx
                if closed[b]:
                    if chosen:
                        kept[slot, :] = zero
                        slot += 1
                    continue
                mxb = mx - F(bx << 2)
                for l in range(LANES):
                    dx = mxb - F(l & 3)
                    dy = myb - F(l >> 2)
                    sigma = max((a2 * dx + b1 * dy) * dx + c2 * dy * dy, zero)
                    alpha = min(cap, opacity * exp(-sigma))
                    alpha = alpha if alpha >= threshold else zero
                    t = state[0, b, l]
                    w = alpha * t
                    left = t - w
                    takes = left > stop
                    w = w if takes else zero
                    state[0, b, l] = left if takes else -abs(t)
                    weights[l] = w
                    state[1, b, l] += w * red
                    state[2, b, l] += w * green
                    state[3, b, l] += w * blue
                if chosen:
                    for l in range(LANES):
                        kept[slot, l] = weights[l]
                    slot += 1
        if (p - begin) & 7 == 7 and close_blocks(state, closed) == BLOCKS:
            break
    for k in range(places[q], places[last]):
        for l in range(LANES):
            kept[k, l] = zero


@kernel
def fill_tiles(
    records,  # [M, 16]
    members,  # [P]
    homes,  # [P] unused
    tiles,  # [T]
    starts,  # [T + 1]
    background,  # [3]
    target,  # [H, W, 3]
    mask,  # [H, W] >= 0
    pairs,  # [Q] places in members of the chosen rows
    begins,  # [T + 1] of each tile in pairs
    boxes,  # [Q, 4] blocks that each pair touches
    places,  # [Q + 1] of each pair's blocks in kept
    kept,  # out [B, 16] weights
    rest,  # out [T, 4, 16, 16] target minus what the other rows make, and m
    thread,
    threads,
):
    F = records.dtype.type
    height, width = mask.shape
    state = carray(scratch(records, STATE), (5, BLOCKS, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tiles.shape[0], threads):
        x0, y0 = open_tile(tiles[k], width, height, state)
        if not load_mask(mask, x0, y0, state, closed):
            rest[k] = F(0)
            kept[places[begins[k]] : places[begins[k + 1]]] = F(0)
            continue
        begin, end, first, last = starts[k], starts[k + 1], begins[k], begins[k + 1]
        keep(records, members, begin, end, x0, y0, pairs, first, last, boxes, places, state, closed, kept)
        for b in range(BLOCKS):
            for l in range(LANES):
                y = min(y0 + (b // SIDE) * 4 + (l >> 2), height - 1)
                x = min(x0 + (b % SIDE) * 4 + (l & 3), width - 1)
                t = abs(state[0, b, l])
                for c in range(3):
                    rest[k, c, b, l] = target[y, x, c] - (state[1 + c, b, l] + t * background[c])
                rest[k, 3, b, l] = state[4, b, l]


@kernel
def round_tiles(
    begins,  # [T + 1] of each tile in the pairs
    boxes,  # [Q, 4] blocks that each pair touches
    places,  # [Q + 1] of each pair's blocks in kept
    entries,  # [Q] which chosen row each pair is of
    homes,  # [Q] place of each pair's sums
    kept,  # [B, 16] weights
    rest,  # [T, 4, 16, 16]
    colors,  # [C, 3]
    sums,  # out [Q, 8]
    thread,
    threads,
):
    F = kept.dtype.type
    zero = F(0)
    state = carray(scratch(kept, _TILE), (FIELDS, BLOCKS, LANES))
    totals = carray(scratch(kept, _TOTALS), (FIELDS, LANES))
    for k in range(thread, rest.shape[0], threads):
        if begins[k] == begins[k + 1]:
            continue
        for f in range(FIELDS):
            for b in range(BLOCKS):
                for l in range(LANES):
                    state[f, b, l] = rest[k, f, b, l]
        for q in range(begins[k], begins[k + 1]):
            red, green, blue = colors[entries[q], 0], colors[entries[q], 1], colors[entries[q], 2]
            slot = places[q]
            for by in range(boxes[q, 0], boxes[q, 1]):
                for bx in range(boxes[q, 2], boxes[q, 3]):
                    b = by * SIDE + bx
                    for l in range(LANES):
                        w = kept[slot, l]
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
                    totals[f, l] = zero
            slot = places[q]
            for by in range(boxes[q, 0], boxes[q, 1]):
                for bx in range(boxes[q, 2], boxes[q, 3]):
                    b = by * SIDE + bx
                    for l in range(LANES):
                        w = kept[slot, l]
                        for f in range(FIELDS):
                            totals[f, l] += w * state[f, b, l]
                    slot += 1
            sum_lanes(totals, 4, sums, homes[q])
