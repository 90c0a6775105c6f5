"""Compositing tiles front to back: colours, alpha, depth. Knows no cameras and no rows, only records and lists.

C = sum_i w_i c_i + T bg with w_i = alpha_i T_i, T_i = prod_{j<i} (1 - alpha_j). State of a tile is [fields, 16 blocks,
16 lanes]; field 0 is T. A pixel that takes no more rows has its T negated: w is then negative, and `T - w > STOP` fails
for ever after, without a branch in the vector loop.
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
    TILE,
    device,
    exp,
    kernel,
    prefetch,
    scratch,
)
from splatpainter.rendering.profiles import PLAYCANVAS_FALLOFF, PLAYCANVAS_MAX_ALPHA

STATE = 5 * PIXELS
AHEAD = 6
"""Records are asked for this many list entries before they are used."""


@device
def blocks_hit(m, e):
    """Blocks [begin, end) of a tile that [m - e, m + e] hits, m relative to the centre of the tile's first pixel."""
    zero = type(m)(0)
    limit = type(m)(TILE - 1)
    if m + e < zero:
        return 0, 0
    # In this order of arguments NaN becomes the bound: casts of NaN are undefined.
    return int(min(limit, max(zero, m - e))) >> 2, (int(min(limit, m + e)) >> 2) + 1


@device
def open_tile(tile, width, height, state):
    """(x, y) of the tile's first pixel; T = 1 inside the picture, -1 (takes nothing) outside, other fields 0."""
    F = state.dtype.type
    across = (width + TILE - 1) // TILE
    ty = tile // across
    x0 = (tile - ty * across) * TILE
    y0 = ty * TILE
    for k in range(state.shape[0]):
        for b in range(BLOCKS):
            for l in range(LANES):
                state[k, b, l] = F(0)
    for b in range(BLOCKS):
        for l in range(LANES):
            inside = y0 + (b // SIDE) * 4 + (l >> 2) < height and x0 + (b % SIDE) * 4 + (l & 3) < width
            state[0, b, l] = F(1) if inside else F(-1)
    return x0, y0


@device
def close_blocks(state, closed):
    """Mark the blocks in which no pixel takes more; returns how many there are."""
    F = state.dtype.type
    count = 0
    for b in range(BLOCKS):
        top = F(-1)
        for l in range(LANES):
            top = max(top, state[0, b, l])
        shut = top < F(0)
        closed[b] |= shut
        count += closed[b]
    return count


@device
def composite(records, members, begin, end, x0, y0, state, closed, profile):
    """Add list entries [begin, end) to fields T, r, g, b, depth of the tile; returns one past the last entry used."""
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
        red = records[i, 6]
        green = records[i, 7]
        blue = records[i, 8]
        depth = records[i, 9]
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
                    state[1, b, l] += w * red
                    state[2, b, l] += w * green
                    state[3, b, l] += w * blue
                    state[4, b, l] += w * depth
        if (p - begin) & 7 == 7 and close_blocks(state, closed) == BLOCKS:
            return p + 1
    return end


@kernel
def draw_tiles(
    records,  # [M, 16]
    members,  # [P] records, tile after tile, front to back
    tiles,  # [T] tile numbers, row by row over the picture
    starts,  # [T + 1] of each tile in members
    background,  # [3]
    image,  # out [H, W, 3]
    alpha,  # out [H, W]
    depth,  # out [H, W] expected depth, 0 where alpha is 0
    ends,  # out [T] one past the last member used
    profile,  # None: inria, True: playcanvas; compiled for each, so that neither costs the other a test per pixel
    thread,
    threads,
):
    F = records.dtype.type
    one = F(1)
    height, width = alpha.shape
    state = carray(scratch(records, STATE), (5, BLOCKS, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tiles.shape[0], threads):
        x0, y0 = open_tile(tiles[k], width, height, state)
        closed[:] = False
        ends[k] = composite(records, members, starts[k], starts[k + 1], x0, y0, state, closed, profile)
        for b in range(BLOCKS):
            for l in range(LANES):
                y = y0 + (b // SIDE) * 4 + (l >> 2)
                x = x0 + (b % SIDE) * 4 + (l & 3)
                if y < height and x < width:
                    t = abs(state[0, b, l])
                    image[y, x, 0] = state[1, b, l] + t * background[0]
                    image[y, x, 1] = state[2, b, l] + t * background[1]
                    image[y, x, 2] = state[3, b, l] + t * background[2]
                    alpha[y, x] = one - t
                    depth[y, x] = state[4, b, l] / (one - t) if t < one else F(0)
