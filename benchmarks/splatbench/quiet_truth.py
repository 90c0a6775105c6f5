"""Truth that is quiet enough to judge: traced twice, and anew with more paths where both differ.

How many paths a picture wants lies in its object and its light: at 16 of them a pillow in a photo studio differs from
itself in 11 % of its pixels by what counts as a speck, a hammer in a market in 0.3 %. Nothing is clamped or filtered,
which would darken small bright lights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from splatbench.ground_truth import GroundTruth, GroundTruthViews
from splatpainter.cameras import Camera
from splatpainter.color import luminance

SPECK_STEP = 0.15
"""Luminance, display units, by which a pixel differs from those around it where it counts as a speck."""
MAX_NOISE = 0.002
"""Share of the object's pixels that may differ by a speck's step between two traces. Where noise is normal, neither
then has a speck of its own in 10,000 pixels; coarse assets have 1."""
FINER = (1, 4, 16)
"""Times the paths that were asked for, in turn. Of eleven held-out pairs at 16 paths all want 64, five 256."""


@dataclass(frozen=True)
class QuietViews:
    """Two traces of the same views, whose noise is independent."""

    views: GroundTruthViews
    again: GroundTruthViews = field(repr=False)
    samples: int
    """Paths per pixel that it took."""


def quiet_views(truth: GroundTruth, cameras: Sequence[Camera], purpose: str) -> QuietViews:
    """Views of the truth with as many paths as they want; `purpose` as of `GroundTruth.render`. Raises ValueError:
    noisy with the most paths that are tried."""
    share, samples = 1.0, truth.setup.samples
    for times in FINER:
        samples = times * truth.setup.samples
        finer = replace(truth, setup=replace(truth.setup, samples=samples))
        views, again = finer.render(cameras, purpose), finer.render(cameras, f"{purpose} again")
        share = noise(views.images.colors, again.images.colors, views.masks & again.masks)
        if share <= MAX_NOISE:
            return QuietViews(views, again, samples)
    raise ValueError(f"{share:.1%} of its pixels differ between two truths of {samples} paths")


def noise(one: np.ndarray, other: np.ndarray, masks: np.ndarray) -> float:
    """0..1: share of the pixels inside masks [V, H, W] whose luminance differs by a speck's step between display
    colours [V, H, W, 3]; 0 where there are none."""
    middle = np.stack([inside(mask) for mask in masks])
    apart = np.abs(luminance(one.astype(np.float64)) - luminance(other.astype(np.float64)))[middle]
    return float((apart > SPECK_STEP).mean()) if apart.size else 0.0


def inside(mask: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels of a mask two pixels off its outline, where nothing else shows through."""
    out = np.pad(mask, 2)
    for axis in (0, 1):
        out = out & np.roll(out, 2, axis) & np.roll(out, -2, axis)
    return out[2:-2, 2:-2]
