"""Compositing a tile front to back: what all kernels over tiles share. Knows no cameras, only `projected` and lists.

C = sum_i w_i c_i + T bg with w_i = alpha_i T_i, T_i = prod_{j<i} (1 - alpha_j). A tile is 16 x 16 pixels = 16 blocks of
4 x 4; a block is 16 lanes, one inner loop that LLVM turns into vector code. The state of a tile is [fields, 16 blocks,
16 lanes]; field 0 is T. A pixel that accepts no more Gaussians has its T negated: w is then negative, and `T - w >
MIN_TRANSMITTANCE` fails for ever after, without a branch in the vector loop.

A profile is None for "inria" and True for "playcanvas": kernels are compiled for each, so that neither costs the other
a test per pixel.
"""

from __future__ import annotations

from splatpainter.kernels.simd import LANES, device, exp
from splatpainter.rendering.cpu.geometry import (
    CONIC_A,
    CONIC_B,
    CONIC_C,
    EXTENT_X,
    EXTENT_Y,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    TILE,
)
from splatpainter.rendering.profiles import (
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    PLAYCANVAS_FALLOFF,
    PLAYCANVAS_MAX_ALPHA,
)

SIDE = TILE // 4
"""Blocks along a tile's side."""
BLOCKS = SIDE * SIDE
PIXELS = BLOCKS * LANES
"""Pixels of a tile."""
PREFETCH_ENTRIES = 6
"""`projected` is asked for this many list entries before it is used."""


@device
def pixel_of(x0, y0, b, l):
    """(x, y) of lane l of block b, in the tile whose first pixel is (x0, y0)."""
    return x0 + (b % SIDE) * 4 + (l & 3), y0 + (b // SIDE) * 4 + (l >> 2)


@device
def open_tile(tile, width, height, state):
    """(x, y) of the tile's first pixel; T = 1 inside the picture, -1 (accepts nothing) outside, other fields 0."""
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
    """Mark the blocks in which no pixel accepts more; returns how many there are."""
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
def is_done(step, state, closed):
    """Whether no pixel of the tile accepts more; looks only after every eighth step."""
    return step & 7 == 7 and close_blocks(state, closed) == BLOCKS


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
def footprint(projected, i, x0, y0):
    """A Gaussian in the tile whose first pixel is (x0, y0): its centre relative to that pixel's, A / 2, B, C / 2 of its
    conic, and its opacity."""
    half = projected.dtype.type(0.5)
    mx = projected[i, MEAN_X] - (projected.dtype.type(x0) + half)
    my = projected[i, MEAN_Y] - (projected.dtype.type(y0) + half)
    return (
        mx,
        my,
        half * projected[i, CONIC_A],
        projected[i, CONIC_B],
        half * projected[i, CONIC_C],
        projected[i, OPACITY],
    )


@device
def block_box(projected, i, mx, my):
    """Blocks that a Gaussian's ellipse may touch: rows [by0, by1), columns [bx0, bx1)."""
    by0, by1 = blocks_hit(my, projected[i, EXTENT_Y])
    bx0, bx1 = blocks_hit(mx, projected[i, EXTENT_X])
    return by0, by1, bx0, bx1


@device
def offset(mx, my, bx, by, l):
    """(dx, dy) from the pixel of lane l in block (bx, by) to a Gaussian's centre, pixels."""
    F = type(mx)
    return mx - F(bx << 2) - F(l & 3), my - F(by << 2) - F(l >> 2)


@device
def falloff(dx, dy, a2, b1, c2):
    """e^-sigma at (dx, dy) pixels from a Gaussian's centre."""
    return exp(-max((a2 * dx + b1 * dy) * dx + c2 * dy * dy, type(dx)(0)))


@device
def alpha_of(opacity, e, profile):
    """Alpha of a Gaussian where its falloff is e, 0 where that is too little to be drawn; see profiles.py."""
    F = type(e)
    if profile is None:
        alpha = min(F(MAX_ALPHA), opacity * e)
    else:
        alpha = min(F(PLAYCANVAS_MAX_ALPHA), opacity * (e - F(PLAYCANVAS_FALLOFF)))
    return alpha if alpha >= F(MIN_ALPHA) else F(0)


@device
def accept(state, b, l, alpha, profile):
    """Weight w = alpha T of a Gaussian in lane l of block b, 0 where the pixel accepts no more. T goes on."""
    F = type(alpha)
    T = state[0, b, l]
    w = alpha * T
    T_next = T - w
    accepted = T_next > F(MIN_TRANSMITTANCE) if profile is None else T >= F(MIN_TRANSMITTANCE)
    state[0, b, l] = T_next if accepted else -abs(T)
    return w if accepted else F(0)
