"""Where to stand to see an asset: a robust centre and radius, an orbit around them. Knows no files and no renderer."""

from __future__ import annotations

import math

import numpy as np

from splatpainter.cameras import Camera, orbit
from splatpainter.splats import Splats

OPAQUE = 0.1
"""Fainter rows are haze and floaters; they do not decide where the asset is."""
MARGIN = 1.08
"""Room around the asset in the picture."""
UPS = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
AUTO_UP = "-y"
"""Up of every asset in memory unless its maker thought otherwise: structure from motion has y down, so do INRIA's PLY
files, and the readers of formats with y up (SPZ, GLB) turn their rows into that frame (io/frames.py)."""


def reach(splats: Splats) -> tuple[np.ndarray, float]:
    """([3] centre, radius) of a ball around nearly all opaque rows; one row in three may be a floater, however far.

    (0, 0, 0) and 1 where no row can be drawn. Rows beyond three median distances from the median centre are left out;
    of the others the middle of the central 98 % per axis is the centre, and 98 % lie within the radius."""
    own = splats.numpy()
    drawable = splats.finite
    opaque = drawable & (own.opacities > OPAQUE)
    means = own.means[opaque if opaque.any() else drawable].astype(np.float64)
    if not len(means):
        return np.zeros(3), 1.0
    away = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    core = means[away <= 3 * np.median(away)] if np.median(away) > 0 else means
    low, high = np.quantile(core, [0.01, 0.99], axis=0)
    center = (low + high) / 2
    radius = float(np.quantile(np.linalg.norm(core - center, axis=1), 0.98))
    typical = float(np.median(own.scales[drawable].max(1)))
    return center, max(radius, 3 * typical, 1e-6)  # one row, or all in one place, is still something to look at


def around(
    splats: Splats,
    count: int,
    *,
    size: int,
    up: str = "auto",
    elevation: float = 15.0,
    fov: float = 40.0,
    distance: float | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[Camera]:
    """`count` square views around the asset. up: "auto" or a key of UPS; fov: vertical, degrees; distance: of the eye
    from the centre, world units, by default so that the asset fills the picture."""
    center, radius = reach(splats)
    if distance is None:
        distance = MARGIN * radius / math.sin(math.radians(fov / 2))
    axis = UPS[AUTO_UP if up == "auto" else up]
    return orbit(
        center, distance, count, elevation=elevation, up=axis, width=size, height=size, fov=fov, background=background
    )
