"""What a mirror image of a light looks like from the lines of sight to a Gaussian, in SH up to degree 2. Where view
dependence moves with the surface's normal as this does, it is a reflection. N Gaussians, M of them."""

from __future__ import annotations

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.kernels import portable
from splatpainter.system.quick_dataclass import dataclass

SH_PRODUCT, SH_ZZ, SH_SQUARES = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
"""Of the functions of band 2, as in `transforms.sh_basis`."""


@dataclass(frozen=True)
class MirrorThresholds:
    """Of mirror images. Source: balls that reflect by Phong's lobes, matte to metal, under eight pairs of skies, SH
    with and without noise, where an entry says no more."""

    bands: tuple[float, float, float] = (1.0, 1.0, 0.8)
    """What a gloss leaves of the light's bands 0 to 2; exponents 6 to 30 differ by 0.2 dB."""
    directions: int = 32
    """Lines of sight over which view dependence is compared."""
    grazing: float = 0.15
    """Cosine to the normal up to which a line of sight does not count: few views hold it."""


MIRROR = MirrorThresholds()


def mirror_image(
    light: np.ndarray, normals: np.ndarray, basis: np.ndarray, towards: np.ndarray
) -> tuple[Floats, Floats]:
    """([M, V] what a mirror with each normal [M, 3] shows of a light along lines of sight [V, 3], less its mean, as a
    mean is no view dependence; [M, V] their weights, of sum 1, 0 where the surface cannot be seen). light: [9] SH;
    basis: [V, K] functions 1 to K of `sh_basis` along them, 3 or 8."""
    bands = basis.shape[1]
    response = np.array([MIRROR.bands[1]] * 3 + [MIRROR.bands[2]] * 5)[:bands]
    mirrored = mirrored_light(light[:, None], normals)[:, 1 : bands + 1, 0] * response
    visible = (portable.matmul(normals, towards.T) < -MIRROR.grazing).astype(np.float64)
    visible /= np.maximum(visible.sum(1, keepdims=True), 1)
    image = portable.matmul(mirrored, basis.T)
    return image - (visible * image).sum(1, keepdims=True), visible


def mirrored_light(coefficients: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """[M, 9, C] SH of the light [9, C] that a mirror with each normal [M, 3] shows along a line of sight d: that of
    direction d - 2 (n . d) n. Band 1 is a vector v (v . d), band 2 a symmetric matrix Q (d . Q d): the mirror, its own
    inverse, turns them to v - 2 (n . v) n and Q - 2 n (Q n)' - 2 (Q n) n' + 4 (n . Q n) n n'."""
    out = np.empty((len(normals), 9, coefficients.shape[1]))
    out[:, 0] = coefficients[0]
    n = normals.T[..., None]  # its components [3, M, 1] against the channels [C]
    v = coefficients[[3, 1, 2]] * np.array([[-1.0], [-1.0], [1.0]])
    along = 2 * (n[0] * v[0] + n[1] * v[1] + n[2] * v[2])
    for row, axis, sign in ((1, 1, -1), (2, 2, 1), (3, 0, -1)):
        out[:, row] = sign * (v[axis] - along * n[axis])
    xy, yz, zz, xz, squares = coefficients[4:]
    # In units in which the five functions are xy, -yz, 2 zz - xx - yy, -xz and xx - yy.
    diagonal = (SH_SQUARES * squares - SH_ZZ * zz, -SH_SQUARES * squares - SH_ZZ * zz, 2 * SH_ZZ * zz)
    xy, yz, xz = SH_PRODUCT / 2 * xy, -SH_PRODUCT / 2 * yz, -SH_PRODUCT / 2 * xz
    q = (
        diagonal[0] * n[0] + xy * n[1] + xz * n[2],
        xy * n[0] + diagonal[1] * n[1] + yz * n[2],
        xz * n[0] + yz * n[1] + diagonal[2] * n[2],
    )
    twice = 2 * (n[0] * q[0] + n[1] * q[1] + n[2] * q[2])
    bent = [2 * (q[axis] - twice * n[axis] / 2) for axis in range(3)]  # 2 Q n - 2 (n . Q n) n: half for either side
    out[:, 4] = (xy - n[0] * bent[1] - bent[0] * n[1]) * (2 / SH_PRODUCT)
    out[:, 5] = (yz - n[1] * bent[2] - bent[1] * n[2]) * (-2 / SH_PRODUCT)
    out[:, 6] = (diagonal[2] - 2 * n[2] * bent[2]) / (2 * SH_ZZ)
    out[:, 7] = (xz - n[0] * bent[2] - bent[0] * n[2]) * (-2 / SH_PRODUCT)
    out[:, 8] = (diagonal[0] - diagonal[1] - 2 * (n[0] * bent[0] - n[1] * bent[1])) / (2 * SH_SQUARES)
    return out
