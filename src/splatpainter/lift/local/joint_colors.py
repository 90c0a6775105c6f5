"""Colours towards several pictures at once, which may change with the direction: SIRT over all of them together.

Knows which Gaussians may take new colours, and pictures with what their pixels count; not where these come from.
C Gaussians of a picture, B SH bands that change.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.kernels import portable
from splatpainter.kernels.library import kernels
from splatpainter.kernels.parallel import run
from splatpainter.lift.colors import MAX_COLOR, MIN_CHANGE, MIN_SEEN_PX
from splatpainter.lift.local.evidence import footprints
from splatpainter.lift.local.local_edit import NOTHING_THERE
from splatpainter.lift.options import LocalOptions
from splatpainter.rendering.cpu.projected_view import ProjectedView
from splatpainter.rendering.cpu.sirt import sirt_steps
from splatpainter.splats import SH_C0, Splats
from splatpainter.transforms import inverses, sh_basis

UNSEEN_DAMPING = 0.1
"""Pixels' worth of weight that each pixel's worth of a Gaussian that no edited view shows adds to the divisor of its
steps."""
MIN_DIVISOR = 1e-6
"""Pixels' worth of weight; keeps divisors above 0."""
DIRECTION_RIDGE = 1.0
"""Pixels' worth of weight that each pixel's worth that shows a Gaussian adds to the divisors of band 1."""


class TargetPicture:
    """One picture to reach, and what it weighs."""

    def __init__(self, view: ProjectedView, target: np.ndarray, use: np.ndarray, movable: np.ndarray) -> None:
        self.view = view
        ids = view.gaussian_ids
        here = movable[ids]
        self.ids = ids[here]
        """[C] of the Gaussians that may move, those that the view shows."""
        self.before = np.ascontiguousarray(view.unclamped_colors[here])
        """[C, 3]"""
        self.footprints = footprints(view)[here]
        self._steps = sirt_steps(view, target, use, here)
        self.weight = np.ascontiguousarray(self._steps.weight)
        """[C] pixels' worth of each in the picture."""

    @staticmethod
    def of(view: ProjectedView, target: Floats, use: Floats, movable: Bools) -> TargetPicture:
        """view: of all tiles; target: [H, W, 3] float32; use: [H, W] float32, what each pixel counts; movable: [N]
        bool."""
        return TargetPicture(view.part(tiles=view.tiles_of(movable)), target, use, movable)

    def basis(self, splats: Splats, degree: int) -> np.ndarray:
        """[C, B] SH basis in the directions of the lines of sight."""
        away = splats.means[self.ids] - self.view.camera.position.astype(np.float32)
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        return np.ascontiguousarray(sh_basis(away, degree), np.float32)

    def add_gain(self, basis: np.ndarray, change: np.ndarray, gain: np.ndarray) -> None:
        """Add sum_p w_ip m_p (target_p - image_p) y_i to `gain` [N, B, 3], with bands changed by `change` [N, B, 3].
        basis: [C, B] y."""
        colors = np.empty_like(self.before)
        run(kernels.change_colors, self.ids, basis, change, self.before, np.float32(MAX_COLOR), colors)
        run(kernels.add_residual, self.ids, basis, np.ascontiguousarray(self._steps.residual(colors)), gain)


def recolored_together(
    splats: Splats,
    pictures: Sequence[TargetPicture],
    around: Sequence[TargetPicture],
    options: LocalOptions,
    degree: int,
) -> np.ndarray:
    """[N, K, 3] SH after `options.rounds` towards all pictures at once, bands up to `degree` of them.

    SIRT, with the sum of w_ip y y^T over the pictures in place of the divisor, y [B] being the basis in a picture's
    direction: since a pixel's weights add up to at most 1, rounds still converge, and larger divisors slow them."""
    count, bands = len(splats), (degree + 1) ** 2
    visible, hidden, weight = (np.zeros(count, np.float32) for _ in range(3))
    varying = np.zeros((count, 3), np.float32)  # what bands >= 1 add in the edited views, by weight
    for picture in pictures:
        visible[picture.ids] += picture.weight
        hidden[picture.ids] += np.maximum(picture.footprints - picture.weight, 0)
        # Without direction the bands above 0 are averaged over the edited views, as `recolor` does for one.
        flat = 0.5 + SH_C0 * splats.sh[picture.ids, 0]
        varying[picture.ids] += picture.weight[:, None] * (picture.before - flat)
    if not (visible > 0).any():
        raise ValueError(NOTHING_THERE)
    # One small matrix a Gaussian: how its bands are told apart by the directions that see it.
    divisor = np.zeros((count, bands, bands), np.float32)
    every = [(picture, picture.basis(splats, degree)) for picture in (*pictures, *around)]
    for picture, basis in every:
        run(kernels.add_squares, picture.ids, basis, picture.weight, divisor)
        weight[picture.ids] += picture.weight
    # A larger divisor is a slower step: what the views do not show of a Gaussian holds it back.
    slow = UNSEEN_DAMPING * hidden
    divisor[:, 0, 0] += SH_C0**2 * np.maximum(slow, MIN_DIVISOR)
    for k in range(1, bands):
        divisor[:, k, k] += SH_C0**2 * np.maximum(DIRECTION_RIDGE * (weight + slow), MIN_DIVISOR)
    # Views around alone move nothing: only what an edited view shows may change.
    seen = np.flatnonzero(visible > MIN_SEEN_PX)
    steps = inverses(divisor[seen])
    change = np.zeros((count, bands, 3), np.float32)
    for _ in range(options.rounds):
        gain = np.zeros_like(change)
        for picture, basis in every:
            picture.add_gain(basis, change, gain)
        # Bounded after every round, as colours are in `lift_colors`, or bands of little weight run away.
        limit = MAX_COLOR / SH_C0
        change[seen] = np.clip(change.take(seen, 0) + portable.matmul(steps, gain.take(seen, 0)), -limit, limit)
    size = SH_C0 * np.abs(change).max((1, 2))
    moved = np.flatnonzero(size > MIN_CHANGE)
    if not len(moved):
        return splats.sh
    sh = splats.sh.copy()
    sh[moved, :bands] += change[moved]
    if degree == 0 and sh.shape[1] > 1:  # as in colors.recolor, with the mean over the views of what the bands add
        keep = (1 - (1 - options.damping) * np.clip(size[moved] / 0.3, 0, 1))[:, None]
        mean = varying[moved] / np.maximum(visible[moved], 1e-6)[:, None]
        sh[moved, 0] += (1 - keep) * mean / SH_C0
        sh[moved, 1:] *= keep[..., None]
    return sh
