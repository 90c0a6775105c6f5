"""Rasterization: tiles -> colours, alpha, depth, and the Gaussian that weighs most in each pixel.

Kernels over tiles begin with `ProjectedView.tile_lists`: projected [M, 16]; flatten_ids [P], entries of `projected`,
tile after tile, front to back; pair_ids [P], where each of these keeps its sums; tile_ids [T], numbered row by row over
the picture; isect_offsets [T + 1], where each tile begins in flatten_ids.
"""

from __future__ import annotations

import numpy as np
from numba import carray

from splatpainter.kernels.simd import LANES, device, kernel, prefetch, scratch
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
from splatpainter.rendering.cpu.geometry import BLUE, DEPTH, GREEN, RED

STATE = 5 * PIXELS
HEAVIEST_STATE = 2 * PIXELS


@device
def composite(projected, flatten_ids, begin, end, x0, y0, state, closed, heaviest, profile):
    """Add list entries [begin, end) to fields T, r, g, b, depth of the tile; returns one past the last entry used.
    heaviest: None, or [16, 16 lanes] for the entry of the largest weight; fields are then T and that weight."""
    for p in range(begin, end):
        i = flatten_ids[p]
        prefetch(projected, flatten_ids[min(p + PREFETCH_ENTRIES, end - 1)])
        mx, my, a2, b1, c2, opacity = footprint(projected, i, x0, y0)
        by0, by1, bx0, bx1 = block_box(projected, i, mx, my)
        red = projected[i, RED]
        green = projected[i, GREEN]
        blue = projected[i, BLUE]
        depth = projected[i, DEPTH]
        for by in range(by0, by1):
            for bx in range(bx0, bx1):
                b = by * SIDE + bx
                if closed[b]:
                    continue
                for l in range(LANES):
                    dx, dy = offset(mx, my, bx, by, l)
                    alpha = alpha_of(opacity, falloff(dx, dy, a2, b1, c2), profile)
                    w = accept(state, b, l, alpha, profile)
                    if heaviest is None:
                        state[1, b, l] += w * red
                        state[2, b, l] += w * green
                        state[3, b, l] += w * blue
                        state[4, b, l] += w * depth
                    else:
                        peak = state[1, b, l]
                        heaviest[b, l] = i if w > peak else heaviest[b, l]
                        state[1, b, l] = w if w > peak else peak
        if is_done(p - begin, state, closed):
            return p + 1
    return end


@kernel
def rasterize_tiles(
    projected,  # [M, 16]
    flatten_ids,  # [P]
    tile_ids,  # [T]
    isect_offsets,  # [T + 1]
    background,  # [3]
    image,  # out [H, W, 3]
    alpha,  # out [H, W]
    depth,  # out [H, W] expected depth, 0 where alpha is 0
    ends,  # out [T] one past the last entry of flatten_ids used
    profile,
    thread,
    threads,
):
    F = projected.dtype.type
    one = F(1)
    height, width = alpha.shape
    state = carray(scratch(projected, STATE), (5, BLOCKS, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tile_ids.shape[0], threads):
        x0, y0 = open_tile(tile_ids[k], width, height, state)
        closed[:] = False
        begin, end = isect_offsets[k], isect_offsets[k + 1]
        ends[k] = composite(projected, flatten_ids, begin, end, x0, y0, state, closed, None, profile)
        for b in range(BLOCKS):
            for l in range(LANES):
                x, y = pixel_of(x0, y0, b, l)
                if y < height and x < width:
                    T = abs(state[0, b, l])
                    image[y, x, 0] = state[1, b, l] + T * background[0]
                    image[y, x, 1] = state[2, b, l] + T * background[1]
                    image[y, x, 2] = state[3, b, l] + T * background[2]
                    alpha[y, x] = one - T
                    depth[y, x] = state[4, b, l] / (one - T) if T < one else F(0)


@kernel
def heaviest_tiles(
    projected,  # [M, 16]
    flatten_ids,  # [P]
    tile_ids,  # [T]
    isect_offsets,  # [T + 1]
    entries,  # out [H, W] int32 entry of `projected` with the largest weight, of equal ones the front one; -1 for none
    profile,
    thread,
    threads,
):
    height, width = entries.shape
    state = carray(scratch(projected, HEAVIEST_STATE), (2, BLOCKS, LANES))
    heaviest = np.empty((BLOCKS, LANES), np.int32)
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tile_ids.shape[0], threads):
        x0, y0 = open_tile(tile_ids[k], width, height, state)
        closed[:] = False
        heaviest[:] = -1
        begin, end = isect_offsets[k], isect_offsets[k + 1]
        composite(projected, flatten_ids, begin, end, x0, y0, state, closed, heaviest, profile)
        for b in range(BLOCKS):
            for l in range(LANES):
                x, y = pixel_of(x0, y0, b, l)
                if y < height and x < width:
                    entries[y, x] = heaviest[b, l]
