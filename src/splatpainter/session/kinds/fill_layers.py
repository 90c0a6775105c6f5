"""Layers that fill a hole: Gaussians that continue the surface over it, in colours of what surrounds it or of pictures.
Appends only.
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import Any, ClassVar, Literal

import numpy as np

from splatpainter.holes.fill import fill_hole, painted
from splatpainter.session.document.layer_operation import LayerOperation, LayerWork
from splatpainter.session.document.layer_view import Blend
from splatpainter.session.replay.delta import Delta, between
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.splats import Splats
from splatpainter.system.quick_dataclass import dataclass

FillWhere = Literal["removed", "around"]
SELECTED = 0.5
"""Weight from which a Gaussian counts as removed, or as lying around the hole."""


@dataclass(frozen=True)
class FillLayer(LayerOperation):
    """New Gaussians over a hole; pictures of its views, where there are some, colour them."""

    kind: ClassVar[str] = "fill"
    reshapes: ClassVar[bool] = True

    fill: FillWhere = "around"
    """What the selection is: what was removed (by a layer below), or what surrounds the hole."""
    selection: str = field(default="", metadata={"blob": True})
    """Hash of that selection (Selection.to_png)."""
    source: dict[str, Any] | None = None
    """Who made its pictures: what receipts say of a picture source."""

    @property
    def takes_views(self) -> bool:
        return True

    @property
    def needs_views(self) -> bool:
        return False

    @property
    def needs_masks(self) -> bool:
        return False

    def result(self, work: LayerWork) -> LayerResult:
        splats, chosen = work.splats, work.selected(self.selection) >= SELECTED
        removed = self.fill == "removed"
        # What was removed bounds the hole from within, what surrounds it from without.
        filled = fill_hole(splats, removed=chosen) if removed else fill_hole(splats, around=chosen)
        # Pictures colour only what this layer has appended, whatever else they show.
        pictured = [view for view in work.views if view.picture is not None]
        pictures = [(view.camera, work.edit(view).image, work.mask(view)) for view in pictured]
        appended = painted(splats, filled.appended, pictures) if filled.holes else filled.appended
        bare = replace(splats, source=None, origin=None)
        # Of no family: an eraser or a split of what is near is none of theirs.
        delta = between(bare, bare.append(appended))
        note = f"{int(chosen.sum()):,} Gaussians removed; " if removed else ""
        return LayerResult(delta, {"note": note + filled.note})

    def mix(
        self,
        below: Splats,
        delta: Delta,
        opacity: float,
        blend: Blend,
        strength: np.ndarray | None,
        mask: np.ndarray | None,
    ) -> Delta:
        # There is nothing below to mix with: its opacity is that of its Gaussians.
        return delta if opacity == 1 and mask is None else fading(delta, opacity, mask)


def fading(delta: Delta, opacity: float, mask: np.ndarray | None) -> Delta:
    """The delta at an opacity of 0..1: new Gaussians are as opaque. mask: [A] 0..1, a factor of it."""
    share = np.full(len(delta.appended), opacity) if mask is None else opacity * mask
    opacities = (delta.appended.opacities * share).astype(np.float32)
    return replace(delta, appended=replace(delta.appended, opacities=opacities))
