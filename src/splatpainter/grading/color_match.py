"""Looks that are fitted to what they are applied to: the colours of a reference picture, and one new colour.

`ColorMatch` carries over mean and covariance by the linear Monge-Kantorovitch map (Pitie and Kokaram, "The Linear
Monge-Kantorovitch Linear Colour Mapping for Example-Based Colour Transfer", CVMP 2007): of all linear maps between two
Gaussian distributions the one that moves colours least,

    t(u) = T (u - m_u) + m_v,   T = A^(-1/2) (A^(1/2) B A^(1/2))^(1/2) A^(-1/2)

with A the covariance of the asset's colours and B that of the picture's, in display sRGB. The asset's are the base
colours of its Gaussians, each weighted by what views from all around show of it, so that what lies inside does not
count. `Recolor` gives everything one colour and keeps its light and shade.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import field

import numpy as np

from splatpainter.cameras import bounding_sphere, spherical_cameras
from splatpainter.color import base_color, linear_to_srgb, luminance, srgb_to_linear, to_display
from splatpainter.kernels import portable
from splatpainter.pictures.picture_reader import Picture
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.transforms import principal_axes

ColorMap = Callable[[np.ndarray], np.ndarray]
"""[..., 3] display colours 0..1 -> the like."""


@dataclass(frozen=True)
class ColorMatchThresholds:
    """How an asset's colours are matched to those of a picture. Source: taste."""

    noise: float = 4 / 255
    """Standard deviation that is added to both distributions: a flat one has no spread that could be stretched."""
    min_alpha: float = 0.5
    """Pixels of a reference picture with less alpha do not count."""
    max_pixels: int = 1 << 20
    """Most pixels of a reference picture that are looked at; of larger ones every n-th row and column."""
    views: int = 24
    """Views around an asset that say what is seen of it."""
    view_px: int = 192
    """Pixels of their sides."""
    min_luminance: float = 1e-3
    """Least luminance of what is given a new colour, in linear light: black has no light and shade that could be
    kept."""


MATCHING = ColorMatchThresholds()


@dataclass(frozen=True)
class AffineMap:
    """Display colours, moved by a matrix from one mean to another."""

    matrix: np.ndarray
    """[3, 3] from the right."""
    start: np.ndarray
    """[3] mean of the colours before the match."""
    end: np.ndarray
    """[3] mean of the colours after it."""

    def __call__(self, colors: np.ndarray) -> np.ndarray:
        matrix, start, end = (values.astype(np.float32) for values in (self.matrix, self.start, self.end))
        return (portable.matmul(colors - start, matrix) + end).clip(0, 1)


@dataclass(frozen=True)
class NewColor:
    """One display colour under the light and shade of what is there."""

    target: tuple[float, float, float]
    mean: float
    """Linear luminance of what is there, which becomes that of the target."""

    def __call__(self, colors: np.ndarray) -> np.ndarray:
        paint = srgb_to_linear(np.asarray(self.target, np.float32))
        shade = luminance(srgb_to_linear(colors.clip(0, 1)))[..., None] / np.float32(self.mean)
        return linear_to_srgb((shade * paint).clip(0, 1)).astype(np.float32)


@dataclass(frozen=True)
class ColorMatch:
    """The colour statistics of a reference picture."""

    picture: Picture = field(repr=False)
    name: str = "picture"

    def fit(self, colors: np.ndarray, weights: np.ndarray) -> AffineMap:
        """colors: [N, 3] display colours of what is to change, weights: [N] how much each of them counts.
        Raises ValueError: nothing of the picture is opaque."""
        height, width = self.picture.colors.shape[:2]
        step = max(1, math.ceil(math.sqrt(height * width / MATCHING.max_pixels)))
        # Statistics of a million pixels are those of fifty million.
        pixels = self.picture.colors[::step, ::step].reshape(-1, 3)
        alpha = self.picture.alpha
        share = np.ones(len(pixels)) if alpha is None else alpha[::step, ::step].reshape(-1).astype(np.float64)
        share[share < MATCHING.min_alpha] = 0
        if not share.sum() > 0:
            raise ValueError(f"{self.name}: expected a reference picture of which something is opaque")
        # What the asset shows against what the picture shows.
        mean, covariance = statistics(colors, weights)
        target_mean, target_covariance = statistics(pixels, share)
        return AffineMap(monge_kantorovitch(covariance, target_covariance), mean, target_mean)

    def describe(self) -> str:
        return f"colours of {self.name}"


@dataclass(frozen=True)
class Recolor:
    """One new colour: the hue and saturation of `target`, and of what is there its luminance, relative to the mean."""

    target: tuple[float, float, float]
    """Display colour 0..1."""

    def fit(self, colors: np.ndarray, weights: np.ndarray) -> NewColor:
        """As ColorMatch.fit. Raises ValueError: what is to change is black."""
        # Shade is luminance over its mean; the new colour takes the place of that mean.
        light = luminance(srgb_to_linear(colors.clip(0, 1).astype(np.float64)))
        mean = float(portable.total(light * weights) / max(portable.total(weights), 1e-12))
        if mean < MATCHING.min_luminance:
            raise ValueError("recolor: expected something brighter than black; raise its exposure first")
        return NewColor(self.target, mean)

    def describe(self) -> str:
        return "colour #" + "".join(f"{round(255 * value):02x}" for value in self.target)


def statistics(colors: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """([3] mean, [3, 3] covariance) float64 of colours [N, 3] with weights [N] >= 0, not all 0."""
    share = weights.astype(np.float64) / portable.total(weights, np.float64)
    mean = portable.transposed_product(colors.astype(np.float64), share[:, None])[:, 0]
    centred = colors - mean
    return mean, portable.gram(centred, share)


def monge_kantorovitch(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[3, 3] symmetric: the linear map from a covariance to another, each with MATCHING.noise added."""
    noise = MATCHING.noise**2 * np.eye(3)
    # The closed form of the optimal map between two Gaussians; noise keeps flat ones invertible.
    root = _power(source + noise, 0.5)
    inverse = _power(source + noise, -0.5)
    middle = _power(portable.matmul(portable.matmul(root, target + noise), root), 0.5)
    return portable.matmul(portable.matmul(inverse, middle), inverse)


def _power(matrix: np.ndarray, exponent: float) -> np.ndarray:
    """Power of a symmetric positive matrix."""
    values, vectors = (of[0] for of in principal_axes((matrix + matrix.T)[None] / 2))
    return portable.matmul(vectors * portable.power(np.maximum(values, 1e-12), exponent), vectors.T)


def display_colors(splats: Splats) -> np.ndarray:
    """[N, 3] float32 base colours 0..1 as a picture shows them; of Gaussians that cannot be drawn too."""
    with np.errstate(over="ignore", invalid="ignore"):
        base = np.clip(np.nan_to_num(base_color(splats.sh)), 0, 1).astype(np.float32)
    return to_display(base, splats.color_space)


def seen_weights(splats: Splats) -> np.ndarray:
    """[N] float64 pixels that show each Gaussian in MATCHING.views views from all around."""
    from splatpainter.rendering.cpu.projected_view import project

    # Views from all around say how much of each Gaussian anybody sees.
    center, radius = bounding_sphere(splats)
    weights = np.zeros(len(splats))
    black, everywhere = (
        np.zeros((MATCHING.view_px, MATCHING.view_px, 3), np.float32),
        np.ones((MATCHING.view_px, MATCHING.view_px), np.float32),
    )
    for camera in spherical_cameras(center, 3.2 * radius, MATCHING.views, size=MATCHING.view_px):
        view = project(splats, camera.local)
        weights[view.gaussian_ids] += view.backproject(black, everywhere).weight
    return weights
