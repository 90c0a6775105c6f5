"""Which row gives a pixel most of its colour: the one with the largest weight w = alpha T. See raster.py for the state.

Of equal weights the row in front counts.
"""

from __future__ import annotations

import numpy as np
from numba import carray

from splatpainter.kernels.simd import (
    BLOCKS,
    CAP,
    LANES,
    PIXELS,
    SIDE,
    STOP,
    THRESHOLD,
    device,
    exp,
    kernel,
    prefetch,
    scratch,
)
from splatpainter.rendering.cpu.raster import AHEAD, blocks_hit, close_blocks, open_tile
from splatpainter.rendering.profiles import PLAYCANVAS_FALLOFF, PLAYCANVAS_MAX_ALPHA

STATE = 2 * PIXELS


@device
def weigh(records, members, begin, end, x0, y0, state, best, closed, profile):
    """Fields T and largest weight of the tile, and in `best` [16, 16 lanes] the entry that has it."""
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
        mx = records[i, 0] - cx
        my = records[i, 1] - cy
        by0, by1 = blocks_hit(my, records[i, 10])
        bx0, bx1 = blocks_hit(mx, records[i, 11])
        a2 = half * records[i, 2]
        b1 = records[i, 3]
        c2 = half * records[i, 4]
        opacity = records[i, 5]
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
                    state[0, b, l] = left if takes else -abs(t)
                    top = state[1, b, l]
                    best[b, l] = i if w > top else best[b, l]
                    state[1, b, l] = w if w > top else top
        if (p - begin) & 7 == 7 and close_blocks(state, closed) == BLOCKS:
            break


@kernel
def weigh_tiles(
    records,  # [M, 16]
    members,  # [P] records, tile after tile, front to back
    tiles,  # [T] tile numbers
    starts,  # [T + 1] of each tile in members
    entries,  # out [H, W] int32 which record, -1 for none
    profile,  # as in raster.draw_tiles
    thread,
    threads,
):
    height, width = entries.shape
    state = carray(scratch(records, STATE), (2, BLOCKS, LANES))
    best = np.empty((BLOCKS, LANES), np.int32)
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tiles.shape[0], threads):
        x0, y0 = open_tile(tiles[k], width, height, state)
        closed[:] = False
        best[:] = -1
        weigh(records, members, starts[k], starts[k + 1], x0, y0, state, best, closed, profile)
        for b in range(BLOCKS):
            for l in range(LANES):
                y = y0 + (b // SIDE) * 4 + (l >> 2)
                x = x0 + (b % SIDE) * 4 + (l & 3)
                if y < height and x < width:
                    entries[y, x] = best[b, l]
