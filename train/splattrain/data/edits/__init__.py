"""Edits as an artist makes them, for training and for the benchmark: a kind, a view of a surface point, and what goes
there. content.py draws them, surface_points.py finds where, on_surfels.py and on_mesh.py put them on an object.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from splatpainter.cameras import Camera
from splattrain.data.edits.content import LAYER_MAKERS, Canvas, EditResources, Recoloring

MIN_EDIT_FRACTION, MAX_EDIT_FRACTION = 0.004, 0.5
"""Part of the edited view that an edit changes."""
MIN_CHANGE = 0.02
"""Of a colour channel, from which a pixel counts as changed."""
MIN_ON_OBJECT = 0.6
"""Part of a layer's coverage that lies on the object."""


@dataclass(frozen=True)
class EditDesign:
    """One edit, made in one view."""

    kind: str
    camera: Camera
    content: np.ndarray | Recoloring = field(repr=False)
    """[H, W, 4] float32 a layer over the view, display colours and coverage; or a recolouring."""

    @property
    def region(self) -> np.ndarray:
        """[H, W] bool: where it may lie in its view."""
        if isinstance(self.content, np.ndarray):
            return self.content[..., 3] > 0
        (center,), (depth,) = self.camera.project(self.content.position[None])
        y, x = np.mgrid[: self.camera.height, : self.camera.width] + 0.5
        radius = self.content.radius * self.camera.fx / max(depth - self.content.radius, 0.3 * depth)
        return (x - center[0]) ** 2 + (y - center[1]) ** 2 < radius**2


def layer_on_object(
    kind: str,
    canvas: Canvas,
    alpha: np.ndarray,
    resources: EditResources,
    rng: np.random.Generator,
    strictness: float = 1.0,
) -> np.ndarray | None:
    """[H, W, 4] a layer of a kind (key of LAYER_MAKERS), or None where less than strictness * MIN_ON_OBJECT of it would
    lie on the object. alpha: [H, W] of the canvas."""
    layer = LAYER_MAKERS[kind](canvas, resources, rng)
    on_object = float((layer[..., 3] * alpha).sum())
    return layer if on_object >= strictness * MIN_ON_OBJECT * float(layer[..., 3].sum()) else None


def change_masks(before: Tensor, after: Tensor, grow_px: int = 1, close_px: int = 0) -> Tensor:
    """[V, H, W] bool: pixels whose colours [V, H, W, 3] differ by more than MIN_CHANGE in a channel, and those within
    `grow_px` of them. Lone pixels do not count: of the nine around a core pixel three must differ. close_px: gaps up to
    about twice as wide are closed first (an edit like grain or sharpening leaves some pixels as they were)."""
    red, green, blue = (after - before).abs().unbind(-1)
    core = (torch.maximum(torch.maximum(red, green), blue) > MIN_CHANGE).to(before.dtype)[:, None]
    mask = core * (F.avg_pool2d(core, 3, 1, 1) > 2.5 / 9)
    if close_px:
        window = 2 * close_px + 1
        mask = 1 - F.max_pool2d(1 - F.max_pool2d(mask, window, 1, close_px), window, 1, close_px)
    return F.max_pool2d(mask, 2 * grow_px + 1, 1, grow_px)[:, 0] > 0.5
