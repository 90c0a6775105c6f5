"""Derivative of compositing: gradients of pixels -> gradients of records' centres, conics, opacities, colours, depths.

Front to back with two numbers of state per pixel. For L with gradients (v_C, v_D, v_T) of colour, accumulated depth and
final transmittance, and g_i = v_C . c_i + v_D z_i:

    dL/d alpha_i = T_i g_i - R_i / (1 - alpha_i),   R_i = sum_{j > i} w_j g_j + T (v_C . bg + v_T)

R starts as the whole sum, known from the picture itself, and loses w_i g_i at each row.
"""

from __future__ import annotations

import numpy as np
from numba import carray

from splatpainter.kernels.simd import (
    BLOCKS,
    CAP,
    LANES,
    PIXELS,
    RECORD,
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
from splatpainter.rendering.cpu.raster import AHEAD, blocks_hit, close_blocks, open_tile

STATE = 6 * PIXELS
LANE_SUMS = 10 * LANES
FIELDS = 10
"""Of one pair: sums over its pixels of u, u dx, u dy, u dx^2, u dx dy, u dy^2 with u = e^-sigma dL/d alpha; of w v_C
(3); of w v_D. Stored in 16 columns, one cache line in float32."""


@device
def load_gradients(image, alpha, depth, v_image, v_alpha, v_depth, x0, y0, state):
    """Fields 1..5 = R, v_C (3), v_D. The renderer's depth is D / alpha with alpha = 1 - T."""
    F = state.dtype.type
    height, width = alpha.shape
    for b in range(BLOCKS):
        for l in range(LANES):
            y = y0 + (b // SIDE) * 4 + (l >> 2)
            x = x0 + (b % SIDE) * 4 + (l & 3)
            if y < height and x < width and alpha[y, x] > F(0):
                red = v_image[y, x, 0]
                green = v_image[y, x, 1]
                blue = v_image[y, x, 2]
                t = F(1) - alpha[y, x]
                v_d = v_depth[y, x] / alpha[y, x]
                v_t = depth[y, x] * v_d - v_alpha[y, x]
                state[1, b, l] = (
                    image[y, x, 0] * red
                    + image[y, x, 1] * green
                    + image[y, x, 2] * blue
                    + depth[y, x] * v_depth[y, x]
                    + t * v_t
                )
                state[2, b, l] = red
                state[3, b, l] = green
                state[4, b, l] = blue
                state[5, b, l] = v_d
            else:
                state[0, b, l] = F(-1)  # nothing was drawn here


@kernel
def draw_back(
    records,  # [M, 16]
    members,  # [P]
    homes,  # [P]
    tiles,  # [T]
    starts,  # [T + 1]
    ends,  # [T] where the forward pass stopped
    image,  # [H, W, 3]
    alpha,  # [H, W]
    depth,  # [H, W]
    v_image,  # [H, W, 3]
    v_alpha,  # [H, W]
    v_depth,  # [H, W]
    sums,  # out [P, 16] in record order
    thread,
    threads,
):
    F = records.dtype.type
    zero = F(0)
    one = F(1)
    half = F(0.5)
    threshold = F(THRESHOLD)
    cap = F(CAP)
    stop = F(STOP)
    height, width = alpha.shape
    state = carray(scratch(records, STATE), (6, BLOCKS, LANES))
    lanes = carray(scratch(records, LANE_SUMS), (FIELDS, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tiles.shape[0], threads):
        x0, y0 = open_tile(tiles[k], width, height, state)
        load_gradients(image, alpha, depth, v_image, v_alpha, v_depth, x0, y0, state)
        closed[:] = False
        cx = F(x0) + half
        cy = F(y0) + half
        begin = starts[k]
        end = ends[k]
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
            red = records[i, 6]
            green = records[i, 7]
            blue = records[i, 8]
            z = records[i, 9]
            for f in range(FIELDS):
                for l in range(LANES):
                    lanes[f, l] = zero
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
                        e = exp(-max((a2 * dx + b1 * dy) * dx + c2 * dy * dy, zero))
                        free = opacity * e
                        a = min(cap, free)
                        a = a if a >= threshold else zero
                        t = state[0, b, l]
                        w = a * t
                        left = t - w
                        takes = left > stop
                        w = w if takes else zero
                        state[0, b, l] = left if takes else -abs(t)
                        g = red * state[2, b, l] + green * state[3, b, l] + blue * state[4, b, l] + z * state[5, b, l]
                        rest = state[1, b, l] - w * g
                        state[1, b, l] = rest
                        u = e * (t * g - rest / (one - a))
                        u = u if (w > zero) & (free <= cap) else zero
                        ux = u * dx
                        uy = u * dy
                        lanes[0, l] += u
                        lanes[1, l] += ux
                        lanes[2, l] += uy
                        lanes[3, l] += ux * dx
                        lanes[4, l] += ux * dy
                        lanes[5, l] += uy * dy
                        lanes[6, l] += w * state[2, b, l]
                        lanes[7, l] += w * state[3, b, l]
                        lanes[8, l] += w * state[4, b, l]
                        lanes[9, l] += w * state[5, b, l]
            sum_lanes(lanes, FIELDS, sums, homes[p])
            if (p - begin) & 7 == 7:
                close_blocks(state, closed)
        for p in range(end, starts[k + 1]):
            for c in range(RECORD):
                sums[homes[p], c] = zero
