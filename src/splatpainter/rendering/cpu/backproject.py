"""The adjoint of compositing: what pixels give back to Gaussians, by weight. See rasterize.py for the lists.

Sums are stored per pair of a Gaussian and a tile, those of one Gaussian beside each other, and added in tile order
afterwards: no atomics, so results are the same bits for any number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import carray

from splatpainter.kernels.simd import LANES, device, kernel, prefetch, scratch, sum_lanes
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
from splatpainter.rendering.cpu.rasterize import composite

STATE = 5 * PIXELS
LANE_SUMS = 6 * LANES
SUMS = 8
"""Columns of one pair's sums: w m v (3), w m, alpha m, max w, two unused. Of two masks without values: w n, alpha n,
max w, w m, alpha m, max w, two unused."""


@device
def backproject_tile(
    projected, flatten_ids, pair_ids, begin, end, x0, y0, state, closed, through, lanes, sums, two, profile
):
    """sums[pair_ids[p]] for list entries [begin, end), from fields T, m v (3), m of the tile. through: also count the
    alpha of Gaussians behind the point where all pixels stop; otherwise stop there too. two: None, or True for two
    masks without values, from fields T, n, unused (2), m. Returns one past the last entry used."""
    zero = projected.dtype.type(0)
    for p in range(begin, end):
        i = flatten_ids[p]
        prefetch(projected, flatten_ids[min(p + PREFETCH_ENTRIES, end - 1)])
        prefetch(sums, pair_ids[min(p + PREFETCH_ENTRIES, end - 1)])
        mx, my, a2, b1, c2, opacity = footprint(projected, i, x0, y0)
        by0, by1, bx0, bx1 = block_box(projected, i, mx, my)
        for k in range(6):
            for l in range(LANES):
                lanes[k, l] = zero
        for by in range(by0, by1):
            for bx in range(bx0, bx1):
                b = by * SIDE + bx
                if closed[b]:
                    continue
                for l in range(LANES):
                    dx, dy = offset(mx, my, bx, by, l)
                    alpha = alpha_of(opacity, falloff(dx, dy, a2, b1, c2), profile)
                    w = accept(state, b, l, alpha, profile)
                    m = state[4, b, l]
                    if two is None:
                        lanes[0, l] += w * state[1, b, l]
                        lanes[1, l] += w * state[2, b, l]
                        lanes[2, l] += w * state[3, b, l]
                    else:
                        n = state[1, b, l]
                        lanes[0, l] += w * n
                        lanes[1, l] += alpha * n
                        lanes[2, l] = max(lanes[2, l], w if n > zero else zero)
                    lanes[3, l] += w * m
                    lanes[4, l] += alpha * m
                    lanes[5, l] = max(lanes[5, l], w if m > zero else zero)
        pair = pair_ids[p]
        sum_lanes(lanes, 5, sums, pair)
        peak = zero
        for l in range(LANES):
            peak = max(peak, lanes[5, l])
        sums[pair, 5] = peak
        if two is not None:
            peak = zero
            for l in range(LANES):
                peak = max(peak, lanes[2, l])
            sums[pair, 2] = peak
        if not through and is_done(p - begin, state, closed):
            return p + 1
    return end


@device
def load_field(mask, x0, y0, state, field, closed):
    """A field = m; blocks with any are opened. False when the whole tile has none."""
    F = state.dtype.type
    height, width = mask.shape
    some = False
    for b in range(BLOCKS):
        for l in range(LANES):
            x, y = pixel_of(x0, y0, b, l)
            if y < height and x < width and mask[y, x] > F(0):
                state[field, b, l] = mask[y, x]
                closed[b] = False
                some = True
            else:
                state[field, b, l] = F(0)
    return some


@device
def load_mask(mask, x0, y0, state, closed):
    """Field 4 = m; blocks without any are closed. False when the whole tile has none."""
    closed[:] = True
    return load_field(mask, x0, y0, state, 4, closed)


@device
def clear(pair_ids, begin, end, sums):
    for p in range(begin, end):
        for k in range(SUMS):
            sums[pair_ids[p], k] = 0


@kernel
def backproject_tiles(
    projected,  # [M, 16]
    flatten_ids,  # [P]
    pair_ids,  # [P]
    tile_ids,  # [T]
    isect_offsets,  # [T + 1]
    values,  # [H, W, 3]
    mask,  # [H, W] >= 0
    sums,  # out [P, 8]
    profile,
    thread,
    threads,
):
    height, width = mask.shape
    state = carray(scratch(projected, STATE), (5, BLOCKS, LANES))
    lanes = carray(scratch(projected, LANE_SUMS), (6, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tile_ids.shape[0], threads):
        x0, y0 = open_tile(tile_ids[k], width, height, state)
        begin, end = isect_offsets[k], isect_offsets[k + 1]
        if not load_mask(mask, x0, y0, state, closed):
            clear(pair_ids, begin, end, sums)
            continue
        for b in range(BLOCKS):
            for l in range(LANES):
                x, y = pixel_of(x0, y0, b, l)
                m = state[4, b, l]
                for c in range(3):
                    state[1 + c, b, l] = m * values[min(y, height - 1), min(x, width - 1), c] if m > 0 else m
        backproject_tile(
            projected, flatten_ids, pair_ids, begin, end, x0, y0, state, closed, True, lanes, sums, None, profile
        )


@kernel
def mask_sums_tiles(
    projected,  # [M, 16]
    flatten_ids,  # [P]
    pair_ids,  # [P]
    tile_ids,  # [T]
    isect_offsets,  # [T + 1]
    mask,  # [H, W] >= 0
    mask2,  # [H, W] >= 0
    sums,  # out [P, 8]
    thread,
    threads,
):
    """Two masks in one walk, without values."""
    height, width = mask.shape
    state = carray(scratch(projected, STATE), (5, BLOCKS, LANES))
    lanes = carray(scratch(projected, LANE_SUMS), (6, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tile_ids.shape[0], threads):
        x0, y0 = open_tile(tile_ids[k], width, height, state)
        begin, end = isect_offsets[k], isect_offsets[k + 1]
        some = load_mask(mask, x0, y0, state, closed)
        if not (load_field(mask2, x0, y0, state, 1, closed) or some):
            clear(pair_ids, begin, end, sums)
            continue
        backproject_tile(
            projected, flatten_ids, pair_ids, begin, end, x0, y0, state, closed, True, lanes, sums, True, None
        )


@kernel
def sirt_tiles(
    projected,  # [M, 16]
    flatten_ids,  # [P]
    pair_ids,  # [P]
    tile_ids,  # [T]
    isect_offsets,  # [T + 1]
    background,  # [3]
    target,  # [H, W, 3]
    mask,  # [H, W] >= 0
    sums,  # out [P, 8]
    errors,  # out [T] sum of m |target - image|^2
    thread,
    threads,
):
    """Rasterize, subtract and backproject, tile by tile, while the tile is in cache."""
    F = projected.dtype.type
    height, width = mask.shape
    rasterized = carray(scratch(projected, STATE), (5, BLOCKS, LANES))
    state = carray(scratch(projected, STATE), (5, BLOCKS, LANES))
    lanes = carray(scratch(projected, LANE_SUMS), (6, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tile_ids.shape[0], threads):
        x0, y0 = open_tile(tile_ids[k], width, height, state)
        open_tile(tile_ids[k], width, height, rasterized)
        begin, end = isect_offsets[k], isect_offsets[k + 1]
        errors[k] = 0
        if not load_mask(mask, x0, y0, state, closed):
            clear(pair_ids, begin, end, sums)
            continue
        stop = composite(projected, flatten_ids, begin, end, x0, y0, rasterized, closed, None, None)
        load_mask(mask, x0, y0, state, closed)
        error = F(0)
        for b in range(BLOCKS):
            for l in range(LANES):
                m = state[4, b, l]
                if m > F(0):
                    x, y = pixel_of(x0, y0, b, l)
                    T = abs(rasterized[0, b, l])
                    for c in range(3):
                        difference = target[y, x, c] - (rasterized[1 + c, b, l] + T * background[c])
                        error += m * difference * difference
                        state[1 + c, b, l] = m * difference
        errors[k] = error
        stop = backproject_tile(
            projected, flatten_ids, pair_ids, begin, stop, x0, y0, state, closed, False, lanes, sums, None, None
        )
        clear(pair_ids, stop, end, sums)


@kernel
def reduce_mask_sums(pair_offsets, sums, out, thread, threads):
    """As `reduce_pairs`, for two masks: the third and the sixth their maximum."""
    F = sums.dtype.type
    m = out.shape[0]
    for i in range(m * thread // threads, m * (thread + 1) // threads):
        for k in range(6):
            out[i, k] = F(0)
        for pair in range(pair_offsets[i], pair_offsets[i + 1]):
            for k in (0, 1, 3, 4):
                out[i, k] += sums[pair, k]
            for k in (2, 5):
                out[i, k] = max(out[i, k], sums[pair, k])


@kernel
def reduce_pairs(pair_offsets, sums, out, thread, threads):
    """out [M, 6]: each Gaussian's sums over its tiles, the sixth their maximum."""
    F = sums.dtype.type
    m = out.shape[0]
    for i in range(m * thread // threads, m * (thread + 1) // threads):
        for k in range(6):
            out[i, k] = F(0)
        for pair in range(pair_offsets[i], pair_offsets[i + 1]):
            for k in range(5):
                out[i, k] += sums[pair, k]
            out[i, 5] = max(out[i, 5], sums[pair, 5])
