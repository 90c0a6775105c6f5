"""Normals of Gaussians: their shortest axes, turned to the side from which they are seen."""

from __future__ import annotations

import numpy as np

from splatpainter.cameras import orbit
from splatpainter.rendering.cpu.projected_view import project
from splatpainter.splats import Splats
from splatpainter.transforms import quat_to_matrix

RING_VIEWS = 8
"""Views around the asset that decide which side of a Gaussian is its outside."""
RING_PX = 160
"""Pixels of their edges."""


def outward_normals(splats: Splats, views: int = RING_VIEWS) -> np.ndarray:
    """[N, 3] float32 unit shortest axes, turned towards the side from which a ring of views sees the Gaussian (else
    away from the asset's centre); zeros for those that cannot be drawn. Colours have no part in them. At least one
    Gaussian must be drawable."""
    drawable = splats.drawable
    if not drawable.all():
        return scattered(outward_normals(splats.take(drawable), views), drawable)
    n = len(splats)
    normal = quat_to_matrix(splats.quats)[np.arange(n), :, splats.scales.argmin(1)]
    center = np.median(splats.means, 0)
    radius = float(np.quantile(np.linalg.norm(splats.means - center, axis=1), 0.98))
    towards = 1e-3 * (splats.means - center) / max(radius, 1e-9)  # [N, 3] mean direction to the views that see it
    shape = (RING_PX, RING_PX)
    for k in range(views):
        tilt = 35.0 if k % 2 else -20.0
        start = 360.0 * k / views
        camera = orbit(center, 2.8 * radius, 1, elevation=tilt, start=start, width=RING_PX, height=RING_PX)[0]
        projected = project(splats, camera)
        sums = projected.backproject(np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32))
        away = camera.position.astype(np.float32) - splats.means[projected.gaussian_ids]
        # What shimmers through the far wall is seen from within.
        weight = np.where(sums.weight > 0.1 * sums.alpha, sums.weight, 0)
        towards[projected.gaussian_ids] += weight[:, None] * away / np.linalg.norm(away, axis=1, keepdims=True)
    side = np.einsum("ni,ni->n", normal, towards)
    normal = np.where(side[:, None] < 0, -normal, normal)
    return normal.astype(np.float32)


def scattered(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """values [M, ...] at the M set entries of mask [N] bool, zeros elsewhere."""
    full = np.zeros((len(mask), *values.shape[1:]), values.dtype)
    full[mask] = values
    return full
