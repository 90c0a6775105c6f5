"""Colours with which one set of Gaussians looks as another one did: least squares over the views of a layer. Pure.

What a layer lays in place of old Gaussians (sheets, pieces) is finer than these, so no old Gaussian's colour is the
look of the place; a few colour rounds towards the old picture find it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatpainter.cameras import Camera
from splatpainter.session.replay.delta import Delta
from splatpainter.splats import Splats

LOOK_ROUNDS = 16
"""Colour rounds in each view."""


def fitted_sh(splats: Splats, editable: np.ndarray, pictures: Sequence[tuple[Camera, np.ndarray]]) -> np.ndarray:
    """[N, K, 3] SH of `splats` after rounds towards pictures ((camera, [H, W, 3] float32) of all that is in view), one
    after the other. editable: [N] bool, those that move; bands >= 1 stay."""
    from splatpainter.lift.colors import painted_sh
    from splatpainter.rendering.cpu.projected_view import project

    sh = splats.sh
    for camera, picture in pictures:
        # Only tiles that show what may move: the rest of the picture has nothing to fit.
        tiles = project(splats, camera, gaussian_mask=editable).tiles_of(editable)
        if tiles.any():
            view = project(replace(splats, sh=sh), camera, tiles=tiles)
            sh = painted_sh(sh, view, picture, editable[view.gaussian_ids], LOOK_ROUNDS, 1.0)
    return sh


def picture_of(splats: Splats, camera: Camera) -> np.ndarray:
    """[H, W, 3] float32."""
    from splatpainter.rendering.cpu.projected_view import project

    return project(splats, camera).rasterize()[0]


def moved_gaussians(before: Splats, after: Splats) -> np.ndarray:
    """[len(after)] bool: those whose mean, rotation or scales are others than before, and those that came."""
    n = len(before)
    out = np.ones(len(after), bool)
    out[:n] = False
    for name in ("means", "quats", "scales"):
        old, new = getattr(before, name), getattr(after, name)
        if old is not new:
            out[:n] |= (old.view(np.uint32) != new[:n].view(np.uint32)).any(1)
    return out


def base_of_parents(below: Splats, delta: Delta) -> np.ndarray:
    """[T + A, K, 3] SH of the Gaussians below that the changed and the appended ones were, or were made from (of none:
    their own)."""
    parents = delta.parent_ids
    tail = np.where((parents >= 0)[:, None, None], below.sh[np.maximum(parents, 0)], delta.appended.sh)
    return np.concatenate([below.sh[delta.gaussian_ids], tail])


def with_base(below: Splats, delta: Delta, cameras: Sequence[Camera]) -> Delta:
    """The delta with the SH from which its opacity and blend start: those below, and for Gaussians that moved or came
    the ones with which the cameras see what they saw before; as it is where none moved."""
    after = delta.apply(below)
    # Where nothing moved, colours below are those of the same index, and there is nothing to fit.
    moved = moved_gaussians(below, after)
    if not moved.any():
        return delta
    n, ids = len(below), delta.gaussian_ids
    start, base = after.sh.copy(), base_of_parents(below, delta)
    # From the parents' colours, which are near: the rounds then converge.
    start[ids], start[n:] = base[: len(ids)], base[len(ids) :]
    pictures = [(camera, picture_of(below, camera)) for camera in cameras]
    sh = fitted_sh(replace(after, sh=start), moved, pictures)
    return replace(delta, base=np.concatenate([sh[ids], sh[n:]]))
