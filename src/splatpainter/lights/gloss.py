"""How glossy an asset is: which part of its view dependence is the mirror image of the light that it was captured in.

SH of a fitted asset hold reflections, and what the fit left of too few views. A reflection moves with the surface's
normal as the light's mirror image does, alike in all of a material; what is left over does not, and is as large in one
Gaussian as in the next. So gloss is regressed over neighbours of one colour, in linear light and where a surface can be
seen at all, and only where they agree beyond chance. N Gaussians.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.color import base_color, display_slope, luminance, to_light
from splatpainter.kernels import portable
from splatpainter.kernels.parallel import each
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.source_light import SourceLight
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere, sh_basis

SH_PRODUCT, SH_ZZ, SH_SQUARES = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
"""Of the functions of band 2, as in `transforms.sh_basis`."""


@dataclass(frozen=True)
class GlossThresholds:
    """Of the regression. Source: balls that reflect by Phong's lobes, matte to metal, under eight pairs of skies, SH
    with and without noise, where an entry says no more."""

    bands: tuple[float, float, float] = (1.0, 1.0, 0.8)
    """What a gloss leaves of the light's bands 0 to 2; exponents 6 to 30 differ by 0.2 dB."""
    neighbourhood: float = 0.5
    """Edge of the cells in which Gaussians of one colour share their gloss, in rms distances of the asset from its
    middle. With 0.25 relit balls of 600 Gaussians lose 0.9 dB, with 1 they gain 0.2."""
    colors: float = 0.2
    """Width of a colour, per channel, display units."""
    directions: int = 32
    """Lines of sight over which view dependence is compared."""
    grazing: float = 0.15
    """Cosine to the normal up to which a line of sight does not count: few views hold it."""
    doubt: float = 2.0
    """Standard errors of a regression that are no gloss. With 1 or 3 the same."""
    min_members: int = 4
    """Gaussians of a neighbourhood, at least."""
    faintest: float = 0.02
    """Variance of the mirrored light over lines of sight, up to which it tells less of gloss; a sixth of what SH of
    noise with a standard deviation of 0.06 have."""
    most: float = 0.8
    """Share of a Gaussian's light that may be gloss."""
    piece: int = 8192
    """Gaussians whose mirrored light is computed at a time."""


GLOSS = GlossThresholds()


def gloss_of(splats: Splats, surface: LitSurface, before: SourceLight) -> Floats:
    """[N] float64 0..1 share of the mirrored light that Gaussians send back, in linear light; 0 where there is no
    telling. before: what they were captured in; the less sure it is, the less gloss is found."""
    out = np.zeros(len(splats))
    if splats.sh.shape[1] < 9:  # one band of a light that nobody knows well is too little to tell gloss by
        return out
    seen = np.flatnonzero(splats.drawable & (surface.facing.seen > 0))
    agreement, power = _compared(splats, surface, before, seen)
    # Regression in each neighbourhood, by what is seen of its Gaussians; chance is what they disagree by.
    groups = _neighbourhoods(splats, seen)
    weights = surface.facing.seen[seen].astype(np.float64)
    total = np.bincount(groups, weights * power)
    gloss = np.bincount(groups, weights * agreement) / total
    rest = weights * (agreement - gloss[groups] * power)
    chance = np.sqrt(np.bincount(groups, rest * rest)) / total
    # As Stein's estimators shrink: what lies within chance is nothing, what lies far beyond is left as it is.
    surplus = np.maximum(1 - (GLOSS.doubt * chance / np.maximum(gloss, 1e-12)) ** 2, 0)
    certain = np.bincount(groups) >= GLOSS.min_members
    out[seen] = (np.clip(gloss * surplus, 0, 1) * certain)[groups]
    return out


def _compared(splats: Splats, surface: LitSurface, before: SourceLight, rows: np.ndarray) -> tuple[Floats, Floats]:
    """([M] covariance of view dependence and mirrored light over the lines of sight to a Gaussian, [M] variance of the
    mirrored light, with its doubt), of luminance, linear."""
    towards = fibonacci_sphere(GLOSS.directions)
    basis = sh_basis(towards, 2)[:, 1:]
    response = np.array([GLOSS.bands[1]] * 3 + [GLOSS.bands[2]] * 5)
    light = luminance(before.coefficients)[:, None]
    # Of an irradiance that is wrong by `uncertainty` each coefficient is wrong by as much, in the mean of normals.
    cosine_lobe = 3 * (2 / 3) ** 2 + 5 * (1 / 4) ** 2
    variance = before.uncertainty**2 * 4 * math.pi / cosine_lobe
    doubt = variance * float(portable.total(response * response)) / (4 * math.pi)
    agreement, power = np.empty(len(rows)), np.empty(len(rows))

    def compare(first: int) -> None:
        chosen = rows[first : first + GLOSS.piece]
        normals = surface.facing.normals[chosen].astype(np.float64)
        sh = splats.sh[chosen, :9].astype(np.float64)
        base = to_light(np.maximum(base_color(sh), 0), splats.color_space)
        bands = luminance(sh[:, 1:] / display_slope(base, splats.color_space)[:, None])
        mirrored = mirrored_light(light, normals)[:, 1:, 0] * response
        # Only lines of sight from which the surface can be seen, and their mean is no view dependence.
        visible = (portable.matmul(normals, towards.T) < -GLOSS.grazing).astype(np.float64)
        visible /= np.maximum(visible.sum(1, keepdims=True), 1)
        ours, theirs = portable.matmul(bands, basis.T), portable.matmul(mirrored, basis.T)
        ours = ours - (visible * ours).sum(1, keepdims=True)
        theirs = theirs - (visible * theirs).sum(1, keepdims=True)
        part = slice(first, first + len(chosen))
        agreement[part] = (visible * ours * theirs).sum(1)
        power[part] = (visible * theirs * theirs).sum(1)

    each(compare, range(0, len(rows), GLOSS.piece))
    # Least squares in the mean of all lights that it may have been: a doubtful one explains less.
    return agreement, power + doubt + GLOSS.faintest


def _neighbourhoods(splats: Splats, rows: np.ndarray) -> np.ndarray:
    """[M] int64 numbers of those that share a place and a colour."""
    moved = splats.means[rows].astype(np.float64)
    moved = moved - moved.mean(0)
    extent = max(float(np.sqrt(portable.mean((moved * moved).sum(1)))), 1e-30)
    # Cells off the origin, about which many assets are symmetric. Far outliers share the outermost cells.
    cells = np.floor(moved / (GLOSS.neighbourhood * extent) + 0.37).clip(-512, 511).astype(np.int64) + 512
    colors = np.floor(base_color(splats.sh[rows]) / GLOSS.colors).clip(0, 15).astype(np.int64)
    key = np.zeros(len(rows), np.int64)
    for column, size in (*((cells[:, k], 1024) for k in range(3)), *((colors[:, k], 16) for k in range(3))):
        key = key * size + column
    return np.unique(key, return_inverse=True)[1].reshape(-1)


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
