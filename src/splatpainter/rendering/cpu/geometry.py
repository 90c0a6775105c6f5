"""One Gaussian seen by one camera: the numbers that kernels hand each other (native/rendering/geometry.h).

Knows no lists and no pixels.
EWA splatting (Zwicker et al. 2001) as in Kerbl et al. 2023: cov2d = (J W R S)(J W R S)^T + 0.3 I.
"""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.rendering.profiles import JACOBIAN_MARGIN
from splatpainter.system.quick_dataclass import dataclass

TILE = 16
"""Tile side, pixels."""

# Columns of `projected` [M, 16]: one Gaussian of one view, 16 numbers = one cache line in float32.
MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_Y, EXTENT_X = range(12)
SQUARED_RADIUS, UNCLAMPED_RED, UNCLAMPED_GREEN, UNCLAMPED_BLUE = range(12, 16)
COLUMNS = 16
"""Mean (px); conic A, B, C (sigma = A dx^2 / 2 + B dx dy + C dy^2 / 2); opacity; colour >= 0; z; half extents of the
drawn ellipse (px); its squared radius in standard deviations; the colour before it is clamped at 0."""

GAUSSIANS_PER_BLOCK = 1024
"""Gaussians per unit of work of projection; each block's results are written side by side from the block's start."""
SUMS = 8
"""Columns of what back-projection sums per pair of a Gaussian and a tile."""

# Columns of the camera vector [27], after the rotation, row by row (0..8), and the translation (9..11): focal lengths
# and principal point (px); bounds of x / z and y / z for Jacobians; window (px); camera centre (world units).
FX, FY, CX, CY, U_MIN, U_MAX, V_MIN, V_MAX, X_MIN, X_MAX, Y_MIN, Y_MAX, EYE_X, EYE_Y, EYE_Z = range(12, 27)


@dataclass(frozen=True)
class StepSizes:
    """What a step in all colours of a view works with (native/rendering/color_rounds.h)."""

    sums: int = 4
    """Columns that it sums per pair of a Gaussian and a tile."""
    tile_weights: int = 1 << 18
    """Weights of one tile's pixels that a thread keeps: 1 MiB in float32, what a core has near it."""
    tile_groups: int = 1 << 14
    """Groups of these: one per batch of 64 list entries, and one per vector of pixels in it."""


STEP_SIZES = StepSizes()


@dataclass(frozen=True)
class ListSizes:
    """What lists of tiles are made with (native/rendering/tile_binning.h)."""

    pairs_at_once: int = 4
    """Pairs that are written at once, of which the last may be none: as many places each share has to spare."""


LIST_SIZES = ListSizes()


def camera_vector(camera: Camera, window: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """[27] what kernels need of a camera. window: [4] x0, x1, y0, y1 in pixels; Gaussians that miss it are dropped."""
    c = camera
    mx, my = JACOBIAN_MARGIN * c.width / c.fx, JACOBIAN_MARGIN * c.height / c.fy
    u_bounds = -c.cx / c.fx - mx, (c.width - c.cx) / c.fx + mx
    v_bounds = -c.cy / c.fy - my, (c.height - c.cy) / c.fy + my
    lens = (c.fx, c.fy, c.cx, c.cy, *u_bounds, *v_bounds)
    out = np.concatenate([c.world_to_camera[:3, :3].ravel(), c.world_to_camera[:3, 3], lens, window, c.position])
    with np.errstate(over="ignore"):  # a camera beyond float32 sees nothing
        out = out.astype(dtype)
    out.flags.writeable = False
    return out
