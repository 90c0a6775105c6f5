"""One Gaussian seen by one camera: what projection and its derivative both need. Knows no lists and no pixels.

EWA splatting (Zwicker et al. 2001) as in Kerbl et al. 2023: cov2d = (J W R S)(J W R S)^T + 0.3 I.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.simd import device, strict
from splatpainter.rendering.profiles import JACOBIAN_MARGIN
from splatpainter.splats import MAX_MAGNITUDE, MIN_QUAT

TILE = 16
"""Tile side, pixels."""

# Columns of `projected` [M, 16]: one Gaussian of one view, 16 numbers = one cache line in float32.
MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, OPACITY, RED, GREEN, BLUE, DEPTH, EXTENT_Y, EXTENT_X = range(12)
SQUARED_RADIUS, UNCLAMPED_RED, UNCLAMPED_GREEN, UNCLAMPED_BLUE = range(12, 16)
COLUMNS = 16
"""Mean (px); conic A, B, C (sigma = A dx^2 / 2 + B dx dy + C dy^2 / 2); opacity; colour >= 0; z; half extents of the
drawn ellipse (px); its squared radius in standard deviations; the colour before it is clamped at 0."""

# Columns of the camera vector [27], after the rotation, row by row (0..8), and the translation (9..11): focal lengths
# and principal point (px); bounds of x / z and y / z for Jacobians; window (px); camera centre (world units).
FX, FY, CX, CY, U_MIN, U_MAX, V_MIN, V_MAX, X_MIN, X_MAX, Y_MIN, Y_MAX, EYE_X, EYE_Y, EYE_Z = range(12, 27)


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


@device
def to_camera(cam, px, py, pz):
    """World point -> camera axes."""
    x = cam[0] * px + cam[1] * py + cam[2] * pz + cam[9]
    y = cam[3] * px + cam[4] * py + cam[5] * pz + cam[10]
    z = cam[6] * px + cam[7] * py + cam[8] * pz + cam[11]
    return x, y, z


@device
def jacobian(cam, u, v, rz):
    """Jacobian of the pixel with respect to the camera-space point, at (u, v) = (x, y) / z clamped to a little outside
    the picture (a linearisation far outside explodes): j00, j02, j11, j12 and the clamped u, v."""
    uc = min(max(u, cam[U_MIN]), cam[U_MAX])
    vc = min(max(v, cam[V_MIN]), cam[V_MAX])
    j00 = cam[FX] * rz
    j11 = cam[FY] * rz
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
    """Whether a Gaussian's mean and quaternion are in the ranges of Splats.drawable; NaN is not."""
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
def tile_columns(mx, my, a, b, q, ex, ey, y0, first, last):
    """Tiles [begin, end) of the tile row that starts at pixel y0 which the ellipse touches, within [first, last), its
    tile_span: rounding must not find a tile outside the bounding box, for which no room was made.

    For dy in the row's band the ellipse's right edge is slope dy + width sqrt(1 - (dy / ey)^2), widest at dy = star.
    Exact arithmetic, because counting and listing the tiles of a row happen in two kernels that must agree.
    """
    F = type(mx)
    zero = F(0)
    one = F(1)
    slope = -b / a
    width = math.sqrt(q / a)
    star = slope * ey * ey / ex
    shrink = one / ey
    low = max(y0 - my, -ey)
    high = min(y0 + F(TILE) - my, ey)
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


@device
def sh_basis(x, y, z, degree, b):
    """b[k] = Y_k(x, y, z), the real spherical harmonics in INRIA's order and signs, for a unit direction; fills
    (degree + 1)^2 entries of b [25]. Polynomials of Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013)."""
    F = b.dtype.type
    b[0] = F(0.2820947917738781)
    if degree < 1:
        return
    b[1] = F(-0.48860251190292) * y
    b[2] = F(0.48860251190292) * z
    b[3] = F(-0.48860251190292) * x
    if degree < 2:
        return
    zz = z * z
    c1 = x * x - y * y
    s1 = F(2) * x * y
    b[4] = F(0.5462742152960395) * s1
    b[5] = F(-1.092548430592079) * z * y
    b[6] = F(0.9461746957575601) * zz - F(0.3153915652525201)
    b[7] = F(-1.092548430592079) * z * x
    b[8] = F(0.5462742152960395) * c1
    if degree < 3:
        return
    linear = F(-2.285228997322329) * zz + F(0.4570457994644658)
    c2 = x * c1 - y * s1
    s2 = x * s1 + y * c1
    b[9] = F(-0.5900435899266435) * s2
    b[10] = F(1.445305721320277) * z * s1
    b[11] = linear * y
    b[12] = z * (F(1.865881662950577) * zz - F(1.119528997770346))
    b[13] = linear * x
    b[14] = F(1.445305721320277) * z * c1
    b[15] = F(-0.5900435899266435) * c2
    if degree < 4:
        return
    cubic = z * (F(-4.683325804901025) * zz + F(2.007139630671868))
    square = F(3.31161143515146) * zz - F(0.47308734787878)
    c3 = x * c2 - y * s2
    s3 = x * s2 + y * c2
    b[16] = F(0.6258357354491763) * s3
    b[17] = F(-1.770130769779931) * z * s2
    b[18] = square * s1
    b[19] = cubic * y
    b[20] = F(1.984313483298443) * z * b[12] - F(1.006230589874905) * b[6]
    b[21] = cubic * x
    b[22] = square * c1
    b[23] = F(-1.770130769779931) * z * c2
    b[24] = F(0.6258357354491763) * c3


@device
def sh_gradient(x, y, z, degree, v):
    """Gradient of sum_k v[k] Y_k with respect to (x, y, z), before projection onto the unit sphere."""
    F = v.dtype.type
    gx = F(0)
    gy = F(0)
    gz = F(0)
    if degree < 1:
        return gx, gy, gz
    k1 = F(0.48860251190292)
    gy -= k1 * v[1]
    gz += k1 * v[2]
    gx -= k1 * v[3]
    if degree < 2:
        return gx, gy, gz
    c1 = x * x - y * y
    s1 = F(2) * x * y
    k2 = F(2 * 0.5462742152960395)
    k3 = F(1.092548430592079)
    gx += k2 * (y * v[4] + x * v[8]) - k3 * z * v[7]
    gy += k2 * (x * v[4] - y * v[8]) - k3 * z * v[5]
    gz += F(2 * 0.9461746957575601) * z * v[6] - k3 * (y * v[5] + x * v[7])
    if degree < 3:
        return gx, gy, gz
    zz = z * z
    k4 = F(3 * 0.5900435899266435)
    k5 = F(1.445305721320277)
    linear = F(-2.285228997322329) * zz + F(0.4570457994644658)
    c2 = x * c1 - y * s1
    s2 = x * s1 + y * c1
    d12 = F(3 * 1.865881662950577) * zz - F(1.119528997770346)
    gx += F(2) * k5 * z * (y * v[10] + x * v[14]) - k4 * (s1 * v[9] + c1 * v[15]) + linear * v[13]
    gy += F(2) * k5 * z * (x * v[10] - y * v[14]) - k4 * (c1 * v[9] - s1 * v[15]) + linear * v[11]
    gz += k5 * (s1 * v[10] + c1 * v[14]) - F(2 * 2.285228997322329) * z * (y * v[11] + x * v[13]) + d12 * v[12]
    if degree < 4:
        return gx, gy, gz
    k6 = F(4 * 0.6258357354491763)
    k7 = F(1.770130769779931)
    cubic = z * (F(-4.683325804901025) * zz + F(2.007139630671868))
    dcubic = F(-3 * 4.683325804901025) * zz + F(2.007139630671868)
    square = F(3.31161143515146) * zz - F(0.47308734787878)
    b12 = z * (F(1.865881662950577) * zz - F(1.119528997770346))
    d20 = F(1.984313483298443) * (b12 + z * d12) - F(2 * 1.006230589874905 * 0.9461746957575601) * z
    gx += k6 * (s2 * v[16] + c2 * v[24]) - F(3) * k7 * z * (s1 * v[17] + c1 * v[23])
    gx += F(2) * square * (y * v[18] + x * v[22]) + cubic * v[21]
    gy += k6 * (c2 * v[16] - s2 * v[24]) - F(3) * k7 * z * (c1 * v[17] - s1 * v[23])
    gy += F(2) * square * (x * v[18] - y * v[22]) + cubic * v[19]
    gz += F(2 * 3.31161143515146) * z * (s1 * v[18] + c1 * v[22]) - k7 * (s2 * v[17] + c2 * v[23])
    gz += dcubic * (y * v[19] + x * v[21]) + d20 * v[20]
    return gx, gy, gz
