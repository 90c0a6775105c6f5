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
from splatpainter.lights.mirror_images import MIRROR, mirror_image
from splatpainter.lights.source_light import SourceLight
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere, sh_basis


@dataclass(frozen=True)
class GlossThresholds:
    """Of the regression. Source: balls that reflect by Phong's lobes, matte to metal, under eight pairs of skies, SH
    with and without noise, where an entry says no more."""

    neighbourhood: float = 0.5
    """Edge of the cells in which Gaussians of one colour share their gloss, in rms distances of the asset from its
    middle. With 0.25 relit balls of 600 Gaussians lose 0.9 dB, with 1 they gain 0.2."""
    colors: float = 0.2
    """Width of a colour, per channel, display units."""
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
    towards = fibonacci_sphere(MIRROR.directions)
    basis = sh_basis(towards, 2)[:, 1:]
    response = np.array([MIRROR.bands[1]] * 3 + [MIRROR.bands[2]] * 5)
    light = luminance(before.coefficients)
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
        theirs, visible = mirror_image(light, normals, basis, towards)
        ours = portable.matmul(bands, basis.T)
        ours = ours - (visible * ours).sum(1, keepdims=True)
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
