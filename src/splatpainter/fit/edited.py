"""Edits by optimisation: steps of 3DGS on the Gaussians that an edit reaches, held by views of the asset from around.

Method "fit" makes them after the lift: seconds to tens of them instead of one, and nearer to the pictures. Zoom-ins are
made so before the lift (lift/local/wide_edit.py). The less the views from around weigh, the more the rest of the
object pays for it; without the lift before it, so does paint (docs/LOG.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.cameras import Camera, orbit_cameras
from splatpainter.fit.optimize import FitOptions, TrainingView, optimize
from splatpainter.rendering import render
from splatpainter.rendering.cpu.projected_view import TILE, project
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass

__all__ = ["EditFitOptions", "fit_edited"]


@dataclass(frozen=True)
class EditFitOptions:
    """How to optimise an edit. On six close-ups of training meshes, PSNR in the edited views / near them / of the whole
    object: nothing 22.8 / 22.0 / 29.2 dB, lift 25.1 / 22.8 / 28.7, this 28.7 / 23.5 / 28.4. On six painted ones, edited
    views / the paint near them: lift 33.1 / 26.2, this 38.0 / 26.4."""

    steps: int = 60
    """Half of them on edited views."""
    views: int = 4
    """Views from around at each of ELEVATIONS, to hold what the edit does not show."""
    weight: float = 4.0
    """Weight of such a view, against 1 for an edited one. 0.5: 29.2 / 23.5 / 28.2 on the close-ups; 8: 28.4 / 23.5 /
    28.6 (with held views of 160 px over one background)."""
    same: float = 0.1
    """Where the lift changed a held view's pixel by less than this (0..1), the asset as it was is held, else the
    lift."""
    size: int = 256
    """Edge of the held views, pixels; at most that of the edited ones."""
    attributes: tuple[str, ...] = ATTRIBUTES
    """Which ones are optimised; the others keep their bits."""
    rate_scales: float = FitOptions.rate_scales
    """Rate as in FitOptions."""


SSIM_MARGIN_PX = 5
"""Pixels around what the Gaussians draw that still enter the structural similarity (half of its window)."""
ELEVATIONS = {-20.0: (0.0, 0.0, 0.0), 15.0: (1.0, 1.0, 1.0), 50.0: (0.0, 0.0, 0.0)}
"""Degrees -> background: over one alone, Gaussians of its colour and holes look alike."""


def fit_edited(
    before: Splats,
    lifted: Splats,
    views: Sequence[tuple[Camera, np.ndarray]],
    gaussian_ids: np.ndarray,
    options: EditFitOptions = EditFitOptions(),
) -> Splats:
    """`lifted` with the given Gaussians ([M] int64) moved so that its renders match the edited views (camera, [H, W, 3]
    the whole picture wanted) while it looks from around as it did. before: the asset before the lift; both numpy. All
    other Gaussians keep their bits."""
    # Views from around say how the rest is to stay; without them the edit would eat into it.
    anchors = _anchors(before, lifted, views[0][0], options)
    edited = [
        view for camera, picture in views if (view := _cropped(lifted, camera, picture, gaussian_ids)) is not None
    ]
    # One view a step: edited views are listed so often that they are every second one.
    often = max(round(len(anchors) / max(len(edited), 1)), 1)  # so that half of the steps are of edited views
    how = FitOptions(steps=options.steps, densify=False, attributes=options.attributes, rate_scales=options.rate_scales)
    return optimize(lifted, edited * often + anchors, how, gaussian_ids=gaussian_ids).splats


def _cropped(splats: Splats, camera: Camera, picture: np.ndarray, gaussian_ids: np.ndarray) -> TrainingView | None:
    """An edited view around what the Gaussians draw in it, weighted as the same part of the whole one would be; None
    where they draw nothing."""
    chosen = np.zeros(len(splats), bool)
    chosen[gaussian_ids] = True
    # Only the part of the picture that the moving Gaussians can change is compared.
    ys, xs = np.nonzero(project(splats, camera, gaussian_mask=chosen).tiles_of(chosen))
    if not len(ys):
        return None
    left, top = max(int(xs.min()) * TILE - SSIM_MARGIN_PX, 0), max(int(ys.min()) * TILE - SSIM_MARGIN_PX, 0)
    right = min((int(xs.max()) + 1) * TILE + SSIM_MARGIN_PX, camera.width)
    bottom = min((int(ys.max()) + 1) * TILE + SSIM_MARGIN_PX, camera.height)
    share = (right - left) * (bottom - top) / (camera.width * camera.height)
    part = np.ascontiguousarray(picture[top:bottom, left:right])
    return TrainingView(camera.cropped(left, top, right - left, bottom - top), part, weight=share)


def _anchors(before: Splats, lifted: Splats, like: Camera, options: EditFitOptions) -> list[TrainingView]:
    """Views of the unedited asset from around."""
    size = min(options.size, like.width, like.height)
    anchors = []
    for elevation, background in ELEVATIONS.items():
        cameras = orbit_cameras(before, options.views, size=size, elevation=elevation, background=background)
        # Where the lift changed little the old picture is to stay; where it changed much, its own.
        pictures = was = render(before, cameras).colors
        if lifted is not before:
            now = render(lifted, cameras).colors
            pictures = np.where((np.abs(now - was).max(-1) < options.same)[..., None], was, now)
        anchors += [TrainingView(c, p, weight=options.weight) for c, p in zip(cameras, pictures, strict=True)]
    return anchors
