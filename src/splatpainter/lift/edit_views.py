"""Edited pictures beside what the asset shows from the same cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import field
from typing import TYPE_CHECKING

import numpy as np

from splatpainter.array_types import Bools, Floats
from splatpainter.cameras import Camera
from splatpainter.lift.local.local_edit import NothingPaintableError, gaussians_in_mask
from splatpainter.rendering import render
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass
from splatpainter.voxels.grid import VoxelGrid

if TYPE_CHECKING:
    from splatpainter.rendering.cpu.projected_view import ProjectedView


@dataclass(frozen=True)
class EditView:
    """One edited picture with what the asset shows there now. `edit_views` makes them (of any sizes; the network wants
    one)."""

    camera: Camera
    edited: Floats = field(repr=False)
    """[H, W, 3] float32 the edited picture, 0..1."""
    mask: Bools = field(repr=False)
    """[H, W] bool pixels that were edited."""
    before: Floats = field(repr=False)
    """[H, W, 3] float32 render of the asset, in `tiles`."""
    depth: Floats | None = field(default=None, repr=False)
    """[H, W] float32 its expected z-depth, 0 where there is nothing; for models whose pictures hold "geometry"."""
    alpha: Floats | None = field(default=None, repr=False)
    """[H, W] float32 its alpha; likewise."""
    name: str = "edit"
    """What errors call it."""
    tiles: Bools | None = field(default=None, repr=False)
    """[TH, TW] bool: tiles of the view that were rendered, at least all under the mask; None: all of them. Analytic
    lifts ask for no others."""
    projected: ProjectedView | None = field(default=None, repr=False, compare=False)
    """The asset in at least these tiles, if at hand."""
    cover: Floats | None = field(default=None, repr=False)
    """[H, W] float32 as of `Edit`."""

    @property
    def target(self) -> np.ndarray:
        """[H, W, 3] the full picture to reach: the edited one inside the mask, the render outside."""
        return np.where(self.mask[..., None], self.edited, self.before)


def edit_views(
    splats: Splats, cameras: Sequence[Camera], pictures: Sequence[np.ndarray], masks: Sequence[np.ndarray]
) -> list[EditView]:
    """Edited pictures with the asset rendered from their cameras. splats: numpy or torch; pictures: [H, W, 3] float
    each; masks: [H, W] bool each."""
    splats, views = splats.numpy(), []
    for camera, picture, mask in zip(cameras, pictures, masks, strict=True):
        # What the asset shows now, from the same camera: changes are differences to this, not to the file the user
        # painted on.
        drawn = render(splats, camera)
        before = (drawn.colors[0], drawn.depths[0, ..., 0], drawn.alphas[0, ..., 0])
        views.append(EditView(camera, np.ascontiguousarray(picture, np.float32), np.asarray(mask, bool), *before))
    return views


def gaussians_in_views(splats: Splats, grid: VoxelGrid, views: Sequence[EditView]) -> Bools:
    """[N] bool Gaussians in voxels that edited pixels show, and that visibly contribute to these pixels, of any view.
    Raises ValueError, naming the view, for one without such Gaussians."""
    from splatpainter.voxels.raycast import editable_gaussians

    reached = np.zeros(len(splats), bool)
    for view in views:
        with errors_name(view.name):
            allowed = editable_gaussians(grid, splats, view.camera, view.mask)
            reached |= gaussians_in_mask(splats, view.camera, view.mask, allowed)
    return reached


@contextmanager
def errors_name(name: str) -> Iterator[None]:
    """Among several edits, the one that is wrong is named."""
    try:
        yield
    except ValueError as error:
        kind = NothingPaintableError if isinstance(error, NothingPaintableError) else ValueError
        raise kind(f"{name}: {str(error).removeprefix('edit: ')}") from None
