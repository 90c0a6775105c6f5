"""Derivative of compositing: gradients of pixels -> of means2d, conics, opacities, colours, depths, per pair.

Front to back with two numbers of state per pixel. For L with gradients (v_C, v_D, v_T) of colour, accumulated depth and
final transmittance, and g_i = v_C . c_i + v_D z_i:

    dL/d alpha_i = T_i g_i - R_i / (1 - alpha_i),   R_i = sum_{j > i} w_j g_j + T (v_C . bg + v_T)

R starts as the whole sum, known from the picture itself, and loses w_i g_i at each Gaussian.
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
    close_blocks,
    falloff,
    footprint,
    offset,
    open_tile,
    pixel_of,
)
from splatpainter.rendering.cpu.geometry import BLUE, COLUMNS, DEPTH, GREEN, RED
from splatpainter.rendering.profiles import MAX_ALPHA

STATE = 6 * PIXELS
LANE_SUMS = 10 * LANES
FIELDS = 10
"""Fields of one pair: sums over its pixels of u, u dx, u dy, u dx^2, u dx dy, u dy^2 with u = e^-sigma dL/d alpha; of w
v_C (3); of w v_D. Stored in 16 columns, one cache line in float32."""


@device
def load_gradients(image, alpha, depth, v_image, v_alpha, v_depth, x0, y0, state):
    """Fields 1..5 = R, v_C (3), v_D. The renderer's depth is D / alpha with alpha = 1 - T."""
    F = state.dtype.type
    height, width = alpha.shape
    for b in range(BLOCKS):
        for l in range(LANES):
            x, y = pixel_of(x0, y0, b, l)
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
def rasterize_backward_tiles(
    projected,  # [M, 16]
    flatten_ids,  # [P]
    pair_ids,  # [P]
    tile_ids,  # [T]
    isect_offsets,  # [T + 1]
    ends,  # [T] where the forward pass stopped
    image,  # [H, W, 3]
    alpha,  # [H, W]
    depth,  # [H, W]
    v_image,  # [H, W, 3]
    v_alpha,  # [H, W]
    v_depth,  # [H, W]
    sums,  # out [P, 16] in the order of pairs
    thread,
    threads,
):
    F = projected.dtype.type
    zero = F(0)
    one = F(1)
    height, width = alpha.shape
    state = carray(scratch(projected, STATE), (6, BLOCKS, LANES))
    lanes = carray(scratch(projected, LANE_SUMS), (FIELDS, LANES))
    closed = np.empty(BLOCKS, np.bool_)
    for k in range(thread, tile_ids.shape[0], threads):
        x0, y0 = open_tile(tile_ids[k], width, height, state)
        load_gradients(image, alpha, depth, v_image, v_alpha, v_depth, x0, y0, state)
        closed[:] = False
        begin = isect_offsets[k]
        end = ends[k]
        for p in range(begin, end):
            i = flatten_ids[p]
            prefetch(projected, flatten_ids[min(p + PREFETCH_ENTRIES, end - 1)])
            prefetch(sums, pair_ids[min(p + PREFETCH_ENTRIES, end - 1)])
            mx, my, a2, b1, c2, opacity = footprint(projected, i, x0, y0)
            by0, by1, bx0, bx1 = block_box(projected, i, mx, my)
            red = projected[i, RED]
            green = projected[i, GREEN]
            blue = projected[i, BLUE]
            z = projected[i, DEPTH]
            for f in range(FIELDS):
                for l in range(LANES):
                    lanes[f, l] = zero
            for by in range(by0, by1):
                for bx in range(bx0, bx1):
                    b = by * SIDE + bx
                    if closed[b]:
                        continue
                    for l in range(LANES):
                        dx, dy = offset(mx, my, bx, by, l)
                        e = falloff(dx, dy, a2, b1, c2)
                        a = alpha_of(opacity, e, None)
                        T = state[0, b, l]
                        w = accept(state, b, l, a, None)
                        g = red * state[2, b, l] + green * state[3, b, l] + blue * state[4, b, l] + z * state[5, b, l]
                        R = state[1, b, l] - w * g
                        state[1, b, l] = R
                        u = e * (T * g - R / (one - a))
                        u = u if (w > zero) & (opacity * e <= F(MAX_ALPHA)) else zero
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
            sum_lanes(lanes, FIELDS, sums, pair_ids[p])
            if (p - begin) & 7 == 7:
                close_blocks(state, closed)
        for p in range(end, isect_offsets[k + 1]):
            for c in range(COLUMNS):
                sums[pair_ids[p], c] = zero
