"""Layers that make what is selected unreadable from all sides (operations/pixelate.py). The project goes on holding
what was there: what is to be gone for good is what is exported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from splatpainter.color import from_hex
from splatpainter.operations.pixelate import Pixelate, pixelate
from splatpainter.operations.region import Region
from splatpainter.session.document.layer_operation import LayerOperation, LayerWork
from splatpainter.session.kinds.operation_layers import OperationLayer
from splatpainter.session.replay.delta import between, without_source
from splatpainter.session.replay.layer_result import LayerResult
from splatpainter.system import jsonio
from splatpainter.system.quick_dataclass import dataclass

EVERYTHING = ("opacity=0..1",)
"""Stands for the region where its options are judged: a layer has a selection in its place."""


@dataclass(frozen=True)
class PixelateLayer(OperationLayer):
    """Pixels or a blur over a selection, in whole cells."""

    operation: Pixelate = Pixelate()

    @classmethod
    def build(cls, kind: str, options: Mapping[str, Any], where: str) -> LayerOperation:
        # Judged as the command judges them: options mean the same in both.
        given = {name: value for name, value in options.items() if name != "selection"}
        operation = jsonio.build(Pixelate, given, where, what=f"the options of {kind}", defaults=True)
        try:
            replace(operation, where=EVERYTHING).check()
            return cls(operation, options.get("selection"))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None

    def result(self, work: LayerWork) -> LayerResult:
        weights = work.selected(self.selection or "")
        below = replace(without_source(work.splats), origin=np.arange(len(work.splats)))
        options = self.operation
        edited = pixelate(
            below,
            Region("selection", ((lambda _: weights,),)),
            size=options.size,
            style=options.style,
            color=from_hex(options.color) if options.color else None,
            margin=options.margin,
            merge=options.merge,
        )
        assert edited.receipt is not None
        return LayerResult(between(below, without_source(edited.splats)), {"note": edited.receipt.note})
