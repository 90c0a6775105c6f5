"""What a view shows besides colours, as compositors want it (arbitrary output variables): alpha, depth, normals, which
Gaussian, what edits saw. Arrays only; files are made of them in view_files.py.

A pixel's weights are the renderer's, w_i = alpha_i T_i, so that every pass lies exactly over the picture.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.lift.global_edit import outward_normals
from splatpainter.rendering.profiles import Profile
from splatpainter.splats import Splats

Aov = Literal["alpha", "depth", "normal", "gaussian-ids", "coverage"]


@dataclass(frozen=True)
class Passes:
    """One view of a splat asset; H, W: the camera's pixels."""

    colors: np.ndarray
    """[H, W, 3] float32 sum_i w_i c_i + (1 - alpha) background, in the asset's colour space."""
    alpha: np.ndarray
    """[H, W] float32 sum_i w_i, 0..1."""
    depth: np.ndarray
    """[H, W] float32 sum_i w_i z_i / alpha: distance along the viewing direction, world units; 0 where alpha is 0."""
    normal: np.ndarray | None = None
    """[H, W, 3] float32 sum_i w_i n_i, made unit length: outward normals in world axes; 0 where nothing is drawn."""
    gaussian_ids: np.ndarray | None = None
    """[H, W] int64 the row with the largest w_i; -1 where nothing is drawn."""
    coverage: np.ndarray | None = None
    """[H, W, 3] float32 parts of alpha: rows predicted and not seen, rows seen by edited views, rows as they were."""


def normals_of(splats: Splats) -> np.ndarray:
    """[N, 3] float32 outward unit normals; zeros for rows that cannot be drawn."""
    return outward_normals(splats) if splats.drawable.any() else np.zeros((len(splats), 3), np.float32)


def draw_passes(
    splats: Splats,
    camera: Camera,
    aovs: Collection[Aov] = (),
    *,
    profile: Profile = "inria",
    normals: np.ndarray | None = None,
    coverage: tuple[np.ndarray, np.ndarray] | None = None,
) -> Passes:
    """Draw colours, alpha, depth, and what `aovs` names besides.

    splats: numpy attributes. profile: as in `render`. normals: [N, 3] of `normals_of`, computed where they are
    wanted and not given (the same for all views of an asset). coverage: [N] bool rows predicted and [N] bool rows seen,
    both False for rows as they were. Raises ValueError as `render`, and for "coverage" without one."""
    from splatpainter.rendering import render
    from splatpainter.rendering.cpu.projected_view import project

    if "coverage" in aovs and coverage is None:
        raise ValueError("coverage: only a session knows which rows its edits saw; export the view from a session")
    drawn = render(splats, camera, profile=profile)
    colors, alpha, depth = drawn.colors[0], drawn.alphas[0, ..., 0], drawn.depths[0, ..., 0]
    if not {"normal", "gaussian-ids", "coverage"} & {*aovs}:
        return Passes(colors, alpha, depth)
    normal = gaussian_ids = parts = None
    frame = project(splats, replace(camera, background=(0.0, 0.0, 0.0)))

    def blend(values: np.ndarray) -> np.ndarray:
        """[H, W, 3] sum_i w_i v_i of values [N, 3]."""
        image, weight, distance = np.empty_like(colors), np.empty_like(alpha), np.empty_like(depth)
        frame.rasterize_into(image, weight, distance, values[frame.gaussian_ids].astype(colors.dtype), profile)
        return image

    if "normal" in aovs:
        summed = blend(normals_of(splats) if normals is None else normals)
        length = np.linalg.norm(summed, axis=-1, keepdims=True)
        normal = np.where(length > 1e-6, summed / np.maximum(length, 1e-6), 0).astype(np.float32)
    if "gaussian-ids" in aovs:
        gaussian_ids = frame.heaviest_gaussians(profile)
    if "coverage" in aovs and coverage is not None:
        predicted, seen = coverage
        parts = blend(np.stack([predicted, seen, ~(predicted | seen)], -1))
    return Passes(colors, alpha, depth, normal, gaussian_ids, parts)
