"""Real spherical harmonics up to degree 4 in INRIA's order and signs, and the derivative of a weighted sum of them.

The polynomials are those of Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013), as gsplat uses them.
"""

from __future__ import annotations

from splatpainter.kernels.simd import device


@device
def sh_basis(x, y, z, degree, b):
    """b[k] = Y_k(x, y, z) for a unit direction; fills (degree + 1)^2 entries of b [25]."""
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
def sh_slope(x, y, z, degree, v):
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
