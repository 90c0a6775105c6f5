"""What a lift says of each Gaussian, in the numbers that a network reads. J Gaussians that the edit may change."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.array_types import Floats
from splatpainter.lift.edit_views import EditView
from splatpainter.lift.global_edit import GlobalLift
from splatpainter.rendering.cpu.projected_view import project, tiles_of_mask
from splatpainter.splats import SH_C0, Splats
from splatpainter.transforms import quat_to_matrix

LIFT_FEATURES = 13
"""Base colour before and after the lift (3 + 3), how much was seen (1), base colour that a global lift's regression
predicts (3), all 0..1; unit normal, outwards or towards the edited views (3)."""
SEEN_FEATURE = 6
"""Which of them says how much was seen."""
HALF_SEEN_PX = 2.0
"""Pixels of weight at which a Gaussian counts as half seen (as GlobalOptions.half_seen)."""


def no_features(ids: np.ndarray) -> np.ndarray:
    """[J, 13] zeros, for models that do not read them."""
    return np.zeros((len(ids), LIFT_FEATURES), np.float32)


def local_features(
    before: Splats, after: Splats, ids: np.ndarray, parents: np.ndarray, views: Sequence[EditView]
) -> np.ndarray:
    """[J, 13]: nothing is predicted, so that is the colour after; normals look at the mean position of the cameras.
    ids: [J] of `after`; parents: [J] of `before`."""
    new = _colors(after, ids)
    axes = quat_to_matrix(np.ascontiguousarray(after.quats[ids]))
    normals = axes[np.arange(len(ids)), :, after.scales[ids].argmin(1)]
    towards = np.mean([view.camera.position for view in views], axis=0) - after.means[ids]
    # An axis has no sign; the side towards the edited views is the one that they lit.
    normals = np.where((normals * towards).sum(1, keepdims=True) < 0, -normals, normals)
    parts = (_colors(before, parents), new, _seen(after, views)[ids, None], new, normals)
    return np.concatenate(parts, 1, dtype=np.float32)


def global_features(before: Splats, lift: GlobalLift, ids: np.ndarray) -> np.ndarray:
    """[J, 13]. before: the asset; ids: [J]."""
    colors = (_colors(before, ids), _colors(lift.splats, ids))
    rest = (lift.seen[ids, None], np.clip(lift.predicted[ids], 0, 1), lift.normals[ids])
    return np.concatenate([*colors, *rest], 1, dtype=np.float32)


def _seen(splats: Splats, views: Sequence[EditView]) -> Floats:
    """[N] float32 0..1: how much of each Gaussian the edited pixels show; HALF_SEEN_PX are a half."""
    weight = np.zeros(len(splats), np.float32)
    for view in views:
        projected = project(splats, view.camera, tiles=tiles_of_mask(view.mask))
        sums = projected.backproject(np.zeros_like(view.edited), view.mask.astype(np.float32))
        weight[projected.gaussian_ids] += sums.weight
    return weight / (weight + HALF_SEEN_PX)


def _colors(splats: Splats, ids: np.ndarray) -> np.ndarray:
    """[J, 3] base colours, within 0..1."""
    return np.clip(0.5 + SH_C0 * splats.sh[ids, 0], 0, 1)
