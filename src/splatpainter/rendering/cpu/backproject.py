"""The adjoint of compositing: what pixels give back to rows, by weight. Knows no cameras; see raster.py for the state.

Sums are stored per (row, tile) pair, beside each other for one row, and added in tile order afterwards: no atomics, so
results are the same bits for any number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import carray

from splatpainter.kernels.simd import (
    BLOCKS,
    CAP,
    LANES,
    SIDE,
    STOP,
    THRESHOLD,
    device,
    exp,
    kernel,
    prefetch,
    scratch,
    sum_lanes,
)
from splatpainter.rendering.cpu.raster import AHEAD, STATE, blocks_hit, close_blocks, composite, open_tile
from splatpainter.rendering.profiles import PLAYCANVAS_FALLOFF, PLAYCANVAS_MAX_ALPHA

LANE_SUMS = 6 * LANES
SUMS = 8
"""Columns of one pair's sums: w m v (3), w m, alpha m, max w, two unused."""


@device
def give_back(records, members, homes, begin, end, x0, y0, state, closed, hidden, lanes, sums, profile):
    """sums[homes[p]] for list entries [begin, end), from fields T, m v (3), m of the tile. hidden: also count the alpha
    of rows behind the point where a pixel stops; otherwise stop there too."""
    F = records.dtype.type
    zero = F(0)
    half = F(0.5)
    threshold = F(THRESHOLD)
    cap = F(CAP) if profile is None else F(PLAYCANVAS_MAX_ALPHA)
    floor = F(PLAYCANVAS_FALLOFF)
    stop = F(STOP)
    cx = F(x0) + half
    cy = F(y0) + half
    for p in range(begin, end):
        i = members[p]
        prefetch(records, members[min(p + AHEAD, end - 1)])
        prefetch(sums, homes[min(p + AHEAD, end - 1)])
        mx = records[i, 0] - cx
        my = records[i, 1] - cy
        by0, by1 = blocks_hit(my, records[i, 10])
        bx0, bx1 = blocks_hit(mx, records[i, 11])
        a2 = half * records[i, 2]
        b1 = records[i, 3]
        c2 = half * records[i, 4]
        opacity = records[i, 5]
        for k in range(6):
            for l in range(LANES):
                lanes[k, l] = zero
        for by in range(by0, by1):
            myb = my - F(by << 2)
            for bx in range(bx0, bx1):
                b = by * SIDE + bx
                if closed[b]:
                    continue
                mxb = mx - F(bx << 2)
                for l in range(LANES):
                    dx = mxb - F(l & 3)
                    dy = myb - F(l >> 2)
                    sigma = max((a2 * dx + b1 * dy) * dx + c2 * dy * dy, zero)
                    if profile is None:
                        alpha = min(cap, opacity * exp(-sigma))
                    else:
                        alpha = min(cap, opacity * (exp(-sigma) - floor))
                    alpha = alpha if alpha >= threshold else zero
                    t = state[0, b, l]
                    w = alpha * t
                    left = t - w
                    takes = left > stop if profile is None else t >= stop
                    w = w if takes else zero
                    m = state[4, b, l]
                    state[0, b, l] = left if takes else -abs(t)
                    lanes[0, l] += w * state[1, b, l]
                    lanes[1, l] += w * state[2, b, l]
                    lanes[2, l] += w * state[3, b, l]
                    lanes[3, l] += w * m
                    lanes[4, l] += alpha * m
                    lanes[5, l] = max(lanes[5, l], w if m > zero else zero)
        home = homes[p]
        sum_lanes(lanes, 5, sums, home)
        top = zero
        for l in range(LANES):
            top = max(top, lanes[5, l])
        sums[home, 5] = top
        if not hidden and (p - begin) & 7 == 7 and close_blocks(state, closed) == BLOCKS:
            return p + 1
    return end


@device
def load_mask(mask, x0, y0, state, closed):
    """Field 4 = m; blocks without any are closed. False when the whole tile has none."""
    F = state.dtype.type
    height, width = mask.shape
    some = False
    for b in range(BLOCKS):
        closed[b] = True
        for l in range(LANES):
            y = y0 + (b // SIDE) * 4 + (l >> 2)
            x = x0 + (b % SIDE) * 4 + (l & 3)
            if y < height and x < width and mask[y, x] > F(0):
                state[4, b, l] = mask[y, x]
                closed[b] = False
                some = True
            else:
                state[4, b, l] = F(0)
    return some


@device
def clear(homes, begin, end, sums):
    for p in range(begin, end):
        for k in range(SUMS):
            sums[homes[p], k] = 0


@kernel
def accumulate_tiles(
    records,  # [M, 16]
    members,  # [P]
    homes,  # [P] place of each member's sums
    tiles,  # [T]
    starts,  # [T + 1]
    values,  # [H, W, 3]
    mask,  # [H, W] >= 0
    sums,  # out [P, 8]
    profile,  # None or True, as in raster.draw_tiles
    thread,
    threads,
):
    height, width = mask.shape
    state = carray(scratch(records, STATE), (5, BLOCKS, LANES))
    lanes = carray(scratch(records, LANE_SUMS), (6, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tiles.shape[0], threads):
        x0, y0 = open_tile(tiles[k], width, height, state)
        if not load_mask(mask, x0, y0, state, closed):
            clear(homes, starts[k], starts[k + 1], sums)
            continue
        for b in range(BLOCKS):
            for l in range(LANES):
                y = min(y0 + (b // SIDE) * 4 + (l >> 2), height - 1)
                x = min(x0 + (b % SIDE) * 4 + (l & 3), width - 1)
                m = state[4, b, l]
                for c in range(3):
                    state[1 + c, b, l] = m * values[y, x, c] if m > 0 else m
        begin, end = starts[k], starts[k + 1]
        give_back(records, members, homes, begin, end, x0, y0, state, closed, True, lanes, sums, profile)


@kernel
def residual_tiles(
    records,  # [M, 16]
    members,  # [P]
    homes,  # [P] place of each member's sums
    tiles,  # [T]
    starts,  # [T + 1]
    background,  # [3]
    target,  # [H, W, 3]
    mask,  # [H, W] >= 0
    sums,  # out [P, 8]
    errors,  # out [T] sum of m |target - image|^2
    thread,
    threads,
):
    """Draw, subtract and give back, tile by tile, while the tile is in cache."""
    F = records.dtype.type
    height, width = mask.shape
    drawn = carray(scratch(records, STATE), (5, BLOCKS, LANES))
    state = carray(scratch(records, STATE), (5, BLOCKS, LANES))
    lanes = carray(scratch(records, LANE_SUMS), (6, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tiles.shape[0], threads):
        x0, y0 = open_tile(tiles[k], width, height, state)
        open_tile(tiles[k], width, height, drawn)
        errors[k] = 0
        if not load_mask(mask, x0, y0, state, closed):
            clear(homes, starts[k], starts[k + 1], sums)
            continue
        end = composite(records, members, starts[k], starts[k + 1], x0, y0, drawn, closed, None)
        load_mask(mask, x0, y0, state, closed)
        error = F(0)
        for b in range(BLOCKS):
            for l in range(LANES):
                m = state[4, b, l]
                if m > F(0):
                    y = y0 + (b // SIDE) * 4 + (l >> 2)
                    x = x0 + (b % SIDE) * 4 + (l & 3)
                    t = abs(drawn[0, b, l])
                    for c in range(3):
                        difference = target[y, x, c] - (drawn[1 + c, b, l] + t * background[c])
                        error += m * difference * difference
                        state[1 + c, b, l] = m * difference
        errors[k] = error
        end = give_back(records, members, homes, starts[k], end, x0, y0, state, closed, False, lanes, sums, None)
        clear(homes, end, starts[k + 1], sums)


@kernel
def reduce_pairs(offsets, sums, out, thread, threads):
    """out [M, 6]: each record's sums over its tiles, the sixth their maximum."""
    F = sums.dtype.type
    m = out.shape[0]
    for i in range(m * thread // threads, m * (thread + 1) // threads):
        for k in range(6):
            out[i, k] = F(0)
        for g in range(offsets[i], offsets[i + 1]):
            for k in range(5):
                out[i, k] += sums[g, k]
            out[i, 5] = max(out[i, 5], sums[g, 5])
