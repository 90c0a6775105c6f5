"""Several cameras of one size over the CPU kernels, forward and backward, in numpy. Knows no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.kernels import simd as lanes
from splatpainter.kernels.parallel import each, run, threads
from splatpainter.rendering.cpu import backward, geometry
from splatpainter.rendering.cpu.projected_view import Frame, project
from splatpainter.rendering.cpu.projection_backward import project_back
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import ATTRIBUTES, Splats

Result = TypeVar("Result")


@dataclass(frozen=True)
class Drawn:
    """C views, and what their derivative needs."""

    colors: np.ndarray
    """[C, H, W, 3]"""
    alphas: np.ndarray
    """[C, H, W, 1]"""
    depths: np.ndarray
    """[C, H, W, 1]"""
    contributions: np.ndarray | None
    """[C, N]"""
    frames: list[tuple[Frame, np.ndarray]]
    """Each view's frame and where its tiles stopped; empty unless asked for."""


def draw_views(
    splats: Splats, cameras: Sequence[Camera], contributions: bool, keep_frames: bool, profile: Profile = "inria"
) -> Drawn:
    """splats: numpy attributes. cameras: of one size, at least one."""
    dtype = splats.means.dtype
    shape = (len(cameras), cameras[0].height, cameras[0].width)
    colors, alphas, depths = np.empty((*shape, 3), dtype), np.empty((*shape, 1), dtype), np.empty((*shape, 1), dtype)
    weights = np.zeros((len(cameras), len(splats)), dtype) if contributions else None

    def draw(c: int) -> tuple[Frame, np.ndarray] | None:
        frame = project(splats, cameras[c])
        ends = frame.draw_into(colors[c], alphas[c, ..., 0], depths[c, ..., 0], profile=profile)
        if weights is not None:
            nothing, everywhere = np.zeros_like(colors[c]), np.ones(shape[1:], dtype)
            weights[c, frame.rows] = frame.accumulate(nothing, everywhere, profile).weight
        return (frame, ends) if keep_frames else None

    frames = _over_views(draw, range(len(cameras)))
    return Drawn(colors, alphas, depths, weights, [frame for frame in frames if frame is not None])


def views_back(
    splats: Splats, drawn: Drawn, v_colors: np.ndarray, v_alphas: np.ndarray, v_depths: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Gradients of (means, quats, scales, opacities, sh) from those of colours, alphas and depths (shapes of Drawn)."""
    out = tuple(np.empty(getattr(splats, name).shape, splats.means.dtype) for name in ATTRIBUTES)

    def back(c: int) -> np.ndarray:
        pictures = (drawn.colors[c], drawn.alphas[c, ..., 0], drawn.depths[c, ..., 0])
        return pixels_back(*drawn.frames[c], *pictures, v_colors[c], v_alphas[c, ..., 0], v_depths[c, ..., 0])

    # View after view adds to the rows' gradients, in that order whatever the threads; a group's sums are held at once.
    group = 2 * threads()
    for first in range(0, len(drawn.frames), group):
        views = range(first, min(first + group, len(drawn.frames)))
        for c, sums in zip(views, _over_views(back, views), strict=True):
            rows_back(splats, drawn.frames[c][0], sums, c == 0, out)
    return out


def pixels_back(frame: Frame, ends: np.ndarray, *pictures: np.ndarray) -> np.ndarray:
    """[P, 16] sums of backward.py. pictures: colours [H, W, 3], alphas, depths [H, W], then their gradients."""
    dtype = frame.records.dtype
    sums = lanes.aligned((len(frame.members), lanes.RECORD), dtype)
    inputs = [lanes.readonly(picture, dtype) for picture in pictures]
    run(backward.draw_back, *frame.lists(frame.records), ends, *inputs, sums)
    return sums


def rows_back(splats: Splats, frame: Frame, sums: np.ndarray, fresh: bool, out: tuple[np.ndarray, ...]) -> None:
    """Write (fresh) or add one view's gradients of the attributes to `out`."""
    attributes = [lanes.readonly(getattr(splats, name), sums.dtype) for name in ATTRIBUTES]
    entries = np.full(len(splats), -1, np.int32)
    entries[frame.rows] = np.arange(len(frame), dtype=np.int32)
    camera = geometry.camera_vector(frame.camera, np.zeros(4), sums.dtype)
    view = (splats.sh_degree, camera, bool(splats.antialiased), entries, frame.records, frame.offsets, sums)
    run(project_back, *attributes, *view, fresh, *out)


def _over_views(function: Callable[[int], Result], views: range) -> list[Result]:
    """Many views: one thread each. Few: one after the other, each on all threads."""
    return each(function, views) if len(views) >= 2 * threads() else [function(c) for c in views]
