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
from splatpainter.lift.whole import outward_normals
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


def draw_passes(
    splats: Splats,
    camera: Camera,
    aovs: Collection[Aov] = (),
    *,
    normals: np.ndarray | None = None,
    coverage: tuple[np.ndarray, np.ndarray] | None = None,
) -> Passes:
    """Draw colours, alpha, depth, and what `aovs` names besides.

    splats: numpy attributes. normals: [N, 3] of `outward_normals`, computed where they are wanted and not given (the
    same for all views of an asset). coverage: [N] bool rows predicted and [N] bool rows seen, both False for rows as
    they were. Raises ValueError: "coverage" without one."""
    from splatpainter.render.cpu.frame import project
    from splatpainter.render.cpu.heaviest import heaviest_rows

    if "coverage" in aovs and coverage is None:
        raise ValueError("coverage: only a session knows which rows its edits saw; export the view from a session")
    frame = project(splats, camera)
    colors, alpha, depth = frame.draw()
    frame = replace(frame, camera=replace(camera, background=(0.0, 0.0, 0.0)))
    normal = gaussian_ids = parts = None
    if "normal" in aovs:
        if normals is None:
            normals = outward_normals(splats) if splats.finite.any() else np.zeros_like(splats.means)
        summed, *_ = frame.draw(np.ascontiguousarray(normals[frame.rows], colors.dtype))
        length = np.linalg.norm(summed, axis=-1, keepdims=True)
        normal = np.where(length > 1e-6, summed / np.maximum(length, 1e-6), 0).astype(np.float32)
    if "gaussian-ids" in aovs:
        gaussian_ids = heaviest_rows(frame)
    if "coverage" in aovs and coverage is not None:
        predicted, seen = (rows[frame.rows] for rows in coverage)
        kinds = np.stack([predicted, seen, ~(predicted | seen)], -1)
        parts, *_ = frame.draw(kinds.astype(colors.dtype))
    return Passes(colors, alpha, depth, normal, gaussian_ids, parts)
