"""What a Gaussian looks like, in numbers by which materials are told apart: its colour, the colours around it, and how
much they vary (texture), in units of what usually differs between two materials.

Lightness counts little, because light and shade are in it; chroma over lightness counts, because white light leaves it
as it is. M Gaussians that can be drawn.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np

from splatpainter.array_types import Floats, Ids
from splatpainter.color import base_color, oklab, to_display
from splatpainter.splats import Splats
from splatpainter.spread.nearest_neighbours import neighbours, weighted_means
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class DescriptorThresholds:
    """What a Gaussian's surroundings look like, in numbers of equal weight. Source: taste, tried on 14 training
    meshes."""

    lightness: float = 0.2
    """OKLab lightness that is one unit."""
    chroma: float = 0.08
    """Chroma over lightness that is one unit."""
    texture: float = 0.1
    """Standard deviation of either that is one unit."""
    chroma_lightness_offset: float = 0.08
    """Added to the lightness that chroma is divided by: the hue of what is nearly black is noise."""
    itself: float = 0.5
    """Weight of a Gaussian's colour."""
    near: float = 1.0
    """Weight of the mean colour of its neighbours."""
    around: float = 0.5
    """Weight of the mean over the neighbours of these."""
    variation: float = 0.5
    """Weight of the texture."""


UNITS = DescriptorThresholds()


DESCRIPTOR_CHANNELS = 15
"""Numbers per Gaussian."""


@dataclass(frozen=True)
class Descriptors:
    """Descriptors of M Gaussians."""

    values: Floats = field(repr=False)
    """[M, DESCRIPTOR_CHANNELS] float32."""
    near: Ids = field(repr=False)
    """[M, COUNT] int32 neighbours."""
    colors: Floats = field(repr=False)
    """[M, 3] float32 mean colour over the neighbours, in units."""
    weights: Floats = field(repr=False)
    """[M] float32 opacity times area."""

    @staticmethod
    def of(splats: Splats) -> Descriptors:
        """splats: numpy, all drawable."""
        colors = to_display(np.clip(base_color(splats.sh), 0, 1), splats.color_space)
        lab = oklab(colors)
        chroma = lab[:, 1:] / (lab[:, :1] + UNITS.chroma_lightness_offset)
        scaled = np.concatenate([lab[:, :1] / UNITS.lightness, chroma / UNITS.chroma], 1).astype(np.float32)
        ordered = np.sort(splats.scales, axis=1)
        # Large opaque Gaussians say more of a material than faint specks.
        weights = (splats.opacities * ordered[:, 1] * ordered[:, 2]).astype(np.float32)
        weights = np.maximum(weights / max(float(weights.max(initial=0)), 1e-30), np.float32(1e-9))
        near = neighbours(splats.means)
        # Two scales: the nearest eight for colour, all sixteen and their neighbours for what is around.
        close, deviation = weighted_means(scaled, weights, near[:, :8])
        mean, _ = weighted_means(scaled, weights, near)
        around, spread = weighted_means(mean, weights, near)
        per_texture = np.array([UNITS.lightness, UNITS.chroma, UNITS.chroma], np.float32) / UNITS.texture
        values = np.concatenate(
            [
                UNITS.itself * scaled,
                UNITS.near * close,
                UNITS.around * around,
                UNITS.variation * per_texture * deviation,
                UNITS.variation * per_texture * spread,
            ],
            1,
        )
        return Descriptors(values.astype(np.float32), near, close, weights)
