"""Whether an asset has fine detail of its own, which paint should let through. Pure.

Detail is the median absolute Laplacian of the luma of a view where the asset covers it: a median, so that outlines and
a few sharp edges do not count. At 256 pixels it is 0.013 to 0.06 on captures (st-peter, massa, playbot) and on the demo
asset, and 0.0002 to 0.003 on smooth shapes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.session.measures.orientation import COVERED_ALPHA, thinned
from splatpainter.splats import Splats

VIEW_PX = 256
"""Edge, pixels, of the view that is measured."""
MIN_FINE_DETAIL = 0.006
"""Fine detail from which an asset counts as detailed."""
LUMA = np.array([0.3, 0.59, 0.11], np.float32)


def fine_detail(splats: Splats, camera: Camera) -> float:
    """Median absolute Laplacian (luma 0..1) of a view, drawn VIEW_PX wide; 0 where the asset covers nothing."""
    from splatpainter.rendering.cpu.projected_view import project

    # One small size for all: the Laplacian of a picture depends on its scale.
    height = max(round(camera.height * VIEW_PX / camera.width), 3)
    small = replace(camera.resized(VIEW_PX, height), background=(0.0, 0.0, 0.0))
    image, alpha, _ = project(replace(thinned(splats), source=None, origin=None), small).rasterize()
    # Over covered pixels alone: what the picture does against the background is no detail of the asset.
    luma = image @ LUMA
    around = luma[:-2, 1:-1] + luma[2:, 1:-1] + luma[1:-1, :-2] + luma[1:-1, 2:]
    laplacian = np.abs(4 * luma[1:-1, 1:-1] - around)[alpha[1:-1, 1:-1] > COVERED_ALPHA]
    return float(np.median(laplacian)) if len(laplacian) else 0.0


def has_fine_detail(splats: Splats, camera: Camera) -> bool:
    """Whether paint on it should keep what lies below."""
    return fine_detail(splats, camera) >= MIN_FINE_DETAIL
