"""What a Gaussian looks like, in numbers by which materials are told apart: its colour, the colours around it, and how
much they vary (texture), in units of what usually differs between two materials.

Lightness counts little, because light and shade are in it; chroma over lightness counts, because white light leaves it
as it is. M Gaussians that can be drawn.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from splatpainter.color import base_color, oklab, to_display
from splatpainter.splats import Splats
from splatpainter.spread.nearest_neighbours import neighbours, weighted_means

LIGHTNESS, CHROMA, TEXTURE = 0.2, 0.08, 0.1
"""OKLab lightness, chroma over lightness, and their standard deviations that are one unit."""
CHROMA_LIGHTNESS_OFFSET = 0.08
"""Added to the lightness that chroma is divided by: the hue of what is nearly black is noise."""
ITSELF, NEAR, AROUND, VARIATION = 0.5, 1.0, 0.5, 0.5
"""Weights: of a Gaussian's colour, of the mean over its neighbours and over theirs, and of the texture."""
DESCRIPTOR_CHANNELS = 15
"""Numbers per Gaussian."""


@dataclass(frozen=True)
class Descriptors:
    """Descriptors of M Gaussians."""

    values: np.ndarray = field(repr=False)
    """[M, DESCRIPTOR_CHANNELS] float32."""
    near: np.ndarray = field(repr=False)
    """[M, COUNT] int32 neighbours."""
    colors: np.ndarray = field(repr=False)
    """[M, 3] float32 mean colour over the neighbours, in units."""
    weights: np.ndarray = field(repr=False)
    """[M] float32 opacity times area."""

    @staticmethod
    def of(splats: Splats) -> Descriptors:
        """splats: numpy, all drawable."""
        colors = to_display(np.clip(base_color(splats.sh), 0, 1), splats.color_space)
        lab = oklab(colors)
        chroma = lab[:, 1:] / (lab[:, :1] + CHROMA_LIGHTNESS_OFFSET)
        scaled = np.concatenate([lab[:, :1] / LIGHTNESS, chroma / CHROMA], 1).astype(np.float32)
        ordered = np.sort(splats.scales, axis=1)
        weights = (splats.opacities * ordered[:, 1] * ordered[:, 2]).astype(np.float32)
        weights = np.maximum(weights / max(float(weights.max(initial=0)), 1e-30), np.float32(1e-9))
        near = neighbours(splats.means)
        close, deviation = weighted_means(scaled, weights, near[:, :8])
        mean, _ = weighted_means(scaled, weights, near)
        around, spread = weighted_means(mean, weights, near)
        per_texture = np.array([LIGHTNESS, CHROMA, CHROMA], np.float32) / TEXTURE
        values = np.concatenate(
            [
                ITSELF * scaled,
                NEAR * close,
                AROUND * around,
                VARIATION * per_texture * deviation,
                VARIATION * per_texture * spread,
            ],
            1,
        )
        return Descriptors(values.astype(np.float32), near, close, weights)
