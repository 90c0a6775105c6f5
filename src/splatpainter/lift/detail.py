"""The detail layer: pixel-sized Gaussians on the painted surface, only where split ones cannot follow the picture.

Splitting alone needs a Gaussian per pixel *and layer* of a capture's fog for a sharp edge; once the fog has been
painted coarsely, one thin Gaussian per wrong pixel does the rest, and from other sides what it misses is painted too.
Spawned on an unpainted surface the same Gaussians are crisp in the edited view and wrong elsewhere (docs/LOG.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatpainter.lift.colors import recolor
from splatpainter.lift.depth_normals import SMOOTHING_PX, surface, surface_normals
from splatpainter.lift.masks import dilated
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.splats import MAX_MAGNITUDE, Splats
from splatpainter.transforms import matrix_to_quat

DETAIL_WIDTH_PX = 0.45
"""Standard deviation of a detail Gaussian across the line of sight. Against 0.6 on 8 painted training meshes: 32.8 dB
in the edited view, not 32.1, and 26.3 beside it, not 26.2; 0.2 to 0.5 dB on captures. Narrower ones would leave holes
in views from nearer."""
DETAIL_THICKNESS = 0.15
"""Thickness / width."""
DETAIL_OPACITY = 0.9
MAX_STRETCH = 3.0
"""A detail Gaussian is stretched along a slanted surface at most this much."""


@dataclass(frozen=True)
class DetailLayer:
    """Gaussians for some pixels."""

    splats: Splats
    hosts: np.ndarray
    """[A] entries of the view (0..M) that gave those pixels most of their colour."""


def detail_layer(splats: Splats, view: ProjectedView, pixels: np.ndarray, target: np.ndarray) -> DetailLayer | None:
    """One Gaussian per pixel, of the target's colour and its host's SH bands >= 1. pixels: [H, W] bool; target:
    [H, W, 3]; view: of `splats`. None when no pixel has a surface."""
    camera = view.camera
    depth, host = surface(view, dilated(pixels, 2 * SMOOTHING_PX))
    ys, xs = np.nonzero(pixels & (depth > 0) & (host >= 0))
    if not len(ys):
        return None
    z = depth[ys, xs].astype(np.float64)
    normal = surface_normals(depth, ys, xs, camera)
    # Axes in the surface whose projections are about one pixel's width along x and y of the picture.
    facing = np.where(np.abs(normal[:, 2]) > 0.25, normal[:, 2], np.where(normal[:, 2] < 0, -0.25, 0.25))
    along = np.stack([np.ones(len(z)), np.zeros(len(z)), -normal[:, 0] / facing], 1)
    stretch = np.linalg.norm(along, axis=1)
    along /= stretch[:, None]
    across = np.cross(normal, along)
    tall = 1 / np.maximum(np.abs(across[:, 1]), 0.25)
    rotation = np.einsum(
        "ji,njk->nik", camera.world_to_camera[:3, :3], np.stack([along, across, np.cross(along, across)], 2)
    )
    width = DETAIL_WIDTH_PX * z / camera.fx
    sizes = [width * np.minimum(stretch, MAX_STRETCH), width * np.minimum(tall, MAX_STRETCH), width * DETAIL_THICKNESS]
    scales = np.stack(sizes, 1)
    means = camera.unproject(z, np.stack([xs, ys], 1) + 0.5)
    if not max(np.abs(means).max(), scales.max()) <= MAX_MAGNITUDE:  # seen through a lens beyond all measure
        return None
    entries = host[ys, xs]
    hosts = splats.take(view.gaussian_ids[entries])
    sh = recolor(hosts.sh, view.unclamped_colors[entries], target[ys, xs], 1.0)
    dtype = splats.means.dtype
    layer = Splats(
        means.astype(dtype),
        matrix_to_quat(rotation).astype(dtype),
        scales.astype(dtype),
        np.full(len(z), DETAIL_OPACITY, dtype),
        sh.astype(dtype),
        splats.antialiased,
        splats.color_space,
        hosts.source,
        hosts.origin,
    )
    return DetailLayer(layer, entries)
