"""One row seen by one camera: the pieces that projection and its derivative both need. Knows no tiles and no pixels.

EWA splatting (Zwicker et al. 2001) as in Kerbl et al. 2023: cov2d = (J W R S)(J W R S)^T + 0.3 I.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.simd import MARGIN, TILE, device, strict
from splatpainter.splats import MAX_MAGNITUDE, MIN_QUAT

# Columns of the camera vector.
ROTATION, SHIFT, FOCAL, CENTER, LIMITS, WINDOW, POSITION, LENGTH = 0, 9, 12, 14, 16, 20, 24, 27


def camera_vector(camera: Camera, window: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """[27] what kernels need of a camera. window: [4] x0, x1, y0, y1 in pixels; rows that miss it are dropped."""
    c = camera
    out = np.empty(LENGTH)
    out[ROTATION:SHIFT] = c.world_to_camera[:3, :3].ravel()
    out[SHIFT:FOCAL] = c.world_to_camera[:3, 3]
    out[FOCAL:LIMITS] = c.fx, c.fy, c.cx, c.cy
    mx, my = MARGIN * c.width / c.fx, MARGIN * c.height / c.fy
    out[LIMITS:WINDOW] = (
        -c.cx / c.fx - mx,
        (c.width - c.cx) / c.fx + mx,
        -c.cy / c.fy - my,
        (c.height - c.cy) / c.fy + my,
    )
    out[WINDOW:POSITION] = window
    out[POSITION:] = c.position
    with np.errstate(over="ignore"):  # a camera beyond float32 sees nothing
        out = out.astype(dtype)
    out.flags.writeable = False
    return out


@device
def to_camera(cam, px, py, pz):
    """World point -> camera axes."""
    x = cam[0] * px + cam[1] * py + cam[2] * pz + cam[9]
    y = cam[3] * px + cam[4] * py + cam[5] * pz + cam[10]
    z = cam[6] * px + cam[7] * py + cam[8] * pz + cam[11]
    return x, y, z


@device
def jacobian(cam, u, v, rz):
    """Of the pixel with respect to the camera-space point, at (u, v) = (x, y) / z clamped to a little outside the
    picture (a linearisation far outside explodes): j00, j02, j11, j12 and the clamped u, v."""
    uc = min(max(u, cam[16]), cam[17])
    vc = min(max(v, cam[18]), cam[19])
    j00 = cam[12] * rz
    j11 = cam[13] * rz
    return j00, -j00 * uc, j11, -j11 * vc, uc, vc


@device
def to_world(cam, j00, j02, j11, j12):
    """J W, [2, 3]: of the pixel with respect to the world point."""
    return (
        j00 * cam[0] + j02 * cam[6],
        j00 * cam[1] + j02 * cam[7],
        j00 * cam[2] + j02 * cam[8],
        j11 * cam[3] + j12 * cam[6],
        j11 * cam[4] + j12 * cam[7],
        j11 * cam[5] + j12 * cam[8],
    )


@device
def unit_quat(w, x, y, z):
    """(w, x, y, z) / |q| and 1 / |q|, NaN for the zero quaternion. Scaled first: float32 squares of 1e-25 vanish."""
    one = type(w)(1)
    big = one / max(max(abs(w), abs(x)), max(abs(y), abs(z)))
    w *= big
    x *= big
    y *= big
    z *= big
    inverse = one / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse * big


@device
def rotation(w, x, y, z):
    """[3, 3] of a unit quaternion, row by row."""
    one = type(w)(1)
    two = type(w)(2)
    return (
        one - two * (y * y + z * z),
        two * (x * y - w * z),
        two * (x * z + w * y),
        two * (x * y + w * z),
        one - two * (x * x + z * z),
        two * (y * z - w * x),
        two * (x * z - w * y),
        two * (y * z + w * x),
        one - two * (x * x + y * y),
    )


@device
def project_axes(p00, p01, p02, p10, p11, p12, q):
    """P R, [2, 3]: the rotated axes in pixels per world unit. q: the nine entries of R."""
    return (
        p00 * q[0] + p01 * q[3] + p02 * q[6],
        p00 * q[1] + p01 * q[4] + p02 * q[7],
        p00 * q[2] + p01 * q[5] + p02 * q[8],
        p10 * q[0] + p11 * q[3] + p12 * q[6],
        p10 * q[1] + p11 * q[4] + p12 * q[7],
        p10 * q[2] + p11 * q[5] + p12 * q[8],
    )


@strict
def within_range(means, quats, n):
    """Whether a row's centre and quaternion are in the ranges of Splats.drawable; NaN is not."""
    F = means.dtype.type
    largest = F(MAX_MAGNITUDE)
    norm = max(max(abs(quats[n, 0]), abs(quats[n, 1])), max(abs(quats[n, 2]), abs(quats[n, 3])))
    if not (norm >= F(MIN_QUAT) and norm <= largest):
        return False
    return abs(means[n, 0]) <= largest and abs(means[n, 1]) <= largest and abs(means[n, 2]) <= largest


@device
def magnitude(values, n):
    """Sum of the magnitudes of values[n] ([N, C]); NaN where one is NaN."""
    total = values.dtype.type(0)
    for c in range(values.shape[1]):
        total += abs(values[n, c])
    return total


@strict
def clamped(x, last):
    """int(x) within [0, last], 0 for NaN. Clamped as a float: casts of what an integer cannot hold are undefined."""
    F = type(x)
    x = x if x > F(0) else F(0)
    return int(x if x < F(last) else F(last))


@strict
def tile_columns(mx, my, a, b, q, xe, ye, y0, first, last):
    """Tiles [begin, end) of the tile row that starts at pixel y0 which the ellipse touches, within [first, last), its
    tile_span: rounding must not find a tile outside the bounding box, for which no room was made.

    For dy in the row's band the ellipse's right edge is slope dy + width sqrt(1 - (dy / ye)^2), widest at dy = star.
    Exact arithmetic, because counting and listing the tiles of a row happen in two kernels that must agree.
    """
    F = type(mx)
    zero = F(0)
    one = F(1)
    slope = -b / a
    width = math.sqrt(q / a)
    star = slope * ye * ye / xe
    shrink = one / ye
    low = max(y0 - my, -ye)
    high = min(y0 + F(TILE) - my, ye)
    right = min(max(star, low), high)
    left = min(max(-star, low), high)
    up = right * shrink
    down = left * shrink
    x1 = mx + slope * right + width * math.sqrt(max(one - up * up, zero))
    x0 = mx + slope * left - width * math.sqrt(max(one - down * down, zero))
    begin = max(clamped(x0 * F(1 / TILE), last), first)
    return begin, clamped(x1 * F(1 / TILE) + one, last)


@strict
def tile_span(m, e, first, last):
    """Tiles [begin, end) which the interval [m - e, m + e] touches, within [first, last); never end < begin."""
    F = type(m)
    begin = max(clamped((m - e) * F(1 / TILE), last), first)
    return begin, max(clamped((m + e) * F(1 / TILE) + F(1), last), begin)
