"""Looking at an asset through a camera: what lies under a pixel, what was seen and what is predicted. Pure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera, orbit
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.rendering.pixel_shares import before_black
from splatpainter.session.replay.conflicts import PREDICTED, SEEN
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

OVERLAY_OPACITY = 0.65
"""Opacity of the coverage over the view."""
ORBIT_VIEWS, ELEVATIONS_DEGREES, VIEW_PX = 12, (-15.0, 15.0, 45.0), 96
"""Views that are tried for the next one: around, at these elevations, of this size."""
MIN_PREDICTED_PIXELS = 12.0
"""Predicted pixels, of VIEW_PX x VIEW_PX, that make a view worth showing."""


@dataclass(frozen=True)
class Hit:
    """What a pixel shows."""

    depth: float
    """z, world units."""
    point: np.ndarray
    """[3] world coordinates."""
    gaussian_id: int
    """The one that gives the pixel most of its colour."""


def pick(splats: Splats, camera: Camera, x: float, y: float) -> tuple[np.ndarray, Hit | None]:
    """([3] the pixel's colour in the asset's space, what lies there, or None where the asset covers less than half).
    x, y: pixels, the first one's centre at 0.5, 0.5. Raises ValueError outside the view."""
    # Outside of the picture there is no pixel to draw; a mistaken size of the page shows here.
    column, line = int(np.floor(x)), int(np.floor(y))
    if not (0 <= column < camera.width and 0 <= line < camera.height):
        raise ValueError(f"pick: expected a pixel of the {camera.width}x{camera.height} view, got {x:g}, {y:g}")
    # A view of this pixel alone, cropped out of the camera: nothing else has to be drawn.
    pixel = camera.cropped(column, line, 1, 1)
    view = project(splats, pixel)
    image, alpha, depth = view.rasterize()
    # Where the background shows through, the depth is a mean of nothing.
    if alpha[0, 0] < 0.5:
        return image[0, 0], None
    # The same weights that the pixel was composited with say whose colour it is.
    sums = view.backproject(np.zeros((1, 1, 3), np.float32), np.ones((1, 1), np.float32))
    z = float(depth[0, 0])
    point = camera.unproject(np.array(z), np.array([x, y]))
    return image[0, 0], Hit(z, point, int(view.gaussian_ids[sums.weight.argmax()]))


def coverage_picture(splats: Splats, coverage: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W, 4] uint8: green where the view shows Gaussians that edits saw, red where predicted ones, else transparent.
    coverage: [N] conflicts.ORIGINAL, SEEN, PREDICTED."""
    shares = _shares(splats, coverage, camera)
    # The two colours are mixed by their shares; where neither is, the overlay is transparent.
    amount = shares[..., :2].sum(-1, keepdims=True)
    colors = shares[..., :2] / np.maximum(amount, 1e-6) @ np.array([[70, 200, 90], [235, 70, 60]], np.float32)
    return np.concatenate([colors, 255 * OVERLAY_OPACITY * np.clip(amount, 0, 1)], -1).round().astype(np.uint8)


def next_view(
    splats: Splats, coverage: np.ndarray, camera: Camera, center: np.ndarray, up: tuple[float, float, float]
) -> Camera | None:
    """The view around `center`, from as far away as `camera` and with its lens, that shows most predicted Gaussians;
    None where none shows enough."""
    # Without predictions every view would score 0 and the search would be for nothing.
    if not (coverage == PREDICTED).any():
        return None
    # The same distance and lens, at a small size: shares of pixels are all that is compared.
    distance = float(np.linalg.norm(camera.position - center))
    scale = VIEW_PX / max(camera.width, camera.height)
    best, max_predicted = None, MIN_PREDICTED_PIXELS
    for elevation in ELEVATIONS_DEGREES:
        ring = orbit(
            center, max(distance, 1e-6), ORBIT_VIEWS, elevation=elevation, up=up, width=VIEW_PX, height=VIEW_PX
        )
        for view in ring:
            view = replace(view, fx=camera.fx * scale, fy=camera.fy * scale).local
            predicted = float(_shares(splats, coverage, view)[..., 1].sum())
            if predicted > max_predicted:
                best, max_predicted = view, predicted
    if best is None:
        return None
    # The size and lens of the camera that was given: only where it stands was looked for.
    return replace(camera, world_to_camera=best.world_to_camera)


def _shares(splats: Splats, coverage: np.ndarray, camera: Camera) -> np.ndarray:
    """[H, W, 3] parts of each pixel: Gaussians seen, predicted, all others."""
    view = before_black(splats, camera)
    kinds = coverage[view.gaussian_ids]
    colors = np.stack([kinds == SEEN, kinds == PREDICTED, np.ones(len(kinds), bool)], -1)
    return view.rasterize(colors.astype(view.projected.dtype))[0]
