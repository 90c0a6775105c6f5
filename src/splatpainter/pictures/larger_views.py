"""Edited pictures that are larger than the view that was rendered: an upscaler's, or of a program that enlarged its
canvas. They are taken as a larger render of the same view, and what counts as edited is what differs both from such a
render and from the small one enlarged. Pure.
"""

from __future__ import annotations

import math

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.masks import change_mask, changed_throughout, dilated, largest_channel
from splatpainter.pictures.picture_reader import Kernel, resample
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class LargerViewThresholds:
    """Pictures with more pixels than their view. Source: taste."""

    min_scale: float = 1.1
    """Pictures that are less larger than their view are resampled to it."""
    max_scale: int = 8
    """Times a picture may be larger than its view, per axis."""
    max_larger_px: int = 4096
    """Most pixels of the longer side of a larger view; pictures beyond are shrunk to it."""
    kernel_range_margin: float = 2 / 255
    """Most by which an enlargement may leave the range of those by KERNELS."""
    reach_px: int = 3
    """Pixels of the view around what surely was edited, in which differences count that may come from enlarging."""


LARGER = LargerViewThresholds()


KERNELS: tuple[Kernel, ...] = ("nearest", "bilinear", "bicubic", "lanczos")
"""Kernels by which programs enlarge."""


def larger_view(view: Camera, width: int, height: int, max_pixels: float = math.inf) -> Camera | None:
    """The view at the size of a picture, at most LARGER.max_larger_px and LARGER.max_scale times its own and of
    `max_pixels`; None where the picture (or what is left of it) is not larger by LARGER.min_scale, or not of its shape
    to a pixel of it."""
    # By width; the height may be off by the rounding of one row of the smaller picture.
    scale = width / view.width
    if scale < LARGER.min_scale or abs(view.height * scale - height) > math.ceil(scale):
        return None
    shrink = min(
        1, LARGER.max_larger_px / max(width, height), LARGER.max_scale / scale, math.sqrt(max_pixels / (width * height))
    )
    larger = view.resized(max(1, int(width * shrink + 1e-6)), max(1, int(height * shrink + 1e-6)))
    return larger if larger.width > LARGER.min_scale * view.width else None


def edited_in_larger(picture: np.ndarray, large: np.ndarray, small: np.ndarray, cover: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels of a picture that were edited; all where everything was made anew (an upscaler that adds
    detail). picture: [H, W, 3] 0..1; large: [H, W, 3] the render at its size; small: [h, w, 3] that of the view; cover:
    [H, W] alpha of the larger render.

    What lies between all enlargements, or between them and the larger render, may have come about by enlarging: it
    counts only near pixels that lie outside."""
    height, width = large.shape[:2]
    before = np.clip(large, 0, 1)
    # Whatever kernel a program used, an unedited pixel lies between these and the larger render.
    enlarged = [resample(np.clip(small, 0, 1), width, height, kernel) for kernel in KERNELS]
    solid = cover > 0.9
    # The kernel that agrees best in the median is taken for the program's.
    errors = [
        float(np.median(largest_channel(np.abs(picture - one))[solid])) if solid.any() else 0.0 for one in enlarged
    ]
    nearest = enlarged[int(np.argmin(errors))]
    if changed_throughout(picture, before, cover) and changed_throughout(picture, nearest, cover):
        return np.ones(cover.shape, bool)
    low = np.minimum.reduce([before, *enlarged]) - LARGER.kernel_range_margin
    high = np.maximum.reduce([before, *enlarged]) + LARGER.kernel_range_margin
    # Beyond all of them it was surely edited; near that, smaller differences count as well.
    surely = change_mask(picture, np.clip(picture, low, high))
    reach = math.ceil(LARGER.reach_px * width / small.shape[1])
    return change_mask(picture, before) & change_mask(picture, nearest) & dilated(surely, reach)
