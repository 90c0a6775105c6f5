"""The colour of a captured light, as reflections have it: what is no metal reflects light without a colour of its own
(Lee 1986, "Method for computing the scene-illuminant chromaticity from specular highlights").

Of what is view dependent in an asset only that is taken which moves with the surface as a mirror image of the light
does, over lines of sight from which the surface can be seen. In most assets this is a few per cent of their light, and
what a fit left of too few views is more: so one number for each channel is asked of all Gaussians together, and places
of the asset that disagree say how far to believe it. Dark materials tell most, as there the same light is more of a
display colour. N Gaussians.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.color import base_color, display_slope, luminance, to_light
from splatpainter.kernels import portable
from splatpainter.lights.irradiance import LitSurface
from splatpainter.lights.mirror_images import MIRROR, mirror_image
from splatpainter.order_statistics import groups, quantile, row_keys
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import fibonacci_sphere, row_norm, sh_basis


@dataclass(frozen=True)
class HighlightThresholds:
    """Of what bears witness. Chosen on fitted assets of tuning meshes (`bench light --tuning`, seeds 5 and 6)."""

    most: int = 16_384
    """Gaussians that are asked: every K-th of more."""
    darkest: float = 0.003
    """Linear colour of the brightest channel from which Gaussians bear witness."""
    brightest: float = 0.9
    """The same of all channels, up to which: beyond, highlights clip."""
    usual: float = 0.9
    """Share of Gaussians whose view dependence counts in full; that of others is cut to the largest of these."""
    cell: float = 0.35
    """Edge of the places that agree or not, in rms distances of the asset from its middle."""
    min_cells: int = 12
    """Places, at least."""
    signal: float = 4.0
    """Standard errors of luminance from which there is a mirror image at all. With 2 hues are known as well in the
    mean, and single ones are led astray."""
    sides: tuple[tuple[float, float], tuple[float, float]] = ((0.0152, -0.0164), (-0.0164, 0.0264))
    """Covariance of what the light's brighter side, which highlights show, differs by from its mean, in natural
    logarithms of red and blue over green: 40 photographed environments."""
    metals: float = 0.1
    """Standard deviation of either logarithm, as some materials colour what they reflect. 0.05 to 0.2 are as good."""


HIGHLIGHT = HighlightThresholds()


@dataclass(frozen=True)
class HighlightColor:
    """How much of a light's mirror image there is in the view dependence of an asset."""

    color: np.ndarray
    """[3] float64 linear, for each channel."""
    covariance: np.ndarray
    """[3, 3] float64, of its error."""

    def log_chance(self, hues: np.ndarray) -> np.ndarray:
        """[M] logarithms of how likely this is of lights of hues [M, 2], natural logarithms of red and blue over green,
        up to a constant. However bright the image is: the best level counts, and there is no negative one."""
        colors = np.stack([portable.exp(hues[:, 0]), np.ones(len(hues)), portable.exp(hues[:, 1])], 1)
        (red, both), (_, blue) = HIGHLIGHT.sides
        unsaid = np.array([[red, 0, both], [0, 0, 0], [both, 0, blue]]) + HIGHLIGHT.metals**2 * np.diag([1, 0, 1])
        precision = portable.inverse(self.covariance + unsaid * float(luminance(self.color)) ** 2)
        weighed = portable.matmul(colors, precision)
        along = np.maximum(portable.matmul(weighed, self.color[:, None])[:, 0], 0)
        best = along * along / (weighed * colors).sum(1)
        apart = portable.dot(self.color, portable.matmul(precision, self.color[:, None])[:, 0]) - best
        return -apart / 2


def sampled_bands(splats: Splats) -> np.ndarray:
    """[M, K, 3] the view dependence that `highlight_color` looks at."""
    return splats.sh[:: _stride(splats), 1:9]


def highlight_color(splats: Splats, surface: LitSurface, light: np.ndarray) -> HighlightColor | None:
    """Of the light that an asset was captured in. light: [9] SH of its luminance, as far as it is told; None where no
    mirror image of it can be told from noise."""
    seen = _witnesses(splats, surface)
    if splats.sh.shape[1] < 4 or len(seen) < HIGHLIGHT.min_cells:
        return None
    agreement, power = _likeness(splats, surface, light, seen)
    cells = _cells_of(splats.means[seen])
    count = int(cells.max()) + 1
    total = float(np.bincount(cells, power, count).sum())
    if count < HIGHLIGHT.min_cells or not total > 0:
        return None
    by_cell = np.stack([np.bincount(cells, column, count) for column in agreement.T], 1)
    shares = by_cell.sum(0) / total
    # Errors of neighbours are one error: the variance is that of sums over places (White 1980, by clusters).
    rest = by_cell - shares * np.bincount(cells, power, count)[:, None]
    covariance = portable.matmul(rest.T, rest) / total**2
    weights = luminance(np.eye(3))
    variance = portable.dot(weights, portable.matmul(covariance, weights[:, None])[:, 0])
    if not luminance(shares) > HIGHLIGHT.signal * math.sqrt(variance):
        return None
    return HighlightColor(shares, covariance)


def _stride(splats: Splats) -> int:
    return max(1, len(splats) // HIGHLIGHT.most)


def _witnesses(splats: Splats, surface: LitSurface) -> np.ndarray:
    """[M] int64 of Gaussians that are seen, and neither black nor clipped."""
    rows = np.arange(0, len(splats), _stride(splats))
    rows = rows[splats.drawable[rows] & (surface.facing.seen[rows] > 0)]
    base = to_light(np.maximum(base_color(splats.sh[rows]), 0), splats.color_space).max(1)
    return rows[(base > HIGHLIGHT.darkest) & (base < HIGHLIGHT.brightest)]


def _likeness(
    splats: Splats, surface: LitSurface, light: np.ndarray, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """([M, 3] covariance of view dependence and mirrored light over the lines of sight to a Gaussian, [M] variance of
    the mirrored light), weighed by what is seen of it and by what noise its colour has in linear light."""
    towards = fibonacci_sphere(MIRROR.directions)
    normals = surface.facing.normals[seen].astype(np.float64)
    sh = splats.sh[seen, :9].astype(np.float64)
    basis = sh_basis(towards, 2)[:, 1 : sh.shape[1]]
    base = to_light(np.maximum(base_color(sh), 0), splats.color_space)
    slope = display_slope(base, splats.color_space)
    bands = sh[:, 1:]
    loud = row_norm(bands.reshape(len(seen), -1))
    bands = bands * np.minimum(1, quantile(loud, HIGHLIGHT.usual) / np.maximum(loud, 1e-12))[:, None, None]
    theirs, visible = mirror_image(light, normals, basis, towards)
    weights = surface.facing.seen[seen].astype(np.float64) * np.square(luminance(slope))
    agreement = np.stack(
        [(visible * portable.matmul(bands[..., k], basis.T) * theirs).sum(1) / slope[:, k] for k in range(3)], 1
    )
    return weights[:, None] * agreement, weights * (visible * theirs * theirs).sum(1)


def _cells_of(points: np.ndarray) -> np.ndarray:
    """[M] int64 numbers of the cells in which points [M, 3] lie."""
    moved = points.astype(np.float64) - points.astype(np.float64).mean(0)
    extent = max(float(np.sqrt(portable.mean((moved * moved).sum(1)))), 1e-30)
    # Far outliers share the outermost cells; cells off the origin, about which many assets are symmetric.
    return groups(row_keys(np.floor(moved / (HIGHLIGHT.cell * extent) + 0.37).clip(-512, 511)))[1]
