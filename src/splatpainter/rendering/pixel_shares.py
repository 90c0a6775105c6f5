"""Which part of a view's pixels some Gaussians make, and what a picture shows under each Gaussian's footprint.

Knows no layer and no tool. Gaussians and their weights are numpy.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.cameras import Camera
from splatpainter.splats import Splats

if TYPE_CHECKING:
    from splatpainter.rendering.cpu.projected_view import ProjectedView

MEASURING_OPACITY = 0.05
"""Peak alpha with which footprints are measured where nothing shall hide anything."""
MASKED_SHARE = 0.5
"""Share of a pixel from which it is within a mask."""


def before_black(splats: Splats, camera: Camera) -> ProjectedView:
    """A view in which the background adds nothing: what is rasterized of weights is their share of each pixel."""
    from splatpainter.rendering.cpu.projected_view import project

    return project(splats, replace(camera, background=(0.0, 0.0, 0.0)))


def share_of(splats: Splats, camera: Camera, weights: np.ndarray) -> Floats:
    """[H, W] float32 0..1: what Gaussians make of each pixel, each counted by its weight ([N] bool or 0..1)."""
    view = before_black(splats, camera)
    return view.rasterize(np.repeat(weights[view.gaussian_ids, None], 3, 1).astype(np.float32))[0][..., 0]


def footprint_mean(splats: Splats, camera: Camera, picture: np.ndarray) -> Floats:
    """[N] float32 mean of a picture ([H, W] 0..1) over each Gaussian's footprint, as if none hid another; 0 beside the
    view."""
    from splatpainter.rendering.cpu.projected_view import project

    faint = replace(
        splats, source=None, origin=None, opacities=np.minimum(splats.opacities, np.float32(MEASURING_OPACITY))
    )
    view = project(faint, camera)
    part, total = view.mask_sums(picture, np.ones(picture.shape, np.float32))
    out = np.zeros(len(splats), np.float32)
    out[view.gaussian_ids] = part.alpha / np.maximum(total.alpha, 1e-9)
    return out


def beside_mask(splats: Splats, camera: Camera, mask: np.ndarray) -> Bools:
    """[N] bool: Gaussians whose middle a view draws beside a mask ([H, W] 0..1), or not at all."""
    pixels, z = camera.project(splats.means.astype(np.float64))
    column, line = np.floor(np.nan_to_num(pixels, nan=-1, posinf=-1, neginf=-1)).T
    visible = (z > 0) & (column >= 0) & (column < camera.width) & (line >= 0) & (line < camera.height)
    out = np.ones(len(splats), bool)
    out[visible] = mask[line[visible].astype(np.int64), column[visible].astype(np.int64)] < MASKED_SHARE
    return out
