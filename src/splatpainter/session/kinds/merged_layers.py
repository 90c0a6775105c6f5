"""Layers that other layers were merged into: they stay inside it, and do what they did."""

from __future__ import annotations

from typing import ClassVar

from splatpainter.session.document.layer_operation import LayerOperation
from splatpainter.system.quick_dataclass import dataclass


@dataclass(frozen=True)
class MergedLayer(LayerOperation):
    """What the layers inside do, with one opacity, blend and mask over all of it."""

    kind: ClassVar[str] = "merged"
    merges: ClassVar[bool] = True
