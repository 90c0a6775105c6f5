"""Layers that hide what is selected."""

from __future__ import annotations

from dataclasses import field, replace
from typing import ClassVar

import numpy as np

from splatpainter.session.document.layer_operation import Coverage, LayerOperation, LayerWork
from splatpainter.session.replay.delta import between
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class HideLayer(LayerOperation):
    """Opacities times 1 - weight of a selection, and 0 where that is all; the Gaussians stay."""

    kind: ClassVar[str] = "hide"
    reshapes: ClassVar[bool] = True
    covers: ClassVar[Coverage] = "as below"

    selection: str = field(default="", metadata={"blob": True})
    """Hash of what is hidden (Selection.to_png)."""

    def result(self, work: LayerWork) -> LayerResult:
        splats, weights = work.splats, work.selected(self.selection)
        faded = (splats.opacities * (1 - weights)).astype(np.float32)
        return LayerResult(between(splats, replace(splats, opacities=faded)))
