"""Several cameras of one size over the CPU kernels, forward and backward, in numpy. Knows no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels.arrays import aligned
from splatpainter.kernels.parallel import each, threads
from splatpainter.rendering.cpu.projected_view import ProjectedView, project
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import ATTRIBUTES, Splats
from splatpainter.system.quick_dataclass import dataclass

Result = TypeVar("Result")


@dataclass(frozen=True)
class RenderedViews:
    """C views, and what their derivative needs."""

    colors: np.ndarray
    """[C, H, W, 3]"""
    alphas: np.ndarray
    """[C, H, W, 1]"""
    depths: np.ndarray
    """[C, H, W, 1]"""
    contributions: np.ndarray | None
    """[C, N]"""
    views: list[tuple[ProjectedView, np.ndarray]]
    """Each projected view and where its tiles stopped; empty unless asked for."""


def render_views(
    splats: Splats, cameras: Sequence[Camera], contributions: bool, keep_views: bool, profile: Profile = "inria"
) -> RenderedViews:
    """splats: numpy attributes. cameras: of one size, at least one."""
    dtype = splats.means.dtype
    shape = (len(cameras), cameras[0].height, cameras[0].width)
    colors, alphas, depths = (aligned((*shape, channels), dtype) for channels in (3, 1, 1))
    weights = np.zeros((len(cameras), len(splats)), dtype) if contributions else None

    def render_view(c: int) -> tuple[ProjectedView, np.ndarray] | None:
        view = project(splats, cameras[c])
        ends = view.rasterize_into(colors[c], alphas[c, ..., 0], depths[c, ..., 0], profile=profile)
        if weights is not None:
            values, mask = np.zeros_like(colors[c]), np.ones(shape[1:], dtype)
            weights[c, view.gaussian_ids] = view.backproject(values, mask, profile).weight
        return (view, ends) if keep_views else None

    views = _over_views(render_view, range(len(cameras)))
    return RenderedViews(colors, alphas, depths, weights, [view for view in views if view is not None])


def render_views_backward(
    splats: Splats, rendered: RenderedViews, v_colors: np.ndarray, v_alphas: np.ndarray, v_depths: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Gradients of (means, quats, scales, opacities, sh) from those of colours, alphas and depths (shapes of
    RenderedViews)."""
    out = tuple(aligned(getattr(splats, name).shape, splats.means.dtype) for name in ATTRIBUTES)

    def rasterize_backward(c: int) -> np.ndarray:
        view, ends = rendered.views[c]
        pictures = (rendered.colors[c], rendered.alphas[c, ..., 0], rendered.depths[c, ..., 0])
        return view.rasterize_backward(ends, *pictures, v_colors[c], v_alphas[c, ..., 0], v_depths[c, ..., 0])

    # View after view adds to the gradients, in that order whatever the threads; a group's sums are held at once.
    group = 2 * threads()
    for first in range(0, len(rendered.views), group):
        views = range(first, min(first + group, len(rendered.views)))
        for c, sums in zip(views, _over_views(rasterize_backward, views), strict=True):
            rendered.views[c][0].project_backward(splats, sums, out, overwrite=c == 0)
    return out


def _over_views(function: Callable[[int], Result], views: range) -> list[Result]:
    """Many views: one thread each. Few: one after the other, each on all threads."""
    return each(function, views) if len(views) >= 2 * threads() else [function(c) for c in views]
