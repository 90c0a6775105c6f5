"""Erasers: what masks reach looks as it did before, in the original or below the layer that the stroke is in."""

from __future__ import annotations

from typing import ClassVar

from splatpainter.lift.masked_gaussians import reached_gaussians
from splatpainter.session.document.layer_operation import Coverage, LayerOperation, LayerWork
from splatpainter.session.replay.eraser import erase_delta, fade_delta
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class EraseLayer(LayerOperation):
    """Back to the original where the masks of its views reach; as a stroke, back to what is below its layer."""

    kind: ClassVar[str] = "erase"
    reads_below_layer: ClassVar[bool] = True
    covers: ClassVar[Coverage] = "original"

    @property
    def takes_views(self) -> bool:
        return True

    @property
    def is_stroke(self) -> bool:
        return True

    def variant(self, fades: bool) -> str:
        return " fade" if fades else ""  # it then moves nothing (eraser.fade_delta)

    def result(self, work: LayerWork) -> LayerResult:
        views = [(view.camera, work.mask(view)) for view in work.views]
        reached = reached_gaussians(work.splats, views)
        delta = fade_delta if work.fades else erase_delta
        return LayerResult(delta(work.splats, work.original, views, reached))
